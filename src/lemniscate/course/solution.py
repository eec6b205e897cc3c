"""The call of a reader's solution, whatever its style: names and order of arguments, methods, NumPy.

A method gets an object of its own class. What the course's constructor sets is put there; the reader's own constructor
runs only where the method asks for more, and as far as it comes.
"""

import ast
import copy
import ctypes
import dataclasses
import inspect
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from itertools import accumulate, takewhile
from types import FunctionType, MethodType, SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

Function = Callable[..., Any]

_NAMES = {
    "reward rewards": "r rew rews rs",
    "value": "values v val vals vs v_s state_values new_value newvalue new_values pred",
    "next_value": "next_values nv next_v v_next values_next next_vals v_prime vp v_s_next next_q next_qs q_next"
    " next_q_value next_q_values q_next_values next_state_value next_state_values target_q target_qs",
    "terminated": "terminations terminateds term terms terminal terminals death deaths te",
    "done": "dones d ended ends end over episode_over finished",
    "ended": "terminations terminated terminals dones done term",
    "gamma": "discount discount_factor g γ",
    "lam gae_lambda lmbda": "lambda lambd lamda gae_lam l λ",
    "clip clip_coef epsilon": "eps clip_eps clip_range clip_ratio clip_epsilon clip_param ε",
    "num_steps n_steps": "t_max num_collection_steps horizon rollout_length steps",
    "states": "state s obs observations",
    "actions": "action a acts",
    "next_states": "next_state s_next next_obs next_observations s_prime s2",
    "advantage advantages mb_advantages": "adv advs a_hat mb_adv minibatch_advantages advantage_estimates",
    "targets": "critic_targets target returns value_targets v_target v_targets",
    "target": "targets returns return_ ret value_target v_target b_returns target_model target_net target_network"
    " target_params target_critic target_actor q_target critic_target actor_target policy_target",
    "old": "log_probs_old old_log_probs log_prob_old old_log_prob logp_old old_logp",
    "ratio": "ratios r_t rt prob_ratio rho importance_ratio",
    "log_ratio": "logratio log_ratios logratios log_r logr lr",
    "newvalue": "new_value newvalues new_values values value mb_values pred",
    "b_returns": "returns batch_returns targets",
    "b_values": "old_values batch_values values_old",
    "mb_inds": "inds indices idx mb_idx mb_indices rows",
    "if_clip": "clip_vloss use_clip clip_value_loss do_clip clipped",
    "old_value": "old_values value_old values_old v_old old_v old",
    "log_prob": "log_probs logprob logprobs logp log_pi log_p",
    "weight": "weights advantage advantages adv returns psi ψ w",
    "online": "source params parameters main local online_params net model src online_net online_model local_model"
    " main_net source_net policy policy_net q_net q_network q critic actor current current_net",
    "x": "values input matrix q q_values logits scores",
    "indices": "index idx inds actions action i",
    "probs": "p probabilities prob pi π",
    "tau": "polyak polyak_coef rho alpha t τ",
}
LAST = {"terminated": ["done", "dones", "d", "ended", "over"]}
"""names that an argument has where no other is meant by them"""
NAMES = {name: f"{names} {others}".split() for names, others in _NAMES.items() for name in names.split()}
"""all names of an argument, by its name in the exercise"""
SETTINGS = ("config", "cfg", "conf", "args", "hp", "hparams", "hyperparameters", "params", "settings", "train_config")
"""names of what holds a reader's settings"""
LIMIT = 8.0
"""seconds that a function may take for all its cases; what is right takes milliseconds"""


def standard(name: str, among: Mapping[str, Any], names: Mapping[str, list[str]] = NAMES) -> str | None:
    """The name among those of the exercise that another name stands for; None if there is none."""
    name = name.lower().strip("_")
    if name in among:
        return name
    return next((known for known in among if name in names.get(known, ())), None)


class Settings(dict):
    """A configuration as a course has it: `config.gamma`, `config["gamma"]`, `config.get("gamma")`."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(f"the configuration has no {name}", name=name, obj=self) from None


class OwnSettings(Settings):
    """A configuration of the reader's, in which a number may have another name than in the exercise."""

    def __missing__(self, name: str) -> Any:
        known = None if name.startswith("__") else standard(name, self)
        if known is None:
            raise KeyError(name)
        return self[known]

    def get(self, name: str, default: Any = None) -> Any:
        """The value of that name, or of another name of it; else the default."""
        return self[name] if standard(name, self) else default


