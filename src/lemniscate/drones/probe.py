"""Drones flown along the conditions of their flight: all points of all axes side by side, in one program."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from itertools import chain
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch

from lemniscate.drones.crazyflow import make_drones, spec_of
from lemniscate.drones.drones import Drones, compile_side_by_side
from lemniscate.drones.vehicle import CONDITIONS, TABLES, read_ranges
from lemniscate.envs.probe import Axis, Begin, Flown, Tally

MOST_FLIGHTS = 1024
"""flights side by side: as many as a cache holds, and few enough that batches of crashed drones end early"""

CONDITION_AXES = tuple(
    Axis(name, nominal=0.0, **{**row, "shown": tuple(row.get("shown", ("", 1.0)))}).around(CONDITIONS[name].nominal)
    for name, row in TABLES["axes"].items()
)
"""of the conditions in `conditions.toml`"""


class DroneProbe:
    """A probe of drones: a point is a value of one condition, while the others are as they are nominally.

    The points are copies of the same drones, `jax.vmap` over the ends of the conditions' ranges; so at each of them the
    starts, the noise and the direction of the wind are the same. Each of the other dynamics is a program of its own.

    Args:
        env: the id.
        starts: E.
        kwargs: of the environment; conditions among them are nominal here, though not in the simulator as it is, and of
            one that is drawn from a range there is no axis.
        dynamics: all that there are.
    """

    ends_by_failure = True

    def __init__(self, env: str, starts: int, kwargs: Mapping[str, Any], dynamics: Sequence[str]) -> None:
        self._make, self._given = partial(make_drones, env, starts, "cpu", kwargs), read_ranges(kwargs)
        ends = {name: (one.nominal, one.nominal) for name, one in CONDITIONS.items()} | self._given
        fixed = {name: low for name, (low, high) in ends.items() if low == high}
        conditions = [axis.around(fixed[axis.name]) for axis in CONDITION_AXES if axis.name in fixed]
        ranges = {**self._given, **{axis.name: (min(axis.values), max(axis.values)) for axis in conditions}}
        self._drones = self._make(kwargs.get("dynamics"), ranges)
        self._ends = np.array([ends[name] for name in ranges], dtype=np.float32).reshape(-1, 2)
        """the ends [K, 2] of the nominal ranges"""
        nominal = self._drones.dynamics
        ordered = tuple(axis for axis in conditions if axis.name != "motor_time" or nominal != "so_rpy")
        every = Axis("dynamics", tuple(dynamics), nominal, "name", "dynamics", "the dynamics {}")
        self.axes = (*ordered, every)
        self.spec = spec_of(env, self._drones)
        self.period = 1 / self._drones.env.freq
        self._points = [(axis.name, value) for axis in ordered for value in axis.values if value != axis.nominal]
        batches = math.ceil((1 + len(self._points)) / max(1, MOST_FLIGHTS // starts))
        self._size = math.ceil((1 + len(self._points)) / batches)
        """the points of a batch"""

    @cached_property
    def _flights(self) -> dict[str, Callable[..., list[Flown]]]:
        """`_fly` with the programs of each of the dynamics by its name: those of a batch, first, and those of a point.

        Traced one after the other, since tracing may use one object, but compiled side by side.
        """
        axis = self.axes[-1]
        others = [self._make(str(name), self._given) for name in axis.values if name != axis.nominal]
        every = [self._drones, *others]
        sizes = [self._size, *[1] * len(others)]
        lowered = [program for one, points in zip(every, sizes, strict=True) for program in _lowered(one, points)]
        compiled = compile_side_by_side(lowered)
        each = zip(every, compiled[::2], compiled[1::2], strict=True)
        return {one.dynamics: partial(_fly, one, *programs) for one, *programs in each}

    def fly(self, begin: Begin, seed: int) -> tuple[Flown, dict[str, list[Flown]]]:
        """All flights, see `Probe.fly`; those that are nominal with their actions.

        Those of each point of a condition batch by batch, of which the last is filled up with nominal ones.
        """
        (_, fly), *others = self._flights.items()
        names, count = list(self._drones.air.ranges), 1 + len(self._points)
        ends = np.tile(self._ends, (math.ceil(count / self._size) * self._size, 1, 1))
        for row, (name, value) in enumerate(self._points, 1):
            ends[row, names.index(name)] = value
        batches = [fly(begin, seed, ends[first : first + self._size]) for first in range(0, len(ends), self._size)]
        nominal, *flown = chain(*batches)
        at = dict(zip(self._points, flown, strict=False))  # the last batch has more
        given = np.array(list(self._given.values()), np.float32).reshape(1, -1, 2)
        at |= {("dynamics", name): one(begin, seed, given)[0] for name, one in others}
        return nominal, {a.name: [at.get((a.name, value), nominal) for value in a.values] for a in self.axes}


def _fly(drones: Drones, restart: Callable, step: Callable, begin: Begin, seed: int, ends: np.ndarray) -> list[Flown]:
    """The flights of P copies of E drones, with the ends [P, K, 2] of their ranges; the first with its actions.

    No flight is reset, so what follows a crash means nothing. A drone whose state is not finite has crashed.
    """
    starts, kept = drones.num_envs, list[torch.Tensor]()
    tally, act, lengths = Tally(len(ends) * starts), begin(), torch.zeros(drones.num_envs, dtype=torch.int64)
    state, obs = restart(np.uint32(seed), ends)
    for _ in range(drones.episode_steps):
        action = act(torch.nan_to_num(torch.from_dlpack(obs))).clamp(-1, 1)
        kept.append(action[:starts].clone())
        lengths += tally.going[:starts]
        state, obs, *out = step(state, jax.dlpack.from_dlpack(action.contiguous()))
        reward, crashed, finished = map(torch.from_dlpack, out)
        tally.add(torch.nan_to_num(reward), crashed, finished)
        if not tally.going.any():
            break
    first, *others = zip(tally.returns.split(starts), tally.terminated.split(starts), strict=True)
    actions = [torch.stack(kept[:length])[:, i] for i, length in enumerate(lengths.tolist())]
    return [Flown(*first, actions), *(Flown(*one) for one in others)]


def _lowered(drones: Drones, points: int) -> tuple[Any, Any]:
    """`restart(seed, ends) -> state, obs`; `step(state, action) -> state, obs, reward, crashed, finished`: traced."""
    drones.env.sim.device = None  # crazyflow places actions on a device, which jax.vmap cannot
    every, calm = jnp.ones(drones.num_envs, dtype=bool), jnp.array(False)

    def restart(seed: jax.Array, ends: jax.Array) -> tuple[Any, jax.Array]:
        def one(ends: jax.Array) -> tuple[Any, jax.Array]:
            data, arrays, air = drones.init(jax.random.key(seed))
            return drones.reset((data, arrays, {**air, "ends": ends}), every, calm)[:2]

        state, obs = jax.vmap(one)(ends)
        return state, obs.reshape(-1, obs.shape[-1])

    def step(state: Any, action: jax.Array) -> tuple[Any, ...]:
        state, (obs, reward, ended, _, measures) = jax.vmap(drones.step)(
            state, action.reshape(points, drones.num_envs, -1)
        )
        finished = measures["success"] == 1 if "success" in measures else jnp.zeros_like(ended)
        crashed = (ended & ~finished) | ~jnp.isfinite(obs).all(-1)
        return state, obs.reshape(-1, obs.shape[-1]), reward.ravel(), crashed.ravel(), finished.ravel()

    ends = np.zeros((points, len(drones.air.ranges), 2), np.float32)
    action = np.zeros((points * drones.num_envs, drones.action_size), np.float32)
    begun = jax.jit(restart).lower(np.uint32(0), ends)
    return begun, jax.jit(step).lower(begun.out_info[0], action)
