"""Runs: the same bits however they are interrupted, watched or logged."""

import json
import os
import re
import resource
import shutil
import signal
import threading
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch

import environments
import lemniscate as lem
import toy
from conftest import tiny_fields, tiny_off_policy
from forks import command
from helpers import long
from lemniscate.api import training
from lemniscate.api.callbacks import StopAt
from lemniscate.nn.normalizer import RewardScale
from lemniscate.report import playback
from lemniscate.run import checkpoint
from lemniscate.run.directory import Saver
from lemniscate.run.evaluate import EVALUATION
from lemniscate.run.metrics import read_metrics
from lemniscate.run.run import TRAINING
from lemniscate.run.seeding import derive
from lemniscate.run.signals import KINDS as SIGNALS
from lemniscate.system.files import read_json, write_json


class GradedVector(toy.Countdown):
    """Rewards are higher by a level, and zero at first."""

    level = 0.0

    def __init__(self, num_envs):
        super().__init__(num_envs, mode="DISABLED")

    def set_level(self, level):
        self.level = level

    def _reward(self, actions):
        return self.level * np.ones(self.num_envs)


OFF_POLICY = {
    # name: algorithm and fields; in Pendulum-v1, whose episodes are longer than the distance of checkpoints
    "ddpg": {"action_noise": "ou", "policy_delay": 2, "normalize_observations": True},
    "ddpg-pink": {"action_noise": "coloured", "update_every": 2, "num_updates": 3, "network": "simba"},
    "td3": {"network": "layer_norm", "noise_std": "0.3>0.1", "actor_learning_rate": "1e-3>0"},
    "sac": {"action_noise": "coloured"},
    "sac-bins": {"value_range": 5.0, "num_envs": 4},
}


ON_POLICY = {
    # name: algorithm and fields; in CartPole-v1, REPPO in Pendulum-v1
    "reinforce": {"scale_rewards": True, "critic_minibatch_size": 32},
    "reinforce-episodes": {"episodes": 1, "baseline": "mean", "returns": "episode"},
    "a2c": {"gae_lambda": 0.9, "entropy_coef": "0.1>0"},
    "trpo": {"final_critic_learning_rate": 0.1, "critic_minibatch_size": 32},
    "reppo": {"epochs": 2, "minibatch_size": 16},
    "pqn": {"epochs": 2, "minibatch_size": 16},
    "shac": {"backend": "own_simulator:Glide", "critic_minibatch_size": 16},
}


def train(path, env="Countdown-v0", **fields):
    if env in ON_POLICY:
        small = {"num_envs": 4, "num_steps": 8, "total_steps": 256, "hidden": (16,), "evaluate_episodes": 4}
        where = {"reppo": "Pendulum-v1", "shac": "Glide-v0"}.get(env, "CartPole-v1")
        return lem.train(env.split("-")[0], where, run=path, progress=False, **{**small, **ON_POLICY[env], **fields})
    if env in OFF_POLICY:
        fields = tiny_off_policy(**OFF_POLICY[env], **fields)
        return lem.train(env.split("-")[0], "Pendulum-v1", run=path, progress=False, **fields)
    return lem.train("ppo", env, run=path, progress=False, **tiny_fields(env, **fields))


def final_hashes(path: Path) -> dict[str, str]:
    """sha256 of every file of the last checkpoint."""
    last = checkpoint.list_steps(path / "checkpoints")[-1]
    return {"step": last, **json.loads((path / "checkpoints" / f"step-{last}" / "manifest.json").read_text())["files"]}


def history(path: Path) -> list[dict]:
    """The metrics, without what the wall clock decides."""
    return [{k: v for k, v in line.items() if not k.startswith("time/")} for line in read_metrics(path)]


def without_signals(path: Path) -> list[dict]:
    return [
        {k: v for k, v in line.items() if not k.startswith((*SIGNALS, "episode/terminated"))} for line in history(path)
    ]


@pytest.mark.parametrize(
    ("env", "total", "planned"), [("Countdown-v0", 256, 5), ("Pendulum-v1", 256, 1), ("Pendulum-v1", 7_200, 3)]
)
def test_unasked_there_are_five_checkpoints_or_as_many_as_leave_episodes_whole(tmp_path, env, total, planned):
    """Four copies of Pendulum, 200 steps an episode: one each 2,400 steps at most."""
    train(tmp_path / "r", env, total_steps=total, num_steps=64 if total > 256 else 8, keep_checkpoints=10)
    assert len(checkpoint.list_steps(tmp_path / "r" / "checkpoints")) == planned


