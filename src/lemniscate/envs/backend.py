"""The interface that a backend implements."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from torch import Tensor

from lemniscate.envs.probe import Probe
from lemniscate.errors import UserError
from lemniscate.maths import Distribution
from lemniscate.spec import Spec
from lemniscate.types import Step


@dataclass(frozen=True)
class Summary:
    """One number that evaluation makes of a measure besides its mean, from the rows that count.

    `kind` is the root mean square, or the mean over the last step of each episode; the result is multiplied by `scale`.
    The first `skip` steps of every episode are left out.
    """

    name: str
    measure: str
    kind: Literal["rms", "last"]
    scale: float = 1.0
    skip: int = 0


@dataclass(frozen=True)
class Scene:
    """A body that moves in a MuJoCo model, for drawing: where the observation says how it moves.

    Attributes:
        model: a `mujoco.MjModel` whose first mocap body is the one that moves.
        time_step: seconds between two observations.
        position: x, y, z in metres.
        attitude: a unit quaternion, x, y, z, w.
        error: from the position to the reference, in metres; None where no reference is followed.
        boxes: a function to what stands in the present episode of each environment, boxes [N, B, 15]: centre (m), half
            of the sides (m), and the matrix from their frame to the world's, row by row. None where nothing does.
    """

    model: Any
    time_step: float
    position: slice
    attitude: slice
    error: slice | None = None
    boxes: Callable[[], np.ndarray] | None = None


Baseline: TypeAlias = Callable[[Tensor], Distribution]
"""a controller that was not learned: of flat observations [N, O] to a distribution with all on one action, [N, A]"""


@dataclass(frozen=True)
class Quantity:
    """One number of an observation or of an action: its name, its unit, and the frame that it is given in."""

    name: str
    unit: str | None = None
    frame: str | None = None


@dataclass(frozen=True)
class Reference:
    """A closed curve that is followed: `points` [T, 3], one for each control step; what is seen of it at each step.

    That are the points `offsets` [K] steps ahead. The first step of an episode is the last point, number T − 1.
    """

    points: np.ndarray
    offsets: np.ndarray


@dataclass(frozen=True)
class Interface:
    """The meaning of an environment's observations and actions, for a policy that leaves it.

    Attributes:
        parts: the quantities of each part of the observation, by its name.
        action: those of the action.
        period: seconds between two actions.
        delay: seconds from an observation to the action's effect, besides the vehicle's own: the least, the most.
        history: the number of earlier observations and actions that are seen beside the present one.
        action_before: the action, in its units, that is taken to have gone before the first, where there is a history.
        dynamics: the models of the vehicle.
        vehicle: its name, such as crazyflie.
        reference: the curve that it follows, if it does.
    """

    parts: Mapping[str, tuple[Quantity, ...]] = field(default_factory=dict)
    action: tuple[Quantity, ...] = ()
    period: float | None = None
    delay: tuple[float, float] | None = None
    history: int | None = None
    action_before: tuple[float, ...] = ()
    dynamics: tuple[str, ...] | None = None
    vehicle: str | None = None
    reference: Reference | None = None


class Backend(ABC):
    """N parallel environments that are stepped together. Tensors go in and come out, all on one device.

    A backend is a subclass in a file of its own and a line in `registry.BACKENDS`; a user's own is named
    `module:Class`. Its own are the abstract methods; what else is here has a default.
    `tests/envs/test_contract.py` holds each to this contract.

    Attributes:
        spec: observations, actions and the time limit in steps.
        num_envs: N.
        device: of every tensor; actions are expected there too.
        counts: [N] bool, the episode under way counts in the statistics. False where staggering made it a fragment, by
            beginning it late or by cutting it early. Read before a step, it speaks of the episodes that the step may
            end.
        once: it steps an environment of one's own that may exist once at a time, such as a robot. While another is made
            for evaluation or a video, it is closed; `restart` makes it again.
        notices: sentences on its spaces and on what was observed so far, for the one who trains.
        mode: what an environment does after an end, in Gymnasium's words. DISABLED is reset here, in the same step.
        summaries: the numbers that evaluation makes of the measures besides their means.
        scene: what is drawn where a Gymnasium environment would be rendered.
        baseline: a classical controller beside which policies are shown.
        interface: the meaning of the numbers, for policies that are exported.
        differentiable: where gradients are enabled, `obs`, `next_obs` and `reward` of a step are functions of its
            action and, through the state, of those before it, back to the last `detach`; every row is `valid`.
        compiled: a step is a program for one number of environments, so evaluation takes as many as training.
        package: what has to be installed, if anything.
        in_process: the name of the backend that evaluates the policies of one that uses other processes.
    """

    spec: Spec
    num_envs: int
    device: torch.device
    counts: Tensor
    once: bool = False
    notices: Sequence[str] = ()
    mode: AutoresetMode = AutoresetMode.DISABLED
    summaries: tuple[Summary, ...] = ()
    scene: Scene | None = None
    baseline: Baseline | None = None
    interface: Interface = Interface()
    differentiable: bool = False
    compiled: bool = False
    package: str | None = None
    in_process: str | None = None

    @abstractmethod
    def __init__(
        self,
        env: str,
        num_envs: int,
        device: torch.device,
        *,
        stagger: bool = False,
        kwargs: Mapping[str, Any] | None = None,
        wrappers: Sequence[str] = (),
    ) -> None:
        """Make N environments.

        Args:
            env: an id, or the name of an object: `lemniscate.system.named.find` returns it.
            num_envs: N.
            device: where tensors are to be.
            stagger: spread the first episodes, so that parallel environments do not end in the same step.
            kwargs: arguments of the environment itself.
            wrappers: around each single environment, the first one innermost: `lemniscate.system.named.find_callable`.

        Raises:
            UserError: an environment, argument or wrapper that this backend cannot serve; spaces that no policy can
                act in; an environment that hides its final observations.
        """

    @abstractmethod
    def restart(self, seed: int, first: int = 0) -> Tensor:
        """Begin again, as if just built: nothing of the past remains. Returns obs [N, O].

        Args:
            seed: of all environments of the run.
            first: the number of the first of these among them. What is random in environment i follows from `seed` and
                `first + i`, where each has a seed of its own; else from `seed + first`.
        """

    @abstractmethod
    def step(self, action: Tensor) -> Step:
        """Act in every environment; what has ended is reset by itself, now or in the next step (`valid` False).

        Args:
            action: Box float [N, A] in [-1, 1], where more is clipped; Discrete int64 [N]; MultiDiscrete int64 [N, K];
                MultiBinary [N, n]. The backend converts them to the environment's own units, dtype and shape.
        """

    @abstractmethod
    def close(self) -> None:
        """Give back processes and windows."""

    def prepare_gradient(self) -> None:
        """Get ready for derivatives of steps, where a run takes some. Raises `UserError` where there are none."""
        if not self.differentiable:
            raise UserError(
                f"{self.spec.env_id} in the backend {type(self).__name__} cannot be differentiated, and this algorithm"
                " learns by the gradient through its steps: it is for crazyflow's drones, and for backends of one's own"
                " that are differentiable. ppo learns here."
            )

    def detach(self) -> None:
        """Take the present state as given: gradients go back as far as here."""
        raise NotImplementedError(f"{type(self).__name__} is differentiable, and so needs a method detach")

    def call(self, calls: Mapping[str, Any]) -> None:
        """Call methods of every environment, each with its argument: now, and again whenever they are built again.

        Raises `UserError` for a method that is not there or raises, and where a backend calls none.
        """
        cannot = f"{type(self).__name__} calls no methods of its environments, so there can be no curriculum"
        raise UserError(f"{cannot}; --backend gymnasium does, where it serves {self.spec.env_id}.")

    def judge_goals(self, achieved: Tensor, desired: Tensor) -> tuple[Tensor, Tensor]:
        """The rewards of having achieved goals where others were desired, [B, G] each; whether an episode ends there.

        Float32 [B] and bool [B], the environment's own answers. Raises `UserError` where nothing in it says so.
        """
        raise UserError(
            f"{self.spec.env_id} judges no goals in the backend {type(self).__name__}; hindsight is for single"
            " environments of Gymnasium's interface with compute_reward. --replay uniform learns from any."
        )

    @classmethod
    def ids(cls) -> Collection[str]:
        """The ids that it serves where no backend is named, for lists; may import heavy packages."""
        return ()

    @classmethod
    def serves(cls, env: str) -> bool:
        """Whether it can run `env`; of several backends that can, the first in the table does.

        Asked at every start, so it imports nothing heavy.
        """
        return env in cls.ids()

    @classmethod
    def room(cls, env: str) -> tuple[int, int]:
        """The memory in bytes and the open files that each environment takes at least."""
        return 0, 0

    @classmethod
    def wraps(cls, env: str) -> bool:
        """Whether it makes `env` of single environments of Gymnasium's interface, which can be wrapped."""
        return False

    @classmethod
    def exists_once(cls, env: str, num_envs: int) -> bool:
        """Whether a backend of so many gets `once`: they are the user's own, and may exist once at a time."""
        return False

    @classmethod
    def divides(cls, env: str) -> bool:
        """Whether each environment has a seed of its own, and nothing of one depends on the others beside it.

        Where it has not, each shard of a run has a backend.
        """
        return False

    @classmethod
    def probe(cls, env: str, starts: int, trained: Mapping[str, Any], given: Mapping[str, Any]) -> Probe | None:
        """The flights of preflight from so many starts; None flies them as `margins.vector_probe` does.

        `trained` are the arguments of training, `given` those that differ from them.
        """
        return None

    @classmethod
    def make_rendered(cls, env: str, mode: str, kwargs: Mapping[str, Any], wrappers: Sequence[str]) -> gym.Env | None:
        """One environment that renders itself in `mode`, "rgb_array" or "human"; None where it can make none."""
        return None