class MisfitError(TypeError):
    """A solution takes fewer arguments than a case has."""


class TooLong(BaseException):
    """Raised within a solution that has not ended in time; not an Exception, which a solution might catch."""


@contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Raise `TooLong` in this thread, and again every half second, once the time is over; also in an endless loop.

    The seconds are those of the processor, so that a busy machine is no fault of the solution; one that waits has
    four times as many by the clock, and so has an import, which a slow disk may hold up.
    """
    thread, over, sent = threading.get_ident(), threading.Event(), threading.Event()
    clock = time.monotonic
    if hasattr(time, "pthread_getcpuclockid"):
        clock = partial(time.clock_gettime, time.pthread_getcpuclockid(thread))
    start, end = clock(), time.monotonic() + 4 * seconds

    def interrupt() -> None:
        wait = min(seconds, 0.5)
        while not over.wait(wait):
            if time.monotonic() >= end or (clock() - start >= seconds and not _is_importing(thread)):
                sent.set()
                ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), ctypes.py_object(TooLong))

    watch = threading.Thread(target=interrupt, daemon=True)
    watch.start()
    try:
        yield
    finally:
        over.set()
        watch.join()
        if sent.is_set():  # with nothing to take back, Python 3.11 hangs where a trace function is set
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), None)
            _forget_halves()


def _is_importing(thread: int) -> bool:
    frame = sys._current_frames().get(thread)
    while frame and frame.f_globals.get("__name__") != "importlib._bootstrap":
        frame = frame.f_back
    return frame is not None


def _forget_halves() -> None:
    """Remove the parts of packages whose import was broken off, which would leave the next import without them."""
    for name in list(sys.modules):
        parents = accumulate(name.split(".")[:-1], "{}.{}".format)
        if any(parent not in sys.modules for parent in parents):
            del sys.modules[name]


# --- arguments ---


def arranged(
    function: Function, given: Mapping[str, Any], options: Mapping[str, Any], are_held: bool = False
) -> tuple[list[Any], dict]:
    """Positional and keyword arguments: by their names where these are known, the rest in the order of the exercise.

    Args:
        function: the solution.
        given: what it must take, by the names of the exercise.
        options: what it may take.
        are_held: whether an object has the options too, so that a function that takes anything is not given them.

    Raises:
        MisfitError: it takes less than there is.
        TypeError: it wants more than there is.
    """
    # What one calls a module is its forward, but its signature is that of any module.
    parameters = inspect.signature(function.forward if isinstance(function, nn.Module) else function).parameters
    kinds = {parameter.kind for parameter in parameters.values()}
    named = {
        name: each for name, each in parameters.items() if each.kind not in (each.VAR_POSITIONAL, each.VAR_KEYWORD)
    }
    if not named and inspect.Parameter.VAR_POSITIONAL in kinds:
        if are_held or inspect.Parameter.VAR_KEYWORD in kinds:
            return list(given.values()), {} if are_held else dict(options)
        return [*given.values(), *options.values()], {}
    chosen, left = _chosen(named, {**given, **options})
    for name, each in named.items():
        if name not in chosen and each.default is each.empty:
            if name.lower() not in SETTINGS:
                raise TypeError(f"its parameter {name} is none of those that this exercise has: {', '.join(given)}")
            chosen[name] = OwnSettings(options)
    leading = [*takewhile(lambda name: name in chosen and named[name].kind is not named[name].KEYWORD_ONLY, named)]
    rest = []
    if inspect.Parameter.VAR_POSITIONAL in kinds and all(
        name in leading or each.kind is each.KEYWORD_ONLY for name, each in named.items()
    ):
        are_named = inspect.Parameter.VAR_KEYWORD in kinds or are_held
        rest = [left.pop(name) for name in [*left] if name in given or not are_named]
    if inspect.Parameter.VAR_KEYWORD in kinds and not are_held:
        chosen, left = {**chosen, **left}, {}
    if unused := [name for name in left if name in given]:
        raise MisfitError(f"it takes too few arguments, no {', '.join(unused)}; there are {', '.join(given)}")
    # Options by name, as a course calls them; the rest as they stand, which a wrapper may expect.
    return [*(chosen.pop(name) for name in leading), *rest], chosen


def _chosen(named: Mapping[str, inspect.Parameter], left: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The values of parameters, and what is left of those that there are."""
    chosen = {name: left.pop(name) for name in named if name in left}  # before those that another name may mean
    for names in (NAMES, LAST):
        for name in named:
            if name not in chosen and (known := standard(name, left, names)):
                chosen[name] = left.pop(known)
    for name, each in named.items():
        if name in chosen or not left or name.lower() in SETTINGS:
            continue
        if each.default is each.empty or _is_number(each.default):
            chosen[name] = left.pop(next(iter(left)))
    return chosen, left


