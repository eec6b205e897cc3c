"""The settings that every algorithm has, and how the values of all settings are checked."""

import dataclasses
import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from itertools import islice
from pathlib import PurePath
from types import NoneType
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar, get_args, get_origin, get_type_hints

import torch

from lemniscate.envs.registry import MOST_ENVS
from lemniscate.errors import UserError, shown, unknown_name
from lemniscate.run.fields import number, options_of, unknown_field
from lemniscate.run.seeding import Generators
from lemniscate.spec import Spec
from lemniscate.types import Schedule

MOST_WHOLE, MOST_REAL = 10**15, 1e38
"""the largest numbers of a field: float64, and so JSON, counts exactly to 9e15; the float32 of networks ends at 3e38"""
WORTH_COMPILING = 15_000
"""gradient steps from which on a run ends sooner if they are compiled"""
MOST_ITEMS = 1_000
"""the most values of a field that has several"""
WANTED = {bool: "True or False", str: "a text", dict: "a dictionary, such as {'gravity': -5}", NoneType: "None"}
"""the basic types of fields that are no numbers, in a sentence"""

T = TypeVar("T")


@dataclass(frozen=True)
class Range:
    """A closed interval, or with `above` one open at its lower end."""

    low: float = -math.inf
    high: float = math.inf
    above: bool = False

    def __contains__(self, x: float) -> bool:
        return -math.inf < x < math.inf and (self.low < x if self.above else self.low <= x) and x <= self.high

    def __str__(self) -> str:
        if self.high < math.inf:
            high = f"{self.high:,.0f}" if self.high >= 1000 else f"{self.high:g}"
            return f"{'above' if self.above else 'from'} {self.low:g} to {high}"
        return f"{'above' if self.above else 'at least'} {self.low:g}" if self.low > -math.inf else ""


Count = Annotated[int, Range(1)]
Natural = Annotated[int, Range(0)]
NumEnvs = Annotated[int, Range(1, MOST_ENVS)]
Episodes = Annotated[int, Range(1, 1_000_000)]  # the return of each is kept
Repeats = Annotated[int, Range(1, 10_000)]  # within one update
Width = Annotated[int, Range(1, 1_000_000)]
Seed = Annotated[int, Range(0, 2**32 - 1)]
Fraction = Annotated[float, Range(0, 1)]
Positive = Annotated[float, Range(0, above=True)]
NonNegative = Annotated[float, Range(0)]
Finite = Annotated[float, Range()]
Scheduled = Annotated[T, Schedule]  # Scheduled[Positive]: such a number, or the text "FIRST>LAST" of two
Epsilon = Annotated[float, Range(1e-30, 1)]  # a smaller one is a zero in float32
LogStd = Annotated[float, Range(-10, 5)]
SquashedLogStd = Annotated[float, Range(-4.9, 1.9)]  # of a `SquashedGaussianPolicy`


def checked(name: str, value: Any, hint: Any) -> Any:
    """`value` as the field `name` holds it.

    NumPy's scalars and arrays become Python's, 1e6 a whole number where one is wanted, lists tuples. Raises `UserError`
    for a value that no option of `hint` has room for.
    """
    value, wanted = plain(value), list[str]()
    for option in options_of(hint):
        if get_origin(option) is tuple and isinstance(value, Iterable) and not isinstance(value, str | Mapping):
            items = list(islice(value, MOST_ITEMS + 1))
            if len(items) > MOST_ITEMS:
                raise UserError(f"{name} has more than {MOST_ITEMS:,} values.")
            return tuple(checked(name, item, get_args(option)[0]) for item in items)
        try:
            return _convert(value, option)
        except ValueError as error:
            wanted.append(str(error))
    raise UserError(f"{name} must be {' or '.join(wanted)}, not {shown(value)}.")


def _convert(value: Any, option: Any) -> Any:
    """`value` as an `option` that is no union. Raises `ValueError` with what would be right."""
    kind = get_origin(option) or option
    if kind is Annotated or kind in (int, float):
        basic, *marks = get_args(option) if kind is Annotated else (kind,)
        read = _number_or_schedule if Schedule in marks else _number
        return read(value, basic, *(mark for mark in marks if isinstance(mark, Range)))
    if kind is Literal and value not in get_args(option):
        choices = ", ".join(map(str, get_args(option)))
        raise ValueError(f"one of {choices}" if "," in choices else choices)
    if kind is tuple:
        words = get_args(option)[0] is str
        if words and isinstance(value, str) and "," not in re.sub(r"\(.*\)", "", value):  # one alone
            return (value,)
        raise ValueError("several names, such as ('name', 'other')" if words else "several numbers, such as (64, 64)")
    if kind in WANTED and not isinstance(value, kind):
        raise ValueError(WANTED[kind])
    if kind is dict:
        try:  # what a run is trained with is what it is evaluated with when it comes back from its file
            return in_json(value)
        except (TypeError, ValueError, RecursionError):
            raise ValueError("a dictionary of what JSON can hold, with texts as keys") from None
    return value


