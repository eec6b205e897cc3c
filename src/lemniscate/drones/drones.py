# pyright: reportAttributeAccessIssue=false
"""crazyflow's drones as pure functions of their state, and the programs that JAX compiles from such functions.

    act → step → true observation, reward, ends → reset what ended → where to act next

is traced once into a single XLA program, so every row is real.
"""

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from itertools import compress
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from lemniscate.drones.air import Acting, Air, parameter_factors
from lemniscate.drones.vehicle import DYNAMICS, STATE_PARTS, STATE_SIZE, Ranges
from lemniscate.spec import ObservationPart

State: TypeAlias = Any
"""a pytree of arrays"""
Outcome: TypeAlias = tuple[Any, Any, Any, Any, dict[str, Any]]
"""observation [N, O], reward [N], terminated [N], truncated [N], and measures by name, [N] each"""

AHEAD = 0.75
"""the share of staggered episodes that begin ahead of their beginning"""
REFERENCE = "local_samples"
"""the part of an observation that begins with the way to the reference"""
START = np.array((0.0, 0.0, 1.2), np.float32)
"""the middle of the box in which crazyflow's flights of the figure eight begin"""


class Drones:
    """A crazyflow environment with its state apart: SimData, the arrays that the object keeps beside it, and the air.

    The environment's own methods are traced with its state put in and taken out again, so whatever it computes
    (rewards, ends, goals, starts) is computed by crazyflow's code.

    Args:
        env: crazyflow's environment of N drones.
        ranges: the conditions that are other than the simulator's.
        history: the number of steps before this one that are observed too: the state then less the present one, and
            the action.
        privileged: let privileged numbers follow the observation: the air, the rotors' speed and the dynamics.
    """

    def __init__(self, env: Any, ranges: Ranges, history: int = 0, privileged: bool = False) -> None:
        self.env = env
        for name, value in vars(env).items():
            if isinstance(value, np.ndarray):  # the reference trajectory: NumPy cannot be indexed by a tracer
                setattr(env, name, jnp.asarray(value, device=env.device))
        self.num_envs, self.device = env.num_envs, env.device
        self.low, self.high = env.single_action_space.low, env.single_action_space.high
        self.action_size = self.low.size
        self.episode_steps = round(env.max_episode_time * env.freq)
        """the time limit, in control steps"""
        self.dynamics, params = str(env.sim.dynamics), env.sim.data.params
        self.mass = float(params.mass.ravel()[0])
        command = np.array((0, 0, 0, self.mass * -float(params.gravity_vec[2])), np.float32)
        self._turning = np.full(4, hovering_rotors(self.dynamics, params), np.float32)
        hover = command, 2 * (command - self.low) / (self.high - self.low) - 1
        self.air = Air(ranges, history, self.num_envs, env.n_substeps, env.freq, hover)
        sizes = {name: space.shape[-1] for name, space in env.single_observation_space.spaces.items()}
        names = (*STATE_PARTS, *(name for name in sizes if name not in STATE_PARTS))
        past = [ObservationPart(("history",), (history, STATE_SIZE + self.action_size))] if history else []
        self.parts = (*(ObservationPart((name,), (sizes[name],)) for name in names), *past)
        """the flat observation: the drone's state first, then the task's own parts, then the history"""
        truth = jax.eval_shape(lambda: self._truth(self.air.empty(jax.random.key(0))))
        self.privileged = truth.shape[1] if privileged else 0
        """the number of privileged numbers that follow the flat observation"""
        self.error = slice(STATE_SIZE, STATE_SIZE + 3) if REFERENCE in names else None
        self._own_parameters()
        self._arrays = [name for name, value in vars(env).items() if isinstance(value, jax.Array)]
        self._initial = self._take()

    def _own_parameters(self) -> None:
        """Give each drone parameters of its own, where conditions or the task change them."""
        sim, factors = self.env.sim, parameter_factors(self.dynamics, dict.fromkeys(self.air.ranges, jnp.ones(1)))
        shared = {name: getattr(sim.data.params, name) for name in (*factors, *getattr(self.env, "own_parameters", ()))}
        each = {name: jnp.tile(value, (self.num_envs, 1, *[1] * value.ndim)) for name, value in shared.items()}
        params = sim.data.params.replace(**each)
        sim.data, sim.default_data = sim.data.replace(params=params), sim.default_data.replace(params=params)

    def _take(self) -> tuple[Any, dict[str, Any]]:
        return self.env.sim.data, {name: getattr(self.env, name) for name in self._arrays}

    @contextlib.contextmanager
    def _at(self, state: State) -> Iterator[Any]:
        """The environment in a state; afterwards no placeholder of a tracer stays behind in it."""
        try:
            self._put(state)
            yield self.env
        finally:
            self._put(self._initial)

    def _put(self, state: State) -> None:
        self.env.sim.data = state[0]
        for name, value in state[1].items():
            setattr(self.env, name, value)

    def init(self, key: jax.Array) -> State:
        """The state of drones that have not begun. Goals get keys of their own, which crazyflow never seeds."""
        data, arrays = self._initial
        arrays = {
            name: jax.random.fold_in(key, i) if jnp.issubdtype(value.dtype, jax.dtypes.prng_key) else value
            for i, (name, value) in enumerate(arrays.items(), start=1)
        }
        air = self.air.empty(jax.random.fold_in(key, len(arrays) + 1))
        return data.replace(core=data.core.replace(rng_key=key)), arrays, air

    def reset(self, state: State, mask: jax.Array, stagger: jax.Array) -> tuple[State, jax.Array, jax.Array]:
        """Reset the masked drones; those that begin ahead of the beginning are fragments.

        Ahead means at a random step of the episode, on the reference curve at that point of it, with turning rotors.
        """
        with self._at(state) as env:
            env._reset(mask=mask)
            key, whether, where, turns = jax.random.split(env.sim.data.core.rng_key, 4)
            ahead = mask & stagger & jax.random.bernoulli(whether, AHEAD, (self.num_envs,))
            steps = jax.random.randint(where, (self.num_envs,), 1, self.episode_steps) * ahead
            air = self.air.draw(state[2], mask)
            self._apply_conditions(air, mask)
            if hasattr(env, "begin"):
                env.begin(mask, ahead)
            data, pos = env.sim.data, env.sim.data.states.pos
            if hasattr(env, "trajectory"):
                pos = pos + (env.trajectory[steps - 1] - env.trajectory[-1])[:, None]
            speed = jax.random.uniform(turns, (self.num_envs, 1, 1)) * self._turning
            rotors = jnp.where(ahead[:, None, None], speed, data.states.rotor_vel)
            core = data.core.replace(rng_key=key, steps=data.core.steps + steps[:, None] * env.n_substeps)
            env.sim.data = data.replace(states=data.states.replace(pos=pos, rotor_vel=rotors), core=core)
            air = self.air.begin(air, mask, self._state())
            return (*self._take(), air), self._observe(air), ahead

    def step(self, state: State, action: jax.Array) -> tuple[State, Outcome]:
        """One control step of every drone."""
        with self._at(state) as env:
            action = jnp.clip(action, -1, 1)
            command = self.low + 0.5 * (action + 1) * (self.high - self.low)
            air, acting = self.air.send(state[2], command, (self.low, self.high))
            if self.air.is_windy:
                air, force = self.air.force(air)
                data = env.sim.data
                env.sim.data = data.replace(states=data.states.replace(force=force[:, None]))
            air = self.air.observe(air, self._simulate(air, acting), action)
            if hasattr(env, "advance"):
                env.advance(action)
            obs, measures = self._observe(air), env.measures() if hasattr(env, "measures") else {}
            if self.error:
                true_way = env.obs()[REFERENCE][:, :3] if self.air.is_blurred else obs[:, self.error]
                measures = {"tracking_error": jnp.linalg.norm(true_way, axis=-1)}
            return (*self._take(), air), (obs, env.reward(), env.terminated(), env.truncated(), measures)

    def _apply_conditions(self, air: dict[str, Any], mask: jax.Array) -> None:
        """The conditions drawn for the masked drones, in their parameters and states."""
        drawn, data = air.get("drawn", {}), self.env.sim.data
        params, states = {}, data.states
        for name, factor in parameter_factors(self.dynamics, drawn).items():
            value = getattr(data.params, name)
            params[name] = value * jnp.where(mask, factor, 1.0).reshape(-1, *[1] * (value.ndim - 1))
        if "start_spread" in drawn:
            spread = jnp.where(mask, drawn["start_spread"], 1.0)[:, None, None]
            around = self.env.starts_around[:, None] if hasattr(self.env, "starts_around") else START
            states = states.replace(pos=around + spread * (states.pos - around), vel=spread * states.vel)
        if "rotors" in drawn:
            speed = drawn["rotors"][:, None, None] * self._turning
            states = states.replace(rotor_vel=jnp.where(mask[:, None, None], speed, states.rotor_vel))
        self.env.sim.data = data.replace(params=data.params.replace(**params), states=states)

    def _simulate(self, air: dict[str, Any], acting: Acting) -> jax.Array:
        """Simulate a control step; returns the state [N, 13] as long before its end as observations are late."""
        env, count, is_behind = self.env, self.air.substeps, "observation_delay" in self.air.ranges
        if not (self.air.is_late or is_behind):
            env._apply_action(acting(jnp.zeros((), jnp.int32)))
            env.sim.step(count)
            return self._state()
        before_end = self.air.steps_behind(air)[1] if is_behind else jnp.zeros(self.num_envs, jnp.int32)

        def substep(carry: tuple[Any, jax.Array], i: jax.Array) -> tuple[tuple[Any, jax.Array], None]:
            env.sim.data, seen = carry
            env._apply_action(acting(i))
            env.sim.step(1)
            seen = jnp.where((i == count - 1 - before_end)[:, None], self._state(), seen)
            return (env.sim.data, seen), None

        (env.sim.data, seen), _ = jax.lax.scan(substep, (env.sim.data, self._state()), jnp.arange(count))
        return seen

    def _state(self) -> jax.Array:
        """The true state of the drones, [N, 13]."""
        states = self.env.sim.data.states
        return jnp.concatenate([getattr(states, name)[:, 0] for name in STATE_PARTS], axis=-1)

    def _observe(self, air: dict[str, Any]) -> jax.Array:
        """The flat observation, of the state as it is measured, and what is privileged, [N, O + P]."""
        env, data = self.env, self.env.sim.data
        if self.air.is_blurred:
            seen = jnp.split(air["seen"][:, None], (3, 7, 10), axis=-1)
            env.sim.data = data.replace(states=data.states.replace(**dict(zip(STATE_PARTS, seen, strict=True))))
        parts = env.obs()
        env.sim.data = data
        if self.air.history:
            parts["history"] = self.air.changes(air).reshape(self.num_envs, -1)
        observed = [parts[part.name] for part in self.parts]
        return jnp.concatenate([*observed, self._truth(air)] if self.privileged else observed, axis=-1)

    def _truth(self, air: dict[str, Any]) -> jax.Array:
        """The privileged numbers [N, P]: air, the four rotors' speed (1: hovering), dynamics (one-hot), the task's."""
        rotors = self.env.sim.data.states.rotor_vel[:, 0] / np.where(self._turning > 0, self._turning, 1)
        dynamics = np.eye(len(DYNAMICS), dtype=np.float32)[DYNAMICS.index(self.dynamics)]
        each = [jnp.broadcast_to(part, (self.num_envs, part.shape[-1])) for part in (rotors, dynamics)]
        each += [self.env.truth()] if hasattr(self.env, "truth") else []
        return jnp.concatenate([self.air.truth(air), *each], axis=-1)


