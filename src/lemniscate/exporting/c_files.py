"""`policy.c` and `policy.h`: the operations of a policy in their frame."""

from collections.abc import Mapping
from pathlib import Path
from string import Template

import numpy as np

from lemniscate.exporting.c_code import Body, body_of, braces
from lemniscate.exporting.deployed import safe_action
from lemniscate.exporting.operations import Program
from lemniscate.exporting.provenance import version
from lemniscate.spec import Action, Box, Discrete

TEMPLATES = Path(__file__).parent / "templates"


def fill(template: str, values: Mapping[str, object]) -> str:
    """The text of a template with its values."""
    return Template((TEMPLATES / template).read_text()).substitute(values)


def c_files(
    program: Program,
    action: Action,
    observations: np.ndarray,
    actions: np.ndarray,
    *,
    title: str,
    origin: str,
    period: float | None = None,
) -> dict[str, str]:
    """The texts of `policy.c` and `policy.h`.

    Args:
        program: the policy.
        action: its kind of actions.
        observations: of the self-test, [S, O].
        actions: the true ones, [S, A].
        title: what it is a policy for.
        origin: where the observations are from.
        period: seconds between two actions, where known.
    """
    body = body_of(program)
    places, scratch = body.places()
    shared = {"title": comment(title), "version": version()}
    header = {
        "observations": program.obs.size,
        "actions": program.action.size,
        "tests": len(observations),
        "bound": f"{self_test_bound(program, actions):.0e}F",
        "period": ""
        if period is None
        else f"#define POLICY_PERIOD {np.float32(period)!s}F /* seconds between two actions */\n",
        "safe": safe_sentence(action),
        "origin": comment(origin),
    }
    source = {
        "constants": "\n\n".join(body.constants),
        "safe": braces(safe_action(action)),
        "scratch": max(scratch, 1),
        "functions": "".join(f"{text}\n" for text in functions(body.functions)),
        "arrays": "\n".join(f"    float *const {name} = scratch + {places[name]};" for name in body.sizes),
        "masked": _masked(action),
        "statements": _statements(body),
        "test_observations": _rows(observations),
        "test_actions": _rows(actions),
    }
    return {"policy.c": fill("policy.c", {**shared, **source}), "policy.h": fill("policy.h", {**shared, **header})}


def comment(text: str) -> str:
    """Text, of a run's record perhaps, that does not end the comment that it stands in."""
    return " ".join(text.replace("*/", "* /").replace("\\", "/").split())


def self_test_bound(program: Program, actions: np.ndarray) -> float:
    """The error bound of the self-test: ten times the effect of another order of sums, by the size of the actions."""
    largest = float(np.abs(actions).max())
    return 0.05 * max(1.0, largest) if program.is_rounded else 1e-5 * max(10.0, largest)


def period_line(period: float | None) -> str:
    """The definition of the control period, where it is known."""
    return f"#define POLICY_PERIOD {np.float32(period)!s}F /* seconds between two actions */\n" if period else ""


def safe_sentence(action: Action) -> str:
    """The safe action in words."""
    if isinstance(action, Box):
        return "the middle of each coordinate's range (1 from its bound where it has only one, 0 where it has none)"
    if isinstance(action, Discrete) and action.masked:
        return "the first that the mask permits"
    return "the first choice of each"


def functions(names: set[str]) -> list[str]:
    """The texts of C functions and of those that they call, in the order of their file."""
    blocks = _function_blocks()
    wanted, todo = set[str](), list(names)
    while todo:
        name = todo.pop()
        wanted.add(name)
        todo += [other for other in blocks[name][0] if other not in wanted]
    return [text for name, (_, text) in blocks.items() if name in wanted]


def _function_blocks() -> dict[str, tuple[list[str], str]]:
    """(names that it calls, text) of each function in functions.c, by its name, from the line `// name: names`."""
    found: dict[str, tuple[list[str], str]] = {}
    for block in f"\n{(TEMPLATES / 'functions.c').read_text()}".split("\n// ")[1:]:
        head, _, text = block.partition("\n")
        name, _, called = head.partition(":")
        found[name] = (called.split(), f"{text.strip()}\n")
    return found


def _statements(body: Body) -> str:
    return "\n".join(f"    {statement.text}" for statement in body.statements)


def _masked(action: Action) -> str:
    """The lines of the safe action that obey a mask; empty if there is no mask."""
    if not (isinstance(action, Discrete) and action.masked):
        return ""
    return (
        f"            for (i = 0; i < {action.n}; ++i) {{\n"
        f"                const float permitted = obs[POLICY_OBSERVATIONS - {action.n} + i];\n"
        "                if (is_finite(permitted) && permitted != 0.0F) {\n"
        f"                    action[0] = (float)(i + {action.start});\n"
        "                    break;\n"
        "                }\n"
        "            }\n"
    )


def _rows(rows: np.ndarray) -> str:
    return "\n".join(f"    {braces(row)}," for row in rows.astype(np.float32))
