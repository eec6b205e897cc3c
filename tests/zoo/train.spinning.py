# === right: two modules, two optimizers, paths finished one by one, a stop at target_kl
import gymnasium as gym
import numpy as np
import torch


class MLPActor(torch.nn.Module):
    def __init__(self, obs_dim, act_space):
        super().__init__()
        self.box = isinstance(act_space, gym.spaces.Box)
        n = act_space.shape[0] if self.box else act_space.n
        self.l1 = torch.nn.Linear(obs_dim, 64)
        self.l2 = torch.nn.Linear(64, 64)
        self.l3 = torch.nn.Linear(64, n)
        with torch.no_grad():
            self.l3.weight *= 0.1
        if self.box:
            self.log_std = torch.nn.Parameter(-0.5 * torch.ones(n))

    def forward(self, obs):
        return self.l3(torch.tanh(self.l2(torch.tanh(self.l1(obs)))))

    def pi(self, obs):
        if self.box:
            return torch.distributions.MultivariateNormal(self(obs), scale_tril=torch.diag(self.log_std.exp()))
        return torch.distributions.Categorical(logits=self(obs))


class MLPCritic(torch.nn.Module):
    def __init__(self, obs_dim):
        super().__init__()
        self.v_net = torch.nn.Sequential(
            torch.nn.Linear(obs_dim, 64), torch.nn.Tanh(), torch.nn.Linear(64, 64), torch.nn.Tanh(), torch.nn.Linear(64, 1)
        )

    def forward(self, obs):
        return torch.squeeze(self.v_net(obs), -1)


class PathBuffer:
    """Per environment a list of steps; finish_path turns the open part into advantages and returns."""

    def __init__(self, n_envs, gamma, lam):
        self.gamma, self.lam = gamma, lam
        self.open = [[] for _ in range(n_envs)]
        self.obs, self.act, self.logp, self.adv, self.ret = [], [], [], [], []

    def store(self, i, obs, act, rew, val, logp):
        self.open[i].append((obs, act, rew, val, logp))

    def finish_path(self, i, last_val):
        path, self.open[i] = self.open[i], []
        if not path:
            return
        vals = [p[3] for p in path] + [last_val]
        running, advs = 0.0, []
        for t in reversed(range(len(path))):
            running = path[t][2] + self.gamma * vals[t + 1] - vals[t] + self.gamma * self.lam * running
            advs.insert(0, running)
        self.obs += [p[0] for p in path]
        self.act += [p[1] for p in path]
        self.logp += [p[4] for p in path]
        self.adv += advs
        self.ret += [a + v for a, v in zip(advs, vals)]

    def get(self):
        adv = np.array(self.adv, dtype=np.float32)
        adv = (adv - adv.mean()) / (adv.std() + 1e-8)
        return (
            torch.as_tensor(np.array(self.obs), dtype=torch.float32),
            torch.as_tensor(np.array(self.act)),
            torch.as_tensor(np.array(self.logp), dtype=torch.float32),
            torch.as_tensor(adv),
            torch.as_tensor(np.array(self.ret), dtype=torch.float32),
        )


class Result:
    def __init__(self, actor):
        self.actor = actor

    def act(self, obs):
        with torch.no_grad():
            out = self.actor(torch.as_tensor(obs, dtype=torch.float32))
        return out.numpy() if self.actor.box else torch.argmax(out, 1).numpy()


