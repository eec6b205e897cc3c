"""The contract of the environment floor: what a backend provides."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import torch
from torch import Tensor

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
    """A body that follows a reference in a MuJoCo model, for drawing: where the observation says how it moves.

    Attributes:
        model: a `mujoco.MjModel` whose first mocap body is the one that moves.
        time_step: seconds between two observations.
        position: x, y, z in metres.
        attitude: a unit quaternion, x, y, z, w.
        error: from the position to the reference, in metres.
    """

    model: Any
    time_step: float
    position: slice
    attitude: slice
    error: slice


class Baseline(Protocol):
    """A controller that was not learned: a function of flat observations [N, O] to a distribution over actions."""

    def __call__(self, obs: Tensor) -> Distribution:
        """All probability on one action, [N, A]."""
        ...


class Backend(Protocol):
    """N parallel environments that are stepped together. Tensors go in and come out, all on one device.

    A backend is a class in a file of its own and a line in `registry.BACKENDS`; a user's own is named `module:Class`.
    `tests/envs/test_contract.py` holds each to this contract.

    A backend may have more, each of which is asked for by its name:

    - `summaries`: a tuple of `Summary`;
    - `scene`: a `Scene` or None, which is drawn where a Gymnasium environment would be rendered;
    - `baseline`: a `Baseline` or None, a classical controller beside which policies are shown;
    - `interface`: an `Interface`, the meaning of the numbers, for policies that are exported;
    - `compiled = True`: a step is a program for one number of environments, so evaluation takes as many as training;
    - `package`: what has to be installed;
    - `in_process`: the name of the backend that evaluates its policies, where it uses other processes itself;
    - `divides(env) -> bool`, a class method: whether each environment has a seed of its own, so that nothing of one
      depends on the others beside it; where it has not, each shard of a run has a backend;
    - `room(env) -> (bytes, files)`, a class method: the memory and the open files that each takes at least;
    - `wraps(env) -> bool`, a class method: whether it can put `wrappers` around;
    - `probe(env, starts, trained, given)`, a class method: a `lemniscate.envs.probe.Probe` from so many starts, with
      the arguments of training and those that differ from them; others are flown as `margins.vector_probe` does;
    - `make_rendered(env, mode, kwargs, wrappers)`, a class method: one `gymnasium.Env` that renders itself.
    """

    spec: Spec
    """observations, actions and the time limit in steps"""
    num_envs: int
    """N"""
    device: torch.device
    """of every tensor; actions are expected there too"""
    counts: Tensor
    """[N] bool: the episode under way counts in the statistics. False where staggering made it a fragment, by beginning
    it late or by cutting it early. Read before a step, it speaks of the episodes that the step may end."""

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
        ...

    @classmethod
    def ids(cls) -> Collection[str]:
        """The ids that it serves where no backend is named, for lists; may import heavy packages."""
        ...

    @classmethod
    def serves(cls, env: str) -> bool:
        """Whether it can run `env`; of several backends that can, the first in the table does.

        Asked at every start, so it imports nothing heavy.
        """
        ...

    def restart(self, seed: int, first: int = 0) -> Tensor:
        """Begin again, as if just built: nothing of the past remains. Returns obs [N, O].

        Args:
            seed: of all environments of the run.
            first: the number of the first of these among them. What is random in environment i follows from `seed` and
                `first + i`, where each has a seed of its own; else from `seed + first`.
        """
        ...

    def step(self, action: Tensor) -> Step:
        """Act in every environment; what has ended is reset by itself, now or in the next step (`valid` False).

        Args:
            action: Box float [N, A] in [-1, 1], where more is clipped; Discrete int64 [N]; MultiDiscrete int64 [N, K];
                MultiBinary [N, n]. The backend converts them to the environment's own units, dtype and shape.
        """
        ...

    def close(self) -> None:
        """Give back processes and windows."""
        ...