def _is_number(value: Any) -> bool:
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool))


def call_by_name(function: Function, needed: Mapping[str, Any], offered: Mapping[str, Any] | None = None) -> Any:
    """Call a function with values by the names of its parameters; where it has other names, by position.

    Args:
        function: a function, a class, a torch module, or a method of an object.
        needed: the values of the exercise in its order, each by its names, "next_obs next_state".
        offered: more of them, given only to parameters of these names, and to those without a default.

    Raises:
        TypeError: the function takes another argument, which has no default.
    """
    values = {**needed, **(offered or {})}
    by_name = {name: names for names in values for name in names.split()}
    try:
        bound = _signature(function).bind_partial()
    except ValueError:  # written in C
        return function(*needed.values())
    parameters = bound.signature.parameters.values()
    plain = [parameter for parameter in parameters if parameter.kind not in VARIADIC]
    given = {parameter.name: by_name[parameter.name] for parameter in plain if parameter.name in by_name}
    left = [names for names in values if names not in given.values()]
    for parameter in sorted(plain, key=lambda parameter: parameter.default is not parameter.empty):
        if parameter.name in given:
            continue
        if parameter.default is parameter.empty and not left:
            known = ", ".join(names.split()[0] for names in values)
            raise TypeError(f"its parameter {parameter.name} is none of those that this exercise has: {known}")
        if left and (parameter.default is parameter.empty or left[0] in needed):
            given[parameter.name] = left.pop(0)
    bound.arguments.update({name: values[names] for name, names in given.items()})
    left, kinds = [names for names in left if names in needed], {parameter.kind: parameter for parameter in parameters}
    if inspect.Parameter.VAR_POSITIONAL in kinds:
        bound.arguments[kinds[inspect.Parameter.VAR_POSITIONAL].name] = tuple(values[names] for names in left)
    elif inspect.Parameter.VAR_KEYWORD in kinds:
        named = {names.split()[0]: values[names] for names in left}
        bound.arguments[kinds[inspect.Parameter.VAR_KEYWORD].name] = named
    return function(*bound.args, **bound.kwargs)


VARIADIC = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


def _signature(function: Function) -> inspect.Signature:
    """The signature; that of the function inside, where a decorator hides it."""
    function = function.forward if isinstance(function, nn.Module) else function
    signature = inspect.signature(function)
    inner = [cell.cell_contents for cell in getattr(function, "__closure__", None) or ()]
    is_hidden = all(parameter.kind in VARIADIC for parameter in signature.parameters.values())
    if is_hidden and len(inner) == 1 and inspect.isfunction(inner[0]):
        return _signature(inner[0].__get__(function.__self__) if inspect.ismethod(function) else inner[0])
    return signature


def first_that_works(attempt: Callable[..., Any], *arguments: tuple[Any, ...]) -> Any:
    """The result of an attempt with the first arguments that raise no error; if all do, the first error is raised."""
    errors: list[Exception] = []
    for given in arguments:
        try:
            return attempt(*given)
        except Exception as error:  # an error of the solution, which the next attempt may not meet
            errors.append(error)
    raise errors[0]


# --- objects of the reader's class ---


def owner_of(function: Function) -> tuple[type, str] | None:
    """The class in whose text a function stands, or the last one that inherits it, and its name there."""
    found, seen, waiting = None, {object}, [object]
    is_wrapper = function.__qualname__.rpartition(".")[0].endswith("<locals>")  # it may be of any file
    while waiting and ("." in function.__qualname__ or _has_one_more(function)):  # or put there: A.method = function
        below = set(type.__subclasses__(waiting.pop())) - seen
        seen |= below
        waiting += below
        for cls in (
            below if is_wrapper else (cls for cls in below if getattr(cls, "__module__", "") == function.__module__)
        ):
            for name, held in list(vars(cls).items()):
                if held is function or getattr(held, "__func__", None) is function:
                    found = cls, name
    while found and (heirs := [sub for sub in type.__subclasses__(found[0]) if found[1] not in vars(sub)]):
        found = heirs[-1], found[1]
    return found


