"""The algorithms. One file each, with the same names in the same order; one line each in this table."""

from types import ModuleType

from lemniscate.algos import a2c, ddpg, ppo, reinforce, sac, td3, trpo

ALGORITHMS: dict[str, ModuleType] = {
    "reinforce": reinforce,
    "a2c": a2c,
    "trpo": trpo,
    "ppo": ppo,
    "ddpg": ddpg,
    "td3": td3,
    "sac": sac,
}
