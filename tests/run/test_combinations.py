"""Two features of a run at once."""

import json
import pickle
import signal
import threading
import time
import traceback

import gymnasium as gym
import numpy as np
import pytest
import torch

import lemniscate as lem
from conftest import tiny_fields, tiny_off_policy
from environments import Near, Noise
from lemniscate.algos import find
from lemniscate.envs import registry
from lemniscate.envs.backend import Backend
from lemniscate.envs.vec_env import VecEnv
from lemniscate.errors import UserError
from lemniscate.optim.compiled import Compiled, Compiler
from lemniscate.run.environments import envs_of, make_envs
from lemniscate.run.run import Run
from lemniscate.spec import Box, ObservationPart, Spec
from lemniscate.system.world import World
from lemniscate.types import Step

LIMIT = ("gymnasium.wrappers:TimeLimit(max_episode_steps=20)",)
HINDSIGHT = tiny_off_policy(replay="hindsight", log_every=25, wrappers=LIMIT, total_steps=400, checkpoint_every=400)


class Steady(Noise):
    observation_space, action_space = gym.spaces.Box(-1, 1, (3,), np.float32), gym.spaces.Box(-1, 1, (1,), np.float32)
    length = 10


class Other(Steady):
    pass


def test_one_evaluated_episode_leaves_the_environments_of_training_as_many_as_they_are():
    """One environment of one's own may exist once; of several, that of the evaluation is another one."""
    config = lem.config_for("ppo", Steady, **tiny_fields(evaluate_episodes=1))
    env, eval_env = make_envs(config)
    assert (env.num_envs, eval_env.num_envs) == (4, 1)
    assert eval_env is not env
    assert not eval_env.backend.once
    alone = make_envs(config.replace(num_envs=1, num_steps=16))
    assert alone[0] is alone[1]
    for vec in (env, eval_env, alone[0]):
        vec.close()


def test_a_single_environment_without_a_gradient_is_refused_by_shac(tmp_path):
    fields = {"num_envs": 1, "num_steps": 8, "critic_minibatch_size": 8, "total_steps": 64, "run": tmp_path / "run"}
    with pytest.raises(UserError, match="cannot be differentiated"):
        lem.train("shac", Steady, progress=False, **fields)


@pytest.mark.parametrize("network", ["mlp", "gru"])
def test_the_policy_of_a_compiled_run_has_the_methods_of_its_class(network):
    """The compiled ones are for the shapes of training, and can neither be copied nor pickled."""
    ppo = find("ppo")
    config = ppo.Config(env="Countdown-v0", num_envs=4, num_steps=8, minibatch_size=16, hidden=(8,), network=network)
    env, eval_env = envs_of(config, World())
    state = ppo.init(config, env.spec, torch.device("cpu"))
    state.prepare(World(), Compiler())
    methods = state.per_step_methods()
    assert all(isinstance(getattr(owner, name), Compiled) for owner, name in methods)
    state.release()
    assert not any(isinstance(getattr(owner, name), Compiled) for owner, name in methods)
    pickle.loads(pickle.dumps(state.networks))
    for vec in (env, eval_env):
        vec.close()


def test_what_shares_estimates_is_taken_off_too():
    reppo = find("reppo")
    config = reppo.Config(env="Pendulum-v1", num_envs=4, num_steps=8, minibatch_size=16, hidden=(8,), shards=2)
    state = reppo.init(config, VecEnv(registry.make("Pendulum-v1", 1).backend).spec, torch.device("cpu"))
    state.prepare(World(2), None)
    assert "estimates" in vars(state.networks)
    state.release()
    assert "estimates" not in vars(state.networks)


@pytest.mark.parametrize(
    ("backend", "curriculum"),
    [
        ("gymnasium", "environments:nearer"),
        ("gymnasium-async", "environments:near"),
        ("gymnasium-async", "environments:nearer"),
    ],
)
def test_goals_are_judged_by_the_rules_that_a_curriculum_has_set(backend, curriculum, tmp_path):
    """An episode under way when they change is dropped; the judge beside workers hears of the calls too."""
    run = lem.train(
        "sac", Near, run=tmp_path / "run", backend=backend, curriculum=curriculum, progress=False, **HINDSIGHT
    )
    assert run.policy.step == 400


def test_hindsight_says_that_videos_cut_the_episodes_of_an_environment_that_exists_once():
    config = lem.config_for("sac", Near, **HINDSIGHT | {"num_envs": 1, "video_every": 10, "checkpoint_every": 0})
    spec = registry.make(Near, 1, wrappers=LIMIT).spec
    with pytest.raises(UserError, match="video_every 10 is less than an episode of each environment, which a video"):
        config.make_replay(spec, torch.device("cpu"))


