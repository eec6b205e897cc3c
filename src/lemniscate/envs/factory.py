"""The making of Gymnasium's environments: by an id, from a class or a function, with arguments and wrappers."""

import inspect
import multiprocessing
import os
import sys
import sysconfig
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv

from lemniscate.envs.conversion import SingleEnv
from lemniscate.envs.registry import RSL_RL_METHOD
from lemniscate.envs.returned import CheckedVector, told_with_place
from lemniscate.envs.workers import WatchedVectorEnv, Worker
from lemniscate.errors import UserError, WorkerError, shown, with_article
from lemniscate.system import named

Maker = EnvSpec | Callable[..., Any]
"""an entry of Gymnasium's registry, or a function (or class) that makes an environment"""


def maker_of(env: str) -> Maker:
    """The maker of an environment: a registered id, `module:id`, or `module:name` of a class or function of one's own.

    Raises `UserError` if it is not there, or is neither.
    """
    if ":" not in env:
        return gym.spec(env)
    _, _, name = env.rpartition(":")
    if not named.is_passed(env):
        named.module_of(env)  # to import a module may register ids
        if name in gym.registry:
            return gym.spec(name)
    found = named.find(env)
    if isinstance(found, type) and issubclass(found, gym.Env):
        return EnvSpec(found.__name__, entry_point=found)
    if issubclass(found, VectorEnv) if isinstance(found, type) else callable(found):
        return found
    raise UserError(f"{env} cannot be made: {name} is neither an environment class, nor a function, nor an id.")


def makes_vector(maker: Maker) -> bool:
    """Whether it makes N environments at once: an id registered so, a `VectorEnv`, or what takes `num_envs`."""
    if isinstance(maker, EnvSpec):
        return maker.entry_point is None
    return isinstance(maker, type) or "num_envs" in inspect.signature(maker).parameters  # a class is a `VectorEnv`


def is_own(maker: Maker) -> bool:
    """Whether an environment is the user's own: neither of an installed package nor of the standard library."""
    made_by: Any = getattr(maker, "entry_point", maker)
    while isinstance(made_by, partial):
        made_by = made_by.func
    name = made_by.partition(":")[0] if isinstance(made_by, str) else getattr(made_by, "__module__", "")
    package = name.partition(".")[0]  # to look for what is inside of it would import it
    found = sys.modules.get(package) or (package and find_spec(package))
    file = Path(getattr(found, "__file__", None) or getattr(found, "origin", None) or "")
    installed = {"site-packages", "dist-packages"} & set(file.parts)
    return not installed and not file.is_relative_to(sysconfig.get_path("stdlib"))


def fresh(arguments: Any) -> Any:
    """Dictionaries and lists anew, all the way down: an environment may change what others get too."""
    if type(arguments) is dict:  # and not a space, which is a mapping too
        return {name: fresh(value) for name, value in arguments.items()}
    return [fresh(value) for value in arguments] if type(arguments) is list else arguments


class ResetOptions(gym.Wrapper):
    """An environment whose every reset is given the same options."""

    def __init__(self, env: gym.Env, options: dict[str, Any]) -> None:
        super().__init__(env)
        self._options = options

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """The environment's. Raises `UserError` for options that it refuses."""
        given = {**fresh(self._options), **(options or {})}
        try:
            return self.env.reset(seed=seed, options=given)
        except (ValueError, TypeError, KeyError, AssertionError) as error:
            raise UserError(
                f"reset with the options {given} raised {type(error).__name__}: {str(error).rstrip('.')}."
            ) from error


def make_one(maker: Maker, wrappers: Sequence[Callable[..., Any]] = (), **kwargs: Any) -> SingleEnv:
    """One environment, by its maker: a worker process may not know the id."""
    kwargs = fresh(kwargs)
    point = str(getattr(maker, "entry_point", ""))
    if point.startswith("gymnasium_robotics."):
        give_numbers_of_joints()
    with model_warnings_off() if "gymnasium.envs.mujoco" in point else nullcontext():
        # Gymnasium's own checker would speak first, in warnings and asserts; `SingleEnv` checks every step.
        env = gym.make(maker, disable_env_checker=True, **kwargs) if isinstance(maker, EnvSpec) else maker(**kwargs)
    for wrap in wrappers:
        env = wrap(env)
    if not isinstance(env, gym.Env):
        raise _wrong_kind(env, "gymnasium.Env")
    return SingleEnv(env)


def _wrong_kind(made: object, wanted: str) -> TypeError:
    """The words on something else than what is wanted."""
    instead = "; what speaks rsl_rl's VecEnv is of the backend rsl_rl" if hasattr(made, RSL_RL_METHOD) else ""
    if isinstance(made, gym.Env):
        instead = "; what has an argument num_envs makes that many at once"
    return TypeError(f"it makes {with_article(type(made).__name__)}, not a {wanted}{instead}")