def test_a_time_limit_that_episodes_hardly_reach_does_not_keep_a_run_without_checkpoints(tmp_path):
    """Four copies: one each 12,000 steps, where 27,000 steps of each are allowed."""
    limit = {"max_episode_steps": 27_000}
    train(
        tmp_path / "r",
        "CartPole-v1",
        env_kwargs=limit,
        backend="gymnasium",
        total_steps=24_000,
        num_steps=1_500,
        epochs=1,
        minibatch_size=6_000,
    )
    assert checkpoint.list_steps(tmp_path / "r" / "checkpoints") == [12_000, 24_000]


def test_what_follows_episodes_is_restarted_with_the_environments(tmp_path, monkeypatch):
    """At the start and at each planned checkpoint but the last, after which nothing is played."""
    told = []
    restart = RewardScale.on_restart
    monkeypatch.setattr(RewardScale, "on_restart", lambda self: told.append(int(self.count)) or restart(self))
    train(tmp_path / "run", "CartPole-v1", scale_rewards=True, total_steps=256, checkpoint_every=64)
    assert told == [0, 64, 128, 192]


@pytest.mark.parametrize(
    "env", ["CartPole-v1", *long("Countdown-v0", "Matching-v0", "Pendulum-v1", *OFF_POLICY, *ON_POLICY)]
)
def test_the_same_seed_gives_the_same_bits_and_another_seed_does_not(tmp_path, env):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        train(tmp_path / name, env, seed=seed)
    assert final_hashes(tmp_path / "a")["tensors.safetensors"] == final_hashes(tmp_path / "b")["tensors.safetensors"]
    assert history(tmp_path / "a") == history(tmp_path / "b")
    assert final_hashes(tmp_path / "a")["tensors.safetensors"] != final_hashes(tmp_path / "c")["tensors.safetensors"]


@pytest.mark.parametrize("env", ["CartPole-v1", "ddpg", "trpo"])
@pytest.mark.one_in(3)
def test_evaluation_changes_no_bit_of_training(tmp_path, env):
    train(tmp_path / "without", env)
    train(tmp_path / "with", env, evaluate_every=32)
    tensors = "tensors.safetensors"
    assert final_hashes(tmp_path / "without")[tensors] == final_hashes(tmp_path / "with")[tensors]
    assert sum("evaluation/return" in line for line in read_metrics(tmp_path / "with")) == 8
    losses = [
        [line["gradient_norm"] for line in read_metrics(tmp_path / n) if "gradient_norm" in line]
        for n in ("with", "without")
    ]
    assert losses[0] == losses[1]


@pytest.mark.parametrize("env", ["CartPole-v1", pytest.param("sac", marks=pytest.mark.long)])
@pytest.mark.long
def test_recordings_change_no_bit_of_training_and_survive_a_resume(tmp_path, env, monkeypatch):
    monkeypatch.setattr(training, "is_installed", lambda name: name != "imageio_ffmpeg")
    train(tmp_path / "without", env, checkpoint_every=64)
    path = tmp_path / "with"
    train(path, env, checkpoint_every=64, video_every=96)
    assert final_hashes(path)["tensors.safetensors"] == final_hashes(tmp_path / "without")["tensors.safetensors"]
    videos = {video.name: video.read_bytes() for video in (path / "videos").iterdir()}
    assert set(videos) == {"step-0.gif", "step-96.gif", "step-192.gif"}
    assert len(set(videos.values())) >= 2  # a policy that has not moved yet may do the same
    for step in checkpoint.list_steps(path / "checkpoints")[-2:]:  # back to step 128
        shutil.rmtree(path / "checkpoints" / f"step-{step}")
    (path / "videos" / "step-192.gif").unlink()
    lem.resume(path, progress=False)
    assert {video.name: video.read_bytes() for video in (path / "videos").iterdir()} == videos


