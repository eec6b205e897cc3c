"""Environments shared by several processes are those of one."""

import sys
from dataclasses import replace

import pytest
import torch
from gymnasium.vector import AutoresetMode

import toy
from lemniscate.envs import registry
from lemniscate.envs.backend import Backend
from lemniscate.envs.spaces import random_action
from lemniscate.envs.vec_env import require_end
from lemniscate.errors import UserError
from lemniscate.spec import Discrete, ObservationPart, Spec
from lemniscate.types import Step
from threads import in_world

ENVS = {"Pendulum-v1": "gymnasium", "CartPole-v1": "envpool", "Countdown-v0": "gymnasium"}


def played(world, env_id, backend, steps=30):
    """Everything that comes of random actions in eight environments, and the episodes that ended."""
    env = registry.make(env_id, 8, backend=backend, stagger=True, world=world)
    try:
        rows, rng = [env.restart(5, steps=0)], torch.Generator().manual_seed(1)
        for _ in range(steps):
            step = env.step(random_action(env.spec, env.obs, rng))
            rows += [step.obs, step.next_obs, step.reward, step.terminated, step.truncated, step.valid]
        return rows, env.take_episodes(), env.steps
    finally:
        env.close()


@pytest.mark.parametrize("env_id", ENVS)
def test_any_number_of_processes_steps_the_same_environments(env_id):
    if ENVS[env_id] == "envpool":
        pytest.importorskip("envpool")
    ((rows, episodes, steps),) = in_world(4, 1, lambda world: played(world, env_id, ENVS[env_id]))
    assert steps == 8 * 30
    for size in (2, 4):
        for theirs, ended, taken in in_world(4, size, lambda world: played(world, env_id, ENVS[env_id])):
            assert all(map(torch.equal, rows, theirs))
            assert (ended, taken) == (episodes, steps)


def test_what_each_environment_does_does_not_depend_on_the_shards():
    alone, shared = (
        in_world(shards, 1, lambda world: played(world, "Pendulum-v1", "gymnasium"))[0] for shards in (1, 4)
    )
    assert all(map(torch.equal, alone[0], shared[0]))


def test_first_episodes_are_cut_alike_in_any_process():
    whole = registry.make("Pendulum-v1", 8, stagger=True)
    whole.restart(3)
    part = registry.make("Pendulum-v1", 2, stagger=True)
    part.backend.restart(3, 4)
    cuts = whole.backend._stagger._steps_left
    assert part.backend._stagger._steps_left.tolist() == cuts[4:6].tolist()
    assert len(set(cuts.tolist())) > 4
    whole.close()
    part.close()


def test_the_vectors_of_several_shards_are_described_as_one_is():
    def described(world):
        env = registry.make(toy.Countdown, 4, kwargs={"mode": "NEXT_STEP"}, world=world)
        names = ("mode", "summaries", "scene", "baseline", "interface", "spec", "device")
        try:
            return type(env.backend).__name__, [getattr(env.backend, name) for name in names]
        finally:
            env.close()

    (one,), (two,) = in_world(1, 1, described), in_world(2, 1, described)
    assert (one[0], two[0]) == ("GymnasiumBackend", "Joined")
    assert one[1] == two[1]
    assert one[1][0] is AutoresetMode.NEXT_STEP


class Reusing(Backend):
    """A simulator of one's own that writes over actions and returned tensors; `spoil` changes its answers."""

    spoil = staticmethod(lambda step: step)

    @classmethod
    def serves(cls, env):
        return env == "Count"

    def __init__(self, env, num_envs, device, *, stagger=False, kwargs=None, wrappers=()):
        self.num_envs, self.device = num_envs * (kwargs or {}).get("times", 1), device
        self.spec = Spec(env, (ObservationPart((), (1,)),), Discrete(2), 4)
        self.counts = torch.ones(num_envs, dtype=torch.bool)
        self.obs, self.reward = torch.zeros(self.num_envs, 1), torch.zeros(self.num_envs)
        self.ended = torch.zeros(self.num_envs, dtype=torch.bool)

    def restart(self, seed, first=0):
        return self.obs.zero_()

    def step(self, action):
        action += 5
        self.obs += 1
        self.reward += 1
        self.ended[:] = self.obs[:, 0] % 4 == 0
        return self.spoil(Step(self.obs, self.obs, self.reward, self.ended, self.ended, ~self.ended | True))

    def close(self):
        pass


