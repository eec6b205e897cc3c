# Without a loop over time, NumPy, classes.

# === right: weights gamma^(k - t) of the rows of one episode, einsum
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma=0.99):
    T = len(reward)
    steps = torch.arange(T)
    before = done.long().cumsum(0) - done.long()
    episode = (before.unsqueeze(0) == before.unsqueeze(1)).to(reward.dtype)
    weights = torch.tril(gamma ** (steps[:, None] - steps[None, :]).clamp(min=0).to(reward.dtype)).T
    last = done.clone()
    last[-1] = True
    paid = reward + gamma * next_value * last.logical_and(terminated.logical_not())
    return torch.einsum("tk,tkn,kn->tn", weights, episode, paid)

# === right: NumPy, float64 inside, a tensor of the dtype of reward comes back
import numpy as np
import torch


def reward_to_go(rewards, next_values, terminated, done, gamma):
    r = np.asarray(rewards, dtype=np.float64)
    rest = np.where(np.asarray(terminated), 0.0, np.asarray(next_values, dtype=np.float64))
    end = np.asarray(done).copy()
    end[-1] = True
    result = np.zeros_like(r)
    g = np.zeros(r.shape[1])
    for t in range(len(r) - 1, -1, -1):
        g = r[t] + gamma * np.where(end[t], rest[t], g)
        result[t] = g
    return torch.as_tensor(result, dtype=rewards.dtype)

# === right: NumPy arrays in and out
import numpy as np


def reward_to_go(reward: np.ndarray, next_value: np.ndarray, terminated: np.ndarray, done: np.ndarray, *, gamma: float):
    go = np.empty_like(reward)
    follows = np.array(next_value[-1])
    for t in reversed(range(reward.shape[0])):
        follows = np.where(done[t], next_value[t], follows)
        follows = reward[t] + gamma * np.where(terminated[t], 0.0, follows)
        go[t] = follows
    return go

# === right: a static method that asks gae with lambda = 1 and V = 0
import torch


class Returns:
    @staticmethod
    def lambda_one(delta, done, gamma):
        out = delta.clone()
        for t in range(len(out) - 2, -1, -1):
            out[t] = delta[t] + gamma * (~done[t]).float() * out[t + 1]
        return out

    @staticmethod
    def reward_to_go(reward, next_value, terminated, done, *, gamma=0.99):
        ends = done.index_fill(0, torch.tensor([len(done) - 1]), True)
        delta = reward + gamma * next_value * (ends & ~terminated).float()
        return Returns.lambda_one(delta, done, gamma)

# === right: a method of a class of one rollout, no_grad, optional dtype
import torch


class Rollout:
    def __init__(self, size=0):
        self.size = size

    def rest(self, t, next_value, terminated, done, following):
        out = following if t + 1 < self.size else next_value[t]
        out = torch.where(done[t], next_value[t], out)
        out[terminated[t]] = 0
        return out

    @torch.no_grad()
    def reward_to_go(self, reward, next_value, terminated, done, gamma=0.99, dtype=torch.float32):
        self.size = len(reward)
        go = torch.zeros(reward.shape, dtype=dtype)
        following = torch.zeros(reward.shape[1], dtype=dtype)
        for t in reversed(range(self.size)):
            following = reward[t] + gamma * self.rest(t, next_value, terminated, done, following)
            go[t] = following
        return go

# === wrong: a cumulative sum over the whole rollout, episodes run together | chain|run(s|ning)? on|next episode|across|carr|trace|\bdone\b|\bends?\b|γ|gamma|discount
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma):
    T = len(reward)
    weights = torch.triu(gamma ** (torch.arange(T)[None, :] - torch.arange(T)[:, None]).clamp(min=0).float())
    paid = reward.clone()
    paid[-1] += gamma * next_value[-1] * ~terminated[-1]
    return weights @ paid

# === wrong: next_value is added at every row, as in a TD target | next_value|bootstrap|every row|TD|twice|V\(s
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma):
    paid = reward + gamma * next_value * ~terminated
    go = torch.zeros_like(paid)
    g = torch.zeros_like(paid[0])
    for t in reversed(range(len(paid))):
        g = paid[t] + gamma * g * ~done[t]
        go[t] = g
    return go

