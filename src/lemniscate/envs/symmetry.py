"""Left and right: the mirror image of a robot, derived from its MuJoCo model and proved by stepping mirrored states.

A mirror is an order and a sign for each number. Where stepping a mirrored state with the mirrored action gives the
mirrored successor, every transition teaches two.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from operator import index
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from lemniscate.envs.conversion import SingleEnv, scale_action
from lemniscate.envs.factory import creation_errors, make_one, maker_of, makes_vector
from lemniscate.envs.returned import shown_space
from lemniscate.envs.spaces import action_kind
from lemniscate.errors import UserError, shown
from lemniscate.system.named import find_callable
from lemniscate.types import Record

R = TypeVar("R", bound=Record)

FEWEST, MOST, FOLLOWED = 8, 32, 24
"""the states from which both sides are stepped, and how often, so that contacts are among the steps"""
FREE, SLIDE, HINGE = 0, 2, 3
"""MuJoCo's numbers of the kinds of joints"""
EXACT = 1e-9
"""the largest difference between both, beside 1 or the size of the number itself"""
KINDS = {"obs": "observation", "next_obs": "observation", "action": "action"}
"""the columns of transitions that have an image, and whose it is"""


@dataclass(frozen=True)
class SignedPermutation:
    """The mirror image of a row of numbers: for each, which number it takes, and with which sign; [K] each."""

    source: np.ndarray
    sign: np.ndarray

    def __call__(self, rows: Any) -> Any:
        """The mirror image of arrays or tensors […, K]."""
        if isinstance(rows, Tensor):
            source, sign = (torch.as_tensor(part, device=rows.device) for part in (self.source, self.sign))
            return rows[..., source] * sign.to(rows.dtype)
        return rows[..., self.source] * self.sign

    @property
    def is_identity(self) -> bool:
        """Whether nothing changes."""
        return bool((self.source == np.arange(len(self.source))).all() and (self.sign == 1).all())


@dataclass(frozen=True)
class Mirror:
    """The mirror image of observations [O] and actions [A]."""

    observation: SignedPermutation
    action: SignedPermutation

    def both(self, rows: R, dim: int) -> R:
        """A record of transitions and, behind them along `dim`, their mirror images; rewards and ends are the same."""
        given = vars(rows)
        images = given | {name: getattr(self, kind)(given[name]) for name, kind in KINDS.items()}
        return type(rows)(*(torch.cat([given[name], images[name]], dim) for name in given))


def find_mirror(env: str, kwargs: Mapping[str, Any], wrappers: Sequence[str]) -> Mirror:
    """The mirror of an environment: that of its attribute `mirror`, or of its MuJoCo model.

    `mirror` has two lists, of observation and action: for each number, which number (from 1) its image takes, negative
    where with the other sign. It is believed, but for bounds and wrappers that contradict it; one that is derived from
    a model is proved.

    Raises:
        UserError: there is none, with the reason.
    """
    try:
        with creation_errors(env, kwargs, wrappers):
            maker = maker_of(env)
            if makes_vector(maker):
                raise UserError("it makes many environments at once.")
            one = make_one(maker, tuple(map(find_callable, wrappers)), **kwargs)
        try:
            sizes = dict[str, int]()
            for name, space in (("observation", one.observation_space), ("action", one.action_space)):
                if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
                    raise UserError(f"its {name} is not one row of numbers.")
                sizes[name] = space.shape[0]
            if not one.has_wrapper_attr("mirror"):
                return _derived(one)
            _require_unchanged(one)
            mirror = _given(one.get_wrapper_attr("mirror"), sizes)
            _require_own_image(mirror.action, one.action_space)
            return mirror
        finally:
            one.close()
    except UserError as error:
        raise UserError(f"{env} has no symmetry that could be used: {error}") from None
    except Exception as error:  # of a robot whose model and data are another simulator's
        raise UserError(f"{env} has no symmetry that could be used: {type(error).__name__}, {error}") from error


def _require_own_image(order: SignedPermutation, space: Any) -> None:
    """Raise `UserError` where the bounds of actions are not their own mirror image, as those of a policy are."""
    bounds = np.stack([space.low, space.high])
    if not np.array_equal(np.where(order.sign < 0, -bounds[::-1], bounds)[:, order.source], bounds):
        raise UserError(f"the bounds of its action, {shown_space(space)}, are not the mirror image of themselves.")


def _require_unchanged(env: SingleEnv) -> None:
    """Raise `UserError` where a wrapper changes the observations or actions that an attribute `mirror` is about."""
    inner: Any = env.env
    while not hasattr(inner, "mirror"):
        if isinstance(inner, gym.ObservationWrapper | gym.ActionWrapper):
            name = type(inner).__name__
            raise UserError(
                f"the wrapper {name} changes what its attribute mirror is about: {name} needs one of its own."
            )
        inner = inner.env


