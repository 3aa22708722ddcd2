"""Episodes by hand: what the tests of the environments share."""

import numpy as np


def sample_actions(env, steps, seed=0):
    """(steps, E, N, A) continuous or (steps, E, N) discrete actions."""
    rng = np.random.default_rng(seed)
    space = env.action_spaces[env.agents[0]]
    shape = (steps, env.num_envs, len(env.agents), *space.shape)
    return rng.integers(0, 5, shape) if not space.shape else rng.uniform(-1, 1, shape).astype(np.float32)


def roll(env, actions, seed=None):
    """Observations, rewards and metrics of one episode of all copies; seed None: from where it stands."""
    observations = [env.reset(seed)[0]] if seed is not None else []
    rewards, info = [], {}
    for step in actions:
        obs, reward, _, _, info = env.step(step)
        observations.append(obs)
        rewards.append(reward)
    return np.array(observations), np.array(rewards), info.get("episode_metrics", {})


def place(env, positions):
    """Put the bodies of copy 0 at rest."""
    env.reset(seed=0)
    env.world.position[0] = positions
    env.world.velocity[0] = 0.0


def glide(env, moves):
    """Step with velocities that move the agents by (N, 2) each, without touching anything before the move."""
    env.world.velocity[0, : len(moves)] = np.array(moves) / 0.1 / 0.75
    return env.step(np.zeros((1, len(moves), 5)))


def episode_metrics(info):
    return {name: float(value[0]) for name, value in info["episode_metrics"].items()}
