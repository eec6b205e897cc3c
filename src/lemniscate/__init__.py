"""Deep reinforcement learning that you can read in an evening, leave alone overnight, and fly in half a minute."""

from lemniscate.api import (
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
from lemniscate.errors import NonFiniteError, SweepError, UserError
from lemniscate.policy import TrainedPolicy
from lemniscate.run.evaluate import Evaluation
from lemniscate.run.run import Stopped
from lemniscate.run.seeding import set_seeds
from lemniscate.sweep import TrainedSweep, resume_sweep, train_sweep

__all__ = [
    "Evaluation",
    "NonFiniteError",
    "Stopped",
    "SweepError",
    "TrainedPolicy",
    "TrainedRun",
    "TrainedSweep",
    "UserError",
    "config_for",
    "evaluate",
    "load",
    "make_envs",
    "plot",
    "resume",
    "resume_sweep",
    "set_seeds",
    "train",
    "train_sweep",
    "watch",
]