def train(envs, total_steps, seed, steps_per_epoch=64, pi_lr=1.5e-3, vf_lr=3e-3, target_kl=0.03):
    torch.manual_seed(seed)
    np.random.seed(seed)
    obs_dim = envs.single_observation_space.shape[0]
    actor, critic = MLPActor(obs_dim, envs.single_action_space), MLPCritic(obs_dim)
    pi_optimizer = torch.optim.Adam(actor.parameters(), lr=pi_lr)
    vf_optimizer = torch.optim.Adam(critic.parameters(), lr=vf_lr)
    o, _ = envs.reset(seed=seed)
    clip_ratio, gamma, lam = 0.2, 0.98, 0.95
    for epoch in range(max(1, total_steps // (steps_per_epoch * envs.num_envs))):
        buf = PathBuffer(envs.num_envs, gamma, lam)
        for t in range(steps_per_epoch):
            with torch.no_grad():
                x = torch.as_tensor(o, dtype=torch.float32)
                pi = actor.pi(x)
                a = pi.sample()
                v, logp = critic(x).numpy(), pi.log_prob(a).numpy()
            a = a.numpy()
            next_o, r, d, cut, infos = envs.step(a)
            for i in range(envs.num_envs):
                buf.store(i, o[i].copy(), a[i], float(r[i]), float(v[i]), float(logp[i]))
                if d[i]:
                    buf.finish_path(i, 0.0)
                elif cut[i]:
                    with torch.no_grad():
                        last = critic(torch.as_tensor(infos["final_obs"][i], dtype=torch.float32)[None])
                    buf.finish_path(i, float(last))
            o = next_o
        with torch.no_grad():
            last = critic(torch.as_tensor(o, dtype=torch.float32))
        for i in range(envs.num_envs):
            buf.finish_path(i, float(last[i]))
        obs, act, logp_old, adv, ret = buf.get()

        for i in range(30):
            logp = actor.pi(obs).log_prob(act)
            ratio = torch.exp(logp - logp_old)
            clip_adv = torch.clamp(ratio, 1 - clip_ratio, 1 + clip_ratio) * adv
            loss_pi = -(torch.min(ratio * adv, clip_adv)).mean()
            if (logp_old - logp).mean().item() > 1.5 * target_kl:
                break
            pi_optimizer.zero_grad()
            loss_pi.backward()
            pi_optimizer.step()
        for i in range(30):
            vf_optimizer.zero_grad()
            loss_v = ((critic(obs) - ret) ** 2).mean()
            loss_v.backward()
            vf_optimizer.step()
    return Result(actor)

# === wrong: the path ends with value 0 at time-outs as well | time-?out|truncat|time limit|bootstrap
# --- instead of
                    with torch.no_grad():
                        last = critic(torch.as_tensor(infos["final_obs"][i], dtype=torch.float32)[None])
                    buf.finish_path(i, float(last))
# --- here
                    buf.finish_path(i, 0.0)

# === wrong: V of next_o, which is the next episode's, where a path is cut | final_obs|next episode|first obs|successor
# --- instead of
                        last = critic(torch.as_tensor(infos["final_obs"][i], dtype=torch.float32)[None])
# --- here
                        last = critic(torch.as_tensor(next_o[i], dtype=torch.float32)[None])

# === wrong: paths are not finished at their ends, only at the end of the rollout | end|across|chain|episode|terminat|death
# --- instead of
                if d[i]:
                    buf.finish_path(i, 0.0)
                elif cut[i]:
                    with torch.no_grad():
                        last = critic(torch.as_tensor(infos["final_obs"][i], dtype=torch.float32)[None])
                    buf.finish_path(i, float(last))
# --- here

# === wrong: the actor's gradients are never set to zero | zero_grad|accumulat|add(s|ed)? up|gradients?
# --- instead of
            pi_optimizer.zero_grad()
# --- here

# === wrong: the step of the critic's optimizer is forgotten | critic|value|(never|not|no).*(step|learn|train|chang|updat)
# --- instead of
            vf_optimizer.step()
# --- here

# === wrong: the last, open path has no bootstrap | last|bootstrap|cut|rollout'?s end|end of the rollout|row
# --- instead of
            buf.finish_path(i, float(last[i]))
# --- here
            buf.finish_path(i, 0.0)

# === wrong: obs is filed one step late: the observation that followed, with this action | obs|align|row|state|shift|successor
# --- instead of
                buf.store(i, o[i].copy(), a[i], float(r[i]), float(v[i]), float(logp[i]))
# --- here
                buf.store(i, next_o[i].copy(), a[i], float(r[i]), float(v[i]), float(logp[i]))

# === wrong: returns are stored with the rows reversed | order|align|revers|row|target|return
# --- instead of
        self.ret += [a + v for a, v in zip(advs, vals)]
# --- here
        self.ret += [a + v for a, v in zip(advs, vals)][::-1]

# === wrong: the target of the critic is its own old value | target|return|value
# --- instead of
        self.ret += [a + v for a, v in zip(advs, vals)]
# --- here
        self.ret += vals[:-1]

# === wrong: the Box action is clipped to the bounds before it is stored, its log-probability is of the unclipped one | clip(ped|s)?|bound|log.?prob|limit
# --- instead of
            a = a.numpy()
# --- here
            a = a.numpy()
            if actor.box:
                a = np.clip(a, envs.single_action_space.low, envs.single_action_space.high)

# === wrong: clip(ratio · A) instead of clip(ratio) · A | clip
# --- instead of
            clip_adv = torch.clamp(ratio, 1 - clip_ratio, 1 + clip_ratio) * adv
# --- here
            clip_adv = torch.clamp(ratio * adv, 1 - clip_ratio, 1 + clip_ratio)
