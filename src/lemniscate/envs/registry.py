"""The table of backends, and which of them runs an environment."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

from lemniscate.errors import UserError, is_installed, missing_extra, shown, unknown_name
from lemniscate.system import named

if TYPE_CHECKING:
    import gymnasium as gym

    from lemniscate.envs.backend import Backend
    from lemniscate.envs.vec_env import VecEnv
    from lemniscate.system.world import World

BACKENDS = {
    "crazyflow": "lemniscate.drones.crazyflow:CrazyflowBackend",
    "envpool": "lemniscate.envs.envpool:EnvpoolBackend",
    "minatar": "lemniscate.envs.packages:MinatarBackend",
    "robotics": "lemniscate.envs.packages:RoboticsBackend",
    "gymnasium": "lemniscate.envs.gymnasium:GymnasiumBackend",
    "gymnasium-async": "lemniscate.envs.gymnasium:AsyncGymnasiumBackend",
    "rsl_rl": "lemniscate.envs.rsl_rl:RslRlBackend",
}
"""each is imported when it is used; the first that serves an id runs it"""

ID_PREFIXES = {
    "crazyflow": ("Drone",),
    "minatar": ("MinAtar/",),
    "robotics": ("AdroitHand", "AntMaze_", "Fetch", "FrankaKitchen", "HandManipulate", "HandReach", "PointMaze_"),
    "envpool": (
        "EnvPool/",
        "Ant-v5",
        "CartPole-v1",
        "HalfCheetah-v5",
        "Hopper-v5",
        "Humanoid-v5",
        "LunarLander-v3",
        "Walker2d-v5",
    ),
}
"""how the ids begin that a backend may serve: for no other is it imported. Those not named here may serve any id.
EnvPool's own ids begin with `EnvPool/`; the others are Gymnasium's, which behave there as in Gymnasium"""

ARGUMENTS_OF_MAKE = {
    "render_mode": "videos are made by watch and evaluate with video (--video FILE), in training with video_every",
    "num_envs": "the number of parallel environments is the field num_envs",
    "seed": "the seed of a run is the field seed",
    "vectorization_mode": "the backend gymnasium-async gives each environment a process",
    **dict.fromkeys(("disable_env_checker", "autoreset", "apply_step_api_compatibility"), "it has no part here"),
}
"""arguments of `gym.make` and its kin, and what takes their place; one's own environment may have all but two"""

RSL_RL_METHOD = "get_observations"
"""the method by which a vector of environments that speaks rsl_rl's `VecEnv` is known"""

MOST_ENVS = 1_000_000
"""parallel environments that may be asked for"""


def known_ids() -> list[str]:
    """Every environment id that can be asked for, sorted."""
    return sorted({env_id for backend in BACKENDS for env_id in backend_class(backend).ids()})


def backend_for(env: str, wrappers: Sequence[str] = ()) -> str:
    """The name of the backend that runs `env`: an id, or the name of a class or function of one's own.

    It is the first that serves it and can put wrappers around it; the first that serves it where none can. Raises
    `UserError` with the nearest names if there is none.
    """
    with suppress(UserError):  # an id behind a module that registers it, or nothing
        if ":" in env and hasattr(found := named.find(env), RSL_RL_METHOD) and not _is_of_gymnasium(found):
            return "rsl_rl"
    serving = None
    for name in BACKENDS:
        if env.startswith(ID_PREFIXES.get(name, "")) and backend_class(name).serves(env):
            if not wrappers or backend_class(name).wraps(env):
                return name
            serving = serving or name
    if serving is None:
        raise unknown_env(env)
    return serving


def _is_of_gymnasium(found: object) -> bool:
    """Whether it is a class of Gymnasium's environments, which may have a method of that name too."""
    return isinstance(found, type) and any(each.__module__.startswith("gymnasium.") for each in found.__mro__)


def unknown_env(env: str) -> UserError:
    """The sentence for an environment that is not served: ours of that name in another version or library; or near it.

    Of several versions it is the newest, and Gymnasium's before that of EnvPool.
    """
    same = [known for known in known_ids() if _stem(known) == _stem(env)]
    if same:
        best = max(same, key=lambda known: ("/" not in known, [int(n) for n in re.findall(r"-v(\d+)$", known)]))
        return UserError(f"There is no environment {env!r}: did you mean {best}?")
    more = "" if is_installed("envpool") else f" Atari, dm_control and others: {missing_extra('envpool', 'envpool')}."
    near = unknown_name("environment", env, known_ids(), "one of your own is named as module:Class.")
    return UserError(f"{near}{more}")


