"""The run directory: its creation, its config, its lock, and the checkpoints in it, from which a run may begin."""

import errno
import hashlib
import json
import math
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any, Literal

from filelock import FileLock, Timeout
from torch import Tensor, nn

from lemniscate.errors import UserError, resume_line
from lemniscate.nn.policies import SAC_LOG_STD, SquashedGaussianPolicy
from lemniscate.run import checkpoint
from lemniscate.run.config import Natural, RunConfig, checked
from lemniscate.run.metrics import METRICS, damage, read_metrics
from lemniscate.run.state import TrainState
from lemniscate.spec import Spec
from lemniscate.system import files
from lemniscate.system.console import say
from lemniscate.system.files import DamagedFileError, UnreadableFileError, parsing
from lemniscate.system.world import World

CONFIG, LOCK, FINAL = "config.json", ".lock", "final.json"
BEST = "best"
"""the checkpoint with the best evaluation in training, beside those that are named by their steps"""
SWEEP = "sweep.json"
"""the file that the directory of a sweep has in the place of a `config.json`"""
TUNE = "tune.json"
"""that of a search"""
UNFINISHED = re.compile(rf"{re.escape(LOCK)}|({CONFIG}|{SWEEP}|{TUNE})\..*tmp")
"""the files that the creation of a directory leaves where it fails half-way"""
FUNCTION = ("network", "activation", "normalize_observations")
"""fields of a Config that change what networks of the same shapes compute"""


def require_absent(path: Path) -> None:
    """Raise `UserError` if a run directory exists already; one whose creation failed half-way does not count."""
    if file := files.file_in_the_way(path):
        raise UserError(f"{file} is a file, and a run is a directory: choose another --run.")
    if path == Path():
        raise UserError("A run needs a directory of its own: name one that is new, such as --run runs/first.")
    if path.exists() and (not path.is_dir() or not all(UNFINISHED.fullmatch(file.name) for file in path.iterdir())):
        raise UserError(f"{path} exists already; go on with it ({resume_line(path)}) or choose another --run.")


def require_no_search(path: Path) -> None:
    """Raise `UserError` for the directory of a search, whose trials are sweeps."""
    if (path / TUNE).exists():
        raise UserError(f"{path} is a search: name one of its trials, such as {path / 'trials' / '000'}.")


def create_directory(path: Path, name: str, record: dict[str, Any]) -> None:
    """Create a directory with the one file `name` that says what it is. Raises `UserError` if it exists already."""
    require_absent(path)
    try:
        files.make_directory(path)
        files.write_json(path / name, record)
    except OSError as error:
        raise UserError(f"{path} cannot be created: {error.strerror or error}.") from error


def require_no_file_of_a_run(path: Path) -> None:
    """Raise `UserError` for a file that lies in a run or in a checkpoint, which was meant."""
    stored = any((path.parent / name).is_file() for name in (CONFIG, checkpoint.MANIFEST))
    if stored and path.is_file() and path.suffix != ".pt":
        raise UserError(f"{path} is a file of {path.parent}: name that directory.")


def run_of(path: Path) -> Path:
    """The run of a checkpoint, whose own directory the run removes or replaces; another path as it is."""
    return path.parents[1] if path.parent.name == "checkpoints" else path


def require_no_part_of_a_run(path: Path) -> None:
    """Raise `UserError` for a checkpoint or an export too, where only a run will do."""
    require_no_file_of_a_run(path)
    if not (path / checkpoint.MANIFEST).is_file():
        return
    if run_of(path) != path:
        raise UserError(f"{path} is a checkpoint: name its run, {run_of(path)}.")
    kind = "an export" if (path / "policy.c").is_file() else "a stored policy"
    raise UserError(f"{path} is {kind}: name the run that it is of.")


_say_once = cache(say)  # a command reads a record several times


