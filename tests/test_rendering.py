"""Pictures, films, and PettingZoo's own checks, whose warnings are errors here."""

import copy
import pickle
import sys
import time
import warnings
from functools import partial
from types import SimpleNamespace

import imageio.v2 as imageio
import numpy as np
import pygame
import pytest
from pettingzoo.test import max_cycles_test, parallel_seed_test, render_test
from pettingzoo.test.state_test import test_parallel_env as check_state
from pettingzoo.utils import parallel_to_aec
from PIL import Image

from rllib_maobs.envs import SCENARIOS, MAObsEnv, Recorder, make_scenario, make_vec, parallel_env
from rllib_maobs.envs.rendering import Renderer

IDS = sorted(SCENARIOS)
BACKGROUND, SOLID, FLASH = (250, 249, 246), (92, 98, 107), (230, 30, 30)


@pytest.fixture(autouse=True)
def headless(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


@pytest.fixture(params=IDS)
def scenario_id(request):
    return request.param


# PettingZoo's checks.


@pytest.fixture(params=[*IDS, "learned prey"])
def make_env(request):
    if request.param == "learned prey":
        return partial(parallel_env, "obstacle-predator-prey", prey="learned")
    return partial(parallel_env, request.param)


def test_pettingzoo_render_test(make_env, recwarn):
    render_test(lambda render_mode: parallel_to_aec(make_env(render_mode=render_mode, horizon=20)))
    assert not [str(w.message) for w in recwarn]


def test_pettingzoo_max_cycles_test(make_env, recwarn):
    def parallel(max_cycles):
        return make_env(horizon=max_cycles)

    max_cycles_test(
        SimpleNamespace(parallel_env=parallel, env=lambda max_cycles: parallel_to_aec(parallel(max_cycles)))
    )
    assert not [str(w.message) for w in recwarn]


def test_pettingzoo_seed_test(make_env, recwarn):
    parallel_seed_test(lambda: make_env(horizon=30))
    assert not [str(w.message) for w in recwarn]


@pytest.mark.parametrize("state", ["observations", "world"])
def test_pettingzoo_state_test(make_env, state):
    env = make_env(state=state)
    env.reset(seed=0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_state(env)
    # Positions and velocities have no bounds, as in PettingZoo's own MPE, which this check exempts by name.
    assert {str(w.message) for w in caught} <= {
        "Environment's minimum state space value is -infinity. This is probably too low.",
        "Environment's maximum state space value is infinity. This is probably too high",
    }
    assert env.state_space.contains(env.state())


# Pictures.


def colored(frame, color, tolerance=12):
    """(H, W) where a picture has a colour."""
    return (np.abs(frame.astype(int) - color) <= tolerance).all(axis=-1)


def test_pictures_of_every_scenario_change_and_repeat(scenario_id):
    films = []
    for _ in range(2):
        env = parallel_env(scenario_id, render_mode="rgb_array")
        env.reset(seed=0)
        film = [env.render()]
        for _ in range(5):
            env.step(env.heuristic())
            film.append(env.render())
        assert film[0].dtype == np.uint8 and max(film[0].shape) == 480 and film[0].shape[2] == 3
        assert not any(np.array_equal(film[0], frame) for frame in film[1:])
        films.append(film)
    np.testing.assert_array_equal(*films)


def test_camera_is_fixed_and_bodies_are_to_scale():
    env = parallel_env("spread-3a", render_mode="rgb_array", num_agents=1, num_obstacles=1, obstacle_radius=0.3)
    env.reset(seed=0)
    world = env._copy.env.world
    pixels_per_unit = 480 / 3.0
    for obstacle in ([0.0, 0.0], [0.5, 0.8]):
        world.position[0] = [[-1.0, -1.0], obstacle, [-1.0, 1.0]]
        mask = colored(env.render(), SOLID)
        assert mask.sum() == pytest.approx(np.pi * (0.3 * pixels_per_unit) ** 2, rel=0.02)
        rows, columns = np.nonzero(mask)
        assert columns.mean() == pytest.approx((obstacle[0] + 1.5) * pixels_per_unit, abs=1.0)
        assert rows.mean() == pytest.approx((1.5 - obstacle[1]) * pixels_per_unit, abs=1.0)


def test_walls_are_where_they_are():
    env = parallel_env("simple-tunnel", render_mode="rgb_array")
    env.reset(seed=0)
    frame = env.render()
    wall = colored(frame, SOLID)
    height, width = wall.shape
    scale = width / 3.0
    assert wall[height // 2].nonzero()[0].tolist() == [
        x for x in range(width) if not 0.1 * scale <= x + 0.5 <= 2.9 * scale
    ]
    room = colored(frame, BACKGROUND)[:, int(2.88 * scale)].nonzero()[0]
    assert room.min() == pytest.approx(0.1 * scale, abs=1) and room.max() == pytest.approx(height - 0.1 * scale, abs=1)


def flashes(env):
    return colored(env.render(), FLASH, tolerance=40).sum()


def test_contacts_flash_for_three_steps():
    env = parallel_env("spread-3a", render_mode="rgb_array", num_agents=2, num_obstacles=1)
    env.reset(seed=0)
    world, idle = env._copy.env.world, dict.fromkeys(env.agents, np.zeros(5, np.float32))
    world.position[0] = [[0.0, 0.0], [0.32, 0.0], [1.0, 1.0], [-1.0, -1.0], [-1.0, 1.0]]
    world.velocity[0, :2] = [[0.5, 0.0], [-0.5, 0.0]]
    assert flashes(env) == 0
    env.step(idle)
    both = flashes(env)
    assert both > 100
    world.position[0, :2], world.velocity[0] = [[-0.7, 0.0], [0.7, 0.0]], 0.0
    assert [bool((env.step(idle), flashes(env))[1]) for _ in range(3)] == [True, True, False]
    world.position[0, 0], world.velocity[0, 0] = (
        [1.0, 0.73],
        [0.0, 0.5],
    )  # an obstacle flashes too, and its upper half is above row 80
    env.step(idle)
    obstacle = colored(env.render()[:78], FLASH, tolerance=40)
    assert obstacle.sum() > 30
    env.reset(seed=0)
    assert flashes(env) == 0


def test_trails_and_velocity_marks():
    env = parallel_env("spread-3a", render_mode="rgb_array", num_agents=1, num_obstacles=0, action_mode="force")
    env.reset(seed=0)
    world = env._copy.env.world
    world.position[0] = [[-1.0, 0.0], [1.3, 1.3]]
    env.reset(seed=0)
    world.position[0] = [[-1.0, 0.0], [1.3, 1.3]]
    still = env.render()
    for _ in range(15):
        env.step({"agent_0": np.array([1.0, 0.0], np.float32)})
    moving = env.render()
    x = int((world.position[0, 0, 0] + 1.5) * 160)
    row = slice(238, 243)
    trail = ~colored(moving[row, x - 100 : x - 30], BACKGROUND, 8)
    assert trail.any(axis=0).all() and not (~colored(still[row, x - 100 : x - 30], BACKGROUND, 8)).any()
    mark = colored(moving[row, x + 26 : x + 31], (40, 42, 46), 60)
    assert mark.any(axis=0).all()


def test_walls_flash_those_who_touch_them():
    env = parallel_env("simple-tunnel", render_mode="rgb_array")
    env.reset(seed=0)
    env._copy.env.world.position[0, 0] = [-1.34, 0.3]
    assert flashes(env) == 0
    env.step(dict.fromkeys(env.agents, np.array([0, 0, 1, 0, 0], np.float32)))
    assert flashes(env) > 50


def test_trails_end_with_the_episode():
    env = parallel_env("tunnel", render_mode="rgb_array")  # always starts alike
    env.reset(seed=0)
    start = env.render()
    for _ in range(10):
        env.step(env.heuristic())
    env.reset()
    np.testing.assert_array_equal(env.render(), start)


def around(frame, env, body, radius):
    """The part of a picture within a radius (along x and y) of a body, its middle pixel, and pixels per unit."""
    renderer = env._copy._renderer
    x, y = env._copy.env.world.position[0, body]
    scale = renderer.width / (2 * renderer.half_width)
    row, column, size = (
        int((renderer.half_height - y) * scale),
        int((x + renderer.half_width) * scale),
        int(radius * scale),
    )
    part = frame[row - size : row + size + 1, column - size : column + size + 1]
    return part, part[size : size + 1, size : size + 1], scale


@pytest.mark.parametrize("goal_radius", [0.08, 0.12])
@pytest.mark.parametrize(
    ("scenario_id", "colors"),
    [("simple-tunnel", [(66, 114, 196), (222, 135, 46)]), ("tunnel", [(150, 156, 166), (150, 156, 166)])],
)
def test_targets_are_rings_to_scale_in_the_colour_of_their_owner(scenario_id, colors, goal_radius):
    env = parallel_env(scenario_id, render_mode="rgb_array", goal_radius=goal_radius)
    env.reset(seed=0)
    frame = env.render()
    for body, color in zip((5, 6), colors, strict=True):
        part, middle, scale = around(frame, env, body, 0.145)
        assert colored(middle, color).all()
        columns = np.nonzero(colored(part, color, 40).any(axis=0))[0]
        assert columns.max() - columns.min() == pytest.approx(2 * goal_radius * scale, abs=3)


def test_targets_are_seen_above_the_agents_that_cover_them():
    env = parallel_env("tunnel", render_mode="rgb_array")
    env.reset(seed=0)
    env._copy.env.world.position[0, 0] = env._copy.env.world.position[0, 5] + [0.03, 0.0]
    part, middle, _ = around(env.render(), env, 5, 0.035)
    assert colored(middle, (150, 156, 166)).all() and colored(part, BACKGROUND).sum() > 20


def test_the_prey_is_green_and_predators_differ():
    env = parallel_env("obstacle-predator-prey", render_mode="rgb_array")
    env.reset(seed=0)
    env._copy.env.world.position[0] = [[-1, 0], [0, 0], [1, 0], [0, 1], [1, 1], [-1, -1]]
    frame = env.render()
    for body, color in enumerate([(66, 114, 196), (222, 135, 46), (139, 95, 184), (56, 160, 74)]):
        assert colored(around(frame, env, body, 0.03)[0], color).sum() > 20


def test_agents_outside_are_seen_at_the_border():
    env = parallel_env("spread-3a", render_mode="rgb_array", num_agents=1, num_obstacles=0)
    env.reset(seed=0)
    env._copy.env.world.position[0] = [[7.0, 0.0], [0.0, 1.0]]
    blue = colored(env.render(), (66, 114, 196))
    assert blue.any() and np.nonzero(blue)[1].min() > 460


def test_rendering_changes_nothing():
    actions = None
    ends = []
    for mode in (None, "rgb_array", "human"):
        env = parallel_env("obstacle-predator-prey", render_mode=mode, horizon=6)
        env.reset(seed=3)
        actions = actions or [env.heuristic()] * 6
        for action in actions:
            obs, rewards, *_ = env.step(action)
            if mode:
                env.render()
        ends.append((obs, rewards))
        env.close()
    for obs, rewards in ends[1:]:
        np.testing.assert_equal(obs, ends[0][0])
        assert rewards == ends[0][1]


def test_human_mode_shows_every_step(monkeypatch):
    shown = []
    monkeypatch.setattr(Renderer, "show", lambda self, fps: shown.append((self._steps, fps)))
    for face in (parallel_env("tunnel", render_mode="human"), MAObsEnv({"scenario": "tunnel", "render_mode": "human"})):
        shown.clear()
        face.reset(seed=0)
        face.step(face.heuristic())
        assert face.render() is None
        assert shown == [(0, 10), (1, 10), (1, 10)]


def test_human_mode_runs_in_real_time_and_closes():
    env = parallel_env("tunnel", render_mode="human")
    env.reset(seed=0)
    start = time.perf_counter()
    for _ in range(4):
        env.step(env.heuristic())
    assert time.perf_counter() - start > 0.3
    again = pickle.loads(pickle.dumps(env))
    env.close()
    env.close()
    env.reset()  # the window opens again
    assert pygame.display.get_surface() is not None
    env.close()
    assert pygame.display.get_surface() is None
    again.step(again.heuristic())
    again.close()


def test_rllib_env_renders():
    env = MAObsEnv({"scenario": "tunnel", "render_mode": "rgb_array"})
    env.reset(seed=0)
    twin = parallel_env("tunnel", render_mode="rgb_array")
    twin.reset(seed=0)
    np.testing.assert_array_equal(env.render(), twin.render())
    np.testing.assert_array_equal(copy.deepcopy(env).render(), twin.render())


def test_illegal_rendering(monkeypatch):
    for make in (
        lambda m: parallel_env("tunnel", render_mode=m),
        lambda m: MAObsEnv({"scenario": "tunnel", "render_mode": m}),
    ):
        with pytest.raises(ValueError, match="render_mode='ansi' is illegal; legal: 'human', 'rgb_array' or None"):
            make("ansi")
        with pytest.raises(RuntimeError, match=r"render\(\) needs an environment made with render_mode="):
            make(None).render()
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(ImportError, match=r'pip install -c constraints.txt -e "\.\[render\]"'):
        parallel_env("tunnel", render_mode="rgb_array")
    parallel_env("tunnel").reset(seed=0)


# Films.


@pytest.mark.parametrize("name", ["film.gif", "deep/er/film.mp4"])
def test_films_show_every_picture(tmp_path, name):
    env = parallel_env("simple-tunnel", render_mode="rgb_array", horizon=12)
    with Recorder(tmp_path / name) as recorder:
        env.reset(seed=0)
        recorder.add(env.render())
        while env.agents:
            env.step(env.heuristic())
            recorder.add(last := env.render())
    path = tmp_path / name
    if path.suffix == ".gif":
        film = Image.open(path)
        assert film.n_frames == 13 and film.info["loop"] == 0
        film.seek(5)
        assert film.info["duration"] == 100
        film.seek(12)
        assert film.info["duration"] == 1000  # the end stays for a second
        end = np.asarray(film.convert("RGB"))
    else:
        reader = imageio.get_reader(path)
        assert reader.get_meta_data()["fps"] == 10
        frames = [frame for frame in reader]
        assert len(frames) == 13
        end = frames[-1]
    assert end.shape == last.shape
    assert np.abs(end.astype(int) - last).mean() < 3.0
    assert path.stat().st_size < 200_000


@pytest.mark.parametrize(("name", "writer"), [("film.gif", "PIL.Image"), ("film.mp4", "imageio_ffmpeg")])
def test_recorder_says_at_once_what_is_not_installed(monkeypatch, name, writer):
    monkeypatch.setitem(sys.modules, writer, None)
    with pytest.raises(ImportError, match=rf'recording needs {writer}: pip install .* "\.\[render\]"'):
        Recorder(name)


def test_recorder_errors(tmp_path):
    with pytest.raises(ValueError, match=r"cannot record to 'film\.avi'; legal are names that end in \.gif or \.mp4"):
        Recorder("film.avi")
    with pytest.raises(ValueError, match="no picture was added"):
        Recorder(tmp_path / "film.gif").close()
    recorder = Recorder(tmp_path / "film.gif")
    recorder.add(np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(ValueError, match=r"one size: \(4, 4, 3\) before, now \(4, 6, 3\)"):
        recorder.add(np.zeros((4, 6, 3), np.uint8))
    with pytest.raises(ValueError, match="render_mode="):
        recorder.add(None)
    with pytest.raises(KeyError), Recorder(tmp_path / "broken.gif") as recorder:
        recorder.add(np.zeros((4, 4, 3), np.uint8))
        raise KeyError
    assert not (tmp_path / "broken.gif").exists()


def test_vector_env_draws_by_hand(scenario_id):
    """A `Renderer` on copy 0 of a batch, as a training script may want it."""
    env = make_vec(scenario_id, num_envs=3)
    renderer = Renderer(make_scenario(scenario_id), env.world, size=100)
    env.reset(seed=0)
    renderer.begin()
    env.step(env.heuristic())
    renderer.note_step()
    assert max(renderer.frame().shape) == 100
