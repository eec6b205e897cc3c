"""Episodes shown where a person sits: in a notebook and in a window, or recorded."""

import io
import math
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import gymnasium as gym
import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient
from PIL import Image

import lemniscate as lem
from lemniscate.report import playback


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    path = tmp_path_factory.mktemp("watch") / "run"
    return lem.train("ppo", "CartPole-v1", run=path, progress=False, total_steps=256, compile="off").policy


@pytest.mark.long
def test_a_notebook_shows_the_episode_while_it_is_played(tmp_path):
    """A real kernel runs the cells of a real notebook; every frame replaces the one before."""
    cell = textwrap.dedent(
        f"""
        import lemniscate as lem
        run = lem.train("ppo", "CartPole-v1", run={str(tmp_path / "run")!r}, progress=False, total_steps=2048, compile="off")
        lem.watch(run.policy, seed=1)
        """
    )
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell)])
    client = NotebookClient(notebook, timeout=120)
    updates = []
    heard = client.process_message

    def listen(message, *rest):
        if message["msg_type"] == "update_display_data":
            updates.append(message["content"]["data"]["image/jpeg"])
        return heard(message, *rest)

    client.process_message = listen
    client.execute()
    pictures = [output for output in notebook.cells[0].outputs if output.output_type == "display_data"]
    assert len(pictures) == 1
    assert len(set(updates)) > 5


