"""Deep reinforcement learning that you can read in an evening, leave alone overnight, and fly in half a minute.

Names are imported at their first use, so that `import lemniscate` and `lemniscate --help` do not wait for torch.
"""

# ruff: noqa: F401 (type checkers look for the names here)

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING

__version__ = "0.2.0"

if TYPE_CHECKING:
    from lemniscate.api.plots import plot
    from lemniscate.api.policy import TrainedPolicy, TrainedRun, load, save
    from lemniscate.api.results import check, diagnose, evaluate, push, watch
    from lemniscate.api.training import config_for, resume, train
    from lemniscate.envs.vector_view import make_vec
    from lemniscate.errors import NonFiniteError, NotStoredError, SweepError, UserError
    from lemniscate.exporting.export import export
    from lemniscate.margins.preflight import Preflight, preflight
    from lemniscate.run.environments import make_envs
    from lemniscate.run.evaluate import Evaluation
    from lemniscate.run.seeding import set_seeds
    from lemniscate.run.stopping import Stopped
    from lemniscate.sweeps.sweep import TrainedSweep, resume_sweep, train_sweep
    from lemniscate.sweeps.tuner import Tuned, resume_tuning, tune

MODULES = {
    "api.plots": ("plot",),
    "api.policy": ("TrainedPolicy", "TrainedRun", "load", "save"),
    "api.results": ("check", "diagnose", "evaluate", "push", "watch"),
    "api.training": ("config_for", "resume", "train"),
    "envs.vector_view": ("make_vec",),
    "errors": ("NonFiniteError", "NotStoredError", "SweepError", "UserError"),
    "exporting.export": ("export",),
    "margins.preflight": ("Preflight", "preflight"),
    "run.environments": ("make_envs",),
    "run.evaluate": ("Evaluation",),
    "run.stopping": ("Stopped",),
    "run.seeding": ("set_seeds",),
    "sweeps.sweep": ("TrainedSweep", "resume_sweep", "train_sweep"),
    "sweeps.tuner": ("Tuned", "resume_tuning", "tune"),
}
"""the public names by the module that defines each; no subpackage may have one of these names, which it would hide"""

__all__ = sorted(name for names in MODULES.values() for name in names)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    for module, names in MODULES.items():
        if name in names:
            value = globals()[name] = getattr(import_module(f"lemniscate.{module}"), name)
            return value
    if not name.startswith("_") and find_spec(f"lemniscate.{name}"):
        return import_module(f"lemniscate.{name}")
    raise AttributeError(f"module 'lemniscate' has no attribute {name!r}")


def __dir__() -> list[str]:
    from pkgutil import iter_modules

    return sorted({*globals(), *__all__, *(module.name for module in iter_modules(__path__))})