def read_record(path: Path) -> dict[str, Any]:
    """The record of a run's `config.json`: algorithm and config; if damaged, that of the newest checkpoint.

    Raises `UserError` if it is not a run.
    """
    require_no_part_of_a_run(path)
    if (path / SWEEP).exists():
        runs = sorted(file.parent for file in path.glob(f"*/{CONFIG}"))
        raise UserError(f"{path} is a sweep: name one of its runs, such as {runs[0] if runs else path / '…'}.")
    require_no_search(path)
    try:
        return files.read_json(path / CONFIG)
    except DamagedFileError as error:
        found = _newest(path, planned_only=False)
        if found is None:
            reason = str(error) if (path / CONFIG).is_file() else f"it holds no {CONFIG} that can be read."
            reason = "it is a file." if path.is_file() else reason if path.exists() else "it does not exist."
            raise UserError(f"{path} is not a run directory: {reason}") from None
        _say_once(f"{error} Taking the config in {found.path}.")
        return found.record


def read_config(path: Path) -> tuple[str, dict[str, Any]]:
    """The algorithm's name and the config of a run directory. Raises `UserError` if it is not a run."""
    record = read_record(path)
    with parsing(path / CONFIG):
        return str(record["algorithm"]), dict(record["config"])


def is_finished(path: Path) -> bool:
    """Whether a run has taken all its steps, and its last checkpoint is whole, and planned: its last update was too."""
    _, config = read_config(path)
    steps = checkpoint.list_steps(path / "checkpoints")
    if steps[-1:] < [config["total_steps"]]:
        return False
    newest = path / "checkpoints" / f"step-{steps[-1]}"
    if not checkpoint.is_whole(newest):
        return False
    with parsing(newest):
        return bool(files.read_json(newest / checkpoint.STATE)["record"].get("planned"))


def lost(path: Path) -> str | None:
    """A sentence where a run has taken all its steps, and every checkpoint is gone; else None."""
    _, config = read_config(path)
    if checkpoint.list_steps(path / "checkpoints") or not (lines := read_metrics(path)):
        return None
    last = lines[-1]["step"]
    gone = f"{path} came to step {last:,}, its end; its checkpoints are gone, so that resume begins a new {METRICS}."
    return gone if last >= config["total_steps"] else None


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """The directory of a run or a set of runs, for this process alone. Raises `UserError` if another trains there."""
    try:
        with FileLock(path / LOCK, timeout=0):
            yield
    except Timeout:
        raise UserError(f"{path} is being trained by another process.") from None


def extend(path: Path, total_steps: int) -> None:
    """Let a run go on to `total_steps`; its final scores are no longer final. Raises `UserError` if it stands there."""
    newest = max(checkpoint.list_steps(path / "checkpoints"), default=0)
    if total_steps <= newest:
        raise UserError(f"{path} stands at step {newest:,}: total_steps must be above that, not {total_steps:,}.")
    if gone := lost(path):
        raise UserError(f"{gone.partition(', so')[0]}: nothing is left to go on from to {total_steps:,} steps.")
    try:
        with locked(path):
            record = read_record(path)
            with parsing(path / CONFIG):
                files.write_json(path / CONFIG, {**record, "config": {**record["config"], "total_steps": total_steps}})
            files.remove(path / FINAL)
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror or error}.") from error


def find_checkpoint(path: Path, which: str | int | None = None) -> checkpoint.Checkpoint:
    """A checkpoint, named by its own directory or by that of its run; of a run "best", a step, or the newest whole one.

    Raises:
        UserError: neither a run nor a checkpoint; a run without a whole one, or that one; a damaged checkpoint.
    """
    if which is None and (path / checkpoint.MANIFEST).exists():
        return checkpoint.read(path)
    read_config(path)
    if which is not None:
        which = checked("checkpoint", which, Natural | Literal["best"])
        chosen = path / "checkpoints" / (BEST if which == BEST else f"step-{which}")
        if not chosen.is_dir():
            there = ", ".join(map(str, checkpoint.list_steps(path / "checkpoints"))) or "none"
            raise UserError(f"{path} has no checkpoint {which}; those at steps: {there}; best is kept with keep_best.")
        with suppress(DamagedFileError) if which == BEST else nullcontext():
            return checkpoint.read(chosen)
        return checkpoint.read(chosen)  # the process that trains may have replaced it meanwhile
    found = _newest(path, planned_only=False)
    if found is None:
        raise UserError(f"{path} has no checkpoint that can be read yet.")
    return found