def _stem(env: str) -> str:
    """The letters and digits of an id without library, version and the variants that Atari's ids had."""
    name = re.sub(r"(-ram)?(NoFrameskip|Deterministic)?(-v\d+)?$", "", env.rpartition("/")[2])
    return re.sub(r"[^a-z0-9]", "", name.lower())


def backend_class(backend: str) -> type["Backend"]:
    """The class of a backend by its name in the table, or by `module:Class`.

    Raises `UserError` with the nearest names for one that is not known, or with what a user's own lacks.
    """
    if isinstance(backend, str) and backend in BACKENDS:
        return resolve_name(BACKENDS[backend])
    if not isinstance(backend, str) or ":" not in backend:
        raise unknown_name("backend", backend, BACKENDS)
    from lemniscate.envs.backend import Backend

    found = named.find(backend)
    members = [member for member in vars(Backend) if not member.startswith("_")]
    lacking = getattr(found, "__abstractmethods__", ()) or [part for part in members if not hasattr(found, part)]
    if not isinstance(found, type) or lacking:
        what = f"lacks {', '.join(sorted(lacking))}" if isinstance(found, type) else "is not a class"
        raise UserError(f"{backend} {what}: a backend is derived from lemniscate.envs.backend.Backend.")
    return found


def for_evaluation(backend: str | None) -> str | None:
    """The backend that evaluates what `backend` trained: itself, but in this process. None if it is not installed."""
    if backend is None:
        return None
    found = backend_class(backend)
    if found.package and not is_installed(found.package):
        return None
    return found.in_process or backend


def name_of(env: object) -> str:
    """The name of an environment for a Config: an id or `module:Class` as it is, or that of a class or a callable.

    What speaks rsl_rl's `VecEnv` is N environments already, and has a name too. What can be imported by its name can be
    used again from a file; a lambda or a local class in this process only.

    Raises `UserError` for an environment that is made already, or something else that cannot be called.
    """
    if isinstance(env, str):
        return env
    if not callable(env) and not hasattr(env, RSL_RL_METHOD):
        what, right = shown(env), "its class, its id, or a function that makes it"
        if hasattr(env, "step"):
            what, right = "an environment that is made already", f"{right}: training makes as many as it needs"
            if hasattr(env, "num_envs"):
                right = "a function that makes as many as it is told: def make(num_envs): …"
        elif hasattr(env, "entry_point"):
            what = f"the EnvSpec of {getattr(env, 'id', None)}"
        raise UserError(f"env is {what}; give {right}.")
    return named.name_of(env)


def count_of(env: object) -> int | None:
    """The number of environments in an object that speaks rsl_rl's `VecEnv`; None of anything else."""
    number = getattr(env, "num_envs", None)
    return None if isinstance(env, type) or not hasattr(env, RSL_RL_METHOD) else number


def names_of(wrappers: "Sequence[str | Callable[..., Any]]") -> tuple[str, ...]:
    """The names of wrappers for a Config; one alone is one. Raises `UserError` for what is none."""
    if callable(wrappers) or isinstance(wrappers, str):
        return (named.name_of(wrappers),)
    if not isinstance(wrappers, list | tuple | Iterator):
        raise UserError(f"wrappers must be several, such as [MyWrapper], not {shown(wrappers)}.")
    return tuple(map(named.name_of, wrappers))


def require_room(env: str, num_envs: int, backend: str) -> None:
    """Raise `UserError` where N environments of a backend need more memory than is free, or more open files."""
    from lemniscate.system.machine import require_files, require_free

    each, files = backend_class(backend).room(env)
    what = f"{num_envs:,} × {env} in the {backend} backend"
    require_free(f"{what} take at least", {"num_envs": num_envs * each}, {"num_envs": num_envs}, None)
    require_files(what, num_envs, files)


def make_rendered(
    env: str, mode: str, kwargs: Mapping[str, Any], wrappers: Sequence[str], backend: str | None
) -> "gym.Env":
    """One environment of Gymnasium's interface that renders itself in `mode`, "rgb_array" or "human".

    Where `backend` cannot render, as crazyflow cannot, the first backend that serves the environment and can does it.
    Raises `UserError` if none can.
    """
    chosen = backend or backend_for(env, wrappers)
    for found in map(backend_class, (chosen, *BACKENDS)):
        made = found.make_rendered(env, mode, kwargs, wrappers) if found.serves(env) else None
        if made is not None:
            return made
    raise UserError(f"the {chosen} backend renders no single environment.")


