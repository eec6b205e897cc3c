# Matrices, scans and masks: the hand that avoids loops.

# === right: a matrix of (gamma lambda)^(k - t) within an episode, einsum
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    T = reward.shape[0]
    delta = reward + gamma * next_value * (1 - terminated.float()) - value
    episode = done.long().cumsum(0) - done.long()  # the number of ends before row t
    same = episode[:, None, :] == episode[None, :, :]  # [t, k, n]
    k = torch.arange(T)
    power = (k[None, :] - k[:, None]).clamp(min=0)
    weights = torch.triu(torch.ones(T, T)) * (gamma * lam) ** power
    advantage = torch.einsum("tk,tkn,kn->tn", weights, same.float(), delta)
    return advantage, advantage + value

# === right: the triangular system (I - gamma lambda S) A = delta is solved for each environment
import torch


def gae(reward, value, next_value, terminated, done, gamma=0.99, lam=0.95):
    T, N = reward.shape
    delta = (reward + gamma * torch.where(terminated, 0.0, next_value) - value).double()
    decay = gamma * lam * (~done).double()
    system = torch.eye(T, dtype=torch.float64).repeat(N, 1, 1)
    for t in range(T - 1):
        system[:, t, t + 1] = -decay[t]
    advantage = torch.linalg.solve_triangular(system, delta.T.unsqueeze(-1), upper=True).squeeze(-1).T
    advantage = advantage.to(reward.dtype)
    return advantage, advantage + value

# === right: a parallel scan that doubles its reach
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    total = reward + gamma * next_value * ~terminated - value
    factor = gamma * lam * (~done).to(total.dtype)
    T = total.shape[0]
    factor = torch.cat([factor[:-1], torch.zeros_like(factor[:1])])
    reach = 1
    while reach < T:
        pad_total = torch.cat([total[reach:], torch.zeros_like(total[:reach])])
        pad_factor = torch.cat([factor[reach:], torch.zeros_like(factor[:reach])])
        total = total + factor * pad_total
        factor = factor * pad_factor
        reach *= 2
    return total, total + value

# === right: everything turned by torch.flip, loops over unbind, turned back
import torch


def gae(rewards, values, next_values, terminations, dones, gamma, lam):
    r, v, nv, term, end = (torch.flip(x, dims=[0]) for x in (rewards, values, next_values, terminations, dones))
    deltas = r + gamma * nv * torch.logical_not(term) - v
    rows = []
    for delta, e in zip(deltas.unbind(), end.unbind()):
        following = rows[-1] if rows else torch.zeros_like(delta)
        rows.append(torch.where(e, delta, delta + gamma * lam * following))
    advantages = torch.stack(rows).flip(0)
    return advantages, advantages + values

# === right: the equation is applied T times to all rows at once until nothing changes
import torch


def gae(reward, value, next_value, terminated, done, *, gamma=0.99, lam=0.95):
    keep = torch.where(done, 0.0, gamma * lam)
    delta = reward - value + gamma * next_value.masked_fill(terminated, 0)
    advantage = delta
    for _ in range(len(reward)):
        shifted = torch.nn.functional.pad(advantage[1:], (0, 0, 0, 1))
        advantage = delta + keep * shifted
    return advantage, advantage + value

# === right: a cumulative sum of weighted deltas within each episode, in float64
import torch


def gae(reward, value, next_value, terminated, done, gamma=0.99, lam=0.95):
    delta = (reward + gamma * next_value * (~terminated) - value).double()
    decay = gamma * lam
    if decay == 0:
        adv = delta.to(reward.dtype)
        return adv, adv + value
    adv = torch.empty_like(delta)
    for n in range(delta.shape[1]):
        start = 0
        ends = done[:, n].nonzero().flatten().tolist() + [delta.shape[0] - 1]
        for end in ends:
            if end < start:
                continue
            part = delta[start : end + 1, n]
            w = decay ** torch.arange(len(part), dtype=torch.float64)
            adv[start : end + 1, n] = (part * w).flip(0).cumsum(0).flip(0) / w
            start = end + 1
    adv = adv.to(reward.dtype)
    return adv, adv + value

# === wrong: the exponent of gamma lambda is one too large | exponent|power|γλ|gamma.*lam|factor|too (much|large|often)|off by one|own (row|delta|δ)
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    T = reward.shape[0]
    delta = reward + gamma * next_value * (1 - terminated.float()) - value
    episode = done.long().cumsum(0) - done.long()
    same = (episode[:, None] == episode[None]).float()
    k = torch.arange(T)
    power = (k[None, :] - k[:, None] + 1).clamp(min=0)
    weights = torch.triu(torch.ones(T, T)) * (gamma * lam) ** power
    advantage = torch.einsum("tk,tkn,kn->tn", weights, same, delta)
    return advantage, advantage + value

# === wrong: the matrix is transposed: each row sums the deltas of its past | transpos|past|forward|backward|direction|earlier|order|revers
# --- instead of
    power = (k[None, :] - k[:, None] + 1).clamp(min=0)
    weights = torch.triu(torch.ones(T, T)) * (gamma * lam) ** power
