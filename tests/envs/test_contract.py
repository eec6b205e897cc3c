"""The contract of the env floor, over every backend and every autoreset mode."""

import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode

import environments
import toy
from lemniscate.data.rollout import collect
from lemniscate.envs import registry
from lemniscate.envs.backend import Backend
from lemniscate.envs.gymnasium import GymnasiumBackend
from lemniscate.errors import NonFiniteError, UserError
from lemniscate.nn.actor_critic import ActorCritic
from lemniscate.nn.networks import Layers
from lemniscate.spec import Box

MODES = [mode.name for mode in AutoresetMode]
EVERY = [
    ("CartPole-v1", "gymnasium"),
    ("CartPole-v1", "gymnasium-async"),
    ("Pendulum-v1", "gymnasium"),
    ("Countdown-v0", "gymnasium"),
    ("Matching-v0", "gymnasium"),
    ("CartPole-v1", "envpool"),
    ("Hopper-v5", "envpool"),
    ("LunarLander-v3", "envpool"),
    *[(f"Copy-{kind}-v0", "gymnasium") for kind in environments.KINDS],
    ("Copy-tuple-v0", "gymnasium-async"),
    ("Copy-masked-v0", "gymnasium-async"),
    ("DroneFigureEightTrajectory-v0", "crazyflow"),
    *(
        pytest.param(f"Drone{name}-v0", "crazyflow", marks=pytest.mark.long)
        for name in ("ReachPos", "ReachVel", "Landing")
    ),
]


def countdown(mode, num_envs=3, kind=toy.Countdown, **kwargs):
    return registry.make(kind, num_envs, kwargs={"mode": mode, **kwargs})


def play(env, num_steps, seed=0):
    """A rollout of a fresh policy, from a restart."""
    policy = ActorCritic(env.spec, Layers((8,))).policy
    env.restart(seed)
    return collect(env, policy, num_steps, torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(("env_id", "backend"), EVERY)
def test_every_backend(env_id, backend):
    env = registry.make(env_id, 4, backend=backend, stagger=True)
    try:
        torch.manual_seed(0)
        first = play(env, 70)
        torch.manual_seed(0)
        again = play(env, 70)
    finally:
        env.close()
    mask = env.spec.action.n if getattr(env.spec.action, "masked", False) else 0
    assert first.obs.shape == first.next_obs.shape == (70, 4, env.spec.observation_size + mask)
    assert first.obs.dtype == (torch.uint8 if env.spec.image else torch.float32)
    assert first.reward.dtype == torch.float32
    assert first.terminated.dtype == first.truncated.dtype == first.valid.dtype == torch.bool
    if isinstance(env.spec.action, Box):
        assert first.action.shape == (70, 4, env.spec.action.size)
    assert not (first.terminated & first.truncated).any()
    for name in ("obs", "action", "reward", "next_obs", "terminated", "truncated"):  # a restart forgets everything
        assert torch.equal(getattr(first, name), getattr(again, name)), name
    inside = first.valid[:-1] & ~first.done[:-1]
    size = env.spec.observation_size
    assert torch.equal(
        first.next_obs[:-1][inside][:, :size], first.obs[1:][inside][:, :size]
    )  # where no episode ends, rows join up
    assert first.done.any() or "Drone" in env_id or env_id == "Pendulum-v1"


@pytest.mark.parametrize("mode", MODES)
def test_each_row_is_what_its_action_caused(mode):
    """Countdown's observations are (copy, episode, step), so every row says who it is."""
    rollout = play(countdown(mode, length=4), 23)
    copy, episode, step = rollout.obs.unbind(-1)
    next_copy, next_episode, next_step = rollout.next_obs.unbind(-1)
    valid = rollout.valid
    assert (copy == torch.arange(3)).all()
    assert (next_copy == copy).all()
    assert (next_episode == episode)[valid].all()  # the true successor belongs to the same episode
    assert (next_step == step + 1)[valid].all()
    assert (rollout.terminated == (next_step == 4))[valid].all()
    assert (rollout.reward[valid] == 1).all()
    assert not rollout.truncated.any()
    reset_rows = (~valid).sum().item()
    assert reset_rows == (3 * 4 if mode == "NEXT_STEP" else 0)


@pytest.mark.parametrize("mode", MODES)
def test_truncation_is_not_termination(mode):
    rollout = play(countdown(mode, length=None, horizon=4), 10)
    assert rollout.truncated.any()
    assert not rollout.terminated.any()
    ends = rollout.truncated & rollout.valid
    assert (rollout.next_obs[ends][:, 2] == 4).all()  # the true final observation, not the reset one


@pytest.mark.parametrize("mode", MODES)
def test_episodes_are_counted_without_the_reset_rows(mode):
    env = countdown(mode, length=5)
    play(env, 30)
    episodes = env.take_episodes()
    assert set(episodes.returns) == {5.0}
    assert set(episodes.lengths) == {5}
    assert env.take_episodes().returns == []


class Half(GymnasiumBackend):
    """Only the methods of a step are there."""

    restart = step = Backend.restart


class Alone:
    """A backend by the names of its methods, without the defaults."""

    restart = step = close = serves = None


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("Half", "test_contract:Half lacks restart, step: a backend is derived from lemniscate.envs.backend.Backend"),
        (
            "Alone",
            "test_contract:Alone lacks baseline, call, compiled, detach, differentiable, divides, exists_once, ids,",
        ),
        ("play", "test_contract:play is not a class"),
    ],
)
def test_what_a_backend_of_ones_own_lacks_is_said(name, sentence):
    with pytest.raises(UserError, match=sentence):
        registry.make("CartPole-v1", 2, backend=f"envs.test_contract:{name}")


