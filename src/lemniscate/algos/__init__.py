"""The algorithms. One file each, with the same names in the same order; one line each in this table."""

from types import ModuleType

from lemniscate.algos import ddpg, ppo, sac, td3

ALGORITHMS: dict[str, ModuleType] = {"ddpg": ddpg, "ppo": ppo, "sac": sac, "td3": td3}
