"""What several test files share."""

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import ray
import torch
from hypothesis import HealthCheck, settings

import rllib_maobs as maobs
from rllib_maobs.learner import JointLearner
from rllib_maobs.replay import Batch, Moment

torch.set_num_threads(1)

ALGORITHMS = sorted(maobs.ALGORITHMS)
FAULTS = "tests/faults/"
TALLY = "tally: "


def pytest_configure(config: pytest.Config) -> None:
    """`pytest -m faults` is the long form of tests/faults; every other run has a short one."""
    common: dict[str, Any] = {"deadline": None, "suppress_health_check": [*HealthCheck], "database": None}
    settings.register_profile("short", max_examples=25, derandomize=True, **common)
    settings.register_profile("long", max_examples=1000, **common)
    settings.load_profile("long" if is_long(config) else "short")


def is_long(config: pytest.Config) -> bool:
    """Whether `-m faults` was given."""
    return "faults" in (config.getoption("markexpr") or "").replace("not faults", "")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """All tests in tests/faults are of that kind."""
    for item in items:
        if item.nodeid.startswith(FAULTS):
            item.add_marker("faults")


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Print what the tests of faults have counted."""
    counts: Counter[str] = Counter()
    for report in (report for reports in terminalreporter.stats.values() for report in reports):
        if getattr(report, "when", "") == "teardown":
            counts.update({k.removeprefix(TALLY): v for k, v in report.user_properties if k.startswith(TALLY)})
    if counts:
        terminalreporter.section("faults")
        for name, count in sorted(counts.items()):
            terminalreporter.line(f"{count:>12,} {name}")


@pytest.fixture
def long(pytestconfig: pytest.Config) -> bool:
    """Whether this is the long form of the tests of faults."""
    return is_long(pytestconfig)


@pytest.fixture
def tally(record_property: Callable[[str, object], None]) -> Iterator[Counter[str]]:
    """Counts for the summary at the end of the run, by what is counted: `tally["kills survived"] += 1`."""
    counts: Counter[str] = Counter()
    yield counts
    for name, count in counts.items():
        record_property(TALLY + name, count)


@pytest.fixture(scope="session")
def ray_session() -> Iterator[None]:
    """One small local Ray for all tests of a process."""
    ray.init(num_cpus=2, include_dashboard=False)
    yield
    ray.shutdown()


def small_config(algorithm: str, **options: Any) -> maobs.JointConfig:
    """An algorithm on spread-3a, small enough to build in a second; options are the environment's.

    Actions are of the first kind that the algorithm takes.
    """
    config = maobs.ALGORITHMS[algorithm]()
    if config.supports.actions[0] == "discrete":
        options = {"action_mode": "discrete", **options}
    config.environment("maobs/spread-3a", env_config=options)
    config.env_runners(num_envs_per_env_runner=2)
    config.training(train_batch_size_per_learner=16, replay_buffer_capacity=5_000)
    if config.recurrent:
        config.training(seq_length=3)
    config.reporting(min_sample_timesteps_per_iteration=40)
    return config.debugging(seed=0)


def random_batch(config: maobs.JointConfig, size: int = 32, seed: int = 0) -> Batch:
    """Random joint transitions for a validated config, some of them terminal, as replay would give them."""
    generator = torch.Generator().manual_seed(seed)
    team = config.team
    n, o, a = len(team.agents), team.observation_size, team.action_size
    legal = torch.from_numpy(team.action_mask)
    present = torch.arange(o) < torch.tensor(team.observation_sizes)[:, None]  # (N, O)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=generator)

    if team.discrete:
        choice = normal(size, n, a).masked_fill(~legal, -torch.inf).argmax(-1)
        actions = torch.nn.functional.one_hot(choice, a).to(torch.get_default_dtype())
        noise = torch.rand((size, n, a), generator=generator)
    else:
        actions, noise = torch.tanh(normal(size, n, a)) * legal, normal(size, n, a)
    rewards = normal(size, 1).expand(-1, n).clone() if config.supports.team_reward else normal(size, n)
    goes_on = (normal(size, 1) < 0.5) & (normal(size, n) < 0.8)  # nobody, all, or some
    discount = config.gamma**config.n_step * goes_on.to(torch.get_default_dtype())

    def moment(name: str) -> Moment:
        obs = normal(size, n, o) * present
        window = mask = recurrent_state = state = None
        if config.recurrent:
            length = config.seq_length
            window = (normal(size, length, n, o) * present).transpose(1, 2)  # in memory as replay's
            obs = window[:, :, -1]
            # Windows of all lengths: what lies before the first observation is not empty, but does not count.
            count = torch.randint(1, length + 1, (size, 1), generator=generator)
            mask = (torch.arange(length) >= length - count).to(torch.get_default_dtype())
        if config.stored_state:
            recurrent_state = normal(size, n, 2, config.model_config.get("lstm_cell_size", 64))
        if config.critic_state == "world" and config.uses_state:
            state = normal(size, config.state_size)
        return Moment(obs, state, window, mask, recurrent_state, name)

    return Batch(moment("now"), moment("next"), actions, rewards, discount, noise)


def build_learner(config: maobs.JointConfig) -> JointLearner:
    """The learner of a config, with targets that differ from the online networks."""
    config.validate()
    spaces = dict(zip(config.module_ids, map(config.team.spaces, config.team.agents), strict=True))
    learner: JointLearner = config.learner_class(
        config=config, module_spec=config.get_multi_rl_module_spec(spaces=spaces)
    )
    learner.build()
    generator = torch.Generator().manual_seed(1)
    for mid in (*dict.fromkeys(config.module_ids), "mixer"):
        if mid in learner.module:
            for name, parameter in learner.module[mid].named_parameters():
                if name.startswith("target_"):
                    parameter.data.add_(0.01 * torch.randn(parameter.shape, generator=generator))
    return learner


@pytest.fixture
def make_learner(ray_session: None) -> Callable[[maobs.JointConfig], JointLearner]:
    """`build_learner`, with Ray started."""
    return build_learner
