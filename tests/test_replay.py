"""Replay: alignment of agents and episodes, true final observations, eviction, memory, resume."""

from typing import Any

import numpy as np
import pytest
import torch

from rllib_maobs.replay import JointReplayBuffer

N, O, A, S, H = 3, 4, 2, 5, 6  # noqa: E741
G = 0.9


def drawn(buffer: JointReplayBuffer, shape: tuple[int, ...], **how: Any) -> dict[str, torch.Tensor]:
    """A sample as one dict; what there was n steps later has "next_" before its name, windows have T before N."""
    batch = buffer.sample(shape, **how)
    columns = {"actions": batch.actions, "rewards": batch.rewards, "discount": batch.discount}
    for prefix, moment in (("", batch.now), ("next_", batch.next)):
        columns |= {f"{prefix}{k}": v for k, v in moment._asdict().items() if isinstance(v, torch.Tensor)}
        if moment.window is not None:
            assert torch.equal(moment.obs, moment.window[..., -1, :])
            columns[f"{prefix}window"] = moment.window.transpose(-3, -2)
    return columns


def terminates(episode: Any) -> Any:
    """Which agents do at the end of an episode: all, none, or in every third one some; the others are truncated."""
    kind, own = episode[..., None] % 3, np.arange(N) == episode[..., None] // 3 % N
    return (kind == 0) | ((kind == 2) & own)


class Simulator:
    """E copies whose every number tells copy, episode, step and agent; episodes of copy e last 3 + e steps."""

    def __init__(self, copies: int, source: str = "r", length: int = 3) -> None:
        self.copies, self.source, self.length = copies, source, length
        self.episode = np.zeros(copies, dtype=int)
        self.t = np.zeros(copies, dtype=int)
        self.start = 0

    def obs(self) -> np.ndarray:
        code = np.arange(self.copies) * 10_000 + self.episode * 100 + self.t
        return (code[:, None, None] + np.arange(N)[:, None] / 10 + np.zeros(O)).astype(np.float32)

    def hidden(self) -> np.ndarray:
        """As the observations, with h apart from c."""
        return self.obs()[:, :, :1, None] + np.array([[0.01], [0.02]], dtype=np.float32) + np.zeros(H, dtype=np.float32)

    def fragment(self, steps: int, state: bool = False, hidden: bool = False) -> dict[str, Any]:
        rows: dict[str, list[np.ndarray]] = {k: [] for k in ("obs", "actions", "rewards", "terminated", "truncated")}
        finals, states, final_states, hiddens, final_hiddens = [], [], [], [], []
        start = self.start
        for _ in range(steps):
            obs = self.obs()
            rows["obs"].append(obs)
            states.append(np.repeat(obs[:, 0, :1], S, axis=1))
            hiddens.append(self.hidden())
            rows["actions"].append(obs[:, :, :1] + np.arange(A, dtype=np.float32) / 100)
            rows["rewards"].append(-obs[:, :, 0])
            self.t += 1
            over = self.t == self.length + np.arange(self.copies)
            rows["terminated"].append(over[:, None] & terminates(self.episode))
            rows["truncated"].append(over & (self.episode % 3 != 0))
            finals.append(self.obs()[over])
            final_states.append(np.repeat(self.obs()[over][:, 0, :1], S, axis=1))
            final_hiddens.append(self.hidden()[over])
            self.episode[over] += 1
            self.t[over] = 0
            self.start += 1
        columns: dict[str, Any] = {k: np.stack(v) for k, v in rows.items()}
        columns |= {"final_obs": np.concatenate(finals), "source": self.source, "start": start}
        if state:
            columns |= {"state": np.stack(states), "final_state": np.concatenate(final_states)}
        if hidden:
            columns |= {"recurrent_state": np.stack(hiddens), "final_recurrent_state": np.concatenate(final_hiddens)}
        return columns


def check(batch: dict[str, torch.Tensor], copies: int, length: int = 3) -> None:
    """Every sampled transition is one that the simulator made."""
    code = batch["obs"][:, 0, 0].round().long()
    copy, episode, t = code // 10_000, code // 100 % 100, code % 100
    agents = torch.arange(N) / 10
    torch.testing.assert_close(batch["obs"], (code[:, None, None] + agents[:, None]).expand(-1, N, O).float())
    # The next observation is the one a step later in the same episode: the true last one at its end.
    torch.testing.assert_close(batch["next_obs"], batch["obs"] + 1)
    torch.testing.assert_close(batch["actions"], batch["obs"][:, :, :1] + torch.arange(A) / 100)
    torch.testing.assert_close(batch["rewards"], -batch["obs"][:, :, 0])
    over = t + 1 == length + copy
    ended = over[:, None] & torch.from_numpy(terminates(episode.numpy()))
    assert torch.equal(batch["discount"], G * (~ended).float())
    assert copy.max() < copies