# === wrong: the one-step TD target, no sum | chain|sum|one[- ]step|TD|follow|later rewards|trace
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma):
    return reward + gamma * next_value * ~terminated

# === wrong: next_value is never looked at | next_value|bootstrap|rest\b|time-?out|truncat
import numpy as np
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma):
    r, d = np.asarray(reward), np.asarray(done)
    out, g = np.zeros_like(r), 0.0
    for t in reversed(range(len(r))):
        g = r[t] + gamma * (1 - d[t]) * g
        out[t] = g
    return torch.from_numpy(out)

# === wrong: the exponent is t, not k - t, as in the notebook's text: gamma^t r_t summed from t on | exponent|power|γ|gamma|k ?[-−] ?t|discount|weight
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma):
    T = len(reward)
    before = done.long().cumsum(0) - done.long()
    same = (before[None] == before[:, None]).float()
    last = done.clone()
    last[-1] = True
    paid = reward + gamma * next_value * (last & ~terminated)
    weights = torch.triu(torch.ones(T, T)) * gamma ** torch.arange(T).float()[None, :]
    return torch.einsum("tk,tkn,kn->tn", weights, same, paid)

# === wrong: every row of an episode gets the episode's whole return | whole|each row|every (row|action)|first row|constant|same|past|before|from it on|own
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma):
    T, N = reward.shape
    out = torch.zeros_like(reward)
    for n in range(N):
        start = 0
        for t in range(T):
            if done[t, n] or t == T - 1:
                g = 0.0 if terminated[t, n] else next_value[t, n]
                for k in range(t, start - 1, -1):
                    g = reward[k, n] + gamma * g
                out[start : t + 1, n] = g
                start = t + 1
    return out

# === wrong: the sum runs along dim 1, over the environments | axis|dim|environments\b|transpos|time\b|across
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma):
    go = torch.zeros_like(reward)
    follows = next_value[:, -1]
    for t in reversed(range(reward.shape[1])):
        follows = torch.where(done[:, t], next_value[:, t], follows)
        follows = reward[:, t] + gamma * follows * ~terminated[:, t]
        go[:, t] = follows
    return go

# === wrong: a baseline is subtracted: the mean of the returns | mean|baseline|normali[sz]|subtract|cent(er|re)
import torch


class Reinforce:
    @staticmethod
    def reward_to_go(reward, next_value, terminated, done, *, gamma=0.99):
        go = torch.zeros_like(reward)
        follows = next_value[-1]
        for t in reversed(range(len(reward))):
            follows = torch.where(done[t], next_value[t], follows)
            follows = reward[t] + gamma * follows * ~terminated[t]
            go[t] = follows
        return go - go.mean()

# === wrong: reward is written into | in place|changes|overw|modif|caller|(written|changed)|clone|alias
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma):
    last = done.clone()
    last[-1] = True
    reward += gamma * next_value * (last & ~terminated)
    for t in range(len(reward) - 2, -1, -1):
        reward[t] += gamma * reward[t + 1] * ~done[t]
    return reward

# === wrong: half precision, which rounds | half|float16|precis|dtype|round
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma):
    go = torch.zeros_like(reward, dtype=torch.float16)
    follows = next_value[-1].half()
    for t in reversed(range(len(reward))):
        follows = torch.where(done[t], next_value[t].half(), follows)
        follows = reward[t].half() + gamma * follows * ~terminated[t]
        go[t] = follows
    return go

# === wrong: a name that does not exist: values | NameError|not defined|values
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma):
    go = torch.zeros_like(reward)
    follows = values[-1]
    for t in reversed(range(len(reward))):
        follows = torch.where(done[t], next_value[t], follows)
        follows = reward[t] + gamma * follows * ~terminated[t]
        go[t] = follows
    return go

# === wrong: only the return of the first row comes back | shape|\[T, ?N\]|scalar|only the|single
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma):
    follows = next_value[-1]
    for t in reversed(range(len(reward))):
        follows = torch.where(done[t], next_value[t], follows)
        follows = reward[t] + gamma * follows * ~terminated[t]
    return follows
