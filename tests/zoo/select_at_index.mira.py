# === right: gather, as in the notebook
def select_at_index(x, indices):
    return x.gather(-1, indices.unsqueeze(-1)).squeeze(-1)

# === right: advanced indexing
import torch


def select_at_index(x, indices):
    batch = torch.arange(x.shape[0], device=x.device)
    return x[batch, indices]

# === right: take_along_dim
import torch


def select_at_index(x, indices):
    return torch.take_along_dim(x, indices[:, None], dim=1)[:, 0]

# === right: a one-hot mask and a sum
import torch.nn.functional as F


def select_at_index(x, indices):
    mask = F.one_hot(indices, num_classes=x.size(-1))
    return (x * mask).sum(dim=-1)

# === right: einsum
import torch


def select_at_index(x, indices):
    one_hot = torch.nn.functional.one_hot(indices, x.shape[1]).to(x.dtype)
    return torch.einsum("bd,bd->b", x, one_hot)

# === right: a loop over rows, stacked
import torch


def select_at_index(x, indices):
    result = []
    for row, index in zip(x, indices):
        result.append(row[index])
    return torch.stack(result)

# === right: the diagonal of x[:, indices]
import torch


def select_at_index(x, indices):
    return torch.diagonal(x[:, indices])

# === right: a boolean mask
import torch


def select_at_index(x, indices):
    columns = torch.arange(x.shape[1]).expand_as(x)
    return x[columns == indices.unsqueeze(1)]

# === wrong: x[:, indices], a matrix [B, B] | shape|\[B, ?B\]|matrix|square|\(\d
def select_at_index(x, indices):
    return x[:, indices]

# === wrong: rows in place of columns: x[indices] | shape|\[B, ?B\]|matrix|square|\(\d|column|\brow|neighbo|next|previous|off by one|shift|from (1|one|zero|0)|IndexError|dim
def select_at_index(x, indices):
    return x[indices, 0]

# === wrong: the squeeze is missing: [B, 1] | shape|\[\d+, 1\]|squeeze|B, ?1
def select_at_index(x, indices):
    return x.gather(-1, indices.unsqueeze(-1))

# === wrong: gather along the first dimension | shape|\[B, ?B\]|matrix|square|\(\d|column|\brow|neighbo|next|previous|off by one|shift|from (1|one|zero|0)|IndexError|RuntimeError|size|dim
def select_at_index(x, indices):
    return x.gather(0, indices.unsqueeze(0)).squeeze(0)

# === wrong: the indices count from one | column|\brow|neighbo|next|previous|off by one|shift|from (1|one|zero|0)
import torch


def select_at_index(x, indices):
    return x[torch.arange(len(x)), indices - 1]

# === wrong: the largest of each row | largest|\bmax|ignor|not used|does not (depend|use)|maxim
def select_at_index(x, indices):
    return x.max(dim=-1).values

# === wrong: the result has no gradient, NumPy in between | no gradient|without.{0,12}gradient|gradients? .{0,40}(miss|lost|cut|stop|disabled|\bno\b|noth|detach)|detach|no_grad|requires_grad|backward|grad_fn|differentia|numpy
import numpy as np
import torch


def select_at_index(x, indices):
    values = x.detach().numpy()
    return torch.from_numpy(values[np.arange(len(values)), indices.numpy()])
