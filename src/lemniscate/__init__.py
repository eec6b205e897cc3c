"""Deep reinforcement learning that you can read in an evening, leave alone overnight, and fly in half a minute."""

from lemniscate.errors import NonFiniteError, UserError
from lemniscate.front import (
    TrainedRun,
    config_for,
    evaluate,
    load,
    make_envs,
    plot,
    resume,
    train,
    watch,
)
from lemniscate.run.evaluate import Evaluation
from lemniscate.run.run import Stopped
from lemniscate.run.seeding import set_seeds
from lemniscate.trained import TrainedPolicy

__all__ = [
    "Evaluation",
    "NonFiniteError",
    "Stopped",
    "TrainedPolicy",
    "TrainedRun",
    "UserError",
    "config_for",
    "evaluate",
    "load",
    "make_envs",
    "plot",
    "resume",
    "set_seeds",
    "train",
    "watch",
]