def plain(value: Any) -> Any:
    """A value of NumPy or torch as Python's, a path as its text; anything else as it is, which `json` then refuses."""
    if hasattr(value, "tolist"):
        return value.tolist()
    return str(value) if isinstance(value, torch.device | PurePath) else value


def in_json(value: Any) -> Any:
    """A value as it comes back from JSON, with arrays and tuples as lists.

    Raises `TypeError`, `ValueError` or `RecursionError` for what JSON cannot hold, such as a key that is no text.
    """
    value = plain(value)
    if isinstance(value, list | tuple):
        return [in_json(item) for item in value]
    if not isinstance(value, Mapping):
        plainly = type(value) in (str, int, bool) or (type(value) is float and math.isfinite(value))
        return value if plainly else json.loads(json.dumps(value, allow_nan=False))
    if strange := [key for key in value if not isinstance(key, str)]:  # `json` would make texts of some
        raise TypeError(f"the key {strange[0]} is no text")
    return {str.__str__(key): in_json(item) for key, item in value.items()}


def _number(value: Any, kind: type, limits: Range = Range()) -> int | float:
    """A finite number within `limits`; 1e6 is whole."""
    name, most = ("a whole number", MOST_WHOLE) if kind is int else ("a number", MOST_REAL)
    wanted = f"{name} {limits}".strip()
    if isinstance(value, int | float) and not isinstance(value, bool):
        if most < abs(value) < math.inf and not limits.high < math.inf:
            raise ValueError(f"{wanted}, and at most {most:g}")
        if value in limits and (kind is float or isinstance(value, int) or value.is_integer()):
            return kind(value)
    raise ValueError(wanted)


def _number_or_schedule(value: Any, kind: type, limits: Range) -> int | float | Schedule:
    """A number within `limits`, or a `Schedule` from one to another; what all are to be above, it may end at."""
    ends = value.split(">") if isinstance(value, str) else ()
    try:
        if len(ends) == 2:
            first = _number(number(ends[0]), kind, limits)
            last = _number(number(ends[1]), kind, dataclasses.replace(limits, above=False))  # no update is at the end
            return Schedule(f"{first}>{last}")
        return _number(value, kind, limits)
    except ValueError as error:
        raise ValueError(f"{error}, or a schedule 'FIRST>LAST' of two such numbers") from None


