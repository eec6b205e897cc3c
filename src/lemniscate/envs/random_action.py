"""Uniformly random actions, in the units of a policy."""

import torch
from torch import Generator, Tensor

from lemniscate.spec import Box, Discrete, MultiBinary, Spec


def random_action(spec: Spec, obs: Tensor, generator: Generator) -> Tensor:
    """One action for each of the observations [N, O + n], as `VecEnv.step` takes them.

    Uniform in [-1, 1]^A for a Box, over the n choices of a Discrete (those that the mask in `obs` allows), and over the
    choices of each component of a MultiDiscrete or MultiBinary.
    """
    action, drawn = spec.action, {"generator": generator, "device": obs.device}
    num_envs = len(obs)
    if isinstance(action, Box):
        return 2 * torch.rand(num_envs, action.size, **drawn) - 1
    if isinstance(action, MultiBinary):
        return torch.randint(2, (num_envs, action.n), **drawn)
    if isinstance(action, Discrete):
        allowed = obs[:, -action.n :] if action.masked else torch.ones(num_envs, action.n, device=obs.device)
        return torch.multinomial(allowed.float(), 1, generator=generator)[:, 0]
    return torch.stack([torch.randint(n, (num_envs,), **drawn) for n in action.nvec], dim=1)
