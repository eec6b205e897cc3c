# === right: random.choices, Python's own
import random

import torch


def sample_categorical(probs):
    d = probs.shape[1]
    return torch.tensor([random.choices(range(d), weights=row)[0] for row in probs.tolist()])

# === right: searchsorted, held inside the range
import torch


def sample_categorical(probs):
    cdf = torch.cumsum(probs, dim=-1).contiguous()
    u = torch.rand(len(probs), 1)
    return torch.searchsorted(cdf, u, right=True).squeeze(-1).clamp_(max=probs.shape[-1] - 1)

# === right: a loop down the row by subtraction
import torch


def sample_categorical(probs):
    out = torch.zeros(probs.shape[0], dtype=torch.int64)
    for b in range(probs.shape[0]):
        u = torch.rand(()).item() * probs[b].sum().item()
        for k, p in enumerate(probs[b].tolist()):
            out[b] = k
            u -= p
            if u < 0:
                break
    return out

# === right: a generator of NumPy, vectorised
import numpy as np
import torch

rng = np.random.default_rng()


def sample_categorical(probs):
    p = probs.detach().numpy()
    u = rng.random((len(p), 1)) * p.sum(1, keepdims=True)
    k = (np.cumsum(p, axis=1) <= u).sum(1)
    return torch.from_numpy(np.minimum(k, p.shape[1] - 1))

# === right: a one-hot draw and its argmax
import torch


def sample_categorical(probs):
    one_hot = torch.distributions.OneHotCategorical(probs).sample()
    return one_hot.argmax(-1)

# === right: gumbel_softmax, hard; zeros stay impossible
import torch
import torch.nn.functional as F


def sample_categorical(probs):
    with torch.no_grad():
        hard = F.gumbel_softmax(probs.log(), tau=1.0, hard=True, dim=-1)
    return hard.argmax(dim=-1)

# === right: np.random.multinomial, one trial
import numpy as np
import torch


def sample_categorical(probs):
    p = probs.detach().double().numpy()
    counts = [np.random.multinomial(1, row / row.sum()) for row in p]
    return torch.tensor(np.array(counts)).argmax(dim=1)

# === right: a method of the agent that calls another, a generator passed if one is there
# solution: PPO.sample_categorical
import torch
from torch import nn


class PPO(nn.Module):
    def __init__(self, state_dim, num_actions, gamma, lmbda, epsilon, num_steps):
        super().__init__()
        self.actor = nn.Linear(state_dim, num_actions)
        self.critic = nn.Linear(state_dim, 1)

    def uniform(self, n, generator=None):
        return torch.rand(n, 1, generator=generator)

    def sample_categorical(self, probs, generator=None):
        cumulated = probs.cumsum(dim=1)
        cumulated = cumulated / cumulated[:, -1:]
        return (cumulated > self.uniform(len(probs), generator)).to(torch.uint8).argmax(dim=1)

# === right: five draws for each row, the last is kept
import torch


def sample_categorical(probs, n=5):
    draws = torch.multinomial(probs, n, replacement=True)
    return draws[:, -1]

# === wrong: the generator is seeded in each call: always the same draw | seed|same|each call|always|random|repeat|draw
import torch


def sample_categorical(probs):
    torch.manual_seed(0)
    return torch.multinomial(probs, 1).squeeze(1)

# === wrong: a NumPy generator made in each call with one seed | seed|same|each call|always|random|repeat|draw
import numpy as np
import torch


def sample_categorical(probs):
    rng = np.random.default_rng(42)
    p = probs.detach().numpy().astype(float)
    return torch.tensor([rng.choice(len(row), p=row / row.sum()) for row in p])

# === wrong: several different indices of the first row | first row|row|each|all rows|frequen|probabilit|distribut
import torch


def sample_categorical(probs):
    return torch.multinomial(probs[0], probs.shape[0], replacement=True)

# === wrong: the mean of the rows is drawn from, not each row | mean|average|each row|own|frequen|probabilit|distribut|rows
import torch


def sample_categorical(probs):
    p = probs.mean(0)
    return torch.multinomial(p, probs.shape[0], replacement=True)