def make_vector(
    maker: Maker, num_envs: int, kwargs: Mapping[str, Any], wrappers: Sequence[Callable[..., Any]], workers: bool
) -> tuple[VectorEnv, int | None]:
    """N environments of a maker, and their time limit in steps; with `workers`, each in a process of its own."""
    makers = [partial(make_one, maker, wrappers, **kwargs)] * num_envs
    if makes_vector(maker):
        make = partial(gym.make_vec, maker) if isinstance(maker, EnvSpec) else maker
        made = make(num_envs=num_envs, **fresh(dict(kwargs)))
        if not isinstance(made, VectorEnv):
            raise _wrong_kind(made, "gymnasium.vector.VectorEnv")
        if made.num_envs != num_envs:
            kind = type(made).__name__
            raise UserError(
                f"{kind} has {made.num_envs} environments where num_envs is {num_envs}; it must make as many"
            )
        envs = one = CheckedVector(made)
    elif workers:
        method = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"  # Windows
        multiprocessing.get_context(method).set_forkserver_preload([__name__])  # imported once, for all
        one = makers[0]()
        one.close()
        in_workers = [partial(Worker, make, os.getpid()) for make in makers]
        envs = WatchedVectorEnv(in_workers, context=method, autoreset_mode=AutoresetMode.DISABLED)
    else:
        envs = SyncVectorEnv(makers, copy=False, autoreset_mode=AutoresetMode.DISABLED)
        one = envs.envs[0]
        if len({id(env.unwrapped) for env in envs.envs}) < num_envs:
            raise UserError("it returned the same environment again; make a new one at each call")
    require_no_statistics(one, envs)
    return envs, one.spec.max_episode_steps if one.spec else None


STATISTICS = {"obs_rms", "return_rms", "ret_rms", "reward_rms", "running_mean_std"}
"""the attributes that hold running statistics in Gymnasium's wrappers and in those modelled on them"""


def require_no_statistics(env: Any, vector: VectorEnv) -> None:
    """Close `vector` and raise `UserError` where `env` or a wrapper of it learns statistics: no checkpoint has them.

    Of a vector the first environment is looked at. Those that are fixed (`update_running_mean` False) may stay.
    """
    while isinstance(env, gym.Env | VectorEnv):
        held = {name.strip("_"): value for name, value in vars(env).items()}
        learns = STATISTICS & held.keys() or {name for name, value in held.items() if _is_running(value)}
        if isinstance(env, AsyncVectorEnv):
            learns = {name for name in STATISTICS if any(env.call("has_wrapper_attr", name))}
        if learns and held.get("update_running_mean", True):
            vector.close()
            raise UserError(
                f"{type(env).__name__} learns statistics, {min(learns)}, that no checkpoint has: leave them out, and"
                " train with normalize_observations, for rewards with scale_rewards (--normalize-observations,"
                " --scale-rewards)."
            )
        several = held.get("envs")
        env = held.get("env", several[0] if isinstance(several, list | tuple) and several else None)


def _is_running(value: object) -> bool:
    """Whether it is a running mean and variance, as `RunningMeanStd` is; of an array or a table these are methods.

    A filter of one's own may have a mean and a variance too: it counts nothing.
    """
    return {"mean", "var", "count"} <= set(dir(value)) and not callable(getattr(value, "mean", len))


def give_numbers_of_joints() -> None:
    """Give Gymnasium-Robotics the kinds of joints as numbers, which it compares as MuJoCo 4 no longer can."""
    import mujoco
    from gymnasium_robotics.utils import mujoco_utils  # pyright: ignore[reportMissingImports]

    joints = SimpleNamespace(**{name: int(kind) for name, kind in vars(mujoco)["mjtJoint"].__members__.items()})
    mujoco_utils.mujoco = SimpleNamespace(**{**vars(mujoco), "mjtJoint": joints})


@contextmanager
def model_warnings_off() -> Iterator[None]:
    """No warnings of MuJoCo about models, which it writes on standard error and into a file where the command runs."""
    try:
        from mujoco import set_mju_user_warning  # pyright: ignore[reportAttributeAccessIssue]
    except ImportError:  # Gymnasium says what to install
        yield
        return
    set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        set_mju_user_warning(None)


@contextmanager
def creation_errors(env: str, kwargs: Mapping[str, Any] | None, wrappers: Sequence[str] = ()) -> Iterator[None]:
    """An error that the making of an environment raises, as a `UserError` that names the arguments and wrappers."""
    try:
        yield
    except WorkerError:
        raise
    except (Exception, SystemExit) as error:
        given = [f"{name}={shown(value)}" for name, value in (kwargs or {}).items()] + list(wrappers)
        with_these = f" with {', '.join(given)}" if given else ""
        said = str(error).partition(" was raised from the environment creator")[0]
        if not isinstance(error, gym.error.Error | ImportError | TypeError | ValueError | KeyError | AssertionError):
            said = told_with_place(error)
        if "required positional argument" in said:
            said += "; it is given in env_kwargs (--env-args), or with a wrapper: module:Name(key=value)"
        elif "unexpected keyword argument 'num_envs'" in said:
            said += "; a vector environment is made with num_envs"
        raise UserError(f"{env} cannot be made{with_these}: {said}") from error