class Solution:
    """A function, a method, or a module of the reader's, ready to be called in a case.

    Args:
        function: what was given to the check.
        is_method: whether the exercise is a method, so that its first argument may be an object though it has no class.
    """

    def __init__(self, function: Function, is_method: bool = False) -> None:
        self._bound = getattr(function, "__self__", None) if inspect.ismethod(function) else None
        self._function = plain = getattr(function, "__func__", function)
        owner = None if self._bound is not None or not isinstance(plain, FunctionType) else owner_of(plain)
        self._class = type(self._bound) if self._bound is not None else owner and owner[0]
        if isinstance(self._bound, type):  # a class method
            self._class = type(self._bound.__name__, (self._bound,), {})
        static = owner is not None and isinstance(inspect.getattr_static(*owner), staticmethod)
        named = is_method and isinstance(plain, FunctionType) and _has_one_more(plain)
        self._takes_self = self._bound is not None or (owner is not None and not static) or named
        self._endless = set[int]()
        """statements of the constructor that take too long here"""

    def call(self, given: Mapping[str, Any], options: Mapping[str, Any], attributes: Mapping[str, Any] | None) -> Any:
        """Call it with the arguments of a case; a method with an object that has options and attributes.

        Raises:
            Exception: what the solution raises.
        """
        function = partial(self._function, None) if self._takes_self else self._function
        args, named = arranged(function, given, options, are_held=self._takes_self)
        taken = {id(value) for value in [*args, *named.values()]}
        others = {name: each for name, each in options.items() if id(each) not in taken}
        if not self._takes_self:
            with _constants(self._function, others):
                return self._function(*args, **named)
        return self._function(self._object(others if attributes is None else options, attributes), *args, **named)

    def _object(self, options: Mapping[str, Any], attributes: Mapping[str, Any] | None) -> Any:
        """An object of the class: after the reader's constructor, with what the course's sets, if it is of one."""
        config, held = None, {}
        if attributes is not None:
            config, held = attributes.get("config"), {**attributes, **options, "device": torch.device("cpu")}
        if config is not None:  # the course's trainer has numbers in its configuration alone
            config.update(options)
            held = {name: each for name, each in held.items() if not isinstance(each, int | float) or name == "n_envs"}
        if self._class is None:
            return SimpleNamespace(**held)
        made, known = self._blank(), OwnSettings({**options, **(config or {})})
        constructed = self._bound is None and self._construct(made, known)
        for name, value in held.items():
            if name != "config" or not constructed:
                _set(made, name, value)
        has_numbers = constructed and config is not None
        for name, value in [*_members(made)]:
            if name not in held and (mine := _in_place_of(name, value, known, held, has_numbers)) is not None:
                _set(made, name, mine)
        return made

    def _construct(self, made: Any, config: Settings) -> bool:
        """Run the reader's constructor, statement by statement: those that make environments cannot run here.

        Returns:
            Whether there is one.
        """
        function = inspect.unwrap(type(made).__init__)
        known = {"config": config, "wandb_log": False, **config, "state_dim": 3, "num_actions": 2, "envs": None}
        with suppress(Exception):
            args, named = arranged(partial(function, made), {}, known)
            bound = inspect.signature(function).bind(made, *args, **named)
            bound.apply_defaults()
            scope = {**function.__globals__, **bound.arguments, "super": partial(super, type(made), made)}
            (definition,) = ast.parse(textwrap.dedent(inspect.getsource(function))).body
            assert isinstance(definition, ast.FunctionDef)
            for number, statement in enumerate(definition.body):
                try:
                    with limited(LIMIT / 3):
                        if number not in self._endless:
                            exec(compile(ast.Module([statement], []), inspect.getfile(function), "exec"), scope)
                except TooLong:
                    self._endless.add(number)
                except (Exception, SystemExit):
                    pass
            return True
        return False

    def _blank(self) -> Any:
        """The object of a method before anything is set: a copy of a bound one, or one that was not constructed."""
        if isinstance(self._bound, type):
            return self._class
        if self._bound is not None:
            made = copy.copy(self._bound)
            vars(made).update({name: copy.copy(each) for name, each in vars(made).items() if isinstance(each, dict)})
            return made
        made: Any = object.__new__(self._class or object)
        if isinstance(made, nn.Module):
            nn.Module.__init__(made)
        return made


