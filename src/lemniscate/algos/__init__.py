"""The algorithms. One file each, with the same names in the same order; one line each in this table."""

from types import ModuleType

from lemniscate.algos import ddpg, ppo

ALGORITHMS: dict[str, ModuleType] = {"ddpg": ddpg, "ppo": ppo}
