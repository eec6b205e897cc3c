# pyright: reportAttributeAccessIssue=false
"""crazyflow's drones behind the contract of environments.

crazyflow's environments are NEXT_STEP: they simulate, then reset what ended one step earlier, then compute a reward at
the reset state. Here the same methods are called in another order, that of `drones.Programs`, so every row is real.
"""

from __future__ import annotations

import contextlib
import inspect
import io
import math
import os
import warnings
from collections.abc import Collection, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from lemniscate.drones.vehicle import CONDITIONS, DYNAMICS, GAINS, PD, Ranges, interface_of, read_ranges
from lemniscate.envs.backend import Backend, Scene, Summary
from lemniscate.envs.factory import creation_errors, model_warnings_off
from lemniscate.envs.spaces import action_kind
from lemniscate.errors import UserError, missing_extra, shown, unknown_name
from lemniscate.spec import Spec
from lemniscate.types import Step

if TYPE_CHECKING:
    from lemniscate.drones.drones import Drones, Programs
    from lemniscate.drones.probe import DroneProbe

IDS = ("DroneFigureEightTrajectory-v0", "DroneGates-v0", "DroneLanding-v0", "DroneReachPos-v0", "DroneReachVel-v0")
CONTROL_HZ, SIMULATED_HZ = 50, 500
"""control steps in a second unless `freq` says another number, and crazyflow's of its dynamics"""
MOST_HISTORY = 50
OWN = (*CONDITIONS, "history", "privileged", "dynamics")
"""the arguments that are ours or read by us; the others are crazyflow's"""


