"""BenchMARL: its MADDPG's update; its experiment plays an environment of random numbers."""

import tempfile
from typing import Any

import torch
from benchmarl.algorithms import MaddpgConfig
from benchmarl.environments.common import TaskClass
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from tests.benchmarks.libraries import HIDDEN, ROWS, Shape, job
from tests.benchmarks.workers import Job


class RandomEnv(EnvBase):
    def __init__(self, shape: Shape) -> None:
        super().__init__()

        def of_agents(**specs: Any) -> Composite:
            return Composite(agents=Composite(specs, shape=(shape.agents,)))

        self.observation_spec = of_agents(observation=Unbounded((shape.agents, shape.observation)))
        self.action_spec = of_agents(action=Bounded(-1.0, 1.0, (shape.agents, shape.action)))
        self.reward_spec = of_agents(reward=Unbounded((shape.agents, 1)))
        self.done_spec = Composite(done=Unbounded((1,), dtype=torch.bool))

    def _reset(self, tensordict: Any, **kwargs: Any) -> Any:
        return self.observation_spec.rand().update({"done": torch.zeros(1, dtype=torch.bool)})

    def _step(self, tensordict: Any) -> Any:
        return self._reset(None).update(self.reward_spec.rand())

    def _set_seed(self, seed: int | None) -> None:
        pass


class RandomTask(TaskClass):
    def get_env_fun(self, *args: Any, **kwargs: Any) -> Any:
        return lambda: RandomEnv(self.config["shape"])

    def supports_continuous_actions(self) -> bool:
        return True

    def supports_discrete_actions(self) -> bool:
        return False

    def max_steps(self, env: Any) -> int:
        return 100

    def has_render(self, env: Any) -> bool:
        return False

    def group_map(self, env: Any) -> dict[str, list[str]]:
        return {"agents": [f"agent_{i}" for i in range(self.config["shape"].agents)]}

    def observation_spec(self, env: Any) -> Any:
        return env.observation_spec

    def action_spec(self, env: Any) -> Any:
        return env.full_action_spec

    def info_spec(self, env: Any) -> None:
        return None

    state_spec = action_mask_spec = info_spec

    @staticmethod
    def env_name() -> str:
        return "random"


def prepare(shape: Shape, fused: bool) -> Job:
    """Let an experiment fill its replay buffer; with the fused `Adam` or the default."""
    shape = Shape(*shape)
    config = ExperimentConfig.get_from_yaml()
    config.share_policy_params = False
    config.polyak_tau, config.clip_grad_val = 0.01, None
    config.adam_extra_kwargs = {"fused": True} if fused else {}
    config.off_policy_train_batch_size, config.off_policy_memory_size = shape.batch, ROWS
    # One iteration, which fills the replay buffer.
    config.max_n_frames = config.off_policy_collected_frames_per_batch = ROWS
    config.off_policy_n_optimizer_steps = 1
    config.evaluation, config.loggers, config.create_json = False, [], False
    algorithm = MaddpgConfig.get_from_yaml()
    algorithm.share_param_critic, algorithm.delay_value = False, True
    networks = [MlpConfig(num_cells=HIDDEN, layer_class=torch.nn.Linear, activation_class=torch.nn.ReLU) for _ in "ac"]
    with tempfile.TemporaryDirectory() as folder:
        config.save_folder = folder
        task = RandomTask("random", {"shape": shape})
        experiment = Experiment(task, algorithm, networks[0], seed=0, config=config, critic_model_config=networks[1])
        experiment.run()
    buffer = experiment.replay_buffers["agents"]
    assert len(buffer) == ROWS
    sample, same = buffer.sample, buffer.sample()

    def update() -> int:
        buffer.sample = same.copy
        experiment._optimizer_loop("agents")
        return 1

    def replay() -> int:
        buffer.sample = sample
        experiment._optimizer_loop("agents")
        return 1

    optimizers = experiment.optimizers["agents"]
    parameters = [
        sum(p.numel() for p in optimizers[loss].param_groups[0]["params"]) // shape.agents
        for loss in ("loss_actor", "loss_value")
    ]
    return job({"update": update, "replay": replay}, parameters)