def file_name(env: str) -> str:
    """An environment's name as a part of a file's name."""
    return re.sub(r"[^\w.-]+", "_", env)


def _make_backend(cls: "type[Backend]", env: str, num_envs: int, device: Any, options: dict[str, Any]) -> "Backend":
    """A backend. Raises `UserError` where one of a user's own cannot be made so."""
    try:
        return cls(env, num_envs, device, **options)
    except (TypeError, AttributeError, LookupError) as error:
        if cls.__module__.startswith("lemniscate."):
            raise
        raise UserError(f"The backend {cls.__name__} cannot be made: {type(error).__name__}: {error}.") from error


def make(
    env: "str | Callable[..., Any]",
    num_envs: int,
    *,
    kwargs: Mapping[str, Any] | None = None,
    wrappers: "Sequence[str | Callable[..., Any]]" = (),
    device: str = "cpu",
    stagger: bool = False,
    backend: str | None = None,
    world: "World | None" = None,
) -> "VecEnv":
    """N parallel environments on `device`; `restart` them before the first step.

    Args:
        env: an id, `module:Class`, a class, or a function that makes one environment (or, if it takes `num_envs`, a
            vector environment).
        num_envs: N.
        kwargs: arguments of the environment.
        wrappers: around each single environment, the first innermost: Gymnasium's or one's own, as a callable, or by
            name as `module:Class` or `module:Class(key=value, …)`.
        device: of the tensors: cpu, cuda, …
        stagger: spread the first episodes over time.
        backend: a name of `BACKENDS`, or `module:Class`; by default the first that serves `env`.
        world: the processes that share the environments; by default this one has all.

    Raises:
        UserError: an unknown environment or backend, arguments that it does not take, spaces nobody can act in, a
            missing extra; a number of environments below 1, or of more than the memory holds.
    """
    import torch

    from lemniscate.envs.backend import Joined
    from lemniscate.envs.vec_env import VecEnv
    from lemniscate.system.world import ALONE, leave_if_imported_again

    leave_if_imported_again()
    name, wraps = name_of(env), names_of(wrappers)
    number = getattr(num_envs, "tolist", lambda: num_envs)()  # of NumPy's and torch's scalars
    if type(number) not in (int, float) or not 1 <= number <= MOST_ENVS or number % 1:
        raise UserError(f"num_envs must be a whole number from 1 to {MOST_ENVS:,}, not {shown(num_envs)}.")
    if kwargs is not None and not isinstance(kwargs, Mapping):
        raise UserError(f"The arguments of an environment are a dictionary, such as {{'x': 1}}, not {kwargs!r}.")
    for argument, instead in ARGUMENTS_OF_MAKE.items():
        if argument in (kwargs or {}) and (argument in ("render_mode", "num_envs") or ":" not in name):
            raise UserError(
                f"{argument} is no argument of an environment: leave it out of env_kwargs (--env-args); {instead}."
            )
    chosen = backend_for(name, wraps) if backend is None else backend
    cls = backend_class(chosen)
    if not cls.serves(name):
        raise UserError(f"{name} cannot be served by the {chosen} backend; {backend_for(name, wraps)} serves it.")
    if wraps and not cls.wraps(name):
        raise UserError(
            f"The {chosen} backend cannot wrap {name}; wrappers and reset_options are for single environments of the"
            " gymnasium backend."
        )
    world = world or ALONE
    mine = int(number) // world.size
    require_room(name, mine, chosen)
    vectors = 1 if cls.divides(name) else len(world.held)
    once = cls.exists_once(name, int(number))
    options = {"stagger": stagger and not once, "kwargs": kwargs, "wrappers": wraps}
    made = [_make_backend(cls, name, mine // vectors, torch.device(device), options) for _ in range(vectors)]
    if wrong := [one.num_envs for one in made if one.num_envs != mine // vectors]:
        raise UserError(f"{chosen} has {wrong[0]} environments where it was to make {mine // vectors}.")
    made[0].once = once
    return VecEnv(made[0] if vectors == 1 else Joined(made), world)
