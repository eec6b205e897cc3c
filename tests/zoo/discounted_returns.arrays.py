# Tensors, NumPy, matrices and classes.

# === right: torch.zeros_like, backwards with an index
import torch


def discounted_returns(rewards, gamma):
    returns = torch.zeros_like(rewards)
    returns[-1] = rewards[-1]
    for t in range(len(rewards) - 2, -1, -1):
        returns[t] = rewards[t] + gamma * returns[t + 1]
    return returns

# === right: NumPy in float64, an array comes back
import numpy as np


def discounted_returns(rewards, gamma=0.99):
    rewards = np.asarray(rewards, dtype=np.float64)
    returns = np.zeros(len(rewards))
    running_add = 0.0
    for t in reversed(range(len(rewards))):
        running_add = running_add * gamma + rewards[t]
        returns[t] = running_add
    return returns

# === right: an upper triangular matrix of gamma^(k - t) times the rewards
import torch


def discounted_returns(rewards, *, gamma: float):
    t = torch.arange(rewards.shape[0])
    exponent = (t.unsqueeze(0) - t.unsqueeze(1)).clamp(min=0)
    return torch.triu(torch.as_tensor(gamma, dtype=rewards.dtype) ** exponent) @ rewards

# === right: a clone that is added to in place, doubling the reach
import torch


def discounted_returns(rewards, gamma):
    out, reach = rewards.clone(), 1
    while reach < len(out):
        shifted = torch.zeros_like(out)
        shifted[:-reach] = out[reach:]
        out += gamma**reach * shifted
        reach *= 2
    return out

# === right: a static method of an agent with settings in a dataclass
from dataclasses import dataclass

import torch


@dataclass
class Settings:
    gamma: float = 0.99
    learning_rate: float = 1e-3


class Reinforce:
    def __init__(self, settings=None):
        self.settings = settings or Settings()

    @staticmethod
    def discounted_returns(rewards, gamma=Settings.gamma):
        values = torch.as_tensor(rewards).double()
        total = values.new_zeros(())
        out = torch.empty_like(values)
        for i in range(values.numel()):
            total = values[-1 - i] + gamma * total
            out[-1 - i] = total
        return out.to(torch.as_tensor(rewards).dtype)

# === right: np.polyval on each tail
import numpy as np
import torch


def discounted_returns(rewards, gamma):
    r = np.asarray(rewards, dtype=np.float64)
    tails = (r[t:][::-1] for t in range(len(r)))
    return torch.as_tensor(np.array([np.polyval(tail, gamma) for tail in tails]), dtype=torch.float32)

# === wrong: normalized returns, which nobody asked for here | normali[sz]|standardi[sz]|zero mean|mean 0|std\b|deviation
import torch


def discounted_returns(rewards, gamma):
    returns = torch.zeros_like(rewards)
    G = 0.0
    for t in reversed(range(len(rewards))):
        G = rewards[t] + gamma * G
        returns[t] = G
    if len(returns) > 1:
        returns = (returns - returns.mean()) / (returns.std() + 1e-9)
    return returns

# === wrong: an array of the integers, so that returns are rounded | integer|whole number|round|dtype|int\d*\b|float
import numpy as np


def discounted_returns(rewards, gamma):
    returns = np.zeros(len(rewards), dtype=np.int64)
    G = 0
    for t in reversed(range(len(rewards))):
        G = float(rewards[t]) + gamma * G
        returns[t] = int(G)
    return returns

# === wrong: floor division where a product is meant | floor|divi|γ|gamma|round|integer|//
import torch


def discounted_returns(rewards, gamma):
    returns = torch.zeros_like(rewards)
    G = 0.0
    for t in reversed(range(len(rewards))):
        G = rewards[t] + G * gamma // 1
        returns[t] = G
    return returns

# === wrong: rewards are overwritten | in place|changes|overw|modif|caller|(written|changed)|clone|alias
import torch


def discounted_returns(rewards, gamma):
    for t in range(len(rewards) - 2, -1, -1):
        rewards[t] += gamma * rewards[t + 1]
    return rewards

# === wrong: gamma squared | γ|gamma|squar|twice|discount|power
import torch


def discounted_returns(rewards, gamma):
    t = torch.arange(len(rewards))
    exponent = (t[None, :] - t[:, None]).clamp(min=0)
    return torch.triu((gamma**2) ** exponent.float()) @ rewards

# === wrong: the lower triangle: past rewards | past|triang|forward|backward|direction|transpos|before|order\b|revers
import torch


def discounted_returns(rewards, gamma):
    t = torch.arange(len(rewards))
    return torch.tril(gamma ** (t[:, None] - t[None, :]).clamp(min=0).float()) @ rewards

# === wrong: only one step ahead: r_t + gamma r_{t+1} | one step|chain|sum|next reward|all (later|following)|two|rest\b|follow
import torch


def discounted_returns(rewards, gamma):
    following = torch.cat([rewards[1:], torch.zeros(1)])
    return rewards + gamma * following

# === wrong: gamma of its own, 0.99, in place of the argument | 0\.99|argument|γ|gamma|constant|hard|fixed
import torch

GAMMA = 0.99


def discounted_returns(rewards, gamma=GAMMA):
    out, G = torch.zeros_like(rewards), 0.0
    for t in reversed(range(len(rewards))):
        G = rewards[t] + GAMMA * G
        out[t] = G
    return out

# === wrong: the first row is left out: range(T - 1, 0, -1) | row 0|first (row|step)|range|left out|never (filled|written|computed)|stays? (0|zero)
import torch


def discounted_returns(rewards, gamma):
    out, G = torch.zeros_like(rewards), 0.0
    for t in range(len(rewards) - 1, 0, -1):
        G = rewards[t] + gamma * G
        out[t] = G
    return out

# === wrong: the loop waits for a list to become empty and takes nothing from it | never end|time limit|endless|seconds|too long|did not (end|finish|return)|no end|still running|took
import torch


def discounted_returns(rewards, gamma):
    left, G, out = list(rewards), 0.0, None
    while left:
        G = left[-1] + gamma * G
        out = G
    return out
