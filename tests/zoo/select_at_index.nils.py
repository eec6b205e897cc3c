# === right: flattened with offsets, index_select
import torch


def select_at_index(x, indices):
    n, d = x.shape
    flat = x.reshape(n * d)
    return flat.index_select(0, torch.arange(n) * d + indices)

# === right: masked_select, written as a static method
# solution: Tools.select_at_index
import torch


class Tools:
    @staticmethod
    def mask(x, indices):
        mask = torch.zeros_like(x, dtype=torch.bool)
        return mask.scatter_(1, indices.view(-1, 1), True)

    @classmethod
    def select_at_index(cls, x, indices):
        return torch.masked_select(x, cls.mask(x, indices))

# === right: a method beside the other helpers of a module
# solution: PPO.select_at_index
from torch import nn


class PPO(nn.Module):
    def __init__(self, state_dim, num_actions, gamma, lmbda, epsilon, num_steps):
        super().__init__()
        self.actor = nn.Linear(state_dim, num_actions)
        self.critic = nn.Linear(state_dim, 1)

    def select_at_index(self, x, indices):
        batch_size = x.shape[0]
        return x[range(batch_size), indices]

# === right: torch.take on the flat tensor
import torch


def select_at_index(x, indices):
    starts = torch.arange(0, x.numel(), x.shape[-1])
    return x.take(starts + indices)

# === right: a batched product with one-hot columns
import torch


def select_at_index(scores, actions):
    eye = torch.eye(scores.shape[-1], dtype=scores.dtype, device=scores.device)
    return torch.bmm(scores.unsqueeze(1), eye[actions].unsqueeze(2)).squeeze(2).squeeze(1)

# === right: vmap
import torch


def select_at_index(x, indices):
    pick = lambda row, i: row.gather(0, i[None])[0]
    return torch.vmap(pick)(x, indices)

# === right: Python integers, nested by a comprehension
import torch


def select_at_index(x, indices):
    return torch.stack([x[i, j] for i, j in enumerate(indices.tolist())], dim=0)

# === wrong: squeeze without a dimension, a scalar for a batch of one | one row|B ?= ?1|single|shape|squeeze|scalar|\[\]|\(\)
import torch


def select_at_index(x, indices):
    return x.gather(1, indices.unsqueeze(1)).squeeze()

# === wrong: the row's sum is left: the mask was compared the wrong way | mask|\bsum\b|others|all but|the rest
import torch


def select_at_index(x, indices):
    columns = torch.arange(x.shape[1])
    return (x * (columns != indices[:, None])).sum(1)

# === wrong: the first index for all rows | \bfirst|all rows|every row|same|each|own|\brows?\b
def select_at_index(x, indices):
    return x[:, indices[0]]

# === wrong: a list of floats | list|tensor|float|type
def select_at_index(x, indices):
    return [float(x[i, j]) for i, j in enumerate(indices)]

# === wrong: torch.tensor of a list, the gradient is lost | no gradient|without.{0,12}gradient|gradients? .{0,40}(miss|lost|cut|stop|disabled|\bno\b|noth|detach)|detach|no_grad|requires_grad|backward|grad_fn|differentia|torch\.tensor|list
import torch


def select_at_index(x, indices):
    return torch.tensor([x[i, j].item() for i, j in enumerate(indices)], dtype=x.dtype)

# === wrong: the indices are returned, not what stands there | indices (themselves|are returned|in place)|the index|not what|values? of x|element|x itself|dtype|int64|whole number|int\b|gradient
def select_at_index(x, indices):
    picked = []
    for i in range(len(indices)):
        picked.append(indices[i])
    return indices.new_tensor(picked)

# === wrong: softmax was taken before | softmax|normali|x itself|value|prob
import torch


def select_at_index(x, indices):
    return torch.softmax(x, -1).gather(-1, indices[:, None])[:, 0]

# === wrong: the order of the rows is turned | order|revers|turn|row|flip
import torch


def select_at_index(x, indices):
    out = []
    for i in reversed(range(len(x))):
        out.append(x[i, indices[i]])
    return torch.stack(out)

# === wrong: index_select gives B columns of each row | columns|shape|\[B, ?B\]|matrix|square|\(\d
import torch


def select_at_index(x, indices):
    return torch.index_select(x, 1, indices)

# === wrong: take without offsets: only from the first row | first row|row|offset|flat|take
def select_at_index(x, indices):
    return x.take(indices)

# === wrong: the method is misspelt | AttributeError|gathr|has no|attribute
def select_at_index(x, indices):
    return x.gathr(-1, indices.unsqueeze(-1)).squeeze(-1)

# === wrong: input that waits for the keyboard | input|EOF|keyboard|read
def select_at_index(x, indices):
    dim = int(input("which dimension? "))
    return x.gather(dim, indices.unsqueeze(dim)).squeeze(dim)