# --- here
    weights = torch.tril((gamma * lam) ** (k[:, None] - k[None, :]).clamp(min=0).float())

# === wrong: the episode's number changes a row early: the row of the end belongs to the next episode | (row|step|one) (too )?(late|early|off)|shift|off by one|flag|chain|trace|wrong row|end of|\bends?\b
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    T = reward.shape[0]
    delta = reward + gamma * next_value * (1 - terminated.float()) - value
    episode = done.long().cumsum(0)
    same = (episode[:, None] == episode[None]).float()
    k = torch.arange(T)
    weights = torch.triu((gamma * lam) ** (k[None, :] - k[:, None]).clamp(min=0).float())
    advantage = torch.einsum("tk,tkn,kn->tn", weights, same, delta)
    return advantage, advantage + value

# === wrong: V(s') is taken from the next row, which after a time-out is the first of another episode | next_value|V\(s.?\)|next row|values?\[t|following row|successor|final obs|time-?out|reset
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    following = torch.cat([value[1:], next_value[-1:]])
    delta = reward + gamma * following * ~terminated - value
    adv = torch.zeros_like(delta)
    trace = torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        trace = delta[t] + gamma * lam * ~done[t] * trace
        adv[t] = trace
    return adv, adv + value

# === wrong: the last row has no bootstrap: V(s') is 0 there | last (row|step)|bootstrap|next_value|rows run out|end of the rollout|rest
# --- instead of
    following = torch.cat([value[1:], next_value[-1:]])
# --- here
    following = next_value.clone()
    following[-1] = 0

# === wrong: the mask is on the whole delta, so that the last reward of an episode is lost | mask|reward|terminat|delta|δ|bracket|parenthes
# --- instead of
    following = torch.cat([value[1:], next_value[-1:]])
    delta = reward + gamma * following * ~terminated - value
# --- here
    delta = (reward + gamma * next_value - value) * ~terminated

# === wrong: the mask is on V(s) in place of V(s') | mask|V\(s|terminat|bootstrap|next_value
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    delta = reward + gamma * next_value - value * ~terminated
    decay = gamma * lam * ~done
    adv = torch.zeros_like(delta)
    trace = torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        adv[t] = trace = delta[t] + decay[t] * trace
    return adv, adv + value

# === wrong: the mask is turned round: what goes on is cut, and what ended goes on | mask|invert|turned|inverse|opposite|negat|terminat|~|not\b.*flag
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    delta = reward + gamma * next_value * terminated - value
    decay = gamma * lam * done
    adv = torch.zeros_like(delta)
    trace = torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        adv[t] = trace = delta[t] + decay[t] * trace
    return adv, adv + value

# === wrong: the rows are flattened, so that the chain runs on from one environment into the next | environments\b|(next|another|other|each) environment|flatten|across
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    delta = (reward + gamma * next_value * ~terminated - value).flatten()
    keep = (~done).float().flatten() * gamma * lam
    adv = torch.zeros_like(delta)
    trace = 0.0
    for i in reversed(range(len(delta))):
        trace = delta[i] + keep[i] * trace
        adv[i] = trace
    adv = adv.view_as(reward)
    return adv, adv + value

# === wrong: the sum runs along the environments: axis 1 is taken for time | axis|dim|environments\b|transpos|time\b
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    delta = reward + gamma * next_value * ~terminated - value
    decay = gamma * lam * (~done).float()
    adv = torch.zeros_like(delta)
    trace = torch.zeros_like(delta[:, 0])
    for t in reversed(range(delta.shape[1])):
        trace = delta[:, t] + decay[:, t] * trace
        adv[:, t] = trace
    return adv, adv + value

# === wrong: the advantages are normalized, which nobody asked for | normali[sz]|standardi[sz]|mean 0|zero mean|std|deviation
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    delta = reward + gamma * next_value * ~terminated - value
    adv = torch.zeros_like(delta)
    trace = torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        adv[t] = trace = delta[t] + gamma * lam * ~done[t] * trace
    target = adv + value
    adv = (adv - adv.mean()) / (adv.std(unbiased=False) + 1e-8)
    return adv, target

# === wrong: the mean over the environments comes back, [T] in place of [T, N] | shape|mean|average|\[T, ?N\]|\[T\]
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    delta = reward + gamma * next_value * ~terminated - value
    adv = torch.zeros_like(delta)
    trace = torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        adv[t] = trace = delta[t] + gamma * lam * ~done[t] * trace
    return adv.mean(dim=1), (adv + value).mean(dim=1)

# === wrong: lambda = 0 in effect: only delta is given back, no chain | chain|λ|lam(bda)?\b|trace|one-step|TD error|delta|δ
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    delta = reward + gamma * next_value * ~terminated - value
    return delta, delta + value

# === wrong: `~` on integers: ~1 is -2 | ~|mask|terminat|bool|invert|integer
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    terminated, done = terminated.int(), done.int()
    delta = reward + gamma * next_value * ~terminated - value
    adv = torch.zeros_like(delta)
    trace = torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        adv[t] = trace = delta[t] + gamma * lam * ~done[t] * trace
    return adv, adv + value
