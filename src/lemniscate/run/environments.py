"""The environments of a run, for training and for evaluation, their curriculum, and whether there is room for it."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, nullcontext, suppress
from typing import Any

import torch

from lemniscate.envs import registry
from lemniscate.envs.symmetry import Mirror, find_mirror
from lemniscate.envs.vec_env import VecEnv
from lemniscate.errors import UserError, shown
from lemniscate.run.config import RunConfig, in_json
from lemniscate.spec import Spec
from lemniscate.system import named
from lemniscate.system.machine import require_free
from lemniscate.system.world import World

BYTES_PER_PARAMETER = 16
"""of a parameter, its gradient, and the two moments of its optimizer"""


def make_envs(config: RunConfig) -> tuple[VecEnv, VecEnv]:
    """Two vectors of environments that share nothing: one for training, staggered, and one for evaluation.

    They are restarted with seeds of different streams, so no start of one is ever a start of the other. One environment
    of one's own that may exist once at a time (`Backend.once`) is both.

    Raises:
        UserError: as `lemniscate.envs.registry.make`; no Config; a device that is not there; a run that takes more
            memory than is free.
    """
    if not isinstance(config, RunConfig):
        raise UserError(f"make_envs needs a Config, such as config_for('ppo', 'CartPole-v1'), not {shown(config)}.")
    env, eval_env = envs_of(config, World(config.shards))
    assert eval_env is not None
    return env, eval_env


def envs_of(config: RunConfig, world: World) -> tuple[VecEnv, VecEnv | None]:
    """The environments of one process of a run; of several, only the first evaluates. Raises as `make_envs`."""
    require_several(config, world.size)
    device, arguments = device_for(config.device), env_arguments(config, backend=config.backend)
    mirror = mirror_of(config)  # first, and closed again: it makes an environment, and there may be one at a time
    with ExitStack() as failing:
        eval_env = None
        if world.is_first:  # the few, before the many
            eval_env = evaluation_env(config, config.evaluate_episodes, device=str(device))
            failing.callback(eval_env.close)
            if world.size == 1:
                require_memory(config, eval_env.spec, device)
            if eval_env.backend.once and eval_env.num_envs == config.num_envs:
                eval_env.mirror = mirror
                if config.differentiates:
                    eval_env.backend.prepare_gradient()
                failing.pop_all()
                return eval_env, eval_env
            eval_env.backend.once = False  # one of several, which may be made again
        env = registry.make(num_envs=config.num_envs, device=str(device), stagger=True, world=world, **arguments)
        failing.callback(env.close)
        env.mirror = mirror
        if config.differentiates:
            env.backend.prepare_gradient()
        failing.pop_all()
        return env, eval_env


def require_several(config: RunConfig, processes: int) -> None:
    """Raise `UserError` where environments that exist once at a time are to be divided among processes."""
    if processes > 1 and registry.backend_class(str(config.backend)).exists_once(config.env, config.num_envs):
        said = f"{config.env} exists once at a time, and cannot be divided among {processes} processes"
        raise UserError(f"{said}: train in one.")


def mirror_of(config: RunConfig) -> Mirror | None:
    """The mirror image of a run's transitions, where they are to have one.

    Raises `UserError` where there is none and symmetry is on.
    """
    wanted = getattr(config, "symmetry", "off")  # of algorithms that do not ask how likely a mirrored action was
    if wanted == "off":
        return None
    with suppress(UserError) if wanted == "auto" else nullcontext():
        layers = getattr(config, "layers", None)
        if layers and layers.remembers:
            raise UserError(f"symmetry is not for network {layers.kind}: a memory has no mirror image.")
        if getattr(config, "replay", "uniform") == "hindsight":
            raise UserError("symmetry is not for replay hindsight: its goals have no mirror image.")
        if ":" in str(config.backend):
            raise UserError(f"symmetry is of environments of Gymnasium, and not of the backend {config.backend}.")
        return find_mirror(config.env, config.env_kwargs, config.all_wrappers)
    return None


def evaluation_env(
    config: RunConfig,
    episodes: int,
    *,
    env: str | Callable[..., Any] | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    backend: str | None = None,
    device: str = "cpu",
) -> VecEnv:
    """A few environments of a run, or of another `env`; as many as in training where no others may be made.

    `env_kwargs` change those of the run; in another environment they are the only ones.
    """
    arguments = env_arguments(config, env, env_kwargs, backend)
    name = arguments["env"]
    served_by = registry.backend_class(arguments["backend"] or registry.backend_for(name, config.all_wrappers))
    own_vector = ":" in name and not served_by.wraps(name)  # which may make no other number
    as_in_training = served_by.compiled or served_by.exists_once(name, config.num_envs) or own_vector
    number = registry.count_of(env) or config.num_envs  # an object has its own
    return registry.make(num_envs=number if as_in_training else min(episodes, 16), device=device, **arguments)


def env_arguments(
    config: RunConfig,
    env: str | Callable[..., Any] | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    backend: str | None = None,
) -> dict[str, Any]:
    """The arguments of `registry.make`: env, kwargs, wrappers, backend; by default those of a run's evaluation."""
    name = config.env if env is None else registry.name_of(env)
    kwargs = {**(config.env_kwargs if name == config.env else {}), **(env_kwargs or {})}
    if env is None and backend is None:
        backend = registry.for_evaluation(config.backend)
    return {"env": name, "kwargs": kwargs, "wrappers": config.all_wrappers, "backend": backend}


