# === right: multinomial, as in the notebook
import torch


def sample_categorical(probs):
    return torch.multinomial(probs, 1, replacement=True).squeeze(1)

# === right: torch's Categorical
from torch.distributions import Categorical


def sample_categorical(probs):
    return Categorical(probs=probs).sample()

# === right: the inverse of the cumulated probabilities
import torch


def sample_categorical(probs):
    cdf = probs.cumsum(-1)
    u = torch.rand(probs.shape[0], 1, dtype=probs.dtype, device=probs.device) * cdf[:, -1:]
    return (u >= cdf).sum(-1)

# === right: Gumbel's trick
import torch


def sample_categorical(probs):
    u = torch.rand_like(probs)
    gumbel = -torch.log(-torch.log(u))
    return torch.argmax(torch.log(probs) + gumbel, dim=-1)

# === right: a race of exponentials
import torch


def sample_categorical(probs):
    times = torch.empty_like(probs).exponential_(1.0)
    return (probs / times).argmax(dim=1)

# === right: np.random.choice in a loop over the rows
import numpy as np
import torch


def sample_categorical(probs):
    p = probs.detach().cpu().numpy().astype(np.float64)
    p = p / p.sum(axis=1, keepdims=True)
    actions = [np.random.choice(len(row), p=row) for row in p]
    return torch.as_tensor(actions, dtype=torch.long)

# === wrong: the likeliest index, nothing is drawn | argmax|likeliest|largest|drawn?\b|random|never|always|same|most probable
def sample_categorical(probs):
    return probs.argmax(dim=-1)

# === wrong: softmax once more: the probabilities are taken for logits | softmax|logit|frequen|probabilit|distribut|twice
from torch.distributions import Categorical


def sample_categorical(probs):
    return Categorical(logits=probs).sample()

# === wrong: uniform, the probabilities are ignored | uniform|ignor|frequen|probabilit|distribut
import torch


def sample_categorical(probs):
    return torch.randint(0, probs.shape[-1], (probs.shape[0],))

# === wrong: one draw for all rows | same|one (draw|number)|all rows|independen|each row|together|correlat
import torch


def sample_categorical(probs):
    cdf = probs.cumsum(-1)
    u = torch.rand(1)
    return (u * cdf[:, -1:] >= cdf).sum(-1).clamp(max=probs.shape[-1] - 1)

# === wrong: the squeeze is missing: [B, 1] | shape|\[\d+, 1\]|squeeze|B, ?1
import torch


def sample_categorical(probs):
    return torch.multinomial(probs, 1)

# === wrong: one-hot vectors, not indices | one-?hot|shape|index|indices|float
from torch.distributions import OneHotCategorical


def sample_categorical(probs):
    return OneHotCategorical(probs=probs).sample()

# === wrong: floats in place of indices | float|int|dtype|index|indices|type
import torch


def sample_categorical(probs):
    return torch.multinomial(probs, 1).squeeze(1).float()

# === wrong: from one to d, as in the lecture's notation | from (1|one|zero|0)|off by one|\+ ?1|range|index|frequen|probabilit
import torch


def sample_categorical(probs):
    return torch.multinomial(probs, 1).squeeze(1) + 1
