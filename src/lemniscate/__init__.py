"""Deep reinforcement learning that you can read in an evening, leave alone overnight, and fly in half a minute.

Names are imported at their first use, so that `import lemniscate` and `lemniscate --help` do not wait for torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING

__version__ = "0.2.0"

if TYPE_CHECKING:
    from lemniscate.api import config_for, train
    from lemniscate.checks import check
    from lemniscate.envs.vector_view import make_vec
    from lemniscate.errors import NonFiniteError, NotStoredError, SweepError, UserError
    from lemniscate.exporting.export import export
    from lemniscate.margins.preflight import Preflight, preflight
    from lemniscate.plots import plot
    from lemniscate.policy import TrainedPolicy
    from lemniscate.pushed import push
    from lemniscate.results import evaluate, watch
    from lemniscate.resumed import resume
    from lemniscate.run.environments import make_envs
    from lemniscate.run.evaluate import Evaluation
    from lemniscate.run.run import Stopped
    from lemniscate.run.seeding import set_seeds
    from lemniscate.stored import TrainedRun, load, save
    from lemniscate.sweep import TrainedSweep, resume_sweep, train_sweep
    from lemniscate.tuning.tuner import Tuned, resume_tuning, tune

__all__ = [
    "Evaluation",
    "NonFiniteError",
    "NotStoredError",
    "Preflight",
    "Stopped",
    "SweepError",
    "TrainedPolicy",
    "TrainedRun",
    "TrainedSweep",
    "Tuned",
    "UserError",
    "check",
    "config_for",
    "evaluate",
    "export",
    "load",
    "make_envs",
    "make_vec",
    "plot",
    "preflight",
    "push",
    "resume",
    "resume_sweep",
    "resume_tuning",
    "save",
    "set_seeds",
    "train",
    "train_sweep",
    "tune",
    "watch",
]

MODULES = {
    "Evaluation": "run.evaluate",
    "NonFiniteError": "errors",
    "Stopped": "run.run",
    "NotStoredError": "errors",
    "Preflight": "margins.preflight",
    "SweepError": "errors",
    "TrainedPolicy": "policy",
    "TrainedRun": "stored",
    "TrainedSweep": "sweep",
    "Tuned": "tuning.tuner",
    "UserError": "errors",
    "check": "checks",
    "config_for": "api",
    "evaluate": "results",
    "export": "exporting.export",
    "load": "stored",
    "make_envs": "run.environments",
    "make_vec": "envs.vector_view",
    "plot": "plots",
    "preflight": "margins.preflight",
    "push": "pushed",
    "resume": "resumed",
    "resume_sweep": "sweep",
    "resume_tuning": "tuning.tuner",
    "save": "stored",
    "set_seeds": "run.seeding",
    "train": "api",
    "train_sweep": "sweep",
    "tune": "tuning.tuner",
    "watch": "results",
}
"""where each public name is defined"""

SUBMODULES = (
    *(
        "algos",
        "api",
        "course",
        "data",
        "envs",
        "errors",
        "exporting",
        "margins",
        "maths",
        "nn",
        "optim",
        "policy",
        "presets",
    ),
    *("plots", "pushed", "report", "results", "run", "spec", "stored", "sweep", "testing", "tuning", "types"),
)
"""what `lemniscate.NAME` imports by itself"""


def __getattr__(name: str) -> object:
    if name in SUBMODULES:
        return import_module(f"lemniscate.{name}")
    if name not in MODULES:
        raise AttributeError(f"module 'lemniscate' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(f"lemniscate.{MODULES[name]}"), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *SUBMODULES})
