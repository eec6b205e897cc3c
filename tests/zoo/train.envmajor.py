# === right: env-major rows [N, T], −log π by F.cross_entropy, the Gaussian by its formula, full batch
import math

import gymnasium as gym
import numpy as np
import torch
import torch.nn.functional as F


def mlp(i, o):
    return torch.nn.Sequential(torch.nn.Linear(i, 128), torch.nn.ReLU(), torch.nn.Linear(128, 128), torch.nn.ReLU(), torch.nn.Linear(128, o))


class ActorCritic(torch.nn.Module):
    def __init__(self, state_dim, action_space):
        super().__init__()
        self.finite = isinstance(action_space, gym.spaces.Discrete)
        self.out_dim = action_space.n if self.finite else action_space.shape[0]
        self.actor = mlp(state_dim, self.out_dim)
        self.critic = mlp(state_dim, 1)
        self.log_sigma = torch.nn.Parameter(torch.full((self.out_dim,), -0.2), requires_grad=not self.finite)

    def log_probs(self, s, a):
        out = self.actor(s)
        if self.finite:
            return -F.cross_entropy(out, a.long(), reduction="none")
        z = (a - out) / self.log_sigma.exp()
        return (-0.5 * z**2 - self.log_sigma - 0.5 * math.log(2 * math.pi)).sum(-1)

    def select(self, s):
        out = self.actor(s)
        if self.finite:
            return torch.multinomial(F.softmax(out, dim=-1), 1)[:, 0]
        return out + self.log_sigma.exp() * torch.randn_like(out)

    def values(self, s):
        return self.critic(s)[:, 0]

    @torch.no_grad()
    def act(self, obs):
        out = self.actor(torch.tensor(np.asarray(obs), dtype=torch.float32))
        return np.asarray(out.max(dim=-1).indices if self.finite else out)


def collect(ac, envs, state, T):
    N = envs.num_envs
    s, a, r, s2, term, trunc = [], [], [], [], [], []
    for _ in range(T):
        with torch.no_grad():
            action = ac.select(torch.as_tensor(state).float())
        after, reward, te, tr, infos = envs.step(action.numpy())
        following = torch.as_tensor(after).float().clone()
        for n in range(N):
            if te[n] or tr[n]:
                following[n] = torch.as_tensor(infos["final_obs"][n])
        s.append(torch.as_tensor(state).float())
        a.append(action)
        r.append(torch.as_tensor(reward).float())
        s2.append(following)
        term.append(torch.as_tensor(te).float())
        trunc.append(torch.as_tensor(tr).float())
        state = after
    rows = [torch.stack(x, dim=1).reshape(N * T, *x[0].shape[1:]) for x in (s, a, r, s2, term, trunc)]
    return rows, state


def compute_advantages(ac, s, r, s2, term, trunc, T, gamma, lmbda):
    with torch.no_grad():
        v, v2 = ac.values(s), ac.values(s2)
    adv = torch.zeros_like(r)
    for i in range(len(r) - 1, -1, -1):
        last = (i + 1) % T == 0
        adv[i] = r[i] + gamma * (1 - term[i]) * v2[i] - v[i]
        if not last and not term[i] and not trunc[i]:
            adv[i] += gamma * lmbda * adv[i + 1]
    return adv, adv + v


def train(envs, total_steps, seed, gamma=0.98, lmbda=0.95, epsilon=0.2, T=32, K=16, alpha=2e-3):
    torch.manual_seed(seed)
    ac = ActorCritic(envs.single_observation_space.shape[0], envs.single_action_space)
    optimizer = torch.optim.Adam([p for p in ac.parameters() if p.requires_grad], lr=alpha)
    iterations = max(1, total_steps // (T * envs.num_envs))
    scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda i: 1 - i / (iterations + 1))
    state, _ = envs.reset(seed=seed)
    for _ in range(iterations):
        (s, a, r, s2, term, trunc), state = collect(ac, envs, state, T)
        adv, targets = compute_advantages(ac, s, r, s2, term, trunc, T, gamma, lmbda)
        norm = (adv - adv.mean()) / (adv.std() + 1e-6)
        with torch.no_grad():
            old = ac.log_probs(s, a)
        for _ in range(K):
            ratio = torch.exp(ac.log_probs(s, a) - old)
            actor_loss = -torch.min(ratio * norm, torch.clamp(ratio, 1 - epsilon, 1 + epsilon) * norm).mean()
            critic_loss = F.mse_loss(ac.values(s), targets)
            optimizer.zero_grad()
            (actor_loss + critic_loss).backward()
            torch.nn.utils.clip_grad_norm_(ac.parameters(), 1.0)
            optimizer.step()
        scheduler.step()
    return ac