def test_another_object_than_the_run_began_with_is_refused(tmp_path):
    run = lem.train("ppo", Steady, run=tmp_path / "run", progress=False, **tiny_fields(total_steps=32))
    with pytest.raises(UserError, match=r"env of .*run is '.*:Steady': leave env out; with another one it is a run"):
        lem.resume(run, total_steps=64, env=Other, progress=False)
    with pytest.raises(UserError, match=r"curriculum of .*run is None: leave curriculum out"):
        lem.resume(run, total_steps=64, curriculum="environments:near", progress=False)
    assert lem.resume(run, total_steps=64, env=Steady, progress=False).policy.step == 64


def test_a_run_off_policy_goes_on_with_another_time_limit(tmp_path, monkeypatch):
    """Its action noise is as long as an episode, and begins anew anyway."""
    fields = tiny_off_policy(total_steps=64, learning_starts=32)
    gym.register("Limited-v0", entry_point=Steady, max_episode_steps=5)
    run = lem.train("td3", "Limited-v0", run=tmp_path / "run", progress=False, **fields)
    monkeypatch.setattr(gym.registry["Limited-v0"], "max_episode_steps", 8)
    assert lem.resume(run, total_steps=128, progress=False).policy.step == 128
    del gym.registry["Limited-v0"]


class Patient(World):
    """A world that knows whether it is busy."""

    is_busy = False

    def busy(self):
        world = self

        class Busy:
            def __enter__(self):
                world.is_busy = True

            def __exit__(self, *_):
                world.is_busy = False

        return Busy()


def test_callbacks_and_restarts_may_take_as_long_as_they_like(tmp_path, monkeypatch):
    """A process that is not busy and makes no step is ended after some seconds."""
    seen = []
    run, train = tmp_path / "run", lem.api.training._train
    monkeypatch.setattr(lem.api.training, "_train", lambda world, *given: train(Patient(world.shards), *given))
    begin = Run._restart

    def restart(self, state):
        monkeypatch.setattr(
            self.env,
            "restart",
            lambda *_, was=self.env.restart: seen.append(("restart", self.world.is_busy)) or was(*_),
        )
        begin(self, state)
        monkeypatch.undo()

    def callback(step, metrics, policy):
        seen.append(("callback", worlds[0].is_busy))

    worlds = []
    made = Run.__init__

    def init(self, *args, **kwargs):
        made(self, *args, **kwargs)
        worlds.append(self.world)

    monkeypatch.setattr(Run, "__init__", init)
    monkeypatch.setattr(Run, "_restart", restart)
    lem.train("ppo", Steady, run=run, callbacks=callback, progress=False, **tiny_fields(total_steps=32))
    assert ("callback", True) in seen
    assert ("restart", True) in seen
    assert all(busy for _, busy in seen)


class Doubles(Backend):
    """One of one's own, whose rewards are float64."""

    def __init__(self, env, num_envs, device, *, stagger=False, kwargs=None, wrappers=()):
        self.num_envs, self.device = num_envs, device
        self.spec = Spec(env, (ObservationPart((), (3,)),), Box((-1.0,), (1.0,)), 10)
        self.counts = torch.ones(num_envs, dtype=torch.bool)

    @classmethod
    def serves(cls, env):
        return env == "Anything"

    def restart(self, seed, first=0):
        return torch.zeros(self.num_envs, 3)

    def step(self, action):
        obs, no = torch.zeros(self.num_envs, 3), torch.zeros(self.num_envs, dtype=torch.bool)
        return Step(obs, obs, action[:, 0].double(), no, no, ~no)

    def close(self):
        pass


@pytest.mark.parametrize("shards", [1, 2])
def test_a_backend_of_ones_own_is_looked_at_in_shards_too(shards):
    env = registry.make("Anything", 4, backend=f"{__name__}:Doubles", world=World(shards))
    env.restart(0)
    with pytest.raises(
        UserError, match=r"Doubles.step\(\) returns an array of shape \(4,\) and type torch.float64 as reward"
    ):
        env.step(torch.zeros(4, 1))


def test_measures_of_a_differentiable_step_hold_no_graph():
    values, no = torch.ones(2, requires_grad=True), torch.zeros(2, dtype=torch.bool)
    step = Step(values[:, None], values[:, None], 2 * values, no, no, ~no, measures={"height": 3 * values})
    assert step.measures["height"].requires_grad
    assert not any(x.requires_grad for x in (step.detach().obs, step.detach().reward, step.detach().measures["height"]))


class Stopping(Steady):
    """Asks its process to stop in one of its resets: as Ctrl-C does while a run restarts its environments."""

    resets, at = 0, 0

    def reset(self, *, seed=None, options=None):
        Stopping.resets += 1
        if Stopping.resets == Stopping.at:
            signal.raise_signal(signal.SIGINT)
        return super().reset(seed=seed, options=options)