def _given(given: Any, sizes: Mapping[str, int]) -> Mirror:
    """The mirror of an attribute `mirror`. Raises `UserError` where it does not fit, or is not its own inverse."""
    orders = list[SignedPermutation]()
    try:
        lists = [np.array([index(number) for number in numbers]) for numbers in given]
        pairs = list(zip(lists, sizes.items(), strict=True))
    except (TypeError, ValueError):
        wanted = "two lists of whole numbers, such as ([-1, 3, 2], [2, 1])"
        raise UserError(f"its attribute mirror is {shown(given)}; it must be {wanted}.") from None
    for signed, (name, size) in pairs:
        order = SignedPermutation(np.abs(signed) - 1, np.sign(signed).astype(np.float64))
        each = list(range(1, size + 1))
        if sorted(np.abs(signed)) != each or order(signed).tolist() != each:
            wanted = f"each of 1 to {size} once, in pairs"
            raise UserError(f"mirror of its {name} is {shown(signed.tolist())}; it must have {wanted}.")
        orders.append(order)
    return Mirror(*orders)


def _derived(env: SingleEnv) -> Mirror:
    """The mirror of a MuJoCo model, proved. Raises `UserError` where there is none."""
    bare: Any = env.unwrapped
    if not all(hasattr(bare, name) for name in ("model", "data", "set_state")):
        raise UserError("it is no MuJoCo environment of Gymnasium's kind, and has no attribute mirror.")
    for reflection in np.array([(1.0, -1.0, 1.0), (-1.0, 1.0, 1.0), (1.0, 1.0, 1.0)]):
        orders = _Body(bare.model, reflection).orders()
        if orders and not all(order.is_identity for order in orders):
            return _proved(env, *orders)
    raise UserError("its body has no left and right.")


class _Body:
    """A MuJoCo model at its reference pose, and its image under a reflection of space: of y, of x, or none."""

    def __init__(self, model: Any, reflection: np.ndarray) -> None:
        mujoco: Any = import_module("mujoco")
        self.model, self.data = model, mujoco.MjData(model)
        mujoco.mj_forward(model, self.data)
        self.polar, self.axial = reflection, reflection.prod() * reflection
        """how the components of a place, a velocity or a force are reflected, and those of a rotation"""
        self.image: dict[int, int] = {}
        """of each joint, the joint on the other side"""
        self.sign: dict[int, float] = {}

    def orders(self) -> tuple[SignedPermutation, SignedPermutation, SignedPermutation] | None:
        """The orders of qpos, of qvel and of the controls; None where the body is not its own image."""
        if not self._match(0, 0):
            return None
        model = self.model
        pos, vel, controls = (SignedPermutation(np.arange(n), np.ones(n)) for n in (model.nq, model.nv, model.nu))
        for joint, image in self.image.items():
            free = model.jnt_type[joint] == FREE
            signs = [*self.polar, 1.0, *self.axial] if free else [self.sign[joint]]  # place, quaternion w x y z
            rates = [*self.polar, *self.axial] if free else [self.sign[joint]]
            for order, start, values in ((pos, model.jnt_qposadr, signs), (vel, model.jnt_dofadr, rates)):
                there = slice(start[image], start[image] + len(values))
                order.source[there], order.sign[there] = np.arange(len(values)) + start[joint], values
        moved = {int(joint): number for number, joint in enumerate(model.actuator_trnid[:, 0])}
        if len(moved) < model.nu or model.actuator_trntype.any():  # more than one for a joint, or of something else
            return None
        for joint, number in moved.items():
            if (image := moved.get(self.image[joint])) is None:
                return None
            gears = model.actuator_gear[[number, image], 0]
            controls.source[image] = number
            controls.sign[image] = self.sign[joint] * np.sign(gears[0] * gears[1])
        return pos, vel, controls

    def _match(self, body: int, image: int) -> bool:
        """Whether what hangs on `body` is on the other side what hangs on `image`, and which joint is which."""
        here, there = self.model.body(body), self.model.body(image)
        for of in (self.data.xpos, self.data.xipos):
            if not np.allclose(self.polar * of[body], of[image], atol=1e-6):
                return False
        if not np.isclose(here.mass, there.mass).all() or here.jntnum != there.jntnum:
            return False
        for offset in range(int(here.jntnum[0])):
            joint, other = int(here.jntadr[0]) + offset, int(there.jntadr[0]) + offset
            kind = self.model.jnt_type[joint]
            if kind != self.model.jnt_type[other] or kind not in (FREE, SLIDE, HINGE):
                return False
            axis = (self.axial if kind == HINGE else self.polar) * self.data.xaxis[joint]
            along = float(axis @ self.data.xaxis[other])
            if kind != FREE and abs(along) < 1 - 1e-6:
                return False
            self.image[joint], self.sign[joint] = other, float(np.sign(along)) or 1.0
        left = self._children(image)
        for child in self._children(body):
            others = sorted(left, key=lambda one: one == child)  # another one first: itself is no image in a plane
            found = next((other for other in others if self._match(child, other)), None)
            if found is None:
                return False
            left.remove(found)
        return not left

    def _children(self, body: int) -> list[int]:
        return [child for child in range(1, self.model.nbody) if self.model.body_parentid[child] == body]


