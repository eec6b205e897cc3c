# Functions: flags as masks, torch and NumPy, one critic and two.

# === right: 1 - float(terminated)
import torch


def td_target(rewards, next_values, terminations, gamma=0.99):
    return rewards + gamma * (1.0 - terminations.float()) * next_values

# === right: torch.where between the two cases, no_grad
import torch


@torch.no_grad()
def td_target(reward, next_value, terminated, *, gamma):
    return torch.where(terminated, reward, reward + gamma * next_value)

# === right: masked_fill on the bootstrap, torch.addcmul
import torch


def td_target(reward, next_value, terminated, gamma):
    bootstrap = next_value.masked_fill(terminated, 0.0)
    return torch.addcmul(reward.expand_as(bootstrap), bootstrap, torch.full_like(bootstrap, gamma))

# === right: in-place operations on a clone
import torch


def td_target(reward, next_value, terminated, *, gamma):
    y = next_value.detach().clone()
    y[..., terminated] = 0
    y *= gamma
    y += reward
    return y

# === right: an index for the rows that go on, Python floats for the discount
import torch


def td_target(r, q_next, term, gamma=0.99, n_step=1):
    discount = [0.0 if t else gamma**n_step for t in term.tolist()]
    return r + q_next * torch.tensor(discount, dtype=q_next.dtype)

# === right: NumPy inside, float64, the tensor's dtype comes back
import numpy as np
import torch


def td_target(reward, next_value, terminated, *, gamma=0.99):
    r, q = np.asarray(reward, dtype=float), np.asarray(next_value, dtype=float)
    alive = np.logical_not(np.asarray(terminated))
    return torch.as_tensor(r + gamma * q * alive, dtype=torch.float32)

# === right: NumPy arrays in and out, np.where
import numpy as np


def td_target(reward: np.ndarray, next_value: np.ndarray, terminated: np.ndarray, *, gamma: float) -> np.ndarray:
    return np.where(np.logical_not(terminated), np.add(reward, np.multiply(gamma, next_value)), reward)

# === right: loops over critics and rows, whatever the number of critics
import torch


def _one(r, v, dead, gamma):
    if dead:
        return r
    return r + gamma * v


def td_target(reward, next_value, terminated, *, gamma):
    if next_value.dim() > 1:
        return torch.stack([td_target(reward, critic, terminated, gamma=gamma) for critic in next_value])
    rows = zip(reward.unbind(), next_value.unbind(), terminated.tolist())
    return torch.stack([_one(r, v, dead, gamma) for r, v, dead in rows])

# === right: einsum of a diagonal discount
import torch


def td_target(reward, next_value, terminated, gamma):
    discount = gamma * terminated.logical_not().to(next_value.dtype)
    return reward + torch.einsum("...b,b->...b", next_value, discount)

# === wrong: terminated is not used: a death bootstraps | terminat|death|mask|bootstrap
import torch


def td_target(reward, next_value, terminated, *, gamma):
    return reward + gamma * next_value

# === wrong: the mask is turned round: terminated rows bootstrap, the others do not | mask|invert|turned|inverse|opposite|negat|terminat|~
import torch


def td_target(reward, next_value, terminated, *, gamma):
    return reward + gamma * next_value * terminated

# === wrong: gamma is missing | γ|gamma|discount
import torch


def td_target(reward, next_value, terminated, *, gamma):
    return reward + next_value * (~terminated)

# === wrong: gamma multiplies the reward, too | γ|gamma|discount|reward|bracket|parenthes
import torch


def td_target(reward, next_value, terminated, *, gamma):
    return gamma * (reward + next_value * ~terminated)

# === wrong: gamma squared | γ|gamma|squar|twice|discount
import torch


def td_target(reward, next_value, terminated, *, gamma):
    discount = gamma * ~terminated
    return reward + gamma * next_value * discount

# === wrong: the mask is on everything, so that the last reward is lost | mask|reward|lost|bracket|parenthes|terminat
import torch


def td_target(reward, next_value, terminated, *, gamma):
    return (reward + gamma * next_value) * (1 - terminated.float())

# === wrong: the mask is on the reward in place of the bootstrap | mask|reward|terminat|bootstrap
import torch


def td_target(reward, next_value, terminated, *, gamma):
    return reward * ~terminated + gamma * next_value

# === wrong: `1 - terminated` on a bool tensor | bool|subtract
import torch


def td_target(reward, next_value, terminated, *, gamma):
    return reward + gamma * next_value * (1 - terminated)

# === wrong: `not terminated` on a whole batch | ambiguous|Boolean value|\bnot\b terminated
import torch


def td_target(reward, next_value, terminated, *, gamma):
    return reward + gamma * next_value * (not terminated)

# === wrong: `~` on integers gives -1 and -2 | ~|mask|terminat|bool|invert|integer
import torch


def td_target(reward, next_value, terminated, *, gamma):
    return reward + gamma * next_value * ~terminated.long()

# === wrong: terminated.any(): one death ends the bootstrap of the whole batch | \bany\b|whole batch|other rows?|every row|all (the )?rows|each row|batch
import torch


def td_target(reward, next_value, terminated, *, gamma):
    if terminated.any():
        return reward.expand_as(next_value).clone()
    return reward + gamma * next_value

# === wrong: the minimum over the critics is taken here, [B] for [C, B] | min|critics?|shape|\[C, ?B\]
import torch


def td_target(reward, next_value, terminated, *, gamma):
    if next_value.dim() == 2:
        next_value = next_value.min(dim=0).values
    return reward + gamma * next_value * ~terminated

# === wrong: unsqueeze(-1) on the reward makes a [B, B] square | shape|broadcast|unsqueeze|\[B, ?B\]|size|dimension
import torch


def td_target(reward, next_value, terminated, *, gamma):
    mask = (~terminated).float().unsqueeze(-1)
    return reward.unsqueeze(-1) + gamma * next_value * mask

# === wrong: the mean of the batch comes back, a scalar | mean|shape|scalar|average
import torch


def td_target(reward, next_value, terminated, *, gamma):
    return (reward + gamma * next_value * ~terminated).mean()

# === wrong: the bootstrap is subtracted | minus|sign|subtract
import torch


def td_target(reward, next_value, terminated, *, gamma):
    return reward - gamma * next_value * ~terminated

# === wrong: whole numbers: gamma is cast to int | integer|whole number|round|dtype|\bint\b|γ|gamma
import torch


def td_target(reward, next_value, terminated, *, gamma):
    return reward + int(gamma) * next_value * ~terminated

# === wrong: the result is rounded to whole numbers | integer|whole number|round|dtype|\bint|float|long
import torch


def td_target(reward, next_value, terminated, *, gamma):
    return (reward + gamma * next_value * ~terminated).long()
