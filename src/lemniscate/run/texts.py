"""The values of fields, as they are typed."""

import json
from contextlib import suppress
from types import NoneType
from typing import Annotated, Any, get_args, get_origin

from lemniscate.errors import UserError
from lemniscate.run.config import flag, options_of


def read(name: str, hint: Any, text: Any) -> Any:
    """The value that `text` (of a tuple, several texts) stands for; what cannot be read as `hint` says stays as it is.

    The Config then says what would be right. Raises `UserError` for a dictionary that is not JSON.
    """
    options = options_of(hint)
    if isinstance(text, list):
        item = next(get_args(option)[0] for option in options if get_origin(option) is tuple)
        parts = [part for word in text for part in _split(word)]
        return () if parts == ["none"] else tuple(read(name, item, part) for part in parts)
    if NoneType in options and text == "none":
        return None
    if any(is_dict(option) for option in options):
        return read_json(flag(name), text)
    return number(text) if any(map(number_type, options)) else text


def number(text: Any) -> Any:
    """The number that `text` stands for, 1e6 and 1_000 too; what is none stays, for the sentence on it."""
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text)
    return text


def read_json(option: str, text: str) -> dict[str, Any]:
    """The dictionary that `text` is in JSON. Raises `UserError` for anything else."""
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        value = None
    if not isinstance(value, dict):
        raise UserError(f"""{option} must be a JSON object, such as '{{"gravity": -5}}', not {text}""")
    return value


def number_type(option: Any) -> type | None:
    """Int or float, if it is one of them, with a range or without."""
    kind = get_args(option)[0] if get_origin(option) is Annotated else option
    return kind if kind in (int, float) else None


def is_dict(option: Any) -> bool:
    """Whether it is a dictionary."""
    return option is dict or get_origin(option) is dict


def _split(word: str) -> list[str]:
    """The parts between commas that are in no bracket: "a:b(x=1,y=2),c:d" is two."""
    parts, depth = [""], 0
    for character in word:
        depth += (character in "([{") - (character in ")]}")
        if character == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += character
    return [part.strip() for part in parts if part.strip()]