@lru_cache(maxsize=4)
def programs(
    env_id: str, num_envs: int, device: str, kwargs: tuple[tuple[str, Any], ...]
) -> tuple[Programs, list[Drones]]:
    """The compiled programs of so many drones, built once a process, since all vectors of a size share them.

    Also the drones that they fly: one vector of them for each of the dynamics.
    """
    # JAX takes a second to import, and this module is imported wherever a backend is looked for.
    from lemniscate.drones.drones import Mixed, Programs

    given = dict(kwargs)
    ranges, each = read_ranges(given), dynamics_of(given) or (None,)
    drones = [make_drones(env_id, num_envs // len(each), device, given, dynamics, ranges) for dynamics in each]
    return Programs(drones[0] if len(drones) == 1 else Mixed(drones)), drones


def make_drones(
    env_id: str, num_envs: int, device: str, kwargs: Mapping[str, Any], dynamics: str | None, ranges: Ranges
) -> Drones:
    """So many drones in one dynamics, by default crazyflow's, and under conditions that need not be those of kwargs."""
    from lemniscate.drones.drones import Drones

    own = {name: value for name, value in kwargs.items() if name not in OWN}
    own |= {"dynamics": dynamics} if dynamics else {}
    with warnings.catch_warnings(action="ignore"), model_warnings_off():
        made = gym.make_vec(env_id, num_envs=num_envs, device=device, **{"freq": CONTROL_HZ, **own}).unwrapped
    return Drones(made, ranges, kwargs.get("history", 0), kwargs.get("privileged", False))


def spec_of(env_id: str, drones: Drones) -> Spec:
    """The Spec of drones."""
    action, time_limit = action_kind(drones.env.single_action_space, env_id), drones.episode_steps
    return Spec(env_id, drones.parts, action, max_episode_steps=time_limit, privileged=drones.privileged)


class JaxBackend(Backend):
    """N environments that are stepped by compiled programs; what a subclass adds is their making, and the Spec."""

    compiled, differentiable = True, True

    def __init__(self, programs: Programs, num_envs: int, device: torch.device, *, stagger: bool) -> None:
        import jax

        self.num_envs, self.device = num_envs, device
        self._programs, self._from_dlpack = programs, jax.dlpack.from_dlpack
        # Committed to the device like everything that follows, or the step would be compiled a second time.
        self._put = lambda value: jax.device_put(value, programs.device)
        self._stagger = self._put(np.bool_(stagger))
        self._valid = torch.ones(num_envs, dtype=torch.bool, device=device)
        self._moving = torch.zeros(programs.moving_size, device=device)

    def restart(self, seed: int, first: int = 0) -> Tensor:
        """Begin again from `seed + first`, the seed of this vector."""
        self._state, obs, fragment = self._programs.restart(self._put(np.uint32(seed + first)), self._stagger)
        self.counts = ~torch.from_dlpack(fragment)
        return torch.from_dlpack(obs)

    def step(self, action: Tensor) -> Step:
        """[N, A] actions in [-1, 1]; every row of the answer is real."""
        if torch.is_grad_enabled() and (action.requires_grad or self._moving.requires_grad):
            self._moving, *out, measures = _Differentiable.apply(self._moving, action, self)
        else:
            *out, measures = self._simulate(self._from_dlpack(action.contiguous()))
        obs, next_obs, reward, flags = out
        terminated, truncated, fragment = flags
        self.counts = (self.counts | terminated | truncated) & ~fragment
        named = {name: torch.from_dlpack(values) for name, values in measures.items()}
        return Step(obs, next_obs, reward, terminated, truncated, self._valid, named)

    def prepare_gradient(self) -> None:
        """Compile the program of the derivatives."""
        _ = self._programs.pull

    def detach(self) -> None:
        """Take the present state as given: gradients go back as far as here."""
        self._moving = self._moving.detach()

    def _simulate(self, command: Any) -> tuple[Any, ...]:
        """Observation, next observation, reward, flags and measures of a step; the command is an array of JAX."""
        self._state, (*out, measures) = self._programs.step(self._state, command, self._stagger)
        return *map(torch.from_dlpack, out), measures

    def close(self) -> None:
        """Nothing to give back: the programs are shared."""


class _Differentiable(torch.autograd.Function):
    """A step of the simulator, of which JAX computes the derivatives.

    The state stays in JAX. In torch a tensor `moving` [F] stands in for the numbers of it that actions move: its own
    numbers mean nothing, but derivatives by it are those by the state.
    """

    @staticmethod
    def forward(ctx: Any, moving: Tensor, action: Tensor, backend: JaxBackend) -> Any:
        command = backend._from_dlpack(action.detach().clone())
        ctx.to_jax = backend._from_dlpack
        ctx.pull = partial(backend._programs.pull, backend._state, command, backend._stagger)
        return torch.zeros_like(moving), *backend._simulate(command)

    @staticmethod
    def backward(ctx: Any, *by: Any) -> Any:
        by_before, by_action = ctx.pull(tuple(ctx.to_jax(one.contiguous()) for one in by[:4]))
        return torch.from_dlpack(by_before), torch.from_dlpack(by_action), None


def jax_device(device: torch.device) -> str:
    """The name of a torch device in JAX. Raises `UserError` for mps, cuda:1, …, and cuda where JAX sees no GPU."""
    import jax

    if device.type == "mps" or device.index:
        raise UserError(f"JAX's environments run on cpu or cuda, the first GPU, not on {device}.")
    if device.type == "cuda" and not any(d.platform == "gpu" for d in jax.devices()):
        raise UserError("JAX sees no GPU, so this cannot run on cuda; it comes with: pip install 'jax[cuda12]'")
    return "gpu" if device.type == "cuda" else "cpu"


class CrazyflowBackend(JaxBackend):
    """N drones flown at 50 Hz by normalized [roll, pitch, yaw, thrust] commands, all on one device.

    The flat observation is position 3 (m), quaternion 4 (xyzw), velocity 3 (m/s), angular velocity 3 (rad/s), then the
    task's own part: for the figure eight, `local_samples` 30, the next ten points of the curve, 0.1 s apart, as seen
    from the drone (m). The length of its first three numbers is the measure `tracking_error`, in metres.

    With `stagger`, three of four episodes begin at a random time of theirs, on the reference curve where there is one:
    as if the drone had been flying before. All of the course is flown from the first step on, and the drones never fly
    in step. Their returns are not counted, since they are fragments.

    `kwargs` are crazyflow's: `dynamics`, `drone`, `max_episode_time` (s), `freq` (Hz), and those of the task.
    """

    @classmethod
    def ids(cls) -> Collection[str]:
        """Crazyflow's four tasks and the race."""
        return IDS

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
        assert not wrappers, "drones cannot be wrapped"
        _import()
        kwargs = dict(kwargs or {})
        _check(env, num_envs, kwargs)
        if kwargs.get("track") is not None:  # programs are kept by what a file holds, and not by its name
            from lemniscate.drones.gates import read_track, text_of_track

            read_track(kwargs["track"])  # says by the file's name what is wrong with it
            kwargs["track"] = text_of_track(kwargs["track"])
        with creation_errors(env, kwargs):
            hashable = {name: tuple(value) if isinstance(value, list) else value for name, value in kwargs.items()}
            shared, vectors = programs(env, num_envs, jax_device(device), tuple(sorted(hashable.items())))
        super().__init__(shared, num_envs, device, stagger=stagger)
        drones, flown = vectors[0], [one.dynamics for one in vectors]
        self.spec = spec_of(env, drones)
        self.interface = interface_of(drones.env, flown, drones.air.delay, drones.air.history, drones.air.hover)
        moves = drones.env.sim.mj_model, 1 / drones.env.freq, slice(0, 3), slice(3, 7)
        if hasattr(drones.env, "boxes"):
            self.scene = Scene(*moves, boxes=lambda: self._boxes(drones.env))
        if drones.error:
            self.summaries = (
                Summary("rmse_mm", "tracking_error", "rms", scale=1000),
                Summary("rmse_after_1s_mm", "tracking_error", "rms", scale=1000, skip=drones.env.freq),
            )
            self.scene = Scene(*moves, drones.error)
            first = drones.error.start
            reference, preview = slice(first, first + 3 * drones.env.n_samples), drones.env.samples_dt
            action = self.spec.bounded_box()
            each = [GAINS[one] for one in flown], [one.mass for one in vectors]
            if drones.env.n_samples >= 3:  # of which it makes the reference's acceleration
                self.baseline = PD(*each, action, reference, slice(7, 10), preview)

    def _boxes(self, env: Any) -> np.ndarray:
        """The boxes of a `Scene`, of each drone's present episode."""
        from lemniscate.drones.drones import interleaved

        each = self._state if isinstance(self._state, list) else [self._state]
        return np.asarray(interleaved(*(env.boxes(arrays) for _, arrays, _ in each)))

    @classmethod
    def probe(cls, env: str, starts: int, trained: Mapping[str, Any], given: Mapping[str, Any]) -> DroneProbe:
        """Flights along each condition and in all dynamics, on the CPU.

        Conditions that only training has are nominal; so are the first dynamics, of those given or else of training.
        """
        _import()
        from lemniscate.drones.probe import DroneProbe

        kwargs = {name: value for name, value in trained.items() if name not in (*CONDITIONS, "privileged")}
        kwargs |= given
        attitude = kwargs.get("control", "attitude") == "attitude"  # body rates need the dynamics that have motors
        if several := dynamics_of(kwargs):
            kwargs["dynamics"] = several[0]
        _check(env, starts, kwargs)
        with creation_errors(env, kwargs):
            return DroneProbe(env, starts, kwargs, DYNAMICS if attitude else ("first_principles",))


def _import() -> None:
    os.environ.setdefault("SCIPY_ARRAY_API", "1")  # crazyflow insists, and before SciPy is first imported
    # XLA calls two of its own preferences missing features of the processor, in four lines, when it loads a program.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # MJX announces optional packages that it does not find
            import crazyflow  # noqa: F401  (registers the environments)

            import lemniscate.drones.gates  # noqa: F401  (registers the race)
    except ModuleNotFoundError as error:
        raise missing_extra("crazyflow", "drone") from error
    _keep_programs()


def _keep_programs() -> None:
    """Keep compiled programs in the user's cache, unless JAX has been told another place.

    Two programs of drones take 5 to 20 s to compile. What they are made of and the processor are part of their names.
    """
    import jax

    if jax.config.jax_compilation_cache_dir:
        return
    with contextlib.suppress(OSError, RuntimeError):  # no home, or one that cannot be written to
        place = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lemniscate" / "jax"
        place.mkdir(parents=True, exist_ok=True)
        jax.config.update("jax_compilation_cache_dir", str(place))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
        jax.config.update("jax_persistent_cache_enable_xla_caches", "none")  # those no two processes may share


def _check(env_id: str, num_envs: int, kwargs: Mapping[str, Any]) -> None:
    """Raise `UserError` for an argument that the environment does not have, or a value that it cannot take."""
    entry: Any = gym.spec(env_id).vector_entry_point
    known = {*inspect.signature(entry).parameters, *OWN} - {"num_envs", "device"}
    for name, value in kwargs.items():
        if name not in known:
            raise unknown_name(f"argument of {env_id}", name, known)
        several = name == "dynamics" and isinstance(value, list | tuple)
        if not (name in CONDITIONS or several or isinstance(value, int | float | str | None) or callable(value)):
            raise UserError(f"{name} of {env_id} must be a number or a word, not {value!r}.")
    _check_simulation(env_id, kwargs)
    history, several = kwargs.get("history", 0), dynamics_of(kwargs)
    if not isinstance(history, int) or isinstance(history, bool) or not 0 <= history <= MOST_HISTORY:
        raise UserError(f"history must be a whole number of steps from 0 to {MOST_HISTORY}, not {history!r}.")
    if not isinstance(kwargs.get("privileged", False), bool):
        raise UserError(f"privileged must be true or false, not {kwargs['privileged']!r}.")
    if kwargs.get("dynamics") in ([], (), ""):
        raise UserError(f"dynamics of {env_id} must be one or several of {', '.join(DYNAMICS)}.")
    if unknown := [name for name in several if name not in DYNAMICS]:
        raise unknown_name("dynamics", str(unknown[0]), DYNAMICS)
    if several and num_envs % len(several):
        raise UserError(f"{num_envs} drones cannot be divided equally among {len(several)} dynamics.")
    read_ranges(kwargs)


def _check_simulation(env_id: str, kwargs: Mapping[str, Any]) -> None:
    """Raise `UserError` for steps, a time limit or a drone that crazyflow has not."""
    freq, most = kwargs.get("freq", CONTROL_HZ), kwargs.get("max_episode_time", 10.0)
    if type(freq) is not int or not 0 < freq <= SIMULATED_HZ or SIMULATED_HZ % freq:
        raise UserError(f"freq of {env_id} must be a whole number that divides {SIMULATED_HZ}, not {shown(freq)}.")
    if type(most) not in (int, float) or not 1 / freq < most < math.inf:
        wanted = f"seconds, more than the {1 / freq:g} of a step"
        raise UserError(f"max_episode_time of {env_id} must be {wanted}, not {shown(most)}.")
    if "drone" in kwargs:
        from crazyflow.drones import Drone

        if kwargs["drone"] not in (models := [each.value for each in Drone]):
            raise unknown_name("drone", kwargs["drone"], models)


def dynamics_of(kwargs: Mapping[str, Any]) -> tuple[str, ...]:
    """The names of the dynamics among the arguments; none where crazyflow is to choose."""
    given = kwargs.get("dynamics")
    return () if given is None else tuple(given) if isinstance(given, list | tuple) else (given,)
