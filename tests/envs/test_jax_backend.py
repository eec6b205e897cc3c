"""The JAX half of the environment floor, on a tiny environment that is two pure functions."""

import pytest
import torch

jax = pytest.importorskip("jax")
import jax.numpy as jnp

from lemniscate.drones.crazyflow import JaxBackend
from lemniscate.drones.drones import Programs
from lemniscate.envs import registry
from lemniscate.spec import Box, ObservationPart, Spec

N, LIMIT = 4, 20


def reset(key):
    """A point on a line."""
    x = jax.random.uniform(key, (), minval=-1.0, maxval=1.0)
    return {"x": x, "t": jnp.int32(0)}, jnp.stack([x, 0.0])


def step(state, action):
    """It is pushed; beyond 2 the episode ends."""
    x, t = state["x"] + action[0], state["t"] + 1
    obs = jnp.stack([x, t.astype(jnp.float32)])
    return {"x": x, "t": t}, obs, -jnp.abs(x), jnp.abs(x) > 2, {"distance": jnp.abs(x)}


class Vectorized:
    """What `Programs` takes, from the two functions of a single environment, with a time limit.

    `reset(key) -> (state, obs [O])` and `step(state, action [A]) -> (state, obs [O], reward, terminated, measures)` are
    pure functions of one environment. With staggering, the first episode of each is cut after a random number of
    steps, uniform up to the time limit.
    """

    def __init__(self, reset, step, num_envs, action_size, max_steps, device):
        self.num_envs, self.action_size, self.device = num_envs, action_size, device
        self._reset, self._step, self._max_steps = reset, step, max_steps

    def init(self, key):
        """Keys, and environments that have not begun."""
        key, begin = jax.random.split(key)
        states, obs = jax.vmap(self._reset)(jax.random.split(begin, self.num_envs))
        nothing = jnp.zeros(self.num_envs, dtype=int)
        return {"key": key, "env": states, "obs": obs, "age": nothing, "limit": nothing}

    def reset(self, state, mask, stagger):
        """Fresh states where `mask`; a limit of 0 is that of an environment before its first episode."""
        key, begin, where = jax.random.split(state["key"], 3)
        fresh, fresh_obs = jax.vmap(self._reset)(jax.random.split(begin, self.num_envs))

        def choose(new, old):
            return jnp.where(mask.reshape(-1, *[1] * (new.ndim - 1)), new, old)

        fragment = mask & stagger & (state["limit"] == 0)
        cut = jax.random.randint(where, (self.num_envs,), 1, self._max_steps + 1)
        limit = jnp.where(fragment, cut, self._max_steps)
        obs = choose(fresh_obs, state["obs"])
        state = {
            "key": key,
            "env": jax.tree.map(choose, fresh, state["env"]),
            "obs": obs,
            "age": choose(jnp.zeros_like(state["age"]), state["age"]),
            "limit": choose(limit, state["limit"]),
        }
        return state, obs, fragment

    def step(self, state, action):
        """Every environment one step on."""
        env, obs, reward, terminated, measures = jax.vmap(self._step)(state["env"], action)
        age = state["age"] + 1
        return {**state, "env": env, "obs": obs, "age": age}, (obs, reward, terminated, age >= state["limit"], measures)


class PointBackend(JaxBackend):
    """A backend of somebody's own: what it adds to the JAX half."""

    def __init__(self, env, num_envs, device, *, stagger=False, kwargs=None, wrappers=()):
        limit = (kwargs or {}).get("max_steps", LIMIT)
        envs = Vectorized(reset, step, num_envs, action_size=1, max_steps=limit, device=jax.devices("cpu")[0])
        super().__init__(Programs(envs), num_envs, device, stagger=stagger)
        part = ObservationPart((), (2,))
        self.spec = Spec(env, (part,), Box((-1.0,), (1.0,)), max_episode_steps=limit)

    @classmethod
    def ids(cls):
        return ("Point-v0",)

    @classmethod
    def serves(cls, env):
        return env in cls.ids()


BACKEND = f"{__name__}:PointBackend"


def make(**kwargs):
    return registry.make("Point-v0", N, backend=BACKEND, **kwargs)


def test_each_row_is_what_its_action_caused():
    env = make()
    obs = env.restart(3).clone()
    ends = 0
    for t in range(60):
        action = torch.full((N, 1), 0.3) if t < 40 else torch.zeros(N, 1)
        step = env.step(action)
        torch.testing.assert_close(step.next_obs[:, 0], obs[:, 0] + action[:, 0])
        torch.testing.assert_close(step.next_obs[:, 1], obs[:, 1] + 1)
        torch.testing.assert_close(step.reward, -step.next_obs[:, 0].abs())
        assert torch.equal(step.measures["distance"], -step.reward)
        assert torch.equal(step.terminated, step.next_obs[:, 0].abs() > 2)
        assert torch.equal(step.truncated, (step.next_obs[:, 1] == LIMIT) & ~step.terminated)
        done = step.terminated | step.truncated
        assert (step.obs[done][:, 0].abs() <= 1).all()
        assert (step.obs[done][:, 1] == 0).all()
        assert torch.equal(step.obs[~done], step.next_obs[~done])
        ends += int(done.sum())
        obs = step.obs.clone()
    assert ends == len(env.take_episodes().returns) > N


def test_the_seed_is_all_there_is():
    env = make()
    first, other, again = env.restart(1).clone(), env.restart(2).clone(), env.restart(1).clone()
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert len(first[:, 0].unique()) == N
    env.restart(1)
    env.step(torch.ones(N, 1))
    assert torch.equal(env.restart(1), first)


def test_staggering_cuts_first_episodes_which_do_not_count():
    env = registry.make("Point-v0", 64, backend=BACKEND, stagger=True)
    env.restart(0)
    lengths = torch.zeros(64)
    for t in range(1, LIMIT + 1):
        step = env.step(torch.zeros(64, 1))
        lengths[step.truncated & (lengths == 0)] = t
    assert len(lengths.unique()) > 10
    assert env.take_episodes().returns == []
    for _ in range(LIMIT):
        step = env.step(torch.zeros(64, 1))
    assert env.take_episodes().lengths == [LIMIT] * 64


def test_arguments_reach_it():
    assert make(kwargs={"max_steps": 7}).spec.max_episode_steps == 7