def test_a_backend_of_ones_own_may_write_over_what_it_was_given_and_what_it_returned():
    env = registry.make("Count", 2, backend=f"{__name__}:Reusing")
    env.restart(0)
    action = torch.zeros(2, dtype=torch.int64)
    steps = [env.step(action) for _ in range(4)]
    assert action.tolist() == [0, 0]
    assert [step.reward.tolist() for step in steps] == [[t, t] for t in (1, 2, 3, 4)]
    assert [step.obs[0].item() for step in steps] == [1, 2, 3, 4]
    assert steps[-1].terminated.all()
    assert not steps[-1].truncated.any(), "never with terminated"


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (
            lambda step: (step.obs, step.reward),
            r"Spoiled.step\(\) returns a tuple; it must be a Step of lemniscate.types",
        ),
        (
            lambda step: replace(step, reward=step.reward[:, None]),
            r"as reward; it must be a Tensor \[2\] of torch.float32",
        ),
        (lambda step: replace(step, terminated=step.reward), r"as terminated; it must be a Tensor \[2\] of torch.bool"),
        (lambda step: replace(step, obs=step.obs.double()), r"as obs; it must be a Tensor \[2, 1\] of torch.float32"),
        (lambda step: replace(step, next_obs=step.obs.repeat(1, 2)), r"as next_obs; it must be a Tensor \[2, 1\]"),
        (lambda step: replace(step, reward=step.reward.numpy()), "as reward; it must be a Tensor"),
    ],
)
def test_what_a_backend_of_ones_own_returns_wrongly_is_said(spoil, said, monkeypatch):
    monkeypatch.setitem(globals(), "Spoiled", type("Spoiled", (Reusing,), {"spoil": staticmethod(spoil)}))
    env = registry.make("Count", 2, backend=f"{__name__}:Spoiled")
    env.restart(0)
    with pytest.raises(UserError, match=said):
        env.step(torch.zeros(2, dtype=torch.int64))


def test_a_backend_of_another_size_is_said():
    with pytest.raises(UserError, match="has 4 environments where it was to make 2"):
        registry.make("Count", 2, backend=f"{__name__}:Reusing", kwargs={"times": 2})


def test_an_episode_that_outlives_its_limit_is_told(monkeypatch):
    monkeypatch.setattr("lemniscate.envs.vec_env.PATIENCE", 50)
    require_end("Count", 53, 4)
    with pytest.raises(
        UserError, match="has not ended after 54 steps, and its time limit is 4: it must return truncated"
    ):
        require_end("Count", 54, 4)
    with pytest.raises(UserError, match="or train with --wrappers"):
        require_end("Count", 50, None)
    with pytest.raises(UserError, match=r"return truncated in its step\(\)\.$"):
        require_end("Count", 50, None, can_wrap=False)


def without(name):
    class Lacking(Reusing):
        def restart(self, seed, first=0):
            obs = super().restart(seed, first)
            if name == "counts":
                self.counts = None
            return obs

        def step(self, action):
            step = super().step(action)
            return replace(step, measures={"m": 3}) if name == "measures" else step

    if name == "spec":
        Lacking.spec = property(lambda self: {}, lambda self, value: None)
    if name == "options":
        Lacking.__init__ = lambda self, env, num_envs, device: None
    return Lacking


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("counts", "restart.. returns None as counts; it must be a Tensor .2. of torch.bool"),
        ("measures", "step.. returns 3 as measures.'m'.; it must be a Tensor .2."),
        ("spec", "must have a spec, a Spec of lemniscate.spec"),
        ("options", "The backend .* cannot be made: TypeError: .* unexpected keyword argument"),
    ],
)
def test_what_a_backend_of_ones_own_lacks_is_said(name, said, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "Lacking", without(name), raising=False)
    with pytest.raises(UserError, match=said):  # noqa: PT012  (each of these may be where it is said)
        env = registry.make("Count", 2, backend=f"{__name__}:Lacking")
        env.restart(0)
        env.step(torch.zeros(2, dtype=torch.int64))