def test_films_by_the_number_of_training_episodes(tmp_path, monkeypatch):
    monkeypatch.setattr(training, "is_installed", lambda name: name != "imageio_ffmpeg")
    path = tmp_path / "r"
    train(path, "CartPole-v1", video_every_episodes=3)
    lines = read_metrics(path)
    ended = np.cumsum([len(line.get("episode/returns", ())) for line in lines])
    due = [line["step"] for line, now, before in zip(lines, ended, [0, *ended], strict=False) if now // 3 > before // 3]
    assert 1 < len(due) < len(lines)
    assert {video.name for video in (path / "videos").iterdir()} == {f"step-{step}.gif" for step in (0, *due)}


def test_what_cannot_be_recorded_is_told_before_training(tmp_path):
    with pytest.raises(lem.UserError, match="Countdown-v0"):
        train(tmp_path / "r", video_every=64)
    assert not (tmp_path / "r").exists()


def test_what_can_no_longer_be_recorded_costs_no_step(tmp_path, monkeypatch, capsys):
    def full(*_args, **_):
        raise OSError("No space left on device")

    monkeypatch.setattr(playback, "save_frames", full)
    path = tmp_path / "r"
    train(path, "CartPole-v1", checkpoint_every=64, video_every=96)
    assert "No recording at step 96: No space left on device" in capsys.readouterr().err
    done = final_hashes(path)
    for step in checkpoint.list_steps(path / "checkpoints")[-2:]:  # back to step 128
        shutil.rmtree(path / "checkpoints" / f"step-{step}")

    def blind(*_args):
        raise lem.UserError("there is no display")

    monkeypatch.setattr(playback, "_rendered", blind)
    lem.resume(path, progress=False)  # where nobody can see, a run goes on all the same
    assert "No recording at step 192: there is no display" in capsys.readouterr().err
    assert final_hashes(path) == done


def test_two_seeds_of_neighbouring_runs_share_no_start():
    starts = {derive(seed, stream, step) for seed in range(50) for stream in range(2) for step in range(50)}
    assert len(starts) == 50 * 2 * 50


def test_training_and_evaluation_are_separate_and_differently_seeded():
    config = lem.config_for("ppo", "CartPole-v1", num_envs=4, evaluate_episodes=4)
    train_env, eval_env = lem.make_envs(config)
    assert train_env is not eval_env
    a = train_env.restart(derive(config.seed, TRAINING, 0))
    b = eval_env.restart(derive(config.seed, EVALUATION, 0))
    assert not torch.equal(a, b)
    before = train_env.obs.clone()
    eval_env.step(torch.zeros(4, dtype=torch.int64))
    assert torch.equal(train_env.obs, before)


@pytest.mark.parametrize("env", ["CartPole-v1", *OFF_POLICY, *ON_POLICY])
@pytest.mark.one_in(2)
def test_a_run_resumed_from_any_checkpoint_ends_in_the_same_bits(tmp_path, env):
    fields = {"checkpoint_every": 64, "keep_checkpoints": 10}
    train(tmp_path / "whole", env, **fields)
    for back in (1, 2, 3):
        path = shutil.copytree(tmp_path / "whole", tmp_path / f"back{back}")
        for step in checkpoint.list_steps(path / "checkpoints")[-back:]:
            (path / "checkpoints" / f"step-{step}" / "manifest.json").unlink()
        lem.resume(path, progress=False)
        assert final_hashes(path) == final_hashes(tmp_path / "whole")
        assert history(path) == history(tmp_path / "whole")


LONG_MEMORY = {"buffer_size": 1000, "final_learning_rate": 1.0}


@pytest.mark.parametrize("env", ["CartPole-v1", "sac", "ddpg"])
@pytest.mark.one_in(3)
def test_a_run_that_goes_on_beyond_its_end_is_the_longer_run(tmp_path, env):
    """Nothing here is annealed: so it makes no difference when the longer total was asked for. The buffer grows.

    Which lines have signals is a share of the run, so that a shorter one has them more often.
    """
    fields = {"checkpoint_every": 64, "keep_checkpoints": 20, **({} if env == "CartPole-v1" else LONG_MEMORY)}
    train(tmp_path / "whole", env, total_steps=512, **fields)
    path = train(tmp_path / "r", env, **fields).path
    (path / "final.json").write_text("{}")
    assert lem.resume(path, total_steps=512, progress=False).policy.step == 512
    assert not (path / "final.json").exists()
    assert final_hashes(path) == final_hashes(tmp_path / "whole")
    assert without_signals(path) == without_signals(tmp_path / "whole")


def test_what_falls_over_the_whole_run_is_said_where_it_is_extended(tmp_path, capsys):
    fields = {"num_envs": 2, "num_steps": 8, "minibatch_size": 8, "total_steps": 64, "hidden": (8,)}
    path = lem.train("pqn", "CartPole-v1", run=tmp_path / "r", progress=False, **fields).path
    lem.resume(path, total_steps=128)
    assert "from here on: final_learning_rate 0.0, final_epsilon 0.05." in capsys.readouterr().err


def test_a_run_that_goes_on_is_interrupted_like_any_other(tmp_path, capsys):
    """With annealing, and checkpoints by the length of the run: the first part keeps its own."""
    path = train(tmp_path / "r", desired_kl=None, clip="0.2>0.1", keep_checkpoints=20).path
    first = checkpoint.list_steps(path / "checkpoints")
    whole = shutil.copytree(path, tmp_path / "whole")
    lem.resume(whole, total_steps=544)
    said = "Over the new total of 544 steps from here on: clip 0.2>0.1, final_learning_rate 0.0."
    assert said in capsys.readouterr().err
    later = checkpoint.list_steps(whole / "checkpoints")
    assert later == [*first, 352, 448, 544]  # a fifth of the new total, in whole updates
    lines = {line["step"]: line["learning_rate"] for line in history(whole)}
    assert lines[256] == pytest.approx(3e-4 * (1 - 224 / 256))
    assert lines[288] == pytest.approx(3e-4 * (1 - 256 / 544))
    for back in (1, 2, 3):  # the last time, before a checkpoint beyond the first part
        interrupted = shutil.copytree(whole, tmp_path / f"back{back}")
        for step in later[-back:]:
            shutil.rmtree(interrupted / "checkpoints" / f"step-{step}")
        lem.resume(interrupted, progress=False)
        assert final_hashes(interrupted) == final_hashes(whole)
        assert history(interrupted) == history(whole)


def test_a_run_goes_on_to_a_step_above_the_one_where_it_stands(tmp_path, capsys):
    path = train(tmp_path / "r", checkpoint_every=64).path
    for steps in (256, 100):
        with pytest.raises(lem.UserError, match=rf"stands at step 256: total_steps must be above that, not {steps}\."):
            lem.resume(path, total_steps=steps)
    with pytest.raises(lem.UserError, match="total_steps must be a whole number"):
        lem.resume(path, total_steps="more")
    assert read_json(path / "config.json")["config"]["total_steps"] == 256
    shutil.rmtree(path / "checkpoints" / "step-256")
    assert lem.resume(path, total_steps=224.0, progress=False).policy.step == 224  # an unfinished one may end earlier
    from filelock import FileLock

    with FileLock(path / ".lock"), pytest.raises(lem.UserError, match="being trained by another process"):
        lem.resume(path, total_steps=512)


def test_the_best_checkpoint_is_kept_and_the_final_one_stays_the_policy_of_the_run(tmp_path, monkeypatch):
    scores = {32: 1.0, 64: 5.0, 96: 2.0, 128: 4.0, 160: 7.0, 192: 3.0, 224: 7.0, 256: 6.0, 288: 1.0}
    save = Saver.save_if_best
    monkeypatch.setattr(Saver, "save_if_best", lambda self, state, _: save(self, state, scores[state.step]))
    every = {"evaluate_every": 32, "checkpoint_every": 96, "keep_checkpoints": 1}
    fields = {**tiny_fields("CartPole-v1", keep_best=True, **every), "env": "CartPole-v1", "progress": False}
    whole = lem.train("ppo", run=tmp_path / "whole", **fields).path
    assert [lem.load(whole, checkpoint=which).step for which in ("best", 256, None)] == [160, 256, 256]
    assert lem.load(whole / "checkpoints" / "best").step == 160
    assert lem.load(lem.load(whole), checkpoint="best").step == 160
    with pytest.raises(lem.UserError, match="has no checkpoint 96; those at steps: 256; best is kept with keep_best"):
        lem.load(whole, checkpoint=96)
    with pytest.raises(lem.UserError, match="checkpoint must be a whole number at least 0 or best, not 'bst'"):
        lem.load(whole, checkpoint="bst")
    assert any("Whole checkpoints: 256; it is finished." in finding.sentence for finding in lem.check(whole))
    names = ("manifest.json", "state.json", "tensors.safetensors")
    expected = [(whole / "checkpoints" / "best" / name).read_bytes() for name in names]
    for stop in (128, 160, 224):  # before it; at it, beyond the checkpoint that is resumed; and after it
        path = tmp_path / str(stop)
        lem.train("ppo", run=path, callbacks=[StopAt(stop)], **fields)
        lem.resume(path, progress=False)
        assert [(path / "checkpoints" / "best" / name).read_bytes() for name in names] == expected
    path = tmp_path / "shorter"  # which never comes again to the step of the best
    lem.train("ppo", run=path, callbacks=[StopAt(160)], **fields)
    shutil.rmtree(path / "checkpoints" / "step-160")
    lem.resume(path, total_steps=128, progress=False)
    assert lem.load(path, checkpoint="best").step == 128
    tensors = whole / "checkpoints" / "best" / "tensors.safetensors"
    tensors.write_bytes(tensors.read_bytes()[:-1])
    with pytest.raises(lem.UserError, match=r"best/tensors\.safetensors is damaged"):
        lem.load(whole, checkpoint="best")
    assert lem.resume(whole, total_steps=288, progress=False).policy.step == 288


LEVELS = {
    # environment and backend: each environment, each in a process of its own, a vector that is one by itself
    "each": (environments.Graded, "gymnasium"),
    "processes": (environments.Graded, "gymnasium-async"),
    "vector": (GradedVector, "gymnasium"),
}


@pytest.mark.parametrize("kind", ["each", "vector", *long("processes")])
def test_a_curriculum_is_the_same_after_a_resume_and_is_for_training_alone(tmp_path, kind):
    env, backend = LEVELS[kind]
    own = {"env": env, "backend": backend, "curriculum": environments.harder, "progress": False}
    fields = tiny_fields("CartPole-v1", checkpoint_every=64, keep_checkpoints=10, evaluate_every=64, shards=2)
    whole = lem.train("ppo", run=tmp_path / "whole", **{**fields, **own}).path
    lines = history(whole)
    returns = [line["episode/return"] for line in lines if "episode/return" in line]
    assert returns[0] < returns[-1]
    assert all(line["evaluation/return"] == 0 for line in lines if "evaluation/return" in line)
    calls = [read_json(file)["record"]["calls"] for file in (whole / "checkpoints").glob("*/state.json")]
    assert len({call["set_level"] for call in calls}) == len(calls)
    for back in (1, 3, 4):
        path = shutil.copytree(whole, tmp_path / f"back{back}")
        for step in checkpoint.list_steps(path / "checkpoints")[-back:]:
            shutil.rmtree(path / "checkpoints" / f"step-{step}")
        lem.resume(path, progress=False)
        assert final_hashes(path) == final_hashes(whole)
        assert history(path) == lines


@pytest.mark.parametrize(
    ("curriculum", "backend", "said"),
    [
        (lambda step, metrics: 3, "gymnasium", "must return a dictionary of methods .* at step 0 it returned 3"),
        (lambda step, metrics: None, "gymnasium", "must return a dictionary of methods .* at step 0 it returned None"),
        (lambda step, metrics: {"set_level": object()}, "gymnasium", "that JSON can hold"),
        (lambda step, metrics: {"set_level": -1}, "gymnasium", r"Graded.set_level\(-1\), which .* ValueError: no such"),
        (lambda step, metrics: {"set_levl": 1}, "gymnasium", "There is no method Graded.set_levl"),
        (lambda step, metrics: {"set_levl": 1}, "gymnasium-async", "There is no method Graded.set_levl"),
        (lambda step, metrics: metrics["x"], "gymnasium", "The curriculum raised KeyError at step 0: 'x'"),
        (lambda step: {}, "gymnasium", r"A curriculum must be a function of \(step, metrics\), not lambda\(step\)"),
        ("environments:nothing", "gymnasium", "environments has no nothing"),
        (lambda step, metrics: {}, "envpool", "EnvpoolBackend calls no methods of its environments"),
    ],
)
def test_a_curriculum_that_cannot_be_followed_is_told_before_a_run_begins(tmp_path, curriculum, backend, said):
    env = "CartPole-v1" if backend == "envpool" else environments.Graded
    given = {**tiny_fields("CartPole-v1", num_envs=2), "env": env, "backend": backend, "curriculum": curriculum}
    with pytest.raises(lem.UserError, match=said):
        lem.train("ppo", run=tmp_path / "r", progress=False, **given)
    assert not (tmp_path / "r").exists()


class Narrow(environments.Graded):
    """Other spaces than when the run began: one number to see, or one choice more."""

    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def _see(self):
        return super()._see()[:1]


class Wide(environments.Graded):
    action_space = gym.spaces.Discrete(3)


@pytest.mark.parametrize(("now", "space"), [(Narrow, "observation"), (Wide, "action")])
def test_a_run_does_not_go_on_in_other_spaces(tmp_path, monkeypatch, now, space):
    """Before anything is restored or removed, so that the run goes on once the environment is what it was."""
    monkeypatch.setattr(environments, "Later", type("Later", (environments.Graded,), {}), raising=False)
    fields = tiny_fields("CartPole-v1", checkpoint_every=64, keep_checkpoints=10)
    path = lem.train("ppo", "environments:Later", run=tmp_path / "r", progress=False, **fields).path
    shutil.rmtree(path / "checkpoints" / "step-256")
    before = {file: file.read_bytes() for file in (path / "checkpoints").rglob("*") if file.is_file()}
    monkeypatch.setattr(environments, "Later", now)
    with pytest.raises(
        lem.UserError, match=f"r was trained with another {space} space than environments:Later has now"
    ):
        lem.resume(path, progress=False)
    assert {file: file.read_bytes() for file in (path / "checkpoints").rglob("*") if file.is_file()} == before


class Drawn(environments.Graded):
    """It is made of a file."""

    def __init__(self, file=None, text=None, **kwargs):
        super().__init__(**kwargs)


def test_a_file_that_the_environment_is_made_of_and_that_has_changed_is_named(tmp_path, capsys):
    file = tmp_path / "track.toml"
    file.write_text("one")
    kwargs = {"file": str(file), "text": "name = 1\n" * 1000}
    fields = tiny_fields("CartPole-v1", checkpoint_every=64, keep_checkpoints=10)
    path = lem.train("ppo", Drawn, run=tmp_path / "r", progress=False, **fields | {"env_kwargs": kwargs}).path
    for content, told in (("one", False), ("two", True)):
        shutil.rmtree(path / "checkpoints" / "step-256")
        file.write_text(content)
        assert lem.resume(path, progress=False).policy.step == 256
        said = f"{file} has changed since step 192: the environment is another one from here on."
        assert (said in capsys.readouterr().err) == told


def test_a_damaged_checkpoint_is_named_and_the_one_before_is_taken(tmp_path, capsys):
    fields = {"checkpoint_every": 64, "keep_checkpoints": 10}
    train(tmp_path / "r", "CartPole-v1", **fields)
    expected = final_hashes(tmp_path / "r")
    newest = tmp_path / "r" / "checkpoints" / "step-256" / "tensors.safetensors"
    data = bytearray(newest.read_bytes())
    data[len(data) // 2] ^= 1
    newest.write_bytes(data)
    assert lem.load(tmp_path / "r").step == 192
    assert "step-256/tensors.safetensors is damaged: its sha256 differs" in capsys.readouterr().err
    lem.resume(tmp_path / "r", progress=False)
    assert final_hashes(tmp_path / "r") == expected


def test_a_nan_in_training_stops_it_and_spares_the_checkpoint(tmp_path, monkeypatch):
    class Breaks(toy.Countdown):
        count = 0

        def step(self, actions):
            obs, reward, *rest = super().step(actions)
            Breaks.count += 1
            if Breaks.count == 30:
                reward[2] = np.inf
            return obs, reward, *rest

    monkeypatch.setattr(toy, "Countdown", Breaks)
    with pytest.raises(lem.NonFiniteError, match="reward of environment 2 is inf in the step after 1"):
        train(tmp_path / "r", checkpoint_every=64)
    policy = lem.load(tmp_path / "r")
    assert policy.step == 64
    assert all(torch.isfinite(t).all() for t in policy.module.state_dict().values())


def test_a_loss_that_is_not_finite_stops_training(tmp_path, monkeypatch):
    from lemniscate.algos import ppo

    monkeypatch.setattr(ppo, "value_loss", lambda value, *_: value.mean() * float("nan"))
    with pytest.raises(lem.NonFiniteError, match=r"losses/\w+ is nan in the update that ends at step 32"):
        train(tmp_path / "r")


@contextmanager
def largest_file(size):
    """Beyond `size` bytes of a file, the system refuses to write, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)


def test_a_full_disk_costs_a_checkpoint_and_not_the_run(tmp_path, capsys):
    with ExitStack() as full:

        def fill(step, *_):
            if step == 96:
                full.enter_context(largest_file(500))
            if step == 160:
                full.close()

        fields = {**tiny_fields(), "checkpoint_every": 64}
        path = lem.train("ppo", "Countdown-v0", run=tmp_path / "r", callbacks=[fill], progress=False, **fields).path
    said = capsys.readouterr().err
    assert len(re.findall(r"The checkpoint at step \d+ could not be written: .*File too large", said)) == 1
    assert checkpoint.list_steps(path / "checkpoints")[-1] == 256
    assert [line["step"] for line in read_metrics(path)] == list(range(32, 257, 32))
    assert not list(path.rglob("*.tmp"))


def test_a_run_directory_that_is_moved_while_it_trains_does_not_begin_anew_beside_itself(tmp_path):
    def move(step, *_):
        if step == 96:
            (tmp_path / "r").rename(tmp_path / "moved")

    fields = {**tiny_fields(), "checkpoint_every": 64}
    with pytest.raises(lem.NotStoredError, match=r"is not stored: .*the run directory is gone"):
        lem.train("ppo", "Countdown-v0", run=tmp_path / "r", callbacks=[move], progress=False, **fields)
    assert not (tmp_path / "r").exists()
    assert checkpoint.list_steps(tmp_path / "moved" / "checkpoints") == [64]


def test_a_policy_that_the_disk_refuses_is_not_lost_and_no_success(tmp_path, capsys):
    train(tmp_path / "whole")
    with ExitStack() as full:

        def fill(step, *_):
            if step == 192:
                full.enter_context(largest_file(500))

        with pytest.raises(lem.NotStoredError, match=r"is not stored: .*resumes at step \d+") as refused:
            lem.train("ppo", "Countdown-v0", run=tmp_path / "r", callbacks=[fill], progress=False, **tiny_fields())
    policy = refused.value.run.policy
    whole = lem.load(tmp_path / "whole")
    assert all(
        torch.equal(a, b) for a, b in zip(policy.networks.parameters(), whole.networks.parameters(), strict=True)
    )
    lem.resume(tmp_path / "r", progress=False)
    assert final_hashes(tmp_path / "r") == final_hashes(tmp_path / "whole")


def test_two_processes_do_not_share_a_directory(tmp_path):
    from filelock import FileLock

    lem.train("ppo", "Countdown-v0", run=tmp_path / "r", progress=False, callbacks=[lambda *_: True], **tiny_fields())
    with FileLock(tmp_path / "r" / ".lock"), pytest.raises(lem.UserError, match="being trained by another process"):
        lem.resume(tmp_path / "r", progress=False)


def words_for(name, value):
    """A field as it is written on the command line."""
    values = [] if value is True else value if isinstance(value, tuple) else [value]
    return [f"--{name.replace('_', '-')}", *map(str, values)]


def long_run(path, env, updates=150, compile="off"):
    """Arguments of a run of some seconds with a checkpoint every eighth update."""
    if env in OFF_POLICY:
        fields = tiny_off_policy(**OFF_POLICY[env], total_steps=16 * updates, checkpoint_every=128, compile=compile)
        given = [word for name, value in fields.items() for word in words_for(name, value)]
        return ["train", env, "--env", "Pendulum-v1", "--run", path, *given]
    fields = tiny_fields(env, hidden=(32, 32), total_steps=32 * updates, checkpoint_every=32 * 8, epochs=4)
    flags = ["--run", path, "--compile", compile]
    for name in ("num_envs", "num_steps", "total_steps", "epochs", "minibatch_size", "checkpoint_every"):
        flags += [f"--{name.replace('_', '-')}", fields[name]]
    return ["train", "ppo", "--env", env, "--preset", "paper", "--hidden", "32", "32", *flags]


def wait_for(condition, process=None):
    while not condition():
        assert process is None or process.poll() is None
        time.sleep(0.005)


@pytest.mark.long
def test_a_compiled_run_goes_on_to_the_same_bits(tmp_path):
    """From a checkpoint on in a new process: what was compiled there is compiled again here."""
    whole, half = tmp_path / "whole", tmp_path / "half"
    assert command(*long_run(whole, "ddpg", updates=40, compile="on")).wait() == 0
    shutil.copytree(whole, half)
    for step in checkpoint.list_steps(half / "checkpoints")[1:]:
        shutil.rmtree(half / "checkpoints" / f"step-{step}")
    resumed = command("resume", half)
    said = resumed.communicate()[1]
    assert resumed.returncode == 0
    assert "Compiling" in said
    assert "Nothing can be compiled" not in said
    assert final_hashes(half) == final_hashes(whole)
    assert history(half) == history(whole)


@pytest.mark.long
def test_ctrl_c_at_a_terminal_reaches_the_workers_too_and_harms_nothing(tmp_path):
    path = tmp_path / "r"
    arguments = [*long_run(path, "CartPole-v1", updates=3000), "--backend", "gymnasium-async"]
    process = command(*arguments)
    wait_for(lambda: len(read_metrics(path)) > 5, process)
    os.killpg(process.pid, signal.SIGINT)
    said = process.communicate()[1]
    assert process.returncode == 130
    assert f"lemniscate resume {path}" in said
    assert "Traceback" not in said


@pytest.mark.parametrize(("signum", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_leaves_a_checkpoint_and_says_how_to_go_on(tmp_path, signum, code):
    path = tmp_path / "r"
    process = command(*long_run(path, "CartPole-v1", updates=3000))
    wait_for(lambda: len(read_metrics(path)) > 20, process)
    process.send_signal(signum)
    said = process.communicate()[1]
    assert process.returncode == code
    assert f"lemniscate resume {path}" in said
    assert "Traceback" not in said
    stopped = lem.load(path).step
    assert stopped >= 20 * 32
    assert checkpoint.list_steps(path / "checkpoints")[-1] == stopped


def test_stopped_and_resumed_it_ends_in_the_same_bits(tmp_path):
    whole, path = tmp_path / "whole", tmp_path / "stopped"
    assert command(*long_run(whole, "Countdown-v0")).wait() == 0
    process = command(*long_run(path, "Countdown-v0"))
    wait_for(lambda: len(read_metrics(path)) > 20, process)
    process.terminate()
    assert process.wait() == 143
    assert command("resume", path).wait() == 0
    assert final_hashes(path) == final_hashes(whole)
    assert history(path) == history(whole)


@pytest.mark.long
def test_many_steps_between_two_lines_are_stopped_amid_and_resumed_to_the_same_bits(tmp_path):
    fields = {**OFF_POLICY["sac"], "log_every": 500, "total_steps": 2_000, "checkpoint_every": 1000, "compile": "off"}
    words = [word for name, value in tiny_off_policy(**fields).items() for word in words_for(name, value)]
    train_sac = ["train", "sac", "--env", "Pendulum-v1", *words, "--run"]
    assert command(*train_sac, tmp_path / "whole").wait() == 0
    process = command(*train_sac, tmp_path / "r")
    wait_for(lambda: len(read_metrics(tmp_path / "r")) >= 1, process)
    time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    assert "the policy is saved" in process.communicate()[1]
    assert process.returncode == 130
    assert lem.load(tmp_path / "r").step % 1000
    assert command("resume", tmp_path / "r").wait() == 0
    assert final_hashes(tmp_path / "r") == final_hashes(tmp_path / "whole")
    assert history(tmp_path / "r") == history(tmp_path / "whole")


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_an_update_that_hangs_is_interrupted(tmp_path, signum):
    small = {"total_steps": 1000, "num_envs": 2, "num_steps": 8, "minibatch_size": 16, "compile": "off"}
    steps = [word for name, value in small.items() for word in words_for(name, value)]
    process = command("train", "ppo", "--env", "environments:Hanging", *steps, "--run", tmp_path / "r")
    wait_for(lambda: len(read_metrics(tmp_path / "r")) == 6, process)
    time.sleep(0.5)
    asked = time.monotonic()
    process.send_signal(signum)
    said = process.communicate()[1]
    assert time.monotonic() - asked < 6  # two seconds, and as long as a busy machine takes to end a process
    assert process.returncode == 128 + signum
    assert "Stopped in the middle of an update" in said
    assert "Traceback" not in said


def test_a_stop_on_a_planned_checkpoint_keeps_it(tmp_path, monkeypatch):
    """The signal arrives in the update that ends at a planned checkpoint; with one kept, it must be that one."""
    from lemniscate.algos import ppo

    fields = {"checkpoint_every": 64, "keep_checkpoints": 1}
    train(tmp_path / "whole", "CartPole-v1", **fields)
    update = ppo.update

    def stop_at(step):
        def stopping(config, state, rollout):
            metrics = update(config, state, rollout)
            if state.step == step:
                os.kill(os.getpid(), signal.SIGTERM)
            return metrics

        return stopping

    for step in (128, 160):
        path = tmp_path / f"stopped{step}"
        monkeypatch.setattr(ppo, "update", stop_at(step))
        with pytest.raises(lem.Stopped, match="at step 128"):
            train(path, "CartPole-v1", **fields)
        assert lem.load(path).step == step
        monkeypatch.setattr(ppo, "update", update)
        lem.resume(path, progress=False)
        assert final_hashes(path) == final_hashes(tmp_path / "whole")


def test_environments_that_draw_from_global_generators_resume_exactly_too(tmp_path, monkeypatch):
    class Careless(toy.Matching):
        def _draw(self, mask):
            self.secret = np.where(mask, np.random.randint(0, 2, self.num_envs), self.secret)  # noqa: NPY002

    monkeypatch.setattr(toy, "Matching", Careless)
    fields = {"checkpoint_every": 64, "keep_checkpoints": 10}
    train(tmp_path / "whole", "Matching-v0", **fields)
    train(tmp_path / "evaluated", "Matching-v0", evaluate_every=32, **fields)
    train(tmp_path / "back", "Matching-v0", **fields)
    for step in checkpoint.list_steps(tmp_path / "back" / "checkpoints")[-2:]:
        (tmp_path / "back" / "checkpoints" / f"step-{step}" / "manifest.json").unlink()
    lem.resume(tmp_path / "back", progress=False)
    assert final_hashes(tmp_path / "back") == final_hashes(tmp_path / "whole")
    tensors = "tensors.safetensors"
    assert final_hashes(tmp_path / "evaluated")[tensors] == final_hashes(tmp_path / "whole")[tensors]


def test_a_checkpoint_of_a_newer_format_is_refused_and_not_deleted(tmp_path):
    train(tmp_path / "r")
    manifest = tmp_path / "r" / "checkpoints" / "step-256" / "manifest.json"
    write_json(manifest, {**read_json(manifest), "format": 6})
    with pytest.raises(lem.UserError, match="has format 6; this version of lemniscate reads 5"):
        lem.resume(tmp_path / "r", progress=False)
    assert manifest.exists()


def test_training_off_the_main_thread_leaves_signals_alone(tmp_path):
    failures = []

    def work():
        try:
            train(tmp_path / "r")
        except BaseException as error:
            failures.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert not failures
