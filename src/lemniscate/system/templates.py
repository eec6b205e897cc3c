"""Texts from templates of Jinja's: pages, cards, C."""

from collections.abc import Callable
from pathlib import Path
from typing import Any


def filled(template: Path, filters: dict[str, Callable[..., Any]], **context: Any) -> str:
    """The text of a template; what is put into HTML is escaped, into other texts not.

    Args:
        template: its file, beside those that it includes.
        filters: functions that it calls by these names.
        context: the values that it names.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined  # a training without a report needs none

    templates = Environment(
        loader=FileSystemLoader(template.parent),
        autoescape=".html" in template.name,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    templates.filters |= filters
    return templates.get_template(template.name).render(context)
