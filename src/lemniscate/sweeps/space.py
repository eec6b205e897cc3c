"""The settings that a search may choose, and their ranges.

    learning_rate=log:1e-4:1e-2, gamma=.9:.999, hidden=64 64|256 256

is a range whose orders of magnitude are equally likely, a range whose numbers are, and a choice of two.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, get_type_hints

from lemniscate.errors import UserError, shown
from lemniscate.run.config import RunConfig
from lemniscate.run.fields import kinds_of, read, unknown_field

NOT_SEARCHED = ("env", "backend", "seed", "total_steps", "checkpoint_every", "evaluate_every", "evaluate_episodes")
"""fields that are the same in all trials, or set by the search itself"""


@dataclass(frozen=True)
class Interval:
    """The numbers from `low` to `high`; with `log` uniform in their logarithm, with `whole` whole ones."""

    low: float
    high: float
    log: bool
    whole: bool

    def draw(self, trial: Any, name: str) -> Any:
        """The number that Optuna suggests; of one with a fraction, six digits, which a preset can say."""
        if self.whole:
            return trial.suggest_int(name, self.low, self.high, log=self.log)
        value = float(f"{trial.suggest_float(name, self.low, self.high, log=self.log):.6g}")
        return min(max(value, self.low), self.high)

    def key_of(self, value: Any) -> Any:
        """The suggestion of Optuna that stands for `value`; None if it is outside."""
        return value if isinstance(value, int | float) and self.low <= value <= self.high else None


@dataclass(frozen=True)
class Choice:
    """One of several values, as they were typed."""

    values: Mapping[str, Any]

    def draw(self, trial: Any, name: str) -> Any:
        """The value that Optuna suggests."""
        return self.values[trial.suggest_categorical(name, list(self.values))]

    def key_of(self, value: Any) -> Any:
        """The suggestion of Optuna that stands for `value`; None if it is none of the choices."""
        return next((key for key, choice in self.values.items() if choice == value), None)


Space = dict[str, Interval | Choice]


def read_texts(search: object) -> dict[str, str]:
    """The text of each range by its field, in "learning_rate=log:1e-4:1e-2, gamma=.9:.999" or a dictionary of them."""
    if isinstance(search, Mapping):
        pairs = [(str(name), str(text)) for name, text in search.items()]
    elif isinstance(search, str):
        pairs = [_pair(field) for field in re.split(r",\s*(?=[\w-]+\s*=)", search.strip(" ,")) if field]
    else:
        raise UserError(f"search must be a text such as 'gamma=.9:.999', or a dictionary, not {shown(search)}.")
    if not pairs:
        raise UserError("Search what? Name fields with their ranges, such as learning_rate=log:1e-4:1e-2.")
    return {name.strip().lstrip("-").replace("-", "_"): text.strip() for name, text in pairs}


def read_space(texts: Mapping[str, str], config: RunConfig) -> Space:
    """The ranges that the texts stand for.

    Raises:
        UserError: a field that the Config does not have or a search cannot change, or a range that it has no room for.
    """
    hints, space = get_type_hints(type(config), include_extras=True), Space()
    for name, text in texts.items():
        if name not in hints:
            raise unknown_field(name, config.names())
        if name in NOT_SEARCHED:
            raise UserError(f"{name} is the same in all trials: give it as a field, not in the search.")
        space[name] = _range(name, text, hints[name], config)
    return space


def draw(space: Space, trial: Any) -> dict[str, Any]:
    """The fields of a new trial, by name."""
    return {name: values.draw(trial, name) for name, values in space.items()}


def _pair(field: str) -> tuple[str, str]:
    name, equals, text = field.partition("=")
    if not (name.strip() and equals and text.strip()):
        raise UserError(
            f"A search is written as field=low:high, field=log:low:high or field=a|b, not {field.strip()!r}."
        )
    return name, text


def _range(name: str, text: str, hint: Any, config: RunConfig) -> Interval | Choice:
    """The range that a text stands for; every end of it is a value that the Config has room for."""
    ends = re.fullmatch(r"(log:)?([^:|]+):([^:|]+)", text)
    if not ends:
        values = {part.strip(): _read(name, hint, part) for part in text.split("|")}
        checked = {key: getattr(config.replace(**{name: value}), name) for key, value in values.items()}
        if len(checked) < 2:
            raise UserError(f"{name}={text} is no range: write {name}=low:high, {name}=log:low:high or {name}=a|b.")
        return Choice(checked)
    low, high = (getattr(config.replace(**{name: _read(name, hint, end)}), name) for end in ends.groups()[1:])
    log = ends[1] is not None
    if not all(isinstance(end, int | float) and not isinstance(end, bool) for end in (low, high)):
        raise UserError(f"{name} is no number: give its values as {name}=a|b.")
    if not low < high or (log and low <= 0):
        above = " above 0" if log else ""
        raise UserError(f"{name}={text} is no range: its first number must be{above} below its second one.")
    return Interval(low, high, log, isinstance(low, int) and isinstance(high, int))


def _read(name: str, hint: Any, text: str) -> Any:
    kinds, text = kinds_of(hint), text.strip()
    if bool in kinds:
        return {"on": True, "off": False}.get(text, text)
    return read(name, hint, text.split() if tuple in kinds else text)