@cache
def _hints_of(config: type) -> dict[str, Any]:
    return get_type_hints(config, include_extras=True)


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """The fields that every algorithm has. Checked at construction: a value out of range is named in a `UserError`."""

    differentiates: ClassVar[bool] = False
    """whether it learns by the gradient through the steps of environments"""

    env: str = "CartPole-v1"
    """environment id; `lemniscate envs` lists them"""
    backend: str | None = None
    """simulation backend (default: by the id)"""
    num_envs: NumEnvs = 16
    """number of parallel environments, N; usually 8 to 64"""
    seed: Seed = 1
    """seed of the run, from which all others are derived"""
    total_steps: Count = 1_000_000
    """steps of all environments together; the update that reaches them is the last"""
    device: str = "cpu"
    """device of networks and simulators: cpu, cuda, cuda:N, mps; auto is cuda if there is one"""
    threads: Annotated[int, Range(1, 256)] = 1
    """CPU threads; their number changes rounding"""
    shards: Annotated[int, Range(1, 4096)] = 1
    """equal parts of the environments and of minibatches, S, whose work processes share"""
    compile: Literal["auto", "on", "off"] = "auto"
    """compile the gradient steps and the policy; auto does so in long runs"""
    average_last: Fraction = 0.0
    """average the final policy over this last fraction of the run; usually 0.1"""
    checkpoint_every: Natural = 0
    """steps between checkpoints, and restarts; 0: a fifth of the run, or 3 episodes"""
    keep_checkpoints: Count = 3
    """number of newest checkpoints kept"""
    evaluate_every: Natural = 0
    """steps between evaluations; 0: none"""
    evaluate_episodes: Episodes = 20
    """episodes of each evaluation in training"""
    keep_best: bool = False
    """keep the best state as checkpoints/best"""
    video_every: Natural = 0
    """steps between recordings of an episode into videos/step-N; 0: none"""
    video_every_episodes: Natural = 0
    """training episodes between videos; 0: none"""
    warm_start: str | None = None
    """run, checkpoint or hf://user/name whose networks this run begins with"""
    freeze: tuple[str, ...] = ()
    """parameters to keep, such as policy.net.0"""
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    """arguments of the environment, as JSON: '{"dynamics": "first_principles"}'"""
    reset_options: dict[str, Any] = field(default_factory=dict)
    """options of every reset of the environment"""
    curriculum: str | None = None
    """module:function of (step, metrics) to {method: argument} of the environments"""
    wrappers: tuple[str, ...] = ()
    """module:name or module:name(key=value), the innermost first"""

    def __post_init__(self) -> None:
        hints = _hints_of(type(self))
        for name in self.names():
            object.__setattr__(self, name, checked(name, getattr(self, name), hints[name]))
        if not re.fullmatch(r"auto|cpu|mps|cuda(:(0|[1-9][0-9]*))?", self.device):
            raise UserError(
                f"device must be one of auto, cpu, cuda, cuda:N (such as cuda:1), mps, not {self.device!r}."
            )
        self._require_divisible("num_envs")
        if self.keep_best and not self.evaluate_every:
            raise UserError("keep_best needs evaluations in training: give evaluate_every, such as 10_000 steps.")
        if self.keep_best and self.evaluate_every > self.total_steps:
            raise UserError(
                f"keep_best needs evaluations in training: evaluate_every {self.evaluate_every:,} is beyond the"
                f" {self.total_steps:,} of total_steps."
            )

    def _require_divisible(self, name: str) -> None:
        """Raise `UserError` if `shards` does not divide the field `name`."""
        if getattr(self, name) % self.shards:
            raise UserError(f"shards {self.shards:,} does not divide {name} {getattr(self, name):,}.")

    @cached_property
    def schedules(self) -> dict[str, Schedule]:
        """The fields that change over the run as a `Schedule` says."""
        return {name: value for name in self.names() if isinstance(value := getattr(self, name), Schedule)}

    @property
    def all_wrappers(self) -> tuple[str, ...]:
        """The wrappers, and inside of them one that gives the reset_options, if there are any."""
        options = f"lemniscate.envs.factory:ResetOptions(options={self.reset_options!r})"
        return (options, *self.wrappers) if self.reset_options else self.wrappers

    @property
    def gradient_steps(self) -> int:
        """The number of gradient steps of the whole run."""
        raise NotImplementedError

    @property
    def is_compiled(self) -> bool:
        """Whether a run is compiled: as configured; with "auto", if it is long enough to repay the compilation.

        A loop over the steps of a piece takes many minutes to compile: networks with a memory are not, by themselves.
        """
        layers = getattr(self, "layers", None)
        repays = self.gradient_steps >= WORTH_COMPILING and not (layers and layers.remembers)
        return self.compile == "on" or (self.compile == "auto" and repays)

    def generators(self, device: torch.device) -> Generators:
        """New random generators, seeded by the run's seed."""
        return Generators(self.seed, device)

    def networks(self, spec: Spec) -> Any:
        """New networks for the spaces in `spec`, a module with a `policy`. Raises `UserError` if they do not fit."""
        raise NotImplementedError

    def make_networks(self, spec: Spec, device: torch.device) -> Any:
        """`networks` to train, on a device, with those in `freeze` frozen. Raises `UserError` if there are none."""
        networks = self.networks(spec).to(device)
        for beginning in self.freeze:
            named = dict(networks.named_parameters())
            frozen = [name for name in named if f"{name}.".startswith(f"{beginning}.")]
            if not frozen:
                raise unknown_name("parameter to freeze", beginning, named, f"there is {', '.join(named)}.")
            for name in frozen:
                named[name].requires_grad_(False)
        return networks

    def memory_bytes(self, spec: Spec) -> dict[str, int]:
        """Bytes that training takes at least, beside networks and environments, by the field that they grow with."""
        return {}

    def notices(self, spec: Spec, device: torch.device) -> list[str]:
        """Sentences that a person should read before a run of this Config starts."""
        return []

    def replace(self, **changes: object) -> Self:
        """A copy with some fields changed. Raises `UserError` for an unknown field or a value out of range."""
        for name in changes:
            if name not in self.names():
                raise unknown_field(name, self.names())
        return dataclasses.replace(self, **changes)

    @classmethod
    def names(cls) -> list[str]:
        """The names of all fields."""
        return [field.name for field in dataclasses.fields(cls)]

    def to_json(self) -> dict[str, Any]:
        """A dictionary that survives JSON. Raises `UserError` for a field that does not."""
        try:
            return json.loads(json.dumps(dataclasses.asdict(self)))
        except TypeError as error:
            raise UserError(f"A field of {type(self).__module__}.Config cannot be stored: {error}.") from None

    @classmethod
    def from_json(cls, record: dict[str, Any]) -> Self:
        """The Config that `to_json` came from. Raises `UserError` for one that another version wrote."""
        strangers = [name for name in record if name not in cls.names()]
        if strangers:
            raise UserError(f"This was written by another version of lemniscate: there is no field {strangers[0]} now.")
        return cls().replace(**record)