def test_frames_are_sent_at_their_own_speed_but_no_faster_than_a_browser_takes(monkeypatch):
    class Place:
        def update(self, shown):
            sent.append(shown.data)

    def display(shown, display_id):
        assert display_id
        sent.append(shown.data)
        return Place()

    sent, now = [], [0.0]
    monkeypatch.setattr("IPython.display.display", display)
    monkeypatch.setattr(playback.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(playback.time, "sleep", lambda seconds: now.__setitem__(0, now[0] + seconds))
    frames = [np.full((8, 8, 3), shade, dtype=np.uint8) for shade in range(0, 200, 2)]
    playback.send_frames(frames, fps=50)
    shades = [int(np.asarray(Image.open(io.BytesIO(jpeg)))[0, 0, 0]) for jpeg in sent]
    assert shades == pytest.approx(range(0, 200, 4), abs=2)
    assert now[0] == pytest.approx(2.0, abs=0.05)


def test_a_terminal_is_no_notebook():
    assert not playback.in_notebook()


def test_a_window_is_opened_and_closed(policy, monkeypatch, capsys):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    opened, make = [], gym.make
    monkeypatch.setattr(gym, "make", lambda *spec, **kwargs: opened.append(make(*spec, **kwargs)) or opened[-1])
    scores = lem.watch(policy, seed=3, episodes=2, random=True)
    (env,) = (env for env in opened if env.render_mode)
    assert env.render_mode == "human"
    assert not env.unwrapped.isopen
    told = [f"Episode {i + 1}: return {n:.1f}, length {n}" for i, n in enumerate(scores.lengths)]
    assert capsys.readouterr().err.splitlines()[:2] == told


def test_without_a_display_it_is_said_at_once(policy, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(gym, "make", lambda *_, **__: pytest.fail("an environment was made"))
    with pytest.raises(lem.UserError, match="There is no display for a window; record a video instead: --video"):
        lem.watch(policy)


NOISE = """
import gymnasium as gym
gym.register("Loud-v0", entry_point="test_playback:Loud", max_episode_steps=5)
import lemniscate as lem
lem.watch(env="Loud-v0", random=True, video="video.gif")
"""


class Loud(gym.Env):
    """Draws with pygame, display and sound included, as Box2D's environments do."""

    observation_space = gym.spaces.Box(-1, 1, (1,))
    action_space = gym.spaces.Discrete(2)
    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012
    render_mode = "rgb_array"

    def __init__(self, render_mode=None):
        pass

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), 0.0, False, False, {}

    def render(self):
        import pygame

        pygame.init()
        pygame.display.set_mode((8, 8))
        return np.zeros((8, 8, 3), np.uint8)


@pytest.mark.long
def test_pygame_is_quiet_while_a_film_is_made(tmp_path):
    names = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER", "XDG_RUNTIME_DIR", "PYGAME_HIDE_SUPPORT_PROMPT")
    quiet = {name: value for name, value in os.environ.items() if name not in names}
    paths = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-W", "ignore", "-c", NOISE]
    done = subprocess.run(command, cwd=tmp_path, env=quiet | {"PYTHONPATH": paths}, capture_output=True, text=True)
    assert done.stderr.splitlines() == ["Episode 1: return 0.0, length 5", "Recorded in video.gif."]
    assert done.stdout == ""


def delays_of(file):
    """The milliseconds that each frame of an animated picture is shown; equal frames are merged into longer ones."""
    delays = []
    with Image.open(file) as video:
        for i in range(video.n_frames):
            video.seek(i)
            video.load()
            delays.append(video.info["duration"])
    return delays


def test_a_film_lasts_as_long_as_its_episodes(policy, tmp_path):
    scores = lem.watch(policy, seed=3, episodes=2, random=True, video=tmp_path / "video.gif")
    assert sum(delays_of(tmp_path / "video.gif")) == pytest.approx(1000 * (sum(scores.lengths) + 2) / 50)


@pytest.mark.parametrize("kind", ["gif", "webp"])
@pytest.mark.parametrize("fps", [20, 30, 60, 125])
def test_a_picture_keeps_the_time_with_delays_that_a_browser_shows(fps, kind, tmp_path):
    """Browsers take a delay of less than 2 hundredths of a second for 10."""
    file = tmp_path / f"video.{kind}"
    shades = np.random.default_rng(0).integers(0, 255, (2 * fps, 8, 8, 3), dtype=np.uint8)
    playback.save_frames(iter(shades), file, fps)
    delays = delays_of(file)
    assert sum(delays) == pytest.approx(2000, abs=30)
    assert min(delays) >= 20


def test_a_video_that_is_there_stays_until_another_one_is_whole(tmp_path):
    def broken():
        yield np.zeros((8, 8, 3), np.uint8)
        raise RuntimeError("the renderer")

    file = tmp_path / "video.gif"
    playback.save_frames([np.zeros((8, 8, 3), np.uint8)] * 3, file, 30)
    first = file.read_bytes()
    with pytest.raises(RuntimeError, match="the renderer"):
        playback.save_frames(broken(), file, 30)
    assert file.read_bytes() == first
    assert list(tmp_path.iterdir()) == [file]


def test_without_ffmpeg_the_extra_is_named_with_a_line_that_works(tmp_path, monkeypatch):
    monkeypatch.setattr("lemniscate.report.playback.is_installed", lambda package: False)
    with pytest.raises(lem.UserError, match=r"imageio_ffmpeg is not installed; .* pip install '\.\[video\]'"):
        playback.save_frames([], tmp_path / "video.mp4", 30)


@pytest.fixture
def unwritten(monkeypatch):
    """Videos are drawn, and not written: that takes time."""
    monkeypatch.setattr(playback, "save_frames", lambda frames, file, fps: [None for _ in frames])


def test_sampled_actions_come_from_the_seed_and_random_ones_are_another_policy(policy, unwritten):
    def lengths(**how):
        return lem.watch(policy, episodes=2, video="video.gif", **how).lengths

    sampled = lengths(deterministic=False, seed=4)
    assert lengths(deterministic=False, seed=4) == sampled
    others = [lengths(seed=4), lengths(random=True, seed=4), lengths(deterministic=False, seed=5)]
    assert sampled not in others
    assert lengths(random=True, seed=4) == others[1]


def test_what_is_watched_is_what_is_evaluated(policy, unwritten):
    how = {"env": "CartPole-v1", "episodes": 3, "seed": 7}
    evaluated = lem.evaluate(policy, **how, backend="gymnasium")
    assert lem.evaluate(policy, **how, video="video.gif").lengths == evaluated.lengths
    assert lem.watch(policy, **how, video="video.gif").returns == evaluated.returns


def test_an_episode_without_end_leaves_no_film(tmp_path, monkeypatch):
    monkeypatch.setattr("lemniscate.envs.vec_env.PATIENCE", 30)
    monkeypatch.setattr(playback, "PATIENCE", 30, raising=False)
    policy = lem.train("ppo", Loud, run=tmp_path / "run", progress=False, total_steps=64, num_envs=2, num_steps=16,
                       minibatch_size=32).policy  # fmt: skip
    for play in (lem.evaluate, lem.watch):
        with pytest.raises(lem.UserError, match=r"An episode of .*Loud has not ended after 30 steps"):
            play(policy, episodes=1, video=tmp_path / "video.gif")
    assert not (tmp_path / "video.gif").exists()


class Unshown(Loud):
    """Cannot be drawn, or is drawn as something else; counts how many are open."""

    open = 0

    def __init__(self, picture=None, render_mode=None):
        self.picture = picture
        type(self).open += 1

    def render(self):
        if self.picture is None:
            raise RuntimeError("no display")
        return self.picture

    def close(self):
        type(self).open -= 1


@pytest.mark.parametrize("picture", [None, [[0]]])
def test_an_environment_that_cannot_be_shown_is_closed(unwritten, picture):
    with pytest.raises(lem.UserError, match=r"cannot be shown here: no display|renders no pictures"):
        lem.watch(env=Unshown, random=True, video="video.gif", env_kwargs={"picture": picture})
    assert Unshown.open == 0


class Shown(Loud):
    """Three steps; pictures grow by `size` at each."""

    size, paid = 0, 1.0

    def reset(self, *, seed=None, options=None):
        self.t = 0
        return super().reset(seed=seed)

    def step(self, action):
        self.t += 1
        return np.zeros(1, np.float32), self.paid, self.t == 3, False, {}

    def render(self):
        return np.full((16 + self.size * self.t, 16, 3), 40 * self.t, np.uint8)


@pytest.mark.parametrize("ending", [".gif", ".webp"])
def test_pictures_that_change_their_size_are_no_film(ending, tmp_path):
    growing = type("Growing", (Shown,), {"size": 2})
    with pytest.raises(lem.UserError, match=r"after pictures of 16 × 16 render\(\) returns one of 16 × 18"):
        lem.watch(env=growing, random=True, video=tmp_path / f"video{ending}")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("fps", ["fast", math.nan, math.inf, -5, [30], 1e-6, None])
def test_a_film_has_a_usual_speed_where_the_environment_says_none(fps, tmp_path):
    odd = type("Odd", (Shown,), {"metadata": {"render_modes": ["rgb_array"], "render_fps": fps}})
    lem.watch(env=odd, random=True, video=tmp_path / "video.gif")
    with Image.open(tmp_path / "video.gif") as video:
        assert video.info["duration"] in (30, 40)


def test_a_reward_beyond_float32_is_not_watched(tmp_path):
    with pytest.raises(lem.NonFiniteError, match=r"is 1e\+300 in step 1 of an episode"):
        lem.watch(env=type("Rich", (Shown,), {"paid": 1e300}), random=True, video=tmp_path / "video.gif")


def test_a_function_is_a_policy(policy, unwritten, capsys):
    how = {"env": "CartPole-v1", "episodes": 3, "seed": 7}
    scores = lem.evaluate(policy, **how, backend="gymnasium")
    assert lem.evaluate(lambda obs: policy.act(obs), **how, backend="gymnasium") == scores
    assert lem.evaluate(lambda obs: policy.act(obs), **how, video="video.gif").returns == scores.returns
    assert lem.watch(lambda obs: int(obs[2] > 0), **how, video="video.gif").episodes == 3
    assert capsys.readouterr().err.count("Episode ") == 3


@pytest.mark.parametrize(
    ("function", "env", "said"),
    [
        (lambda obs: 0, None, "A policy of your own acts in an environment that is named with it"),
        (lambda: 0, "CartPole-v1", r"takes one observation; lambda\(\) does not"),
        (lambda obs: 7, "CartPole-v1", r"CartPole-v1 takes actions of Discrete\(2\), not 7"),
        (lambda obs: [0.0, 1.0], "Pendulum-v1", r"Pendulum-v1 takes actions of Box.*, not \[0.0, 1.0\]"),
        (lambda obs: [np.nan], "Pendulum-v1", r"Pendulum-v1 takes actions of Box.*, not \[nan\]"),
        (lambda obs: ["0.5"], "Pendulum-v1", r"Pendulum-v1 takes actions of Box.*, not \['0.5'\]"),
    ],
)
def test_a_function_that_cannot_act_is_refused_in_a_sentence(function, env, said):
    with pytest.raises(lem.UserError, match=said):
        lem.evaluate(function, env, episodes=1)


def test_a_reward_that_is_not_finite_is_no_score_of_a_function():
    rewards = iter((1.0, 2.0, math.nan))

    def scored(env):
        return gym.wrappers.TransformReward(env, lambda reward: next(rewards))

    def make():
        return scored(gym.make("CartPole-v1"))

    with pytest.raises(lem.NonFiniteError, match="The reward of environment 0 is nan in the step after 2"):
        lem.evaluate(lambda obs: int(obs[2] > 0), env=make, episodes=1)


def test_another_environment_must_fit(policy):
    with pytest.raises(lem.UserError, match="A policy for CartPole-v1 cannot act in Pendulum-v1"):
        lem.watch(policy, "Pendulum-v1", video="video.gif")
    with pytest.raises(lem.UserError, match="Watch what"):
        lem.watch(random=True)


BODY = """
<mujoco><worldbody><light pos="0 0 2"/><body><joint name="a" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 .5" size=".05"/></body></worldbody><actuator><motor joint="a"/></actuator></mujoco>
"""

ARM = f'''
import gymnasium as gym, mujoco, numpy as np

class Arm(gym.Env):
    metadata = {{"render_modes": ["rgb_array"], "render_fps": 30}}
    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, render_mode=None):
        self.render_mode, self.model = render_mode, mujoco.MjModel.from_xml_string("""{BODY}""")
        self.data, self.renderer = mujoco.MjData(self.model), None

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        return np.zeros(2, np.float32), {{}}

    def step(self, action):
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data)
        return np.r_[self.data.qpos, self.data.qvel].astype(np.float32), 0.0, False, self.data.time > 0.02, {{}}

    def render(self):
        self.renderer = self.renderer or mujoco.Renderer(self.model, 64, 64)
        self.renderer.update_scene(self.data)
        return self.renderer.render()
'''


def has_egl():
    code = "import os; os.environ['MUJOCO_GL'] = 'egl'; import mujoco; mujoco.GLContext(8, 8)"
    return subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0


@pytest.mark.long
def test_a_report_has_a_film_of_ones_own_model_without_a_display_or_says_why_not(tmp_path):
    """MuJoCo draws by EGL of itself; where MUJOCO_GL names what is not there, the sentence names that variable."""
    pytest.importorskip("mujoco")
    (tmp_path / "arm.py").write_text(ARM)
    shown = {"DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"}
    environment = {name: value for name, value in os.environ.items() if name not in shown}
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
    small = "--total-steps 64 --num-envs 2 --num-steps 32 --minibatch-size 32 --quiet --run"
    train = [sys.executable, "-m", "lemniscate", "train", "ppo", "--env", "arm:Arm", *small.split()]
    where = {"cwd": tmp_path, "capture_output": True, "text": True}
    done = subprocess.run([*train, "r", "--report"], env=environment, **where)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "r" / "videos" / "step-64.gif").exists() or "No video: arm:Arm cannot be shown" in done.stderr
    assert (tmp_path / "r" / "videos" / "step-64.gif").exists() == has_egl()
    watch = [sys.executable, "-m", "lemniscate", "watch", "r", "--video", "a.gif"]
    done = subprocess.run(watch, env={**environment, "MUJOCO_GL": "glfw"}, **where)
    assert done.returncode == 2
    assert "cannot be shown here" in done.stderr
    assert "MUJOCO_GL=egl" in done.stderr