# === wrong: the chain runs on from one environment into the next | environment|across|chain|next env|runs on
# --- instead of
        if not last and not term[i] and not trunc[i]:
# --- here
        if i + 1 < len(r) and not term[i] and not trunc[i]:

# === wrong: the old log-probabilities are computed again in each epoch: the ratio is always 1 | old|ratio.*(1|one)|epoch|again
# --- instead of
        with torch.no_grad():
            old = ac.log_probs(s, a)
# --- here
# --- instead of
        for _ in range(K):
# --- here
        for _ in range(K):
            with torch.no_grad():
                old = ac.log_probs(s, a)

# === wrong: advantages env-major, rows time-major: not aligned | align|order|layout|flatten|row|major|environment
# --- instead of
    rows = [torch.stack(x, dim=1).reshape(N * T, *x[0].shape[1:]) for x in (s, a, r, s2, term, trunc)]
# --- here
    rows = [torch.stack(x, dim=0).reshape(N * T, *x[0].shape[1:]) for x in (s, a, r, s2, term, trunc)]

# === wrong: the rows of the states are stacked time-major, the rest env-major | align|order|layout|flatten|row|major|states?|obs
# --- instead of
    rows = [torch.stack(x, dim=1).reshape(N * T, *x[0].shape[1:]) for x in (s, a, r, s2, term, trunc)]
# --- here
    rows = [torch.stack(x, dim=1).reshape(N * T, *x[0].shape[1:]) for x in (s, a, r, s2, term, trunc)]
    rows[0] = torch.stack(s, dim=0).reshape(N * T, -1)

# === wrong: cross_entropy without the minus: −log π for log π | sign|minus|negat|log.?prob|upside|invert|inverse
# --- instead of
            return -F.cross_entropy(out, a.long(), reduction="none")
# --- here
            return F.cross_entropy(out, a.long(), reduction="none")

# === wrong: the loss is never stepped on: optimizer.step() is missing | step|update|unchanged|(not|never|no).*(learn|chang|mov)
# --- instead of
            optimizer.step()
# --- here

# === wrong: the advantage is λ-chained but without the TD error's − V(s) | \bV\b|value|baseline|subtract|advantage
# --- instead of
        adv[i] = r[i] + gamma * (1 - term[i]) * v2[i] - v[i]
# --- here
        adv[i] = r[i] + gamma * (1 - term[i]) * v2[i]

# === wrong: γ is missing in the bootstrap | gamma|γ|discount
# --- instead of
        adv[i] = r[i] + gamma * (1 - term[i]) * v2[i] - v[i]
# --- here
        adv[i] = r[i] + (1 - term[i]) * v2[i] - v[i]

# === wrong: the Gaussian's log-density is not summed over the dimensions but averaged | sum|dimension|log.?prob|mean
# --- instead of
        return (-0.5 * z**2 - self.log_sigma - 0.5 * math.log(2 * math.pi)).sum(-1)
# --- here
        return (-0.5 * z**2 - self.log_sigma - 0.5 * math.log(2 * math.pi)).mean(-1)

# === wrong: only truncation ends the chain and the bootstrap, a death goes on | terminat|death|flags?|swap|exchang
# --- instead of
    rows = [torch.stack(x, dim=1).reshape(N * T, *x[0].shape[1:]) for x in (s, a, r, s2, term, trunc)]
# --- here
    rows = [torch.stack(x, dim=1).reshape(N * T, *x[0].shape[1:]) for x in (s, a, r, s2, trunc, term)]

# === wrong: the clip is around 0, not around 1 | clip|around (0|1)|1 ?[-−±+]
# --- instead of
            actor_loss = -torch.min(ratio * norm, torch.clamp(ratio, 1 - epsilon, 1 + epsilon) * norm).mean()
# --- here
            actor_loss = -torch.min(ratio * norm, torch.clamp(ratio, -epsilon, epsilon) * norm).mean()
