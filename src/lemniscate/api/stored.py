"""Stored runs and policies: their directories, `load` and `save`."""

import sys
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

from lemniscate import algos
from lemniscate.api.policy import TrainedPolicy
from lemniscate.errors import UserError, prefix_errors, shown
from lemniscate.hub import repository as hub
from lemniscate.hub.trust import is_signed, own_code, require_trusted, signed
from lemniscate.run import checkpoint
from lemniscate.run.directory import find_checkpoint
from lemniscate.run.warm_start import difference
from lemniscate.system.files import parsing


@dataclass(frozen=True)
class TrainedRun:
    """The result of `train` and `resume`: the run directory, the final policy, the seconds of the training loop."""

    path: Path
    policy: TrainedPolicy
    seconds: float


Trained = str | Path | TrainedRun | TrainedPolicy
"""what has a policy: the path of a run or a checkpoint, or an address on the Hub; what `train` returned; the policy"""


def path_of(run: object) -> Path:
    """The directory of a run: of its path, of what `train` returned, or of a policy from `train` or `load`.

    Raises:
        UserError: anything else; a policy on the Hub.
    """
    path = getattr(run, "path", run)
    if not isinstance(path, str | PathLike):
        raise UserError(f"A run is a directory, such as 'runs/lander', or what train returned, not {shown(run)}.")
    if Path(path).parts[:1] == (hub.SCHEME,):
        address = hub.read_address(path)
        raise UserError(f"{address} is on the Hub, and no run directory: it can be loaded, evaluated and watched.")
    return Path(path)


def load(run: Trained, *, trust: bool = False) -> TrainedPolicy:
    """The policy of a run (its newest whole checkpoint), of one checkpoint or on the Hub. No file is executed.

    What `train` returned has its policy already, and a policy is returned as it is.

    Args:
        run: its directory or a checkpoint's; `hf://user/name` or `hf://user/name@revision`, which is downloaded; what
            `train` returned; a policy.
        trust: import the code that the run names as `module:name` also if the run is not of this user and machine.

    Raises:
        UserError: neither a run nor a checkpoint, or a run without a whole checkpoint; a damaged checkpoint; a run from
            elsewhere that names code of its own, without `trust`; networks of the user's own that have other parameters
            now; an address without a policy, a Hub that refuses or cannot be reached.
    """
    if isinstance(run, TrainedRun | TrainedPolicy):
        return run.policy if isinstance(run, TrainedRun) else run
    if not hub.is_address(run):
        return _read(path_of(run), trust)
    address = hub.read_address(run)
    path = hub.download(address)
    with prefix_errors(str(address)):
        return _read(path, trust)


def _read(path: Path, trust: bool) -> TrainedPolicy:
    """The policy of a run or a checkpoint; raises as `load`."""
    found = find_checkpoint(path)
    with parsing(found.path):
        require_trusted(path, own_code_of(found.record), trusted=trust or is_signed(found.record))
        name, fields, step = found.record["algorithm"], found.record["config"], found.numbers["step"]
        spec = checkpoint.spec_from_json(found.record["spec"])
    config = algos.find(name).Config.from_json(fields)
    with nullcontext() if own_code_of(found.record) else parsing(found.path):  # what one's own code raises is its own
        networks = config.networks(spec)
    tensors = found.tensors_of("networks")
    if differs := difference(tensors, networks.state_dict()):
        raise UserError(f"{path} does not fit its networks: {differs}.")
    networks.load_state_dict(tensors)
    return TrainedPolicy(networks, spec, config, step, path)


def own_code_of(record: Mapping[str, Any]) -> list[str]:
    """The names of the code in a run's record that is not lemniscate's: its algorithm, environment, networks."""
    name = record["algorithm"]
    return [*([] if name in algos.ALGORITHMS else [str(name)]), *own_code(record["config"])]


def save(policy: Any, path: str | Path) -> Path:
    """Store a policy for `load`: weights, normalizer, Config and Spec, as a checkpoint without pickle.

    Args:
        policy: from `load`, or what `train` returned. It may begin another run (`warm_start=path`), but not resume
            its own: a run's checkpoints also hold optimizers and random generators.
        path: a new directory, or a policy stored before, which is replaced.

    Raises:
        UserError: something else is at `path`, or it cannot be written.
    """
    path, policy = path_of(path), getattr(policy, "policy", policy)
    if not isinstance(policy, TrainedPolicy):
        raise UserError(f"What can be stored is a policy, from load or train, not a {type(policy).__name__}.")
    if path.exists() and not _is_stored(path):
        raise UserError(f"{path} exists already, and is not a stored policy; choose another path.")
    try:
        _write(policy, path, signed(_identity(policy)))
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error}.") from error
    return path


def write_unsigned(policy: TrainedPolicy, path: Path) -> None:
    """Store a policy for others, without a signature: it would vouch for any run that repeats it. Raises `OSError`."""
    _write(policy, path, _identity(policy))


def _write(policy: TrainedPolicy, path: Path, identity: Mapping[str, Any]) -> None:
    record = {**identity, "spec": checkpoint.spec_to_json(policy.spec), "planned": False, "stored": True}
    checkpoint.write_fields(path, {"networks": policy.networks, "step": policy.step}, record)


def _identity(policy: TrainedPolicy) -> dict[str, Any]:
    """The signed part of a policy."""
    return {"algorithm": algorithm_of(policy), "config": policy.config.to_json()}


def algorithm_of(policy: TrainedPolicy) -> str:
    """The name of the algorithm that trained a policy."""
    return algos.name_of(sys.modules[type(policy.config).__module__])


def _is_stored(path: Path) -> bool:
    """Whether `save` has written what is at `path`: a checkpoint of a run is not to be replaced."""
    try:
        return bool(checkpoint.read(path).record.get("stored"))
    except UserError:
        return False