def _newest(path: Path, planned_only: bool) -> checkpoint.Checkpoint | None:
    """The newest whole checkpoint. One that a running process deletes meanwhile has been followed by another."""
    steps = checkpoint.list_steps(path / "checkpoints")
    for step in reversed(steps):
        folder = path / "checkpoints" / f"step-{step}"
        try:
            found = checkpoint.read(folder)
            if found.record.get("planned") or not planned_only:
                return found
        except DamagedFileError as error:
            if planned_only and isinstance(error, UnreadableFileError):  # a run would remove what it passes over
                remedy = f"resume once it can be read, or remove {folder}"
                raise UserError(f"{error} Nothing is changed: {remedy}.") from None
            if folder.exists():
                say(f"{error} Taking the one before.")
    return None if steps == checkpoint.list_steps(path / "checkpoints") else _newest(path, planned_only)


def load_networks(networks: nn.Module, config: RunConfig, spec: Spec, locate: Callable[[str], Path] = Path) -> str:
    """Load the networks of the run or checkpoint `config.warm_start` into `networks`, as much as fits.

    The tensors of equal names and shapes are taken over, the others stay new: another head, other observations, other
    critics. A normalizer is taken over whole or not at all. `locate` finds the directory that `config.warm_start`
    names: a run knows no address but a path.

    Returns:
        A sentence on what was loaded.

    Raises:
        UserError: no such checkpoint; networks of another function; no layer of the policy fits.
    """
    source = find_checkpoint(locate(str(config.warm_start)))
    name = f"{config.warm_start} at step {source.numbers['step']:,}"
    their_spec = checkpoint.spec_from_json(source.record["spec"])
    elsewhere = "" if their_spec.fits(spec) else f"; it was trained on {their_spec.env_id}, with other spaces"
    theirs, ours = source.record["config"], config.to_json()
    shared = [field for field in (*FUNCTION, "hidden") if field in theirs and field in ours]
    differing = [field for field in shared if theirs[field] != ours[field]]
    settings = [f"{field} is {theirs[field]!r} there and {ours[field]!r} here" for field in differing]
    if set(differing) & set(FUNCTION):
        raise UserError(f"warm_start: {name} does not fit: {settings[0]}.")
    found, own = source.tensors_of("networks"), networks.state_dict()
    comparable = theirs.get("value_range") == ours.get("value_range")  # else a Q of these shapes says another
    fits = {
        key: tensor
        for key, tensor in found.items()
        if key in own and tensor.shape == own[key].shape and (comparable or key.startswith("policy."))
    }
    resized = [key.removesuffix("mean") + "count" for key in own if key.endswith(".mean") and key not in fits]
    fits = {key: tensor for key, tensor in fits.items() if key not in resized}
    if not any(key.startswith("policy.") and tensor.ndim > 1 for key, tensor in fits.items()):
        reason = [*settings, difference(found, own)][0]
        raise UserError(f"warm_start: no layer of the policy of {name} fits: {reason}{elsewhere}.")
    networks.load_state_dict(fits, strict=False)
    named = (*networks.named_parameters(), *networks.named_buffers())  # a normalizer that networks share is one
    mine = [key for key, _ in named if key in own]
    new = [key for key in mine if key not in fits]
    if kept := [key for key in new if any(f"{key}.".startswith(f"{frozen}.") for frozen in config.freeze)]:
        raise UserError(
            f"freeze keeps {kept[0]}, which warm_start cannot take from {name}{elsewhere}: it would stay as drawn."
        )
    if isinstance(networks.policy, SquashedGaussianPolicy) and not any(key.startswith("policy.") for key in new):
        there, here = (fields.get("initial_log_std", SAC_LOG_STD) for fields in (theirs, ours))
        if there != here:  # a constant of the network, and no parameter
            elsewhere += f"; initial_log_std is {there} there and {here} here, so σ is another"
    if not new:
        return f"Warm start: all networks of {name}{elsewhere}."
    some = ", ".join(new[:3]) + ", …" * (len(new) > 3)
    return f"Warm start: {len(mine) - len(new):,} tensors of {name}; {len(new):,} begin anew, {some}{elsewhere}."