class Joined(Backend):
    """Several backends of the same environment, stepped one after the other as if they were one.

    Where one vector cannot be divided among processes, each shard of a run has its own.
    """

    def __init__(self, backends: Sequence[Backend]) -> None:
        self.parts, one = backends, backends[0]
        self.num_envs = len(backends) * one.num_envs
        self.spec, self.device, self.mode, self.notices = one.spec, one.device, one.mode, one.notices
        self.summaries, self.scene, self.baseline = one.summaries, one.scene, one.baseline
        self.interface = one.interface

    def restart(self, seed: int, first: int = 0) -> Tensor:
        """Begin again; see `Backend.restart`."""
        size = self.parts[0].num_envs
        obs = torch.cat([backend.restart(seed, first + i * size) for i, backend in enumerate(self.parts)])
        self._look()
        return obs

    def step(self, action: Tensor) -> Step:
        """The step of all parts; see `Backend.step`. A measure that some of them lack is NaN there."""
        parts = zip(self.parts, action.chunk(len(self.parts)), strict=True)
        steps = [backend.step(part) for backend, part in parts]
        self._look()
        columns = ("obs", "next_obs", "reward", "terminated", "truncated", "valid")
        joined = {name: torch.cat([getattr(step, name) for step in steps]) for name in columns}
        missing = torch.full_like(steps[0].reward, torch.nan)
        names = dict.fromkeys(name for step in steps for name in step.measures)
        measures = {name: torch.cat([step.measures.get(name, missing) for step in steps]) for name in names}
        return Step(**joined, measures=measures)

    def call(self, calls: Mapping[str, Any]) -> None:
        """Call methods of all of them; see `Backend.call`."""
        for backend in self.parts:
            backend.call(calls)

    def judge_goals(self, achieved: Tensor, desired: Tensor) -> tuple[Tensor, Tensor]:
        """The judgement of the first; see `Backend.judge_goals`."""
        return self.parts[0].judge_goals(achieved, desired)

    def close(self) -> None:
        """Close them all."""
        for backend in self.parts:
            backend.close()

    def _look(self) -> None:
        self.counts = torch.cat([backend.counts for backend in self.parts])
        self.notices = self.parts[0].notices  # the others observe the same
