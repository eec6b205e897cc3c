"""How a run is trained besides its Config: loggers, callbacks, and the processes that share the work."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from lemniscate.api.callbacks import Callback
from lemniscate.errors import UserError, is_installed, missing_extra, shown, unknown_name
from lemniscate.run.config import RunConfig
from lemniscate.run.loggers import TRACKERS, JsonLines, LoggerClass, TensorBoard
from lemniscate.system import named

if TYPE_CHECKING:
    from lemniscate.cluster.connection import Cluster


@dataclass(frozen=True)
class RunOptions:
    """The arguments of `train` and `resume` that are not saved with the run, which describes them; made at the door."""

    track: str | LoggerClass | None = None
    callbacks: Callback | str | Sequence[Callback | str] = ()
    report: bool = False
    progress: bool = True
    processes: int = 1
    cluster: str | None = None
    workers: int | None = None
    storage: str | None = None

    def find_cluster(self) -> "Cluster | None":
        """The cluster that is named, if one is. Raises `UserError` where there is none, or no Ray."""
        if self.cluster is None and self.workers is None and self.storage is None:
            return None
        from lemniscate.cluster.connection import find_cluster

        return find_cluster(self.cluster, self.workers, self.storage)

    @property
    def reports(self) -> bool:
        """Whether the final policy is evaluated and drawn: a tracker gets the pictures."""
        return self.report or self.track is not None

    def loggers(self) -> tuple[LoggerClass, ...]:
        """The local loggers, and the tracker. Raises `UserError` if it does not exist or is not installed."""
        track = self.track
        if track is None:
            return JsonLines, TensorBoard
        if isinstance(track, str) and ":" not in track:
            if track not in TRACKERS:
                raise unknown_name("tracker", track, TRACKERS)
            extra, track = TRACKERS[track]
            if not is_installed(extra):
                raise missing_extra(extra, extra)
        if not (isinstance(track, str) or callable(track)):
            raise UserError(f"track must be a logger's name or class, not {shown(track)}.")
        return JsonLines, TensorBoard, named.find(track) if isinstance(track, str) else track

    def functions(self) -> list[Callback]:
        """The callbacks themselves. Raises `UserError` for one that cannot be found or called."""
        functions = [_by_name(one) if isinstance(one, str) else one for one in self._several()]
        for function in functions:
            if not named.takes(function, 3):
                raise UserError(f"A callback must be a function of (step, metrics, policy), not {shown(function)}.")
        return functions

    def names(self) -> list[str]:
        """The names of the callbacks. Raises `UserError` where another process could not import one, or the tracker."""
        names = list(self._several())
        _require_importable(self.track or "", *names)
        return names

    def words(self) -> list[str]:
        """The options of `lemniscate resume` that say the same to another process. Raises as `names`."""
        names = self.names()
        words = [*(["--track", str(self.track)] if self.track else []), *(["--callbacks", *names] if names else [])]
        return words + ["--report"] * self.report + ["--quiet"] * (not self.progress)

    def _several(self) -> Sequence[Any]:
        if isinstance(self.callbacks, list | tuple):
            return self.callbacks
        return [self.callbacks] if self.callbacks else []


def require_importable(config: RunConfig) -> None:
    """Raise `UserError` for an object that a Config names and that another process could not import."""
    _require_importable(config.env, *config.wrappers, getattr(config, "network", ""))


def _require_importable(*names: Any) -> None:
    for name in names:
        if not isinstance(name, str) or "<" in name or name.startswith("__main__:"):
            raise UserError(f"Each process has to import it: put {shown(name)} into a module, and name it.")


def _by_name(name: str) -> Any:
    """The function `module:function`, or an object of `module:Class(key=value, …)`. Raises `UserError`."""
    found = named.find_callable(name)
    made = found.func if isinstance(found, partial) else found
    if not isinstance(made, type):
        return found
    try:
        return found()
    except TypeError as error:
        raise UserError(f"{name} cannot be made; give its arguments as module:Class(key=value, …): {error}.") from error