def difference(theirs: dict[str, Tensor], mine: dict[str, Tensor]) -> str:
    """The first parameter that is missing on one side or has another shape; empty if there is none."""
    for name in [*mine, *theirs]:
        there, here = (list(side[name].shape) if name in side else "missing" for side in (theirs, mine))
        if there != here:
            return f"{name} is {there} there and {here} here"
    return ""


def _files_of(kwargs: Mapping[str, Any]) -> dict[str, dict[str, str]]:
    """The `files` that arguments of an environment name, such as a track or a model, by the sha256 of their content."""
    named = {}
    for value in kwargs.values():
        with suppress(OSError, ValueError):  # what is no name of a file
            if isinstance(value, str) and files.at_home(value).is_file():
                with files.at_home(value).open("rb") as file:
                    named[value] = hashlib.file_digest(file, "sha256").hexdigest()
    return {"files": named} if named else {}


class Saver:
    """Saves the state of a run into its directory, and restores it from there. One process at a time may do so."""

    def __init__(self, path: Path, algorithm: str, config: RunConfig, spec: Spec, world: World) -> None:
        self.path, self._world = path, world
        there = (path / CONFIG).exists() or bool(checkpoint.list_steps(path / "checkpoints"))
        self.exists: bool = world.from_first(there)
        """whether the run directory was there before this process"""
        self._config, self._checkpoints = config, path / "checkpoints"
        self._identity = {"algorithm": algorithm, "config": config.to_json()}
        self._record = {**self._identity, "spec": checkpoint.spec_to_json(spec), **_files_of(config.env_kwargs)}
        self._held = ExitStack()
        self.last_planned = 0
        """the step that `resume` would go on from"""
        self.failure: OSError | None = None
        """why the last checkpoint could not be written, if it could not"""
        self._best = -math.inf
        """the mean return of the evaluation that the checkpoint `best` was kept for"""
        self.logged = 0
        """the step of the last line of metrics"""
        self.calls = dict[str, Any]()
        """the latest calls of a curriculum, as methods and arguments; part of every checkpoint"""

    def open(self) -> None:
        """Lock the directory, then create it if it is new. Raises `UserError` if another process trains in it."""
        if not self._world.is_first:
            return
        try:
            files.make_directory(self.path)
            self._held.enter_context(locked(self.path))
        except OSError as error:
            raise UserError(f"{self.path} cannot be written: {error.strerror or error}.") from error
        if not self.exists:
            create_directory(self.path, CONFIG, self._identity)
        elif not files.is_whole(self.path / CONFIG):
            files.write_json(self.path / CONFIG, self._identity)

    def _tell_changed_files(self, found: checkpoint.Checkpoint) -> None:
        """Say which files that the environment is made of are not as they were at a checkpoint."""
        now, step = self._record.get("files", {}), found.numbers["step"]
        for file, content in found.record.get("files", {}).items():
            if self._world.is_first and now.get(file, content) != content:
                say(f"{file} has changed since step {step:,}: the environment is another one from here on.")

    def restore(self, state: TrainState) -> bool:
        """Restore the newest whole planned checkpoint, if there is one, and delete those after it.

        Checkpoints beyond the one restored are damaged or unplanned; the run will write them again.
        """
        found = self._world.from_first(_newest(self.path, planned_only=True) if self._world.is_first else None)
        if found:
            before, now = found.record["spec"], self._record["spec"]
            for what in ("observation_parts", "action"):
                if json.dumps(before[what]) != json.dumps(now[what]):
                    space = f"another {what.removesuffix('_parts')} space than {now['env_id']} has now"
                    raise UserError(f"{self.path} was trained with {space}.")
            self._tell_changed_files(found)
            found.restore(state)
            self.last_planned = state.step
            self.calls = dict(found.record.get("calls", {}))
        if not self._world.is_first:
            return found is not None
        steps = checkpoint.list_steps(self._checkpoints)
        if found:
            self._keep_metrics(damage(self.path, found.record.get("logged", 0)))
        elif steps:
            self._keep_metrics(f"{self.path} has no planned checkpoint to go on from; it begins again at step 0.")
        else:
            self._keep_metrics(lost(self.path))
        for step in steps:
            if step > state.step:
                files.remove(self._checkpoints / f"step-{step}")
        self._restore_best(state.step)
        return found is not None

    def _restore_best(self, step: int) -> None:
        """Know the best checkpoint again; remove one that is damaged or later: the run comes there again."""
        best = self._checkpoints / BEST
        before = best.with_name(f"{BEST}.old.tmp")
        if before.is_dir() and not best.exists():  # the process was killed while it was replaced
            before.rename(best)
        if checkpoint.is_whole(best):
            found = files.read_json(best / checkpoint.STATE)
            with parsing(best):
                if found["numbers"]["step"] <= step:
                    self._best = float(found["record"]["return"])
                    return
        files.remove(best)

    def _keep_metrics(self, sentence: str | None) -> None:
        """Copy the metrics, which are then written again, where a sentence says what is wrong with them."""
        if sentence:
            file = self.path / METRICS
            names = (file.with_name(f"metrics.damaged-{n}.jsonl") for n in count(1))
            kept = next(name for name in names if not name.exists())
            if file.is_file() and not file.is_symlink():
                files.replace_file(kept, file.read_bytes())
                sentence += f" It is kept as {kept}."
            say(sentence)

    def save(self, state: TrainState, planned: bool) -> None:
        """Write a checkpoint, and have the disk store the metrics up to it. What fails costs only this checkpoint.

        Raises `NonFiniteError` where the state has a NaN or an infinity; the checkpoints before are untouched.
        """
        # An unplanned checkpoint is kept beside the planned ones, never in the place of one: a run goes on only from a
        # planned one, at which its environments restart.
        keep = self._config.keep_checkpoints + (not planned)
        self.failure = None
        if not self._world.is_first:
            return
        try:
            if not self.path.is_dir():  # else it would begin anew beside what was moved
                raise FileNotFoundError(errno.ENOENT, "the run directory is gone", str(self.path))
            if (self.path / METRICS).exists():
                files.sync(self.path / METRICS)  # before the checkpoint, which says up to which step they are whole
            record = {**self._record, "planned": planned, "logged": self.logged, "calls": self.calls}
            checkpoint.write(self._checkpoints, state.saved(), state.step, record, keep)
            self.last_planned = state.step if planned else self.last_planned
        except OSError as error:
            self.failure = error
            say(f"The checkpoint at step {state.step:,} could not be written: {error}.")

    def save_if_best(self, state: TrainState, mean_return: float) -> None:
        """Keep the state as the checkpoint `best` where no evaluation before had so high a mean return."""
        if mean_return <= self._best:
            return
        record = {**self._record, "planned": False, "logged": self.logged, "return": mean_return}
        try:
            checkpoint.write_fields(self._checkpoints / BEST, state.saved(), record)
            self._best = mean_return
        except OSError as error:
            say(f"The best checkpoint, at step {state.step:,}, could not be written: {error}.")

    def close(self) -> None:
        """Unlock the directory."""
        self._held.close()