class Curriculum:
    """The function that a Config names, which decides at new lines of metrics on calls of the environments.

    Args:
        name: of a function of (step, metrics).
        world: in every process the calls are those that rank 0 decides on.

    Raises:
        UserError: one that cannot be found or called.
    """

    def __init__(self, name: str, world: World) -> None:
        self._decide, self._world = named.find_callable(name), world
        if not named.takes(self._decide, 2):
            raise UserError(f"A curriculum must be a function of (step, metrics), not {shown(self._decide)}.")

    def decide(self, lines: Sequence[tuple[int, Mapping[str, float]]]) -> list[dict[str, Any]]:
        """The calls of each line, by method."""
        return self._world.from_first(
            [calls_of(self._decide, step, metrics) for step, metrics in lines] if self._world.is_first else []
        )


def calls_of(curriculum: Callable[..., Any], step: int, metrics: Mapping[str, float]) -> dict[str, Any]:
    """The calls that a curriculum returns, as JSON holds them, so that they are the same from a checkpoint.

    Raises `UserError` for what it raises, and for what is no such dictionary.
    """
    try:  # without the measured times: on them a run would not have the same bits twice
        calls = curriculum(step, {name: value for name, value in metrics.items() if not name.startswith("time/")})
    except Exception as error:
        raise UserError(f"The curriculum raised {type(error).__name__} at step {step:,}: {error}") from error
    with suppress(TypeError, ValueError, AttributeError, RecursionError):
        if isinstance(calls, Mapping):
            return in_json(calls)
    wanted = "a dictionary of methods with an argument each that JSON can hold, such as {'set_level': 1}"
    raise UserError(f"The curriculum must return {wanted}; at step {step:,} it returned {shown(calls)}.")


def device_for(name: str) -> torch.device:
    """The device of that name; auto is cuda where there is a GPU, else cpu. Raises `UserError` for one not there."""
    gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if name == "auto":
        name = "cuda" if gpus else "cpu"
    kind, _, index = name.partition(":")
    if kind == "cuda" and not gpus:
        raise UserError(f"device is {name}, but torch sees no GPU; use cpu or auto.")
    if kind == "cuda" and int(index or 0) >= gpus:
        there = ", ".join(f"cuda:{i}" for i in range(gpus))
        raise UserError(f"device is {name}, but the GPUs that torch sees are: {there}.")
    if kind == "mps" and not torch.backends.mps.is_available():
        raise UserError("device is mps, but torch sees no Apple GPU; use cpu or auto.")
    return torch.device(name)


def require_memory(config: RunConfig, spec: Spec, device: torch.device) -> None:
    """Raise `UserError` where a run takes more memory than is free, with the field that takes most, and its limit."""
    parts = {"hidden": _network_bytes(config, spec), **config.memory_bytes(spec)}
    require_free("This run takes at least", parts, vars(config), device)


def _network_bytes(config: RunConfig, spec: Spec) -> int:
    """The size of the networks, made on the meta device; 0 for those of one's own, which may need real numbers."""
    if ":" in getattr(config, "network", ":"):
        return 0
    with torch.device("meta"):
        networks = config.networks(spec)
    return BYTES_PER_PARAMETER * sum(parameter.numel() for parameter in networks.parameters())