def test_asked_to_stop_while_it_restarts_a_run_writes_no_line_twice(tmp_path):
    def lines(name):
        return [json.loads(line) for line in (tmp_path / name / "metrics.jsonl").read_text().splitlines()]

    fields = tiny_off_policy(num_envs=1, total_steps=200, log_every=10, checkpoint_every=100) | {"progress": False}
    Stopping.resets = Stopping.at = 0
    lem.train("td3", Stopping, run=tmp_path / "whole", **fields)
    # 10 resets by the end of each of 10 episodes, the last of which is cut by the checkpoint at 100; the next restarts.
    for at in range(9, 14):
        Stopping.resets, Stopping.at, name = 0, at, f"stopped-{at}"
        with pytest.raises(KeyboardInterrupt):
            lem.train("td3", Stopping, run=tmp_path / name, **fields)
        Stopping.at = 0
        lem.resume(tmp_path / name, progress=False)
        seen = [(line["step"], "reward/largest" in line) for line in lines(name)]
        assert seen == [(line["step"], "reward/largest" in line) for line in lines("whole")]


def test_a_best_policy_of_no_evaluation_is_refused():
    with pytest.raises(UserError, match="evaluate_every 100 is beyond the 32 of total_steps"):
        lem.config_for("ppo", Steady, **tiny_fields(total_steps=32, keep_best=True, evaluate_every=100))


@pytest.mark.parametrize("video", [False, True])
def test_any_seed_will_do_with_and_without_a_video(video, tmp_path):
    run = lem.train("ppo", "CartPole-v1", run=tmp_path / "run", progress=False, **tiny_fields(total_steps=32))
    for policy in (run, lambda obs: 0):
        file = tmp_path / "a.gif" if video else None
        env = "CartPole-v1" if callable(policy) else None
        assert lem.evaluate(policy, env, seed=2**33, episodes=1, video=file).episodes == 1


def test_a_warm_start_says_that_the_noise_is_another_one(tmp_path, capsys):
    """Of REPPO and SAC log σ at the beginning is a constant of the network, which no parameter takes over."""
    fields = {"num_envs": 4, "num_steps": 8, "minibatch_size": 16, "total_steps": 32, "hidden": (8,)}
    run = lem.train("reppo", Steady, run=tmp_path / "first", progress=False, **fields)
    for value, said in ((1.0, "; initial_log_std is -1.0 there and 1.0 here, so σ is another."), (-1.0, " 32.")):
        more = {"warm_start": run.path, "initial_log_std": value, "run": tmp_path / f"next{value}"}
        lem.train("reppo", Steady, **more, **fields)
        assert f"{said}\n" in capsys.readouterr().err


def test_a_signal_while_a_planned_checkpoint_is_written_does_not_break_it_off(tmp_path, monkeypatch):
    """The disk may take longer than an update may after a signal."""
    from lemniscate.run import checkpoint, stopping

    write = checkpoint.write_fields

    def slow(final, fields, record):
        if record["planned"] and final.name == "step-64":
            signal.raise_signal(signal.SIGINT)
            time.sleep(3 * stopping.PATIENCE)
        write(final, fields, record)

    monkeypatch.setattr(stopping, "PATIENCE", 0.1)
    monkeypatch.setattr(checkpoint, "write_fields", slow)
    fields = tiny_fields(total_steps=256, checkpoint_every=64)
    with pytest.raises(KeyboardInterrupt, match=r"(?s)Stopped at step 64; the policy is saved.*resumes at step 64"):
        lem.train("ppo", Steady, run=tmp_path / "run", progress=False, **fields)
    assert [path.name for path in (tmp_path / "run" / "checkpoints").iterdir()] == ["step-64"]


class Watched(Steady):
    """Asks its process to stop in the middle of an evaluation, twice as long as an update may take then."""

    at, steps = 0, 0

    def step(self, action):
        if threading.current_thread() is threading.main_thread() and "evaluate" in {
            frame.name for frame in traceback.extract_stack()
        }:
            Watched.steps += 1
            if Watched.steps == Watched.at:
                signal.raise_signal(signal.SIGINT)
                time.sleep(0.4)
        return super().step(action)


def test_a_signal_in_an_evaluation_saves_the_policy(tmp_path, monkeypatch):
    from lemniscate.run import stopping

    monkeypatch.setattr(stopping, "PATIENCE", 0.1)
    Watched.at, Watched.steps = 5, 0
    fields = tiny_fields(total_steps=256, evaluate_every=64, checkpoint_every=128)
    with pytest.raises(KeyboardInterrupt, match="Stopped at step 64; the policy is saved"):
        lem.train("ppo", Watched, run=tmp_path / "run", progress=False, **fields)
    assert [path.name for path in (tmp_path / "run" / "checkpoints").iterdir()] == ["step-64"]
    Watched.at = 0
    assert lem.resume(tmp_path / "run", progress=False).policy.step == 256
