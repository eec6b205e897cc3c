# === right: everything in one nn.Module, train its static method; V(s') is the next row's V, but at ends that of final_obs
# solution: Learner.train
import gymnasium as gym
import numpy as np
import torch
import torch.nn as nn
from torch.distributions import Categorical, Normal


class Learner(nn.Module):
    T, K, M, eps, gamma, lam = 64, 8, 4, 0.25, 0.98, 0.9

    def __init__(self, envs):
        super().__init__()
        self.envs = envs
        self.kind = type(envs.single_action_space).__name__
        inputs = gym.spaces.utils.flatdim(envs.single_observation_space)
        outputs = gym.spaces.utils.flatdim(envs.single_action_space)
        self.embed_pi, self.embed_v = nn.Linear(inputs, 64), nn.Linear(inputs, 64)
        self.hidden_pi, self.hidden_v = nn.Linear(64, 64), nn.Linear(64, 64)
        self.norm_pi, self.norm_v = nn.LayerNorm(64), nn.LayerNorm(64)
        self.out_pi, self.out_v = nn.Linear(64, outputs), nn.Linear(64, 1)
        nn.init.uniform_(self.out_pi.weight, -0.01, 0.01)
        nn.init.zeros_(self.out_pi.bias)
        if self.kind == "Box":
            self.scale = nn.Parameter(torch.full((outputs,), 0.55))
        self.optimizer = torch.optim.Adam(self.groups(), eps=1e-5)

    def groups(self):
        policy = [p for n, p in self.named_parameters() if n.endswith(("_pi.weight", "_pi.bias")) or n == "scale"]
        value = [p for n, p in self.named_parameters() if "_v." in n]
        return [{"params": policy, "lr": 1e-3}, {"params": value, "lr": 2e-3}]

    def pi(self, x):
        h = self.norm_pi(torch.relu(self.hidden_pi(torch.relu(self.embed_pi(x)))))
        if self.kind == "Discrete":
            return Categorical(logits=self.out_pi(h))
        return Normal(self.out_pi(h), nn.functional.softplus(self.scale) + 1e-3)

    def v(self, x):
        return self.out_v(self.norm_v(torch.relu(self.hidden_v(torch.relu(self.embed_v(x))))))[..., 0]

    def log_pi(self, pi, a):
        lp = pi.log_prob(a)
        while lp.dim() > a.dim() - (self.kind == "Box"):
            lp = lp.sum(-1)
        return lp

    def act(self, obs):
        with torch.no_grad():
            pi = self.pi(torch.as_tensor(obs, dtype=torch.float32))
        return np.asarray(pi.logits.argmax(-1) if self.kind == "Discrete" else pi.mean)

    def experience(self, obs):
        T, N = self.T, self.envs.num_envs
        self.S = torch.zeros(T + 1, N, obs.shape[1])
        self.R, self.stop, self.dead = torch.zeros(T, N), torch.zeros(T, N), torch.zeros(T, N)
        self.late = {}
        actions, logs = [], []
        for t in range(T):
            self.S[t] = torch.as_tensor(obs)
            with torch.no_grad():
                pi = self.pi(self.S[t])
                a = pi.sample()
                logs.append(self.log_pi(pi, a))
            actions.append(a)
            obs, r, term, trunc, infos = self.envs.step(a.numpy())
            self.R[t] = torch.as_tensor(r)
            self.dead[t] = torch.as_tensor(term).float()
            self.stop[t] = torch.as_tensor(term | trunc).float()
            for i in np.where(trunc & ~term)[0]:
                self.late[t, int(i)] = torch.as_tensor(infos["final_obs"][i]).float()
        self.S[T] = torch.as_tensor(obs)
        self.A, self.logs = torch.stack(actions), torch.stack(logs)
        return obs

    @torch.no_grad()
    def estimate(self):
        V = self.v(self.S)
        V2 = V[1:].clone()
        for (t, i), x in self.late.items():
            V2[t, i] = self.v(x[None])[0]
        V2 *= 1 - self.dead
        self.adv = self.R + self.gamma * V2 - V[:-1]
        for t in range(self.T - 2, -1, -1):
            self.adv[t] += self.gamma * self.lam * (1 - self.stop[t]) * self.adv[t + 1]
        self.goal = self.adv + V[:-1]

    def improve(self):
        T, N = self.R.shape
        for _ in range(self.K):
            places = torch.randperm(T * N)
            for part in places.chunk(self.M):
                t, i = torch.div(part, N, rounding_mode="floor"), part % N
                pi = self.pi(self.S[t, i])
                ratio = torch.exp(self.log_pi(pi, self.A[t, i]) - self.logs[t, i])
                adv = self.adv[t, i]
                adv = (adv - adv.mean()) / (adv.std(unbiased=False) + 1e-5)
                gain = torch.min(ratio * adv, ratio.clamp(1 - self.eps, 1 + self.eps) * adv)
                loss = (self.v(self.S[t, i]) - self.goal[t, i]).pow(2).mul(0.5) - gain
                self.zero_grad()
                loss.mean().backward()
                nn.utils.clip_grad_norm_(self.parameters(), 0.5)
                self.optimizer.step()

    @staticmethod
    def train(envs, total_steps, seed):
        torch.manual_seed(seed)
        learner = Learner(envs)
        obs, _ = envs.reset(seed=seed)
        updates = max(1, round(total_steps / (learner.T * envs.num_envs)))
        rates = [group["lr"] for group in learner.optimizer.param_groups]
        for u in range(updates):
            for group, rate in zip(learner.optimizer.param_groups, rates):
                group["lr"] = rate * (1 - 0.9 * u / updates)
            obs = learner.experience(obs)
            learner.estimate()
            learner.improve()
        return learner

# === wrong: the policy's parameters are not in the optimizer's groups: a name is misspelt | actor|policy|optimi[sz]er|(not|never|no).*(learn|chang|mov|updat)|unchanged
# --- instead of
        policy = [p for n, p in self.named_parameters() if n.endswith(("_pi.weight", "_pi.bias")) or n == "scale"]
# --- here
        policy = [p for n, p in self.named_parameters() if n == "scale" or n.startswith("norm_pi")]

# === wrong: environments and steps are exchanged when the minibatch is taken of the advantages | align|index|row|order|exchang|swap|layout
# --- instead of
                t, i = torch.div(part, N, rounding_mode="floor"), part % N
# --- here
                t, i = torch.div(part, N, rounding_mode="floor"), part % N
                t2, i2 = part % T, torch.div(part, T, rounding_mode="floor")
# --- instead of
                adv = self.adv[t, i]
# --- here
                adv = self.adv[t2, i2]

# === wrong: V(s') at a time-out is that of the next episode's first observation | final_obs|next episode|first obs|time-?out|truncat|successor
# --- instead of
        for (t, i), x in self.late.items():
            V2[t, i] = self.v(x[None])[0]
# --- here

# === wrong: the chain ends only at deaths | chain|time-?out|truncat|across|next episode
# --- instead of
            self.adv[t] += self.gamma * self.lam * (1 - self.stop[t]) * self.adv[t + 1]
# --- here
            self.adv[t] += self.gamma * self.lam * (1 - self.dead[t]) * self.adv[t + 1]

# === wrong: the next value is masked with 'dead' the wrong way round | terminat|death|dead|mask|inverted|bootstrap|revers
# --- instead of
        V2 *= 1 - self.dead
# --- here
        V2 *= self.dead

# === wrong: rewards are not kept: the buffer stays at zero | reward|zero
# --- instead of
            self.R[t] = torch.as_tensor(r)
# --- here
            R = torch.as_tensor(r)