@pytest.mark.parametrize("fragment", [1, 2, 7])
@pytest.mark.parametrize("copies", [1, 4])
def test_transitions_never_mix_episodes_copies_or_agents(copies: int, fragment: int) -> None:
    buffer = JointReplayBuffer(10_000, N, O, A, seed=0)
    simulator = Simulator(copies)
    seen: set[int] = set()
    for _ in range(60 // fragment):
        buffer.add(**simulator.fragment(fragment))
    for _ in range(30):
        batch = drawn(buffer, (256,), gamma=G)
        check(batch, copies)
        seen |= set(batch["obs"][:, 0, 0].round().long().tolist())
    # All steps are drawn but the last ones, whose next observation is not there yet.
    steps = 60 // fragment * fragment * copies
    assert steps - copies <= len(seen) <= steps


def test_the_newest_step_waits_for_its_next_observation() -> None:
    buffer = JointReplayBuffer(100, N, O, A, seed=0)
    simulator = Simulator(1)
    buffer.add(**simulator.fragment(1))
    with pytest.raises(ValueError, match="no complete transition"):
        drawn(buffer, (4,), gamma=G)
    buffer.add(**simulator.fragment(1))
    assert set(drawn(buffer, (50,), gamma=G)["obs"][:, 0, 0].tolist()) == {0.0}


def test_an_empty_buffer_cannot_be_sampled() -> None:
    with pytest.raises(ValueError, match="no complete transition"):
        JointReplayBuffer(10, N, O, A).sample((4,), gamma=G)


@pytest.mark.parametrize("capacity", [23, 40, 64])
def test_old_rows_give_way_and_what_is_left_stays_true(capacity: int) -> None:
    buffer = JointReplayBuffer(capacity, N, O, A, seed=0)
    simulator = Simulator(3)
    written: list[float] = []
    for _ in range(100):
        fragment = simulator.fragment(2)
        buffer.add(**fragment)
        written += [*fragment["obs"][..., 0, 0].ravel().tolist(), *fragment["final_obs"][:, 0, 0].tolist()]
        if len(buffer) > 10:
            batch = drawn(buffer, (64,), gamma=G)
            check(batch, 3)
            assert set(batch["obs"][:, 0, 0].tolist()) <= set(written[-capacity:])
    assert len(buffer) == capacity


def test_what_follows_an_overwritten_step_is_no_episodes_start() -> None:
    """A runner that was slow: by the time it goes on, others have overwritten its last step."""
    buffer = JointReplayBuffer(20, N, O, A, seed=0)
    slow, fast = Simulator(1, "slow", length=50), Simulator(1, "fast", length=50)
    buffer.add(**slow.fragment(5))
    buffer.add(**fast.fragment(12))
    buffer.add(**fast.fragment(8))
    slow.episode += 1  # to tell them apart; it is the same episode
    buffer.add(**slow.fragment(8))
    batch = drawn(buffer, (500,), gamma=G, seq_length=3)
    code = batch["obs"][:, 0, 0].round().long()
    assert {105, 106} & {*code.tolist()} == set() and {107, 108} <= {*code.tolist()}
    assert (batch["mask"][code > 100] == 1).all()


def test_a_fragment_that_fills_the_ring_leaves_no_link_to_what_it_replaced() -> None:
    buffer = JointReplayBuffer(8, N, O, A, seed=0)
    simulator = Simulator(2, length=50)
    for _ in range(3):
        buffer.add(**simulator.fragment(4))
        check(drawn(buffer, (100,), gamma=G), 2, length=50)


def test_a_lost_fragment_is_not_bridged() -> None:
    """A gap in a runner's steps, and a new runner in an old one's place, leave no transition across it."""
    buffer = JointReplayBuffer(1000, N, O, A, seed=0)
    simulator = Simulator(2, length=50)
    buffer.add(**simulator.fragment(4))
    simulator.fragment(3)  # sampled but never arrived
    buffer.add(**simulator.fragment(4))
    restarted = Simulator(2, source="other", length=50)
    restarted.episode += 7
    buffer.add(**restarted.fragment(4))
    batch = drawn(buffer, (500,), gamma=G)
    check(batch, 2, length=50)
    assert {3, 10} & set((batch["obs"][:, 0, 0] % 10_000).long().tolist()) == set()


def test_two_runners_interleave() -> None:
    buffer = JointReplayBuffer(1000, N, O, A, seed=0)
    first, second = Simulator(2, source="1", length=9), Simulator(2, source="2", length=9)
    second.episode += 4
    for _ in range(10):
        buffer.add(**first.fragment(3))
        buffer.add(**second.fragment(3))
    check(drawn(buffer, (500,), gamma=G), 2, length=9)


@pytest.mark.parametrize("capacity", [50, 1000])
@pytest.mark.parametrize("fragment", [1, 2, 7])
@pytest.mark.parametrize("length", [1, 3, 6])
def test_windows_are_the_last_observations_of_the_same_episode(capacity: int, fragment: int, length: int) -> None:
    """They end at t and t + 1, are short at an episode's start, and whole whatever the ring has overwritten."""
    buffer = JointReplayBuffer(capacity, N, O, A, seed=0)
    simulator = Simulator(3, length=5)
    for _ in range(140 // fragment):
        buffer.add(**simulator.fragment(fragment))
    batch = drawn(buffer, (4, 64), gamma=G, seq_length=length)
    assert batch["window"].shape == batch["next_window"].shape == (4, 64, length, N, O)
    now = batch["window"][:, :, -1]
    torch.testing.assert_close(batch["next_window"][:, :, -1], now + 1)
    torch.testing.assert_close(batch["actions"], now[..., :1] + torch.arange(A) / 100)
    t = now[..., 0, 0].round().long() % 100
    for name, newest in (("", t), ("next_", t + 1)):
        ago = torch.arange(length).flip(0)
        counts = ago <= newest[..., None]
        assert torch.equal(batch[f"{name}mask"], counts.float())
        want = batch[f"{name}window"][:, :, -1:] - ago[:, None, None]
        torch.testing.assert_close(batch[f"{name}window"][counts], want[counts])
        assert batch[f"{name}window"].isfinite().all()


@pytest.mark.parametrize("fragment", [1, 5])
def test_windows_do_not_bridge_a_gap(fragment: int) -> None:
    buffer = JointReplayBuffer(1000, N, O, A, seed=0)
    simulator = Simulator(1, length=50)
    for _ in range(10 // fragment):
        buffer.add(**simulator.fragment(fragment))
    simulator.fragment(3)  # sampled but never arrived
    for _ in range(10 // fragment):
        buffer.add(**simulator.fragment(fragment))
    batch = drawn(buffer, (500,), gamma=G, seq_length=4)
    t = batch["window"][:, -1, 0, 0].round().long()
    since = torch.where(t < 13, t, t - 13)
    assert torch.equal(batch["mask"].sum(1).long(), (since + 1).clamp(max=4))


@pytest.mark.parametrize("fragment", [1, 7])
def test_returns_of_n_steps_end_with_the_episode(fragment: int) -> None:
    """Rewards of up to three steps, discounted; the next observation and its discount belong to the last of them."""
    buffer = JointReplayBuffer(1000, N, O, A, S, seed=0)
    simulator = Simulator(2, length=4)
    for _ in range(42 // fragment):
        buffer.add(**simulator.fragment(fragment, state=True))
    # What was never written (final observations have no reward) may be anything.
    rows = torch.from_numpy(buffer._next == -1)
    buffer._columns["rewards"][rows] = torch.nan
    batch = drawn(buffer, (500,), gamma=G, n_step=3, seq_length=2)
    code = batch["window"][:, -1, 0, 0].round().long()
    copy, episode, t = code // 10_000, code // 100 % 100, code % 100
    # At the newest end of the ring there may be fewer steps than three.
    steps = (batch["next_window"][:, -1, 0, 0] - batch["window"][:, -1, 0, 0]).round().long()
    left = 4 + copy - t
    newest = episode == torch.from_numpy(simulator.episode)[copy]
    assert torch.equal(steps[~newest], left.clamp(max=3)[~newest])
    assert (steps[newest] <= 3).all() and (steps >= 1).all()
    own = batch["window"][:, -1, :, 0]
    want = sum(-(own + k) * (G**k * (k < steps))[:, None] for k in range(3))
    torch.testing.assert_close(batch["rewards"], want, rtol=1e-5, atol=1e-2)
    over = (steps == left)[:, None] & torch.from_numpy(terminates(episode.numpy()))
    torch.testing.assert_close(batch["discount"], torch.where(over, 0.0, (G ** steps.float())[:, None]))
    torch.testing.assert_close(batch["next_state"][:, 0], batch["next_window"][:, -1, 0, 0])


def test_stored_states_go_with_their_observations() -> None:
    buffer = JointReplayBuffer(200, N, O, A, S, seed=0)
    simulator = Simulator(2)
    for _ in range(10):
        buffer.add(**simulator.fragment(3, state=True))
    batch = drawn(buffer, (8, 16), gamma=G)
    assert batch["state"].shape == (8, 16, S)
    assert torch.equal(batch["state"][..., 0], batch["obs"][..., 0, 0])
    assert torch.equal(batch["next_state"][..., 0], batch["next_obs"][..., 0, 0])


@pytest.mark.parametrize("n_step", [1, 3])
def test_stored_h_and_c_go_with_the_windows_newest_observations(n_step: int) -> None:
    """Each agent's own, those after the last step with the final observation, also when old rows give way."""
    buffer = JointReplayBuffer(40, N, O, A, recurrent_state=(2, H), seed=0)
    simulator = Simulator(2)
    for _ in range(20):
        buffer.add(**simulator.fragment(3, hidden=True))
        if len(buffer) < 10:
            continue
        batch = drawn(buffer, (8, 16), gamma=G, n_step=n_step, seq_length=2)
        for name in ("", "next_"):
            now = batch[f"{name}window"][:, :, -1, :, :1, None]
            want = (now + torch.tensor([[0.01], [0.02]])).expand(8, 16, N, 2, H)
            torch.testing.assert_close(batch[f"{name}recurrent_state"], want, rtol=0, atol=2e-3)
    with pytest.raises(ValueError, match="stores 'recurrent_state', but none was given"):
        buffer.add(**simulator.fragment(3))
    extra = JointReplayBuffer(500, N, O, A, recurrent_state=(2, H)).nbytes - JointReplayBuffer(500, N, O, A).nbytes
    assert extra == 500 * N * 2 * H * 4


def test_sampling_is_uniform() -> None:
    buffer = JointReplayBuffer(50, N, O, A, seed=0)
    buffer.add(**Simulator(1, length=40).fragment(41))
    counts = np.bincount(drawn(buffer, (40_000,), gamma=G)["obs"][:, 0, 0].long().numpy(), minlength=40)
    assert counts.size == 40
    assert np.abs(counts - 1000).max() < 5 * np.sqrt(1000)


def test_a_restored_buffer_goes_on_as_the_first() -> None:
    simulator = Simulator(2)
    buffer = JointReplayBuffer(64, N, O, A, recurrent_state=(2, H), seed=0)
    for _ in range(20):
        buffer.add(**simulator.fragment(3, hidden=True))
    restored = JointReplayBuffer(64, N, O, A, recurrent_state=(2, H), seed=99)
    restored.set_state(buffer.get_state())
    more = simulator.fragment(3, hidden=True)
    for b in (buffer, restored):
        b.add(**more)
    first, second = drawn(buffer, (100,), gamma=G), drawn(restored, (100,), gamma=G)
    assert all(torch.equal(first[k], second[k]) for k in first)
    with pytest.raises(ValueError, match="'capacity': 64"):
        JointReplayBuffer(65, N, O, A).set_state(buffer.get_state())
    with pytest.raises(ValueError, match=r"'recurrent_state': \(2, 6\).*'recurrent_state': None"):
        JointReplayBuffer(64, N, O, A).set_state(buffer.get_state())


def test_too_small_a_buffer_says_so() -> None:
    with pytest.raises(ValueError, match="raise replay_buffer_capacity"):
        JointReplayBuffer(5, N, O, A).add(**Simulator(2).fragment(3))


def test_half_a_million_joint_steps_of_nine_agents_fit() -> None:
    assert JointReplayBuffer(500_000, 9, 50, 5).nbytes <= 1.3e9
    assert JointReplayBuffer(500_000, 9, 50, 5, 66).nbytes <= 1.3e9


def test_the_teams_value_goes_on_until_all_agents_terminate() -> None:
    buffer = JointReplayBuffer(1000, N, O, A, seed=0)
    buffer.add(**Simulator(1).fragment(60))
    batch = buffer.sample((500,), gamma=G)
    ended = (batch.discount == 0.0).sum(1)
    assert set(ended.tolist()) == {0, 1, N}
    assert torch.equal(batch.team_discount, torch.where(ended == N, 0.0, G)[:, None])


def test_a_buffer_saved_with_one_flag_for_all_is_read() -> None:
    simulator = Simulator(2)
    buffer = JointReplayBuffer(64, N, O, A, seed=0)
    fragment = simulator.fragment(20)
    fragment["terminated"] = np.repeat(fragment["terminated"].all(-1, keepdims=True), N, axis=-1)
    buffer.add(**fragment)
    state = buffer.get_state()
    state["columns"]["terminated"] = state["columns"]["terminated"][:, :1].astype(np.float32)
    restored = JointReplayBuffer(64, N, O, A, seed=1)
    restored.set_state(state)
    first, second = drawn(buffer, (100,), gamma=G), drawn(restored, (100,), gamma=G)
    assert all(torch.equal(first[k], second[k]) for k in first) and 0 < (first["discount"] == 0).sum()


def test_who_terminated_takes_a_byte_for_each_agent() -> None:
    buffer = JointReplayBuffer(500, N, O, A)
    assert buffer._columns["terminated"].nbytes == 500 * N


def test_more_steps_than_an_episode_has_cost_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    buffer, simulator = JointReplayBuffer(400, N, O, A, seed=0), Simulator(2)
    for _ in range(20):
        buffer.add(**simulator.fragment(5))
    looks = []
    places = buffer._places
    monkeypatch.setattr(buffer, "_places", lambda rows: looks.append(1) or places(rows))
    state = buffer.get_state()
    want = buffer.sample((64,), gamma=G, n_step=10)
    few = len(looks)
    buffer.set_state(state)
    got = buffer.sample((64,), gamma=G, n_step=200)
    assert len(looks) == 2 * few
    assert torch.equal(got.rewards, want.rewards) and torch.equal(got.discount, want.discount)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0, N, O, A), "JointReplayBuffer: capacity=0 is illegal; legal: an integer >= 1"),
        ((10.0, N, O, A), "capacity=10.0 is illegal"),
        ((10, N, O, "2"), "action_size='2' is illegal"),
        ((10, N, O, A, -1), "state_size=-1 is illegal; legal: an integer >= 0"),
        (
            (10**12, N, O, A),
            r"rows takes 103,000.0 GB, 103 bytes for each .*, and there are .* GB: legal is a capacity up",
        ),
    ],
)
def test_what_a_buffer_cannot_be(arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        JointReplayBuffer(*arguments)


def test_columns_of_another_team_and_illegal_lengths_are_refused() -> None:
    """Arrays of as many numbers in another order would fit."""
    buffer, columns = JointReplayBuffer(400, N, O, A), Simulator(2).fragment(5)
    for wrong, message in (
        ({"obs": columns["obs"].swapaxes(2, 3)}, r"'obs' must be an array \(5, 2, 3, 4\), not \(5, 2, 4, 3\)"),
        ({"rewards": columns["rewards"][:, :1]}, r"'rewards' must be an array \(5, 2, 3\), not \(5, 1, 3\)"),
        ({"rewards": columns["rewards"].tolist()}, r"'rewards' must be an array"),
        ({"final_obs": columns["final_obs"][1:]}, r"'final_obs' must be an array \(2, 3, 4\), not \(1, 3, 4\)"),
        ({"terminated": columns["terminated"][..., 0]}, r"'terminated' must be an array \(5, 2, 3\), as 'truncated'"),
        ({"state": columns["obs"]}, "'state' was given, but this replay buffer stores none"),
    ):
        with pytest.raises(ValueError, match=message):
            JointReplayBuffer(400, N, O, A).add(**columns | wrong)
    buffer.add(**columns)
    for wrong in ({"n_step": 0}, {"seq_length": -1}):
        with pytest.raises(ValueError, match=r"n_step must be an integer >= 1, seq_length one >= 0 .*, not "):
            buffer.sample((4,), gamma=G, **wrong)
