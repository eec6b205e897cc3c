"""`check`: whether an environment is suitable for training, or the files of a run are whole."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from lemniscate.api.stored import TrainedRun
from lemniscate.envs import check as env_check
from lemniscate.envs import registry
from lemniscate.envs.check import Finding
from lemniscate.run import check as run_check


def check(
    what: "str | Path | TrainedRun | Callable[..., Any]",
    backend: str | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    wrappers: Sequence[str | Callable[..., Any]] = (),
) -> list[Finding]:
    """Check that an environment is suitable for training, or that the files of a run are whole.

    An environment is looked at with Gymnasium's own checker and by random play; of a run or a sweep every file is read,
    and nothing is changed.

    Args:
        what: an environment: an id, `module:Class`, a class, or a function that makes one. Or the directory of a run or
            of a sweep, or what `train` returned.
        backend: of an environment, a simulation backend; by default the first that serves it.
        env_kwargs: arguments of the environment.
        wrappers: around each single environment, the first innermost.

    Returns:
        Everything found, each a sentence with a grade; what keeps an environment from being made is the last.

    Raises:
        UserError: no such environment, backend or wrapper.
    """
    what = what.path if isinstance(what, TrainedRun) else what
    name = str(what) if isinstance(what, Path) else registry.name_of(what)
    return list(each_finding(name, backend, env_kwargs, registry.names_of(wrappers)))


def each_finding(
    what: str, backend: str | None, env_kwargs: Mapping[str, Any] | None, wrappers: Sequence[str]
) -> Iterator[Finding]:
    """The findings of `check`, one by one."""
    if run_check.is_stored(Path(what)):
        return run_check.each_finding(Path(what))
    return env_check.each_finding(what, backend, env_kwargs, wrappers)


def verdict(what: str, found: list[Finding]) -> str:
    """The conclusion from the findings, in a sentence or two."""
    return run_check.verdict(Path(what), found) if run_check.is_stored(Path(what)) else env_check.verdict(what, found)
