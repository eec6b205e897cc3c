"""Environments of every shape, drawn at random: each trains, or is refused in one sentence; nothing changes in silence.

A `Plan` describes an environment and knows whether it is right, or which one fault it has. `Drawn` is that environment;
it records what it returned, in plain types, and which actions it was given: that is the oracle.
"""

import re
import signal
import warnings
from collections import Counter
from dataclasses import dataclass, field
from functools import cache
from types import MappingProxyType
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import NormalizeReward, TransformObservation, TransformReward
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from lemniscate.algos import ppo, sac
from lemniscate.data.replay import interact
from lemniscate.data.rollout import collect
from lemniscate.envs import registry
from lemniscate.errors import NonFiniteError, UserError
from lemniscate.types import Rollout

STEPS = 4
SECONDS = 60
"""of the processor, after which an environment hangs"""
NEVER = 10**9

WHOLE = ("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "bool")
REAL = ("float16", "float32", "float64")
SHAPES = ((), (1,), (3,), (2, 2), (1, 2, 1))
PICTURES = ((6, 7, 3), (3, 6, 7), (7, 6, 1), (1, 6, 7), (1, 2, 1), (2, 6, 7, 3), (2, 3, 6, 7), (18, 17))
MODES = [mode.name for mode in AutoresetMode]
MASKS = ("action_mask", "action_masks", "legal_action_mask")

FORMS = ("same", "list", "tensor", "wide", "real", "read-only", "strided", "swapped", "fortran", "masked", "buffer")
NUMBERS = {
    "float": float,
    "float32": np.float32,
    "float64": np.float64,
    "0-d": np.array,
    "[1]": lambda x: np.array([x]),
    "tensor": torch.tensor,
    "tensor [1]": lambda x: torch.tensor([x]),
    "whole": round,
    "int64": lambda x: np.int64(round(x)),
    "half": np.float16,
}
"""the forms of a number that is right"""
FLAGS = {
    "bool": bool,
    "bool_": np.bool_,
    "0-d": np.array,
    "[1]": lambda x: np.array([x]),
    "tensor": torch.tensor,
    "whole": int,
    "float": float,
    "list": lambda x: [x],
}
JUNK = {
    "text": "far",
    "None": None,
    "long": np.zeros(3),
    "list": [1.0],
    "object": object(),
    "empty": np.zeros((0, 2)),
    "text array": np.array("x"),
    "date": np.datetime64("2020-01-01"),
    "set": {1},
    "endless": 10**400,
}
"""in an info, and no number"""

WRONG_SPACES = {
    "observes a sequence": spaces.Sequence(spaces.Discrete(2)),
    "observes text": spaces.Dict({"a": spaces.Text(3), "b": spaces.Discrete(2)}),
    "observes nothing": spaces.Tuple([spaces.Box(-1, 1, (0,)), spaces.Dict({})]),
    "observes one of 2**62": spaces.Discrete(2**62),
    "observes far too many": spaces.Dict({"a": spaces.MultiDiscrete([2**40, 2])}),
    "acts by nothing": spaces.Box(-1, 1, (2, 0)),
    "acts by one of 2**62": spaces.Discrete(2**62, start=-5),
    "acts by far too many": spaces.MultiDiscrete([2**40, 2]),
    "acts by a dictionary": spaces.Dict({"a": spaces.Discrete(2)}),
    "acts by text": spaces.Text(2),
}
WRONG_MAKING = ("no observation_space", "no action_space", "no environment", "no seed", "learns statistics")
WRONG_VALUES = {
    "reward": (None, "1", [1.0, 2.0], 1j, {}, np.nan, -np.inf, np.float64(1e39), torch.zeros(2), object(), [[1.0], 2.0]),
    "terminated": (None, 2, "no", [True, False], np.nan, 0.5, np.zeros(0), object()),
    "truncated": (None, -1, "", {}, np.array([0, 2]), b"1"),
    "info": (None, [], "x", 3, [("a", 1)], np.zeros(2)),
    "arity": (lambda x: x[:-1], lambda x: (*x, {}), list, lambda x: None, lambda x: x[0]),
    "observation": (None, "text", [[1.0], 2.0], 1j, np.array("a"), object(), np.zeros((4, 3, 2)), {"a": 1}, np.datetime64("nat")),
}  # fmt: skip
"""of what comes back, one after the other"""
SUBTLE = (
    "longer",
    "not finite",
    "fraction",
    "outside",
    "lacking",
    "measure",
    "no choice",
    "mask size",
    "mask kind",
    "late mask",
    "mask beside",
)
"""faults that need an environment of their own kind"""


class Event(NamedTuple):
    """What an environment returned, in plain types, and the action that it had been given; None at a reset."""

    action: Any
    obs: Any
    reward: float
    terminated: bool
    truncated: bool
    numbers: dict[str, float]
    mask: np.ndarray | None
    t: int


@dataclass(eq=False)
class Plan:
    """An environment in words. `wrong` is its fault, which shows from event `at` on; None where it is right."""

    observation: gym.Space
    action: gym.Space
    seed: int = 0
    num_envs: int = 1
    way: str = "function"
    algorithm: str = "ppo"
    form: str = "same"
    reward: str = "float"
    flag: str = "bool"
    scale: float = 1.0
    lengths: tuple[int, ...] = (3,)
    end: str = "terminated"
    limit: int | None = None
    wrappers: tuple[str, ...] = ()
    info: dict[Any, tuple[str, ...]] = field(default_factory=dict)
    mask: str | None = None
    mask_in_steps: bool = True
    none_at_end: bool = False
    scribbles: bool = False
    wrong: str | None = None
    spoiled: Any = None
    at: int = 0
    made: list[Any] = field(default_factory=list, repr=False)

    def __deepcopy__(self, memo):
        return self

    def choices(self):
        """The number of choices of each component of the actions."""
        counts = getattr(self.action, "nvec", None)
        return np.ravel(self.action.n if counts is None else counts).astype(int)


# The environment


class Drawn(gym.Env):
    """The environment of a plan."""

    def __init__(self, plan):
        self.plan, self.metadata = plan, {"render_modes": [], "measures": ["height"]}
        plan.made.append(self)
        if plan.wrong != "no observation_space":
            self.observation_space = plan.observation
        if plan.wrong != "no action_space":
            self.action_space = plan.action
        if plan.mask == "method":
            self.action_masks = lambda: self.shown
        self.buffer = None

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self.log, self.episode, self.is_spoiled = [], -1, False
            self.rng = np.random.default_rng([self.plan.seed, seed])
            self.legal = None
        self.episode, self.t = self.episode + 1, 0
        obs, *_, info = self._event(None, False)
        return self._spoil("arity", (obs, info))

    def step(self, action):
        self.t += 1
        length = self.plan.lengths[self.episode % len(self.plan.lengths)]
        given = np.array(action)
        if self.plan.scribbles and isinstance(action, np.ndarray) and action.flags.writeable:
            action[...] = 1
        returned = self._event(given, self.t >= length)
        return self._spoil("arity", returned)

    def _event(self, action, done):
        plan, rng, number = self.plan, self.rng, len(self.log)
        obs = value_of(plan.observation, rng, plan.scale)
        mask, shown_mask = self._mask(action, done)
        if plan.mask == "key":
            obs["action_mask"] = mask.astype(np.int8)
        reward = float(rng.integers(-8, 9)) if plan.reward in ("whole", "int64") else rng.integers(-8, 9) / 4
        reward *= 1.0 if plan.reward in ("whole", "int64", "half") else plan.scale
        ends = [done and plan.end in (name, "both") for name in ("terminated", "truncated")]
        info, numbers = self._info(number)
        if shown_mask is not None and plan.mask in MASKS:
            info[plan.mask] = shown_mask
        event = Event(action, obs, reward, *ends, numbers, mask, self.t)
        self.log.append(event)
        self.can_spoil_choice = not done and (plan.limit is None or self.t < plan.limit)
        returned = self._shown(obs), NUMBERS[plan.reward](reward), *map(FLAGS[plan.flag], ends), info
        return self._spoiled_parts(returned, action is not None)

    def _shown(self, obs):
        if self.plan.form != "buffer":
            return disguised(obs, self.plan.form)
        self.buffer = overwritten(self.buffer, obs)
        return self.buffer

    def _mask(self, action, done):
        """The flat mask that holds, and what is shown of it."""
        plan = self.plan
        self.shown = None
        if plan.mask is None:
            return None, None
        if action is None or plan.mask_in_steps:
            parts = [self.rng.integers(0, 2, n) for n in plan.choices()]
            for part in parts:
                part[self.rng.integers(len(part))] = 1
            if done and plan.none_at_end:
                parts = [0 * part for part in parts]
            self.legal = np.concatenate(parts).astype(bool)
            several = isinstance(plan.action, spaces.MultiDiscrete)
            forms = (
                self.legal,
                self.legal.astype(np.int8),
                self.legal.tolist(),
                torch.tensor(self.legal),
                tuple(parts),
            )
            self.shown = forms[0 if plan.way in MODES else self.rng.integers(5 if several else 4)]
        return self.legal, self.shown

    def _info(self, number):
        info: dict[Any, Any] = {}
        numbers: dict[str, float] = {}
        for key, forms in self.plan.info.items():
            form, value = forms[number % len(forms)], float(self.rng.integers(-8, 9))
            if form in JUNK:
                info[key] = JUNK[form]
            elif form == "nested":
                info[key] = {"x": value, "deep": {"y": np.float32(value), "text": "x"}, 1: 2}
                numbers |= {f"info/{key}/x": value, f"info/{key}/deep/y": value, f"info/{key}/1": 2.0}
            elif form != "missing":
                info[key] = NUMBERS[form](value)
                numbers[key if key in ("is_success", "height") else f"info/{key}"] = value
        return info, {name: value for name, value in numbers.items() if not name.startswith("info/_")}

    def _due(self, step_alone=False, stepped=True):
        due = (
            self.plan.way not in MODES
            and not self.is_spoiled
            and len(self.log) > self.plan.at
            and (stepped or not step_alone)
        )
        self.is_spoiled |= due
        return due

    def _spoil(self, what, returned):
        return self.plan.spoiled(returned) if self.plan.wrong == what and self._due() else returned

    def _spoiled_parts(self, returned, stepped):
        obs, reward, terminated, truncated, info = returned
        wrong, spoiled = self.plan.wrong, self.plan.spoiled
        if (
            wrong in ("observation", "longer", "not finite", "fraction", "outside", "lacking", "mask beside")
            and self._due()
        ):
            obs = spoiled(obs) if callable(spoiled) else spoiled
        elif wrong == "info" and self._due():
            info = spoiled
        elif wrong == "measure" and self._due(True, stepped):
            info["is_success"] = spoiled
        elif wrong in ("mask size", "mask kind") and self._due():
            info["action_mask"] = self.shown = spoiled
        elif wrong == "late mask" and stepped:
            info["action_mask"] = np.ones(self.plan.choices().sum(), bool)
        elif wrong == "no choice" and self.can_spoil_choice and self._due():
            info["action_mask"] = self.shown = np.zeros(self.plan.choices().sum(), bool)
        elif wrong in ("reward", "terminated", "truncated") and self._due(True, stepped):
            reward = spoiled if wrong == "reward" else reward
            terminated = spoiled if wrong == "terminated" else terminated
            truncated = spoiled if wrong == "truncated" else truncated
        return obs, reward, terminated, truncated, info


class NoSeed(Drawn):
    """Its reset takes nothing."""

    def reset(self):
        return super().reset(seed=0)


def drawn(plan):
    """A function that makes it."""
    if plan.wrong == "no environment":
        return plan
    env = NoSeed(plan) if plan.wrong == "no seed" else Drawn(plan)
    return NormalizeReward(env) if plan.wrong == "learns statistics" else env


def drawn_vector(num_envs, plan):
    """A vector environment of one's own, in the mode that the plan names."""
    return Vector([lambda: Drawn(plan)] * num_envs, autoreset_mode=AutoresetMode[plan.way])


class Vector(SyncVectorEnv):
    """What it returns as a whole may be wrong."""

    steps = 0

    def step(self, actions):
        returned, plan = list(super().step(actions)), self.envs[0].plan
        self.steps += 1
        if self.steps != plan.at + 1 or plan.wrong is None:
            return tuple(returned)
        if plan.wrong == "arity":
            return plan.spoiled(tuple(returned))
        returned[["observation", "reward", "terminated", "truncated", "info"].index(plan.wrong)] = plan.spoiled
        return tuple(returned)


def doubled(env):
    """What is seen, twice as large."""
    old = env.observation_space
    space = spaces.Box(2 * old.low, 2 * old.high, old.shape, old.dtype)
    return TransformObservation(env, lambda obs: 2 * obs, space)


def tenfold(env):
    return TransformReward(env, lambda reward: 10 * reward)


class Aged(gym.Wrapper):
    """The observation beside the age of the episode."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = aged_space(env.observation_space)

    def reset(self, *, seed=None, options=None):
        obs, info = self.env.reset(seed=seed, options=options)
        return {"own": obs, "age": 0}, info

    def step(self, action):
        obs, *rest = self.env.step(action)
        return ({"own": obs, "age": self.unwrapped.t}, *rest)


def aged_space(space):
    return spaces.Dict({"own": space, "age": spaces.Box(0, np.inf, (), np.float32)})


class Table(gym.ActionWrapper):
    """Three actions, counted from 5, in the place of the environment's own."""

    def __init__(self, env):
        super().__init__(env)
        self.action_space = spaces.Discrete(3, start=5)

    def action(self, action):
        return table(self.unwrapped.plan)[int(action) - 5].copy()


def table(plan):
    """The three."""
    rng = np.random.default_rng(plan.seed)
    return [np.asarray(value_of(plan.action, rng)) for _ in range(3)]


# Values


def value_of(space, rng, scale=1.0):
    """A value of a space, in its own types; small numbers, which are exact in every type, or floats times `scale`."""
    if isinstance(space, spaces.Dict):
        return {key: value_of(part, rng, scale) for key, part in space.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(value_of(part, rng, scale) for part in space)
    if isinstance(space, spaces.Discrete):
        return space.dtype.type(int(space.start) + int(rng.integers(int(space.n))))
    if isinstance(space, spaces.MultiDiscrete):
        drawn = rng.integers(space.nvec.astype(np.int64))
        return (space.start.astype(np.int64) + drawn).astype(space.dtype)
    if isinstance(space, spaces.MultiBinary):
        return rng.integers(0, 2, space.shape, np.int8)
    if space.dtype.kind == "f":
        times = scale if space.dtype.itemsize > 2 else 1.0
        return np.clip(times * rng.integers(-8, 9, space.shape) / 4, space.low, space.high).astype(space.dtype)
    low, high = (np.clip(bound.astype(np.float64), -100, 255).astype(np.int64) for bound in (space.low, space.high))
    return np.asarray(rng.integers(low, high, endpoint=True)).astype(space.dtype)


def disguised(value, form):
    """The same in another form."""
    if isinstance(value, dict):
        inside = {key: disguised(part, form) for key, part in value.items()}
        return MappingProxyType(inside) if form == "read-only" else inside
    if isinstance(value, tuple):
        inside = [disguised(part, form) for part in value]
        return inside if form == "list" else tuple(inside)
    array = np.asarray(value)
    return {
        "same": lambda: value,
        "list": array.tolist,
        "tensor": lambda: torch.from_numpy(array.copy()),
        "wide": lambda: array.astype(np.float64 if array.dtype.kind == "f" else np.int64),
        "real": lambda: array.astype(np.float64),
        "read-only": lambda: np.broadcast_to(array, array.shape),
        "strided": lambda: np.repeat(array, 2, axis=0)[::2] if array.ndim else array,
        "swapped": lambda: array.astype(array.dtype.newbyteorder()),
        "fortran": lambda: np.asfortranarray(array) if array.ndim else array,
        "masked": lambda: np.ma.array(array),
    }[form]()


def overwritten(buffer, value):
    """`value`, written into the arrays that were returned before, if there were any."""
    if isinstance(value, dict):
        return {key: overwritten(buffer and buffer[key], part) for key, part in value.items()}
    if isinstance(value, tuple):
        return tuple(overwritten(buffer and buffer[i], part) for i, part in enumerate(value))
    if buffer is None:
        return np.array(value)
    buffer[...] = value
    return buffer


def leaves(space, value):
    """The parts of an observation without parts, each with its space, in the order of the space."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        named = space.items() if isinstance(space, spaces.Dict) else enumerate(space)
        return [leaf for key, part in named for leaf in leaves(part, value[key])]
    return [(space, value)]


def is_picture(space):
    return isinstance(space, spaces.Box) and space.dtype == np.uint8 and space.shape in PICTURES


def flat(space, value):
    """An observation as a policy sees it: numbers as they are, choices one-hot, pictures height × width × channels."""
    pieces = []
    for part, own in leaves(space, value):
        if isinstance(part, spaces.Discrete | spaces.MultiDiscrete):
            counts = np.ravel(part.n if isinstance(part, spaces.Discrete) else part.nvec)
            chosen = np.ravel(own).astype(int) - np.ravel(part.start).astype(int)
            pieces += [np.eye(int(n))[i] for n, i in zip(counts, chosen, strict=True)]
        elif is_picture(part) and len(part.shape) > 2:
            first = part.shape[-1] > part.shape[-3]  # the channels
            rows = np.moveaxis(own, -3, -1) if first else own
            pieces.append(np.ravel(rows if rows.ndim == 3 else np.moveaxis(rows, 0, 2)))
        else:
            pieces.append(np.ravel(own))
    pieces = [piece for piece in pieces if piece.size]
    pictures = all(is_picture(part) for part, own in leaves(space, value) if np.size(own))
    return np.concatenate([piece.astype(np.uint8 if pictures else np.float32) for piece in pieces])


# The strategy


def box(draw, dtypes, unbounded=True):
    """Of numbers, with every kind of bounds."""
    dtype, shape = np.dtype(draw(st.sampled_from(dtypes))), draw(st.sampled_from(SHAPES))
    if dtype == np.uint8 and shape in PICTURES:
        shape = (3,)
    ends = [(-1, 1), (0, 5), (-2, 0.5)] + [(-np.inf, np.inf), (0, np.inf), (-np.inf, 1)] * unbounded
    if dtype.kind in "iu":
        full = (np.iinfo(dtype).min, np.iinfo(dtype).max)
        ends = [(0, 5), full] + ([(-1, 1), (-3, 1)] if dtype.kind == "i" else [(2, full[1])])
    if dtype.kind == "b":
        ends = [(0, 1)]
    drawn = [draw(st.sampled_from(ends)) for _ in range(min(2, int(np.prod(shape))) or 1)]
    bounds = [np.resize(np.array(bound, dtype), shape) for bound in zip(*drawn, strict=True)]
    return spaces.Box(*bounds, shape, dtype)


def choices(draw, most=4):
    """Discrete or MultiDiscrete."""
    dtype, start = draw(st.sampled_from(WHOLE[:-1])), draw(st.integers(-3, 3))
    start = abs(start) if dtype.startswith("u") else start
    if draw(st.booleans()):
        dtype = dtype if dtype.startswith("int") else "int64"
        return spaces.Discrete(draw(st.integers(1, most)), start=start, dtype=dtype)
    nvec = np.array(draw(st.sampled_from([[2, 3], [1], [4, 1, 2], [[2, 3], [3, 1]], [100], [[5]]])), dtype)
    if dtype == "int8" and draw(st.booleans()):
        start = 127 - int(nvec.max()) + 1  # up to the largest number of the type
    return spaces.MultiDiscrete(nvec, dtype, start=np.full_like(nvec, start))


def observed(draw, depth=0):
    """A space of observations."""
    kinds = ["real", "whole", "bytes", "picture", "choices", "binary"] + ["dict", "tuple"] * 2 * (depth < 2)
    kind = draw(st.sampled_from(kinds + ["none"] * (depth > 0)))
    if kind in ("dict", "tuple"):
        parts = [observed(draw, depth + 1) for _ in range(draw(st.integers(1, 3)))]
        if all(isinstance(part, spaces.Box) and 0 in part.shape for part in parts):
            parts.append(spaces.Discrete(2))
        names = draw(st.permutations(["b", "a", "c d", "1"]))
        return spaces.Tuple(parts) if kind == "tuple" else spaces.Dict(dict(zip(names, parts, strict=False)))
    if kind == "picture":
        high = draw(st.sampled_from([255, 255, 1]))
        shape = draw(st.sampled_from(PICTURES))
        return spaces.Box(0, high if len(shape) > 2 else 255, shape, np.uint8)
    return {
        "real": lambda: box(draw, REAL),
        "whole": lambda: box(draw, WHOLE),
        "bytes": lambda: spaces.Box(
            0, draw(st.sampled_from([1, 255])), draw(st.sampled_from([(4,), (2, 3)])), np.uint8
        ),
        "choices": lambda: choices(draw),
        "binary": lambda: spaces.MultiBinary(draw(st.sampled_from([1, 3, [2, 2]]))),
        "none": lambda: spaces.Box(-1, 1, draw(st.sampled_from([(0,), (2, 0)]))),
    }[kind]()


def acted(draw):
    """A space of actions."""
    kind = draw(st.sampled_from(["real", "whole", "choices", "choices", "binary"]))
    if kind == "binary":
        return spaces.MultiBinary(draw(st.sampled_from([1, 3, [2, 2]])))
    return choices(draw) if kind == "choices" else box(draw, REAL if kind == "real" else WHOLE)


@st.composite
def plans(draw):
    """Any of them, most of them right."""
    one_of = lambda *options: draw(st.sampled_from(options))  # noqa: E731
    plan = Plan(observed(draw), acted(draw), seed=draw(st.integers(0, 2**32 - 1)), num_envs=draw(st.integers(1, 3)))
    plan.lengths = one_of((3,), (1,), (NEVER,), (1, 2), (2, 5, 1), (4, NEVER))
    plan.end = one_of("terminated", "truncated", "both")
    plan.scribbles, plan.scale = draw(st.booleans()), one_of(1.0, 1.0, 1.0, 1e4, 1e30)
    _draw_mask(draw, plan)
    plan.way = one_of("function", "function", "function", "class", *MODES)
    if plan.way in MODES:  # Gymnasium's vector takes plain returns alone
        plan.info = {"a": ("float",), "height": ("float",)} if draw(st.booleans()) else {}
        plan.mask_in_steps = True
        if plan.mask == "method":
            plan.mask = None
        if draw(st.integers(0, 3)) == 0:
            plan.num_envs, plan.at = 3, draw(st.integers(0, 3))
            plan.wrong = draw(st.sampled_from(list(WRONG_VALUES)))
            one = {"reward": (1.0, np.float32(1)), "terminated": (True,), "truncated": (False,)}.get(plan.wrong, ())
            plan.spoiled = draw(st.sampled_from([*WRONG_VALUES[plan.wrong], *one]))
        return plan
    plan.form, plan.reward, plan.flag = one_of(*FORMS), one_of(*NUMBERS), one_of(*FLAGS)
    for key in draw(
        st.lists(st.sampled_from(["a", "is_success", "height", 3, "_b", "nest", "b c"]), unique=True, max_size=3)
    ):
        number = st.sampled_from(
            [*NUMBERS, "None", "missing"] + [*JUNK, "nested"] * (key not in ("is_success", "height"))
        )
        plan.info[key] = tuple(draw(st.lists(number, min_size=1, max_size=3)))
    if plan.way == "class" or draw(st.booleans()):
        plan.limit = one_of(None, 1, 2, 4)
    if plan.mask is None:
        _draw_wrappers(draw, plan)
    if draw(st.integers(0, 2)) == 0:
        _draw_fault(draw, plan)
    elif isinstance(plan.action, spaces.Box) and "table" not in plan.wrappers and draw(st.booleans()):
        plan.algorithm, plan.scale = "sac", min(plan.scale, 1e4)
        plan.wrong = (
            None if np.isfinite(np.concatenate([*map(np.ravel, bounds_of(plan.action))])).all() else "no bounds"
        )
    return plan


def _draw_mask(draw, plan):
    if isinstance(plan.action, spaces.Discrete | spaces.MultiDiscrete) and draw(st.booleans()):
        plan.mask = draw(st.sampled_from([*MASKS, "method", "key"]))
        plan.none_at_end = draw(st.booleans())
        plan.mask_in_steps = plan.mask in ("method", "key") or draw(st.booleans())
    if plan.mask == "key":
        mask = spaces.Box(0, 1, (int(plan.choices().sum()),), np.int8)
        plan.observation = spaces.Dict({"seen": plan.observation, "action_mask": mask})


def _draw_wrappers(draw, plan):
    space, chosen = plan.observation, []
    if isinstance(space, spaces.Box) and space.dtype.kind == "f" and space.shape and plan.form != "list":
        chosen += ["doubled"] * draw(st.booleans())
    if plan.reward != "list":
        chosen += ["tenfold"] * draw(st.booleans())
    chosen += ["aged"] * draw(st.booleans()) + ["table"] * draw(st.booleans())
    plan.wrappers = tuple(draw(st.permutations(chosen))) if "doubled" not in chosen else tuple(chosen)


def _draw_fault(draw, plan):
    """One thing that is wrong, where the plan has room for it."""
    plan.at = draw(st.integers(0, 3))
    kind = draw(st.sampled_from(["spaces", "making", *WRONG_VALUES, *WRONG_VALUES, *SUBTLE]))
    if plan.wrappers and kind not in ("reward", "info"):
        plan.wrappers = ()
    if kind == "truncated":  # of which a time limit would make a right one
        plan.limit = None
    if kind == "reward":
        plan.wrappers = tuple(name for name in plan.wrappers if name != "tenfold")
    if kind == "spaces":
        plan.wrong = draw(st.sampled_from(list(WRONG_SPACES)))
        plan.mask, name = None, "observation" if plan.wrong.startswith("observes") else "action"
        setattr(plan, name, WRONG_SPACES[plan.wrong])
    elif kind == "making":
        plan.wrong, plan.way = draw(st.sampled_from(WRONG_MAKING)), "function"
    elif kind in WRONG_VALUES:
        plan.wrong, plan.spoiled = kind, draw(st.sampled_from(WRONG_VALUES[kind]))
        if kind == "observation" and isinstance(plan.spoiled, dict):
            plan.spoiled = None if isinstance(plan.observation, spaces.Dict) else plan.spoiled
        if plan.spoiled is list:  # of which Gymnasium's own wrappers would make a tuple
            plan.limit, plan.wrappers = None, ()
    else:
        _draw_subtle_fault(draw, plan, kind)


def _draw_subtle_fault(draw, plan, kind):
    one_of = lambda *options: draw(st.sampled_from(options))  # noqa: E731
    choosing = isinstance(plan.action, spaces.Discrete | spaces.MultiDiscrete)
    if kind in ("mask size", "mask kind", "no choice") and choosing:
        _give_mask(plan)
    space, count = plan.observation, int(plan.choices().sum()) if choosing else 0
    own = plan.form != "buffer" and plan.mask != "key"
    counted = isinstance(space, spaces.Discrete | spaces.MultiDiscrete) and own
    boxed = isinstance(space, spaces.Box) and own
    arrays = boxed or (own and isinstance(space, spaces.MultiDiscrete | spaces.MultiBinary))
    whole_masks = ([1] * (count + 2), np.zeros((2, count)), *["x", {}] * (count > 1)) if choosing else ([1, 0],)
    first = lambda: int(np.ravel(space.start)[0])  # noqa: E731
    beyond = lambda: first() + int(np.max(getattr(space, "nvec", getattr(space, "n", 0))))  # noqa: E731
    room, spoiled = {
        "longer": (arrays, lambda: lambda obs: np.stack([np.asarray(obs)] * 2)),
        "not finite": (boxed and not is_picture(space), lambda: np.full(space.shape, one_of(np.nan, np.inf, -np.inf))),
        "fraction": (boxed and space.dtype.kind in "iu", lambda: np.full(space.shape, 0.5)),
        "outside": (counted, lambda: np.full(space.shape, one_of(first() - 1, beyond()))),
        "lacking": (isinstance(space, spaces.Dict | spaces.Tuple), lambda: without_the_first),
        "mask beside": (isinstance(space, spaces.Dict) and own, lambda: lambda obs: {**obs, "action_mask": [1, 1]}),
        "measure": ("is_success" not in plan.info, lambda: one_of("yes", np.zeros(3), object(), [1.0])),
        "mask size": (choosing, lambda: [1] * (count + 1)),
        "mask kind": (True, lambda: one_of(*whole_masks)),
        "no choice": (choosing, lambda: None),
        "late mask": (choosing and plan.mask is None, lambda: None),
    }[kind]
    if room:
        plan.wrong, plan.spoiled = kind, spoiled()


def _give_mask(plan):
    if plan.mask == "key":
        plan.observation = plan.observation["seen"]
    plan.mask = "method" if plan.mask == "method" else "action_mask"
    plan.mask_in_steps, plan.none_at_end = True, False


def without_the_first(obs):
    return dict(list(obs.items())[1:]) if hasattr(obs, "items") else obs[1:]


# The property


@cache
def config(algorithm, num_envs):
    """A Config that trains in milliseconds."""
    shared = {"env": "x", "num_envs": num_envs, "hidden": ()}
    rows = num_envs * STEPS
    if algorithm == "ppo":
        return ppo.Config(**shared, num_steps=STEPS, total_steps=rows, minibatch_size=rows, epochs=1)
    off = {"total_steps": 100 * rows, "learning_starts": 1, "batch_size": 4, "buffer_size": rows, "critic_hidden": (4,)}
    return sac.Config(**shared, **off)


def make(plan):
    """The environments, by one of the ways in."""
    kwargs: dict[str, Any] = {"plan": plan}
    known = {"doubled": doubled, "tenfold": tenfold, "aged": Aged, "table": Table}
    wrappers: list[Any] = [known[name] for name in plan.wrappers]
    if plan.way == "class" and plan.limit:
        kwargs["max_episode_steps"] = plan.limit
    elif plan.limit:
        wrappers.append(f"gymnasium.wrappers:TimeLimit(max_episode_steps={plan.limit})")
    maker = {"function": drawn, "class": Drawn}.get(plan.way, drawn_vector)
    return registry.make(maker, plan.num_envs, kwargs=kwargs, wrappers=wrappers)


def train(plan, env):
    """A rollout, the steps that made it, and an update from it; the parameters stay finite."""
    steps, original = [], env.step
    env.step = lambda action: steps.append(original(action)) or steps[-1]
    algorithm = {"ppo": ppo, "sac": sac}[plan.algorithm]
    settings = config(plan.algorithm, plan.num_envs)
    state = algorithm.init(settings, env.spec, env.device)
    policy = state.networks.policy
    if algorithm is ppo:
        rollout = collect(env, policy, STEPS, state.rng.action)
        given = rollout.obs.clone(), rollout.action.clone()
        ppo.update(settings, state, rollout)
        assert all(map(torch.equal, given, (rollout.obs, rollout.action)))
    else:
        rows = []
        for i in range(STEPS):
            obs = env.obs
            step = interact(env, policy, state.replay, state.action_noise, state.rng.action, random=i == 0)
            kept = state.replay.transitions[i * plan.num_envs : (i + 1) * plan.num_envs]
            assert torch.equal(kept.obs, obs)
            rows.append(
                Rollout(
                    obs, kept.action.clone(), kept.reward, kept.next_obs, kept.terminated, step.truncated, step.valid
                )
            )
        rollout = Rollout.stack(rows)
        sac.update(settings, state)
    assert all(parameter.isfinite().all() for parameter in state.networks.parameters())
    return rollout, steps


def check(plan, rollout, steps):
    """Every row of the rollout against what the environment recorded."""
    space = plan.observation
    for name in plan.wrappers:
        space = aged_space(space) if name == "aged" else space
    rows = {name: column.numpy() for name, column in vars(rollout).items()}
    after = np.stack([step.obs.numpy() for step in steps])
    for i, one in enumerate(plan.made[-plan.num_envs :]):
        events = iter(one.log)
        event = next(events)
        same(seen(plan, space, event), rows["obs"][0, i])
        for t in range(STEPS):
            row = {name: column[t, i] for name, column in rows.items()}
            before, event = event, next(events)
            same(seen(plan, space, event), row["next_obs"])
            if row["valid"]:
                late = plan.limit is not None and event.t >= plan.limit
                assert event.t == before.t + 1
                check_action(plan, before, event, row["action"])
                assert row["reward"] == np.float32(event.reward * (10 if "tenfold" in plan.wrappers else 1))
                assert row["terminated"] == event.terminated
                assert row["truncated"] == ((event.truncated or late) and not event.terminated)
                check_measures(event, {name: values[i].item() for name, values in steps[t].measures.items()})
                if (event.terminated or event.truncated or late) and plan.way != "NEXT_STEP":
                    event = next(events)
                    assert event.action is None
            else:
                assert event.action is None
            same(seen(plan, space, event), after[t, i])
            same(after[t, i], rows["obs"][t + 1, i] if t + 1 < STEPS else after[t, i])
        assert next(events, None) is None


def same(expected, got):
    assert expected.dtype == got.dtype
    assert np.array_equal(expected, got), (expected, got)


def seen(plan, space, event):
    """The observation of an event as a policy sees it, through the wrappers, and with the mask."""
    obs = event.obs
    for name in plan.wrappers:
        if name == "aged":
            obs = {"own": obs, "age": event.t}
        elif name == "doubled":
            obs = 2 * obs
    row = flat(space, obs)
    return row if event.mask is None else np.concatenate([row, event.mask.astype(row.dtype)])


def check_action(plan, before, event, chosen):
    """The action that an environment got is what was chosen, in its space, and permitted."""
    got, space = event.action, plan.action
    if "table" in plan.wrappers:
        np.testing.assert_array_equal(got, table(plan)[int(chosen)])
        return
    assert got.shape == space.shape
    assert np.can_cast(got.dtype, space.dtype) or isinstance(space, spaces.Discrete), got.dtype
    if isinstance(space, spaces.Box):
        assert (got >= space.low).all()
        assert (got <= space.high).all()
        exact = np.reshape(in_units(space, chosen.astype(np.float64)), space.shape)
        rough = {"f": {2: 4e-3, 4: 1e-5, 8: 1e-6}.get(space.dtype.itemsize), "i": 0, "u": 0, "b": 0}[space.dtype.kind]
        slack = rough * (1 + np.abs(exact)) if rough else 0.5001
        assert (np.abs(got.astype(np.float64) - exact) <= slack).all(), (got, exact)
        return
    start = np.asarray(getattr(space, "start", 0)).astype(int)
    np.testing.assert_array_equal(got - start, np.reshape(chosen, space.shape))
    if event.mask is not None:
        parts = np.split(before.mask, np.cumsum(plan.choices())[:-1])
        assert all(part[i] for part, i in zip(parts, np.ravel(chosen), strict=True)), (before.mask, chosen)


def bounds_of(space):
    """In float64, infinite where a bound is the largest number of its type."""
    most = 1e30 if space.dtype.kind == "f" else 2**31 - 1
    wide = (bound.astype(np.float64) for bound in (space.low, space.high))
    return [np.where(np.abs(bound) >= most, np.copysign(np.inf, bound), bound) for bound in wide]


def in_units(space, action):
    """low + ½ (a + 1) (high − low) between two bounds, one unit from a single one, else a itself; clipped."""
    exact = []
    for a, low, high in zip(action, *map(np.ravel, bounds_of(space)), strict=True):
        if np.isfinite([low, high]).all():
            a = low + 0.5 * (a + 1) * (high - low)
        elif np.isfinite(low) or np.isfinite(high):
            a += low + 1 if np.isfinite(low) else high - 1
        exact.append(min(max(a, low), high))
    return np.array(exact)


def check_measures(event, measures):
    """Every number of the info, and nothing else."""
    assert {name: value for name, value in measures.items() if not np.isnan(value)} == event.numbers


class Hangs(BaseException):
    pass


def stop(*_):
    raise Hangs


def answer(plan):
    """ "trains" or the sentence; raises whatever is neither, or is not what the plan deserves."""
    env = None
    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        with warnings.catch_warnings(action="ignore"):  # Gymnasium's, and NumPy's where numbers are too large
            env = make(plan)
            env.restart(plan.seed % 1000)
            rollout, steps = train(plan, env)
    except (UserError, NonFiniteError) as error:
        said = str(error)
        assert plan.wrong, f"refused, though it is right: {said}"
        assert "\n" not in said, said
        assert 20 < len(said) < 700, said
        assert re.search(r"drawn|Drawn|NoSeed|Vector|Aged|Normalize|environment \d", said), said
        return said
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
        if env is not None:
            env.close()
    assert not plan.wrong, f"trains, though it is wrong: {plan.wrong}"
    check(plan, rollout, steps)
    return "trains"


def fuzz(examples, **options):
    """The property of so many environments; the numbers of each answer, the refused by their fault."""
    answers = Counter()

    @settings(max_examples=examples, database=None, suppress_health_check=list(HealthCheck), **options)
    @given(plans())
    def each(plan):
        answer(plan)
        answers[plan.wrong] += 1

    each()
    return answers


LINE, TWO, POINT = spaces.Box(-1, 1, (2,)), spaces.Discrete(2), spaces.Box(-1, 1, (), np.float16)
HIGH = spaces.MultiDiscrete(np.array([2], np.int8), dtype=np.int8, start=np.array([126], np.int8))
FOUND = {
    "actions of float16": Plan(LINE, spaces.Box(-1, 1, (2,), np.float16)),
    "observed whole numbers of uint64": Plan(spaces.MultiDiscrete([2], dtype=np.uint64), TWO),
    "whole numbers up to the last of their type": Plan(HIGH, TWO),
    "four values through a wrapper of Gymnasium": Plan(LINE, TWO, limit=4, wrong="arity", spoiled=lambda x: x[:-1], at=1),
    "one reward for three environments": Plan(LINE, TWO, num_envs=3, way="NEXT_STEP", wrong="reward", spoiled=1.0),
    "one flag for three environments": Plan(LINE, TWO, num_envs=3, way="DISABLED", wrong="truncated", spoiled=False),
    "the mask of a last step": Plan(LINE, spaces.Discrete(9), num_envs=2, way="SAME_STEP", lengths=(1,), mask="action_mask"),
    "a number of 400 digits in an info": Plan(LINE, TWO, info={"a": ("endless",)}),
    "one number through a wrapper of Gymnasium": Plan(POINT, POINT, form="tensor", limit=1, wrong="arity", spoiled=lambda x: x[0], at=1),
    "a mask that is not in the space": Plan(spaces.Dict({"a": LINE}), TWO, wrong="mask beside", spoiled=lambda x: {**x, "action_mask": [1, 1]}),
    "arguments of several lines": Plan(spaces.Box(np.float32([[0], [1]]), np.float32([[2], [3]])), TWO, wrong="no seed"),
}  # fmt: skip
"""once a traceback, or changed in silence"""


@pytest.mark.parametrize("name", FOUND)
def test_what_was_found_is_answered(name):
    answer(FOUND[name])


def test_any_environment_trains_or_is_refused_in_a_sentence():
    answers = fuzz(500, derandomize=True)
    assert answers[None] > 250
    assert len(answers) > 12, "faults of most kinds are among them"


@pytest.mark.long
def test_fifty_thousand_environments_train_or_are_refused_in_a_sentence():
    print(fuzz(50_000, phases=[Phase.generate, Phase.shrink]))