class Mixed:
    """Drones of several dynamics in one vector, by turns: drone i has dynamics i mod k.

    Args:
        drones: the k vectors, of N / k drones each.
    """

    def __init__(self, drones: Sequence[Drones]) -> None:
        self.drones = drones
        self.num_envs, self.vector_size = sum(one.num_envs for one in drones), drones[0].num_envs
        self.device, self.action_size = drones[0].device, drones[0].action_size

    def init(self, key: jax.Array) -> State:
        """The state of each vector, with a key of its own."""
        keys = jax.random.split(key, len(self.drones))
        return [one.init(its) for one, its in zip(self.drones, keys, strict=True)]

    def reset(self, state: State, mask: jax.Array, stagger: jax.Array) -> tuple[State, jax.Array, jax.Array]:
        """Reset the masked drones, as `Drones.reset`."""
        return self._call_each(lambda one, its, begins: one.reset(its, begins, stagger), state, mask)

    def step(self, state: State, action: jax.Array) -> tuple[State, Outcome]:
        """One control step of every drone, as `Drones.step`."""
        return self._call_each(Drones.step, state, action)

    def _call_each(self, call: Callable, state: State, rows: jax.Array) -> tuple[Any, ...]:
        """Call a function of each vector, of its state and of its rows; returns the states, and the rest as one."""
        parts = (rows[i :: len(self.drones)] for i in range(len(self.drones)))
        states, *others = zip(*map(call, self.drones, state, parts), strict=True)
        return list(states), *(jax.tree.map(interleaved, *each) for each in others)


