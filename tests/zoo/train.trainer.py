# === right: class Trainer with NumPy buffers, GAE in NumPy, and a train at the module's level
import dataclasses

import gymnasium
import numpy as np
import torch
from torch import nn


@dataclasses.dataclass
class Hyper:
    horizon: int = 64
    epochs: int = 10
    batches: int = 8
    lr: float = 1e-3
    discount: float = 0.98
    lam: float = 0.9
    eps: float = 0.2


class Policy(nn.Module):
    def __init__(self, obs_dim, space):
        super().__init__()
        self.space = space
        self.continuous = not isinstance(space, gymnasium.spaces.Discrete)
        size = int(np.prod(space.shape)) if self.continuous else int(space.n)
        self.pi = nn.Sequential(nn.Linear(obs_dim, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, size))
        self.v = nn.Sequential(nn.Linear(obs_dim, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 1))
        self.apply(self._init)
        nn.init.orthogonal_(self.pi[-1].weight, 0.01)
        if self.continuous:
            self.log_std = nn.Parameter(torch.zeros(size))

    @staticmethod
    def _init(m):
        if isinstance(m, nn.Linear):
            nn.init.orthogonal_(m.weight, 2**0.5)
            nn.init.zeros_(m.bias)

    def dist(self, obs):
        if self.continuous:
            return torch.distributions.Independent(torch.distributions.Normal(self.pi(obs), self.log_std.exp()), 1)
        return torch.distributions.Categorical(logits=self.pi(obs))

    @torch.no_grad()
    def act(self, obs):
        out = self.pi(torch.as_tensor(obs, dtype=torch.float32))
        return out.numpy() if self.continuous else out.argmax(-1).numpy()


class Trainer:
    def __init__(self, envs, seed, hyper=None):
        self.envs, self.h = envs, hyper or Hyper()
        self.rng = np.random.default_rng(seed)
        torch.manual_seed(seed)
        self.net = Policy(envs.single_observation_space.shape[0], envs.single_action_space)
        self.opt = torch.optim.Adam(self.net.parameters(), lr=self.h.lr, eps=1e-5)
        self.obs, _ = envs.reset(seed=seed)
        t, n = self.h.horizon, envs.num_envs
        self.buf_obs = np.zeros((t, n, *envs.single_observation_space.shape), np.float32)
        self.buf_next = np.zeros_like(self.buf_obs)
        self.buf_act = np.zeros((t, n, *envs.single_action_space.shape), envs.single_action_space.dtype)
        self.buf_logp, self.buf_rew, self.buf_term, self.buf_end = (np.zeros((t, n), np.float32) for _ in range(4))

    def rollout(self):
        for t in range(self.h.horizon):
            with torch.no_grad():
                dist = self.net.dist(torch.from_numpy(self.obs).float())
                action = dist.sample()
                logp = dist.log_prob(action)
            nxt, rew, term, trunc, info = self.envs.step(action.numpy())
            true_next = np.array(nxt)
            ended = term | trunc
            if ended.any():
                true_next[ended] = np.stack(list(info["final_obs"][ended]))
            self.buf_obs[t], self.buf_next[t], self.buf_act[t] = self.obs, true_next, action.numpy()
            self.buf_logp[t], self.buf_rew[t], self.buf_term[t], self.buf_end[t] = logp.numpy(), rew, term, ended
            self.obs = nxt

    def advantages(self):
        with torch.no_grad():
            v = self.net.v(torch.from_numpy(self.buf_obs)).squeeze(-1).numpy()
            v_next = self.net.v(torch.from_numpy(self.buf_next)).squeeze(-1).numpy()
        delta = self.buf_rew + self.h.discount * (1 - self.buf_term) * v_next - v
        adv = np.zeros_like(delta)
        acc = np.zeros(self.envs.num_envs, np.float32)
        for t in range(self.h.horizon - 1, -1, -1):
            acc = delta[t] + self.h.discount * self.h.lam * (1 - self.buf_end[t]) * acc
            adv[t] = acc
        return adv, adv + v

    def learn(self):
        adv, ret = self.advantages()
        adv = (adv - adv.mean()) / (adv.std() + 1e-8)
        flat = lambda x: torch.from_numpy(x.reshape(-1, *x.shape[2:]))
        obs, act, old, adv, ret = map(flat, (self.buf_obs, self.buf_act, self.buf_logp, adv, ret))
        for _ in range(self.h.epochs):
            for idx in np.array_split(self.rng.permutation(len(obs)), self.h.batches):
                idx = torch.from_numpy(idx)
                dist = self.net.dist(obs[idx])
                ratio = torch.exp(dist.log_prob(act[idx]) - old[idx])
                clipped = ratio.clip(1 - self.h.eps, 1 + self.h.eps)
                actor = -torch.minimum(ratio * adv[idx], clipped * adv[idx]).mean()
                critic = nn.functional.mse_loss(self.net.v(obs[idx]).squeeze(-1), ret[idx])
                self.opt.zero_grad()
                (actor + 0.5 * critic).backward()
                nn.utils.clip_grad_norm_(self.net.parameters(), 0.5)
                self.opt.step()