def _proved(env: SingleEnv, pos: SignedPermutation, vel: SignedPermutation, controls: SignedPermutation) -> Mirror:
    """The mirror, with the order of the observation as stepping shows it. Raises `UserError` where both sides differ.

    It steps until no number of the observation could be the image of two, from `MOST` starts at most. Actions are those
    of a policy, in [-1, 1]: bounds that are no images of each other show as well.
    """
    bare: Any = env.unwrapped
    rng, reference = np.random.default_rng(0), bare.model.qpos0  # a mirrored pose is one on the other side of this
    env.reset(seed=0)
    box: Any = action_kind(env.action_space, "it")
    here, there = list[np.ndarray](), list[np.ndarray]()
    order, only, starts = SignedPermutation(np.zeros(0, np.int64), np.zeros(0)), False, 0
    while not only and starts < MOST:
        starts += 1
        qpos, qvel = _pose(bare.model, rng), rng.normal(size=vel.source.shape)
        for _ in range(FOLLOWED):
            action = rng.uniform(-1, 1, box.size)
            here_and_there = scale_action(np.stack([action, controls(action)]), box)
            one = _step(env, qpos, qvel, here_and_there[0])
            other = _step(env, reference + pos(qpos - reference), vel(qvel), here_and_there[1])
            qpos, qvel = one[:2]
            expected = reference + pos(qpos - reference), vel(qvel), *one[2:4]
            for name, values, found in zip(("position", "velocity", "reward", "end"), expected, other, strict=False):
                differs = np.abs(values - found).max() / max(1.0, np.abs(values).max())
                if not differs <= EXACT:
                    differs = f"a mirrored {name} differs by {differs:.2g} after one step"
                    raise UserError(f"its body looks symmetric, but moves otherwise on each side: {differs}.")
            here.append(one[4])
            there.append(other[4])
        if starts % FEWEST == 0:
            order, only = _signed_permutation_of(np.array(here), np.array(there))
    return Mirror(order, controls)


def _pose(model: Any, rng: np.random.Generator) -> np.ndarray:
    """Any pose within ½ of the reference; a body that is free is turned, and falls on any of its parts."""
    qpos = model.qpos0 + rng.uniform(-0.5, 0.5, model.nq)
    for address in model.jnt_qposadr[model.jnt_type == FREE]:
        quaternion = rng.normal(size=4)
        qpos[address + 3 : address + 7] = quaternion / np.linalg.norm(quaternion)
    return qpos


def _step(env: SingleEnv, qpos: np.ndarray, qvel: np.ndarray, action: np.ndarray) -> tuple[Any, ...]:
    """Position, velocity, reward, end and observation after one step from a state, as if nothing had been before."""
    bare: Any = env.unwrapped
    mujoco: Any = import_module("mujoco")
    mujoco.mj_resetData(bare.model, bare.data)
    bare.set_state(qpos, qvel)
    obs, reward, terminated, _, _ = env.step(action)
    return bare.data.qpos.copy(), bare.data.qvel.copy(), float(reward), float(terminated), obs


def _signed_permutation_of(here: np.ndarray, there: np.ndarray) -> tuple[SignedPermutation, bool]:
    """Which number of an observation here [K, O] is which there, with which sign; and whether it is the only order.

    Raises `UserError` where a number there is none of those here.
    """
    size, exact = here.shape[1], EXACT if here.dtype == np.float64 else 1e-6
    scale = np.maximum(1.0, np.abs(there).max(0))[:, None]
    fits = {f: np.abs(there.T[:, None] - f * here.T).max(2) / scale <= exact for f in (1.0, -1.0)}
    changes = np.ptp(here, axis=0) > 0
    only = bool((np.stack([*fits.values()]).sum((0, 2))[changes] == 1).all())
    source, sign, left = np.arange(size), np.ones(size), set(range(size))
    while left:  # the image of an image is the number itself: so by pairs, and one that stays the same by itself
        i = min(left)
        others = [i, *sorted(left - {i})]
        found = next(((j, f) for f, fit in fits.items() for j in others if fit[i, j] and fit[j, i]), None)
        if not found:
            raise UserError(f"number {i + 1} of its observation is none of those in the mirror.")
        j, factor = found
        source[[i, j]], sign[[i, j]] = (j, i), factor
        left -= {i, j}
    return SignedPermutation(source, sign), only