def interleaved(*parts: jax.Array) -> jax.Array:
    """The k arrays [N / k, …] as one [N, …], of which row i is from the array i mod k."""
    stacked = jnp.stack(parts, axis=1)
    return stacked.reshape(-1, *stacked.shape[2:])


def hovering_rotors(dynamics: str, params: Any) -> float:
    """The state of each rotor of a drone that hovers: RPM in first principles, newtons of all in other dynamics."""
    if dynamics == "so_rpy":
        return 0.0
    weight = float(params.mass.ravel()[0]) * -float(params.gravity_vec[2])
    if dynamics == "first_principles":
        k0, k1, k2 = map(float, params.rpm2thrust.reshape(-1, 3)[0])
        return (-k1 + math.sqrt(k1**2 - 4 * k2 * (k0 - weight / 4))) / (2 * k2)
    return (weight - float(params.acc_coef.ravel()[0])) / float(params.cmd_f_coef.ravel()[0])


class Programs:
    """The two compiled programs of N environments: `restart(seed, stagger)` and `step(state, action, stagger)`.

    Args:
        envs: pure functions as those of `Drones`: `init(key)`, `reset(state, mask, stagger)` and `step(state, action)`,
            which resets none; and their `num_envs`, `action_size` and `device`.
    """

    def __init__(self, envs: Any) -> None:
        def restart(seed: jax.Array, stagger: jax.Array) -> tuple[State, jax.Array, jax.Array]:
            return envs.reset(envs.init(jax.random.key(seed)), jnp.ones(envs.num_envs, dtype=bool), stagger)

        def step(state: State, action: jax.Array, stagger: jax.Array) -> tuple[State, tuple[Any, ...]]:
            state, (next_obs, reward, terminated, truncated, measures) = envs.step(state, action)
            truncated = truncated & ~terminated
            state, obs, fragment = envs.reset(state, terminated | truncated, stagger)
            flags = jnp.stack((terminated, truncated, fragment))  # each array costs a conversion
            return state, (obs, next_obs, reward, flags, measures)

        self.device, self._step = envs.device, step
        seed, stagger = jax.device_put((np.uint32(0), np.bool_(False)), envs.device)
        action = jax.device_put(np.zeros((envs.num_envs, envs.action_size), np.float32), envs.device)
        begun = jax.jit(restart).lower(seed, stagger)
        stepped = jax.jit(step).lower(begun.out_info[0], action, stagger)
        self.restart, self.step = compile_side_by_side([begun, stepped])
        self._inputs = begun.out_info[0], action, stagger
        size = getattr(envs, "vector_size", envs.num_envs)
        self._moving = [
            leaf.shape[:1] == (size,) and jnp.issubdtype(leaf.dtype, jnp.floating)
            for leaf in jax.tree.leaves(self._inputs[0])
        ]
        self.moving_size = jax.eval_shape(self._take, self._inputs[0]).size
        """F, the count of the numbers in a state that actions may move"""

    def _take(self, state: State) -> jax.Array:
        """The numbers that actions may move, [F]."""
        return ravel_pytree(list(compress(jax.tree.leaves(state), self._moving)))[0]

    def _put(self, state: State, moving: jax.Array) -> State:
        """The state with other numbers of those."""
        leaves, kind = jax.tree.flatten(state)
        others = iter(ravel_pytree(list(compress(leaves, self._moving)))[1](moving))
        pairs = zip(leaves, self._moving, strict=True)
        return jax.tree.unflatten(kind, [next(others) if moves else leaf for leaf, moves in pairs])

    @cached_property
    def pull(self) -> Callable:
        """The program of the derivatives of a step, `pull(state, action, stagger, by)`, compiled where it is needed.

        `by` are the derivatives of a number by the [F] of the state after the step, by obs, next_obs and reward; it
        returns those by the [F] of the state before, and by the action. The step is simulated once more.
        """

        def pull(state: State, action: jax.Array, stagger: jax.Array, by: Any) -> tuple[jax.Array, jax.Array]:
            def moved(moving: jax.Array, action: jax.Array) -> tuple[jax.Array, ...]:
                after, (obs, next_obs, reward, _, _) = self._step(self._put(state, moving), action, stagger)
                return self._take(after), obs, next_obs, reward

            derivatives = jax.vjp(moved, self._take(state), action)[1]
            return derivatives(by)

        state, action, stagger = self._inputs
        after, (obs, next_obs, reward, _, _) = jax.eval_shape(self._step, state, action, stagger)
        by = jax.eval_shape(self._take, after), obs, next_obs, reward
        return jax.jit(pull).lower(state, action, stagger, by).compile()


def compile_side_by_side(lowered: Sequence[Any]) -> list[Callable]:
    """The programs of what `jax.jit` has lowered, compiled by two threads.

    Tracing goes before, one after the other, since it may use one object.
    """
    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(lambda one: one.compile(), lowered))