def train(envs, total_steps, seed=1):
    trainer = Trainer(envs, seed)
    steps = trainer.h.horizon * envs.num_envs
    rounds = max(total_steps // steps, 1)
    for i in range(rounds):
        for group in trainer.opt.param_groups:
            group["lr"] = trainer.h.lr * (1 - i / rounds)
        trainer.rollout()
        trainer.learn()
    return trainer.net

# === wrong: final_obs unused: V of the next episode's first observation | final_obs|next episode|first observation|successor
# --- instead of
            if ended.any():
                true_next[ended] = np.stack(list(info["final_obs"][ended]))
# --- here

# === wrong: the chain of the advantages runs on across the time-outs | chain|across|next episode|into the|runs on|trace
# --- instead of
            acc = delta[t] + self.h.discount * self.h.lam * (1 - self.buf_end[t]) * acc
# --- here
            acc = delta[t] + self.h.discount * self.h.lam * (1 - self.buf_term[t]) * acc

# === wrong: a death goes on: the bootstrap is not cut at terminated | terminat|death|bootstrap
# --- instead of
        delta = self.buf_rew + self.h.discount * (1 - self.buf_term) * v_next - v
# --- here
        delta = self.buf_rew + self.h.discount * v_next - v

# === wrong: the advantages are flattened env-major, all the rest time-major | align|flatten|layout|order|row|major
# --- instead of
        flat = lambda x: torch.from_numpy(x.reshape(-1, *x.shape[2:]))
# --- here
        flat = lambda x: torch.from_numpy(x.reshape(-1, *x.shape[2:]))
        adv = adv.T.reshape(adv.shape)

# === wrong: only the first minibatch of an epoch is used (break) | minibatch|first|rows? (are|is)? ?(never|not|left)|few|part of|all (the )?rows|steps
# --- instead of
                self.opt.step()
# --- here
                self.opt.step()
                break

# === wrong: the learning rate is 100 times too large | learning rate|step size|\blr\b|too large|KL|far
# --- instead of
    lr: float = 1e-3
# --- here
    lr: float = 1e-1

# === wrong: there is no clipping at all | clip
# --- instead of
                actor = -torch.minimum(ratio * adv[idx], clipped * adv[idx]).mean()
# --- here
                actor = -(ratio * adv[idx]).mean()

# === wrong: only the clipped term, without the minimum | min|clip|unclipped|pessimis
# --- instead of
                actor = -torch.minimum(ratio * adv[idx], clipped * adv[idx]).mean()
# --- here
                actor = -(clipped * adv[idx]).mean()

# === wrong: the actor is not in the optimizer | actor|policy.*(not|never|unchanged|same)|optimi[sz]er
# --- instead of
        self.opt = torch.optim.Adam(self.net.parameters(), lr=self.h.lr, eps=1e-5)
# --- here
        self.opt = torch.optim.Adam(self.net.v.parameters(), lr=self.h.lr, eps=1e-5)

# === wrong: the action that is stepped is drawn again: not that of the log-probability | action|drawn|sample|log.?prob
# --- instead of
            nxt, rew, term, trunc, info = self.envs.step(action.numpy())
# --- here
            nxt, rew, term, trunc, info = self.envs.step(dist.sample().numpy())

# === wrong: the critic's target is the reward alone | target|return|reward|value
# --- instead of
        return adv, adv + v
# --- here
        return adv, self.buf_rew

# === wrong: the advantage is of the wrong sign: V − target | sign|advantage|negat|opposite|minus|descent
# --- instead of
        delta = self.buf_rew + self.h.discount * (1 - self.buf_term) * v_next - v
# --- here
        delta = v - self.buf_rew - self.h.discount * (1 - self.buf_term) * v_next

# === wrong: every step overwrites the whole column of observations: all rows are the last one | copy|alias|same|row|obs|overwrit|view
# --- instead of
        self.buf_obs = np.zeros((t, n, *envs.single_observation_space.shape), np.float32)
# --- here
        self.buf_obs = np.zeros((1, n, *envs.single_observation_space.shape), np.float32).repeat(t, 0)
# --- instead of
            self.buf_obs[t], self.buf_next[t], self.buf_act[t] = self.obs, true_next, action.numpy()
# --- here
            self.buf_obs[:], self.buf_next[t], self.buf_act[t] = self.obs, true_next, action.numpy()

# === wrong: the agent acts at random when it is evaluated | random|evaluat|\bact\b|return
# --- instead of
        out = self.pi(torch.as_tensor(obs, dtype=torch.float32))
        return out.numpy() if self.continuous else out.argmax(-1).numpy()
# --- here
        return np.stack([self.space.sample() for _ in obs])