def bound(function: Function) -> Function:
    """A function that stands in a class as a method of an object of it; any other as it is."""
    solution = Solution(function)
    if inspect.ismethod(function) or not solution._takes_self:
        return function
    return MethodType(function, solution._object({}, {}))


def _has_one_more(function: Function) -> bool:
    """Whether the first parameter of a function that stands in no class is an object."""
    first = next(iter(inspect.signature(function).parameters), "")
    return first in ("self", "this", "me", "trainer", "agent", "ppo")


def _set(made: Any, name: str, value: Any) -> None:
    """Set an attribute where the class lets one; a property of its own stays."""
    try:
        setattr(made, name, value)
    except Exception:
        with suppress(Exception):
            object.__setattr__(made, name, value)


def _members(made: Any) -> Iterator[tuple[str, Any]]:
    """The attributes of an object, modules and those of its class among them, without methods and private names."""
    for cls in reversed((made if isinstance(made, type) else type(made)).__mro__):
        yield from ((name, each) for name, each in vars(cls).items() if _is_setting(each) or name.lower() in SETTINGS)
    yield from (getattr(made, "__dict__", {}) if not isinstance(made, type) else {}).items()
    if isinstance(made, nn.Module):
        yield from made.named_children()


def _is_setting(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) > 1e-3


def _fields(value: Any) -> dict[str, Any]:
    """The values of a reader's own configuration."""
    if isinstance(value, Mapping):
        return dict(value)
    if dataclasses.is_dataclass(value):
        return {each.name: getattr(value, each.name) for each in dataclasses.fields(value)}
    return dict(getattr(value, "__dict__", {}))


def _in_place_of(name: str, value: Any, known: OwnSettings, held: Mapping[str, Any], has_numbers: bool) -> Any | None:
    """The case's value for an attribute of the reader's: a configuration, a number, a network; None if it has none."""
    if name.lower() in SETTINGS:
        return OwnSettings({**_fields(value), **known})
    if isinstance(value, nn.Module):
        layers = [module for module in value.modules() if isinstance(module, nn.Linear)]
        ours = [other for other in held.values() if isinstance(other, nn.Linear)]
        return next((other for other in ours if layers and layers[-1].out_features == other.out_features), None)
    if _is_setting(value) and not has_numbers:
        return known.get(name)
    return None


@contextmanager
def _constants(function: Function, options: Mapping[str, Any]) -> Iterator[None]:
    """The options in place of the constants of the reader's file that are called like them, such as GAMMA."""
    names: dict[str, Any] = getattr(inspect.unwrap(function), "__globals__", {})
    known = OwnSettings(options)
    ours = {
        name: mine
        for name, value in names.items()
        if options and len(name) > 1 and not name.startswith("__") and not isinstance(value, type | FunctionType)
        if (mine := _in_place_of(name, value, known, {}, False)) is not None
    }
    before = {name: names[name] for name in ours}
    names.update(ours)
    try:
        yield
    finally:
        names.update(before)


# --- kinds of numbers ---


def numbers(value: Any) -> Tensor | None:
    """A result as a tensor: a tensor, an array, a number, or a list of them; None for anything else."""
    if isinstance(value, Tensor):
        return value.as_subclass(Tensor)
    with suppress(Exception):
        if isinstance(value, list | tuple) and value and isinstance(value[0], Tensor):
            return torch.stack([torch.as_tensor(each) for each in value])
        array = np.asarray(value)
        return torch.from_numpy(array.copy()) if array.dtype.kind in "fiub" else None
    return None


def plain(value: Any) -> Any:
    """The same as tensors, numbers, text, lists and dictionaries; of any other object the name of its class."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        return torch.tensor(value)
    if isinstance(value, Tensor):
        return value.detach().cpu().clone()
    if isinstance(value, np.generic | np.ndarray):
        return plain(value.tolist())
    if isinstance(value, Mapping):
        return {name if isinstance(name, int) else str(name): plain(part) for name, part in value.items()}
    if isinstance(value, list | tuple | set):
        return [plain(part) for part in value]
    kinds = [kind for kind in (bool, int, float, str) if isinstance(value, kind)]
    return value if value is None else kinds[0](value) if kinds else f"<{type(value).__name__}>"
