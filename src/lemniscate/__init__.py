"""Deep reinforcement learning that you can read in an evening, leave alone overnight, and fly in half a minute."""

from lemniscate.errors import NonFiniteError, SetError, UserError
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
from lemniscate.sets import TrainedSet, resume_set, train_set
from lemniscate.trained import TrainedPolicy

__all__ = [
    "Evaluation",
    "NonFiniteError",
    "SetError",
    "Stopped",
    "TrainedPolicy",
    "TrainedRun",
    "TrainedSet",
    "UserError",
    "config_for",
    "evaluate",
    "load",
    "make_envs",
    "plot",
    "resume",
    "resume_set",
    "set_seeds",
    "train",
    "train_set",
    "watch",
]