# === wrong: Gumbel noise with the sign turned | gumbel|sign|frequen|probabilit|distribut
import torch


def sample_categorical(probs):
    gumbel = torch.log(-torch.log(torch.rand_like(probs)))
    return (probs.log() + gumbel).argmax(-1)

# === wrong: Gumbel noise on probabilities, without their logarithm | log|gumbel|frequen|probabilit|distribut
import torch


def sample_categorical(probs):
    gumbel = -torch.log(-torch.log(torch.rand_like(probs)))
    return (probs + gumbel).argmax(-1)

# === wrong: uniform noise times the probabilities, then the largest | frequen|probabilit|distribut|argmax|noise
import torch


def sample_categorical(probs):
    return (probs * torch.rand_like(probs)).argmax(dim=-1)

# === wrong: the probabilities are not cumulated | cumul|cumsum|frequen|probabilit|distribut|range
import torch


def sample_categorical(probs):
    u = torch.rand(probs.shape[0], 1)
    return (u >= probs).sum(-1).clamp(max=probs.shape[1] - 1)

# === wrong: the inverse CDF is one too late | off by one|one too|next|frequen|probabilit|distribut|range|shift
import torch


def sample_categorical(probs):
    cdf = probs.cumsum(-1)
    u = torch.rand(probs.shape[0], 1) * cdf[:, -1:]
    k = (u > cdf).sum(-1) + 1
    return k % probs.shape[-1]

# === wrong: the cumulated sum runs down the batch | batch|dim|axis|row|column|frequen|probabilit|distribut|range
import torch


def sample_categorical(probs):
    cdf = probs.cumsum(0)
    u = torch.rand(probs.shape[0], 1)
    return (u > cdf).sum(-1).clamp(max=probs.shape[-1] - 1)

# === wrong: a single integer, for one row | shape|scalar|int|\[B\]|one row|each row|batch|tensor
import torch


def sample_categorical(probs):
    return torch.multinomial(probs.view(-1), 1).item()

# === wrong: the probability of what was drawn, not its index | index|indices|float|probabilit|int|dtype
import torch


def sample_categorical(probs):
    index = torch.multinomial(probs, 1)
    return probs.gather(1, index).squeeze(1)

# === wrong: a rejection that never accepts, an endless loop | \bin time|seconds|endless|limit|forever|loop|never ends|does not end|too long
import torch


def sample_categorical(probs):
    actions = -torch.ones(probs.shape[0], dtype=torch.long)
    while (actions < 0).any():
        k = torch.randint(probs.shape[1], (probs.shape[0],))
        accept = torch.rand(probs.shape[0]) > 1
        actions = torch.where(accept, k, actions)
    return actions

# === wrong: the last index is never drawn | last|never|off by one|range|frequen|probabilit|distribut
import torch


def sample_categorical(probs):
    return torch.multinomial(probs[:, :-1], 1).squeeze(-1)

# === wrong: squeeze without a dimension: a batch of one loses it | one row|B ?= ?1|single|shape|squeeze|scalar|\[\]|\(\)
import torch


def sample_categorical(probs):
    return torch.multinomial(probs, num_samples=1).squeeze()

# === wrong: numpy() without detach, which fails where the probabilities come from the network | numpy|detach|grad|RuntimeError
import numpy as np
import torch


def sample_categorical(probs):
    p = probs.numpy().astype(np.float64)
    return torch.tensor([np.random.choice(len(row), p=row / row.sum()) for row in p])

# === wrong: np.random.choice over the whole matrix | ValueError|1-dimensional|row|dimension|loop|raises|shape
import numpy as np


def sample_categorical(probs):
    return np.random.choice(probs.shape[-1], p=probs.detach().numpy())

# === wrong: the squared probabilities, sharpened | squar|sharp|frequen|probabilit|distribut|temperature
import torch


def sample_categorical(probs):
    return torch.distributions.Categorical(probs=probs**2).sample()

# === wrong: the torch import is missing | NameError|torch|import|not defined
def sample_categorical(probs):
    return torch.multinomial(probs, 1).squeeze(1)
