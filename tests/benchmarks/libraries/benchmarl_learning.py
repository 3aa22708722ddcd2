"""BenchMARL's MADDPG with its own settings, trained on the PettingZoo face of a scenario."""

import tempfile
import time
from typing import Any

import torch
from benchmarl.algorithms import MaddpgConfig
from benchmarl.environments.pettingzoo.common import PettingZooClass
from benchmarl.experiment import Callback, Experiment, ExperimentConfig
from benchmarl.models import GnnConfig, MlpConfig, SequenceModelConfig
from tensordict import TensorDict
from torchrl.envs import EnvBase, PettingZooWrapper
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rllib_maobs.envs import parallel_env
from tests.benchmarks.libraries.learning import Options, learned
from tests.benchmarks.workers import Job


def network(model: str) -> Any:
    """Return a network as the library gives it: its MLP, or its layer of a graph over all agents before that."""
    mlp = MlpConfig.get_from_yaml()
    if model == "MLP":
        return mlp
    return SequenceModelConfig([GnnConfig.get_from_yaml(), mlp], intermediate_sizes=[mlp.num_cells[-1]])


PILOT = 2  # iterations that tell how long one takes


class Task(PettingZooClass):
    """A scenario."""

    def get_env_fun(self, *args: Any, **kwargs: Any) -> Any:
        return lambda: PettingZooWrapper(
            parallel_env(self.config["scenario"], **self.config["options"]), return_state=False
        )

    def supports_continuous_actions(self) -> bool:
        return True

    def supports_discrete_actions(self) -> bool:
        return False

    def has_state(self) -> bool:
        return False

    def has_render(self, env: EnvBase) -> bool:
        return False

    def max_steps(self, env: EnvBase) -> int:
        return self.config["options"]["horizon"]

    def info_spec(self, env: EnvBase) -> None:
        return None


class Clock(Callback):
    """Notes the process's own time at every iteration, and ends the training when it is over."""

    def __init__(self, seconds: float) -> None:
        super().__init__()
        self.end = time.process_time() + seconds
        self.times = list[float]()

    def on_batch_collected(self, batch: Any) -> None:
        self.times.append(time.process_time())
        if self.times[-1] >= self.end:
            raise TimeoutError


def prepare(model: str, seed: int, scenario: str, options: Options, evaluation: Options) -> Job:
    """Return how to train for so many seconds of the process's own time, and to play then."""
    torch.set_num_threads(1)
    task = Task("SCENARIO", {"scenario": scenario, "options": options})

    def experiment(iterations: int, folder: str, clock: Clock) -> Experiment:
        config = ExperimentConfig.get_from_yaml()
        config.max_n_frames = iterations * config.off_policy_collected_frames_per_batch
        config.evaluation, config.loggers, config.create_json, config.save_folder = False, [], False, folder
        networks = {"model_config": network(model), "critic_model_config": network(model)}
        maddpg = MaddpgConfig.get_from_yaml()
        return Experiment(task, maddpg, **networks, seed=seed, config=config, callbacks=[clock])

    def train_and_play(seconds: float, episodes: int) -> dict[str, Any]:
        with tempfile.TemporaryDirectory() as folder:
            pilot = Clock(float("inf"))
            experiment(PILOT, folder, pilot).run()
            # Exploration falls over a third of the frames, so it must be known how many there will be.
            each = (pilot.times[-1] - pilot.times[0]) / (PILOT - 1)
            clock = Clock(seconds)
            trained = experiment(max(2, int(seconds / each)), folder, clock)
            start = time.process_time()
            try:
                trained.run()
            except TimeoutError:
                pass
            spent = time.process_time() - start

        def act(observations: Any) -> Any:
            seen = TensorDict({"agent": {"observation": torch.from_numpy(observations)}}, observations.shape[:1])
            with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
                return trained.policy(seen)["agent", "action"].numpy()

        return learned(act, scenario, evaluation, episodes, trained.total_frames, spent)

    return Job(train_and_play)