class HidesFinalObs(toy.Countdown):
    def step(self, actions):
        *rest, _ = super().step(actions)
        return (*rest, {})


def test_an_environment_that_hides_the_final_observation_is_refused():
    with pytest.raises(UserError, match="hides the final observation"):
        play(countdown("SAME_STEP", kind=HidesFinalObs, length=3), 10)


class SaysNothing(toy.Countdown):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.metadata = {}


class SaysAText(toy.Countdown):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.metadata = {"autoreset_mode": "NextStep"}


def test_a_text_does_not_say_when_an_environment_resets():
    with pytest.raises(UserError, match=r"such as AutoresetMode.NEXT_STEP of gymnasium.vector, not 'NextStep'"):
        countdown("NEXT_STEP", kind=SaysAText)


@pytest.mark.filterwarnings("ignore:.*missing AutoresetMode")
def test_an_environment_that_does_not_say_when_it_resets_is_refused():
    with pytest.raises(UserError, match="autoreset_mode"):
        countdown("NEXT_STEP", kind=SaysNothing)


@pytest.mark.parametrize("quantity", ["observation", "reward"])
def test_a_nan_is_named_with_environment_and_step(quantity):
    class Breaks(toy.Countdown):
        def step(self, actions):
            obs, reward, *rest = super().step(actions)
            if self.t[0] == 3:
                (obs if quantity == "observation" else reward)[1] = np.nan
            return obs, reward, *rest

    env = countdown("DISABLED", kind=Breaks, length=10)
    with pytest.raises(NonFiniteError, match=rf"The {quantity} of environment 1 is nan in the step after \d+"):
        play(env, 8)


def test_a_reset_by_mask_that_resets_all_is_refused():
    class Forgetful(toy.Countdown):
        def __init__(self, num_envs, mode, length, horizon=None):
            super().__init__(num_envs, mode, length + np.arange(num_envs), horizon)

        def reset(self, *, seed=None, options=None):
            return super().reset(seed=seed)

    with pytest.raises(UserError, match=r"is DISABLED, and its reset\(\) changes rows whose episodes go on"):
        play(countdown("DISABLED", kind=Forgetful, length=4), 8)


def test_noise_of_a_sensor_is_no_reset():
    class Noisy(toy.Countdown):
        def _observe(self):
            return super()._observe() + self.np_random.normal(0, 0.01, (self.num_envs, 3)).astype(np.float32)

        def __init__(self, num_envs, mode, length, horizon=None):
            super().__init__(num_envs, mode, length + np.arange(num_envs), horizon)

    play(countdown("DISABLED", kind=Noisy, length=4), 8)


def test_a_nan_that_a_reset_returns_is_named():
    class BornBroken(toy.Countdown):
        def reset(self, **kwargs):
            obs, info = super().reset(**kwargs)
            if kwargs.get("options"):
                obs[2] = np.nan
            return obs, info

    with pytest.raises(NonFiniteError, match="The observation of environment 2 is nan in the step after"):
        play(countdown("DISABLED", kind=BornBroken, length=3), 8)


@pytest.mark.parametrize("mode", ["NEXT_STEP", "SAME_STEP"])
def test_a_vector_environment_may_write_over_its_own_arrays(mode):
    class Reuses(toy.Countdown):
        def step(self, actions):
            obs, reward, terminated, truncated, info = super().step(actions)
            if not hasattr(self, "mine"):
                self.mine = [np.empty_like(part) for part in (obs, reward, terminated, truncated)]
            for mine, part in zip(self.mine, (obs, reward, terminated, truncated), strict=True):
                mine[:] = part
            return (*self.mine, info)

    plain = play(countdown(mode, length=4), 12)
    reused = play(countdown(mode, kind=Reuses, length=4), 12)
    for name in ("obs", "next_obs", "reward", "terminated", "valid"):
        assert torch.equal(getattr(plain, name), getattr(reused, name)), name


def test_staggering_spreads_the_first_episodes():
    env = registry.make("Pendulum-v1", 16, stagger=True)
    rollout = play(env, 200)
    first_end = rollout.truncated.int().argmax(0)
    assert len(set(first_end.tolist())) > 8
    assert env.take_episodes().returns == []  # the first are fragments
    env.close()


def test_two_copies_differ_and_two_seeds_differ():
    env = registry.make("CartPole-v1", 2)
    a, b = env.restart(0), env.restart(1)
    assert not torch.equal(a[0], a[1])
    assert not torch.equal(a, b)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("CartPol-v1", 2), "CartPole-v1"),
        (("Unreadable-v0", 2), "Unreadable-v0 observes a Sequence"),
        (("DroneLanding-v1", 2), "DroneLanding-v0"),
        (("Ant-v2", 2), "There is no environment 'Ant-v2': did you mean Ant-v5"),
    ],
)
def test_what_cannot_be_made_is_said(arguments, said):
    with pytest.raises(UserError, match=said):
        registry.make(*arguments)


def test_a_backend_that_does_not_serve_an_environment_is_refused():
    with pytest.raises(UserError, match="cannot be served by the crazyflow backend"):
        registry.make("CartPole-v1", 2, backend="crazyflow")
