"""The exported C in the place of the policy."""

from pathlib import Path

from torch import Tensor

from lemniscate.api.policy import TrainedPolicy
from lemniscate.envs.probe import Act
from lemniscate.errors import UserError
from lemniscate.exporting.actions import for_policy
from lemniscate.exporting.export import MANIFEST
from lemniscate.exporting.host import HostPolicy, host_compiler
from lemniscate.system.files import DamagedFileError, read_json


def compiled_policy(policy: TrainedPolicy, run: Path) -> Act:
    """The C of a run's `export`, compiled on this machine.

    Raises:
        UserError: no export, a damaged one, or one of another step; no compiler, or one that refuses.
    """
    compiler, folder = host_compiler(), run / "export"
    if compiler is None:
        raise UserError("There is no C compiler here (cc, gcc, clang or CC), which --compiled needs.")
    try:
        step = read_json(folder / MANIFEST)["step"]
        files = {name: (folder / name).read_text() for name in ("policy.c", "policy.h")}
    except (DamagedFileError, OSError, KeyError):
        raise UserError(f"There is no whole export of {run}: lemniscate export {run}") from None
    if step != policy.step:
        raise UserError(f"{folder} is of step {step:,}, the policy of step {policy.step:,}: lemniscate export {run}")
    host, kind = HostPolicy(files, compiler), policy.spec.action

    def act(obs: Tensor) -> Tensor:
        return for_policy(host.act(obs.numpy()), kind)

    return act
