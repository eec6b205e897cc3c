# === right: one function in CleanRL's manner, tensors [T, N]; a time-out's value is added to its reward
import gymnasium as gym
import numpy as np
import torch
import torch.nn as nn
import torch.optim as optim
from torch.distributions.categorical import Categorical
from torch.distributions.normal import Normal


def layer_init(layer, std=np.sqrt(2), bias_const=0.0):
    torch.nn.init.orthogonal_(layer.weight, std)
    torch.nn.init.constant_(layer.bias, bias_const)
    return layer


class Agent(nn.Module):
    def __init__(self, envs):
        super().__init__()
        n_obs = np.array(envs.single_observation_space.shape).prod()
        self.discrete = isinstance(envs.single_action_space, gym.spaces.Discrete)
        n_act = envs.single_action_space.n if self.discrete else np.prod(envs.single_action_space.shape)
        self.critic = nn.Sequential(
            layer_init(nn.Linear(n_obs, 64)), nn.Tanh(),
            layer_init(nn.Linear(64, 64)), nn.Tanh(),
            layer_init(nn.Linear(64, 1), std=1.0),
        )
        self.actor = nn.Sequential(
            layer_init(nn.Linear(n_obs, 64)), nn.Tanh(),
            layer_init(nn.Linear(64, 64)), nn.Tanh(),
            layer_init(nn.Linear(64, n_act), std=0.01),
        )
        if not self.discrete:
            self.actor_logstd = nn.Parameter(torch.zeros(1, n_act))

    def get_value(self, x):
        return self.critic(x)

    def get_action_and_value(self, x, action=None):
        out = self.actor(x)
        if self.discrete:
            probs = Categorical(logits=out)
            if action is None:
                action = probs.sample()
            return action, probs.log_prob(action), probs.entropy(), self.critic(x)
        probs = Normal(out, self.actor_logstd.expand_as(out).exp())
        if action is None:
            action = probs.sample()
        return action, probs.log_prob(action).sum(1), probs.entropy().sum(1), self.critic(x)

    def act(self, obs):
        with torch.no_grad():
            out = self.actor(torch.Tensor(obs))
        return out.argmax(dim=1).numpy() if self.discrete else out.numpy()


def train(envs, total_steps, seed):
    torch.manual_seed(seed)
    num_steps, update_epochs, minibatch_size = 32, 10, 64
    learning_rate, gamma, gae_lambda, clip_coef, vf_coef, ent_coef = 1e-3, 0.98, 0.95, 0.2, 0.5, 0.0
    num_envs = envs.num_envs
    batch_size = num_envs * num_steps
    agent = Agent(envs)
    optimizer = optim.Adam(agent.parameters(), lr=learning_rate, eps=1e-5)

    obs = torch.zeros((num_steps, num_envs) + envs.single_observation_space.shape)
    actions = torch.zeros((num_steps, num_envs) + envs.single_action_space.shape)
    logprobs = torch.zeros((num_steps, num_envs))
    rewards = torch.zeros((num_steps, num_envs))
    dones = torch.zeros((num_steps, num_envs))
    values = torch.zeros((num_steps, num_envs))

    next_obs, _ = envs.reset(seed=seed)
    next_obs = torch.Tensor(next_obs)
    num_updates = max(1, total_steps // batch_size)
    for update in range(1, num_updates + 1):
        frac = 1.0 - (update - 1.0) / num_updates
        optimizer.param_groups[0]["lr"] = frac * learning_rate

        for step in range(num_steps):
            obs[step] = next_obs
            with torch.no_grad():
                action, logprob, _, value = agent.get_action_and_value(next_obs)
                values[step] = value.flatten()
            actions[step] = action
            logprobs[step] = logprob
            new_obs, reward, terminations, truncations, infos = envs.step(action.cpu().numpy())
            rewards[step] = torch.tensor(reward).view(-1)
            for idx in range(num_envs):
                if truncations[idx] and not terminations[idx]:
                    with torch.no_grad():
                        last = agent.get_value(torch.Tensor(infos["final_obs"][idx]).unsqueeze(0))
                    rewards[step, idx] += gamma * last.item()
            dones[step] = torch.Tensor(np.logical_or(terminations, truncations))
            next_obs = torch.Tensor(new_obs)

        with torch.no_grad():
            next_value = agent.get_value(next_obs).reshape(1, -1)
            advantages = torch.zeros_like(rewards)
            lastgaelam = 0
            for t in reversed(range(num_steps)):
                nextnonterminal = 1.0 - dones[t]
                nextvalues = next_value if t == num_steps - 1 else values[t + 1]
                delta = rewards[t] + gamma * nextvalues * nextnonterminal - values[t]
                advantages[t] = lastgaelam = delta + gamma * gae_lambda * nextnonterminal * lastgaelam
            returns = advantages + values

        b_obs = obs.reshape((-1,) + envs.single_observation_space.shape)
        b_logprobs = logprobs.reshape(-1)
        b_actions = actions.reshape((-1,) + envs.single_action_space.shape)
        b_advantages = advantages.reshape(-1)
        b_returns = returns.reshape(-1)

        b_inds = np.arange(batch_size)
        for epoch in range(update_epochs):
            np.random.shuffle(b_inds)
            for start in range(0, batch_size, minibatch_size):
                mb_inds = b_inds[start : start + minibatch_size]
                _, newlogprob, entropy, newvalue = agent.get_action_and_value(b_obs[mb_inds], b_actions[mb_inds])
                logratio = newlogprob - b_logprobs[mb_inds]
                ratio = logratio.exp()
                mb_advantages = b_advantages[mb_inds]
                mb_advantages = (mb_advantages - mb_advantages.mean()) / (mb_advantages.std() + 1e-8)
                pg_loss1 = -mb_advantages * ratio
                pg_loss2 = -mb_advantages * torch.clamp(ratio, 1 - clip_coef, 1 + clip_coef)
                pg_loss = torch.max(pg_loss1, pg_loss2).mean()
                newvalue = newvalue.view(-1)
                v_loss = 0.5 * ((newvalue - b_returns[mb_inds]) ** 2).mean()
                entropy_loss = entropy.mean()
                loss = pg_loss - ent_coef * entropy_loss + v_loss * vf_coef
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
                optimizer.step()
    return agent

# === wrong: the time-out is taken for a death, its bootstrap is left out | time-?out|time limit|truncat
# --- instead of
            for idx in range(num_envs):
                if truncations[idx] and not terminations[idx]:
                    with torch.no_grad():
                        last = agent.get_value(torch.Tensor(infos["final_obs"][idx]).unsqueeze(0))
                    rewards[step, idx] += gamma * last.item()
# --- here

# === wrong: the done flag of the following step cuts this one (dones[t + 1]) | one (step|row)|shift|next (step|row)|off by one|row.*(done|end|terminat)|(done|end|terminat).*(row|step)|t ?\+ ?1
# --- instead of
                nextnonterminal = 1.0 - dones[t]
# --- here
                nextnonterminal = 1.0 - dones[min(t + 1, num_steps - 1)]

# === wrong: no exponential: the log-ratio is used for the ratio | exp
# --- instead of
                ratio = logratio.exp()
# --- here
                ratio = logratio

# === wrong: the ratio stands upside down | upside|invert|inverse|old.*(minus|[-−/]).*new|reciproc|swapp?ed|wrong way|the other way
# --- instead of
                logratio = newlogprob - b_logprobs[mb_inds]
# --- here
                logratio = b_logprobs[mb_inds] - newlogprob

# === wrong: zero_grad is missing | zero_grad|accumulat|add(s|ed)? up|gradients? .*(sum|never)
# --- instead of
                optimizer.zero_grad()
# --- here

# === wrong: min where the loss needs max | \bmax|\bmin|pessimis|optimis|clip
# --- instead of
                pg_loss = torch.max(pg_loss1, pg_loss2).mean()
# --- here
                pg_loss = torch.min(pg_loss1, pg_loss2).mean()

# === wrong: the sign of the policy loss is wrong: it goes downhill | sign|ascent|descent|minus|opposite|negat|uphill|downhill
# --- instead of
                pg_loss1 = -mb_advantages * ratio
                pg_loss2 = -mb_advantages * torch.clamp(ratio, 1 - clip_coef, 1 + clip_coef)
# --- here
                pg_loss1 = mb_advantages * ratio
                pg_loss2 = mb_advantages * torch.clamp(ratio, 1 - clip_coef, 1 + clip_coef)

# === wrong: the minibatch index is forgotten at the returns' columns: the first rows for all | value|target|return|row|index|align|shuffl
# --- instead of
                v_loss = 0.5 * ((newvalue - b_returns[mb_inds]) ** 2).mean()
# --- here
                v_loss = 0.5 * ((newvalue - b_returns[: len(mb_inds)]) ** 2).mean()

# === wrong: the optimizer has the actor's parameters only | critic|value.*(not|never|unchanged)|optimi[sz]er
# --- instead of
    optimizer = optim.Adam(agent.parameters(), lr=learning_rate, eps=1e-5)
# --- here
    optimizer = optim.Adam(agent.actor.parameters(), lr=learning_rate, eps=1e-5)

# === wrong: every rollout begins with a reset: obs is not carried over | reset|carr(y|ied)|go(es)? on|continu
# --- instead of

        for step in range(num_steps):
# --- here

        next_obs = torch.Tensor(envs.reset()[0])
        for step in range(num_steps):

# === wrong: the value's column [B, 1] meets the returns [B]: the difference is [B, B] | broadcast|shape|\[B, ?B\]|value|target
# --- instead of
                newvalue = newvalue.view(-1)
# --- here

# === wrong: the observation after the step is stored beside the action | obs|row|align|state|shift
# --- instead of
            obs[step] = next_obs
# --- here
# --- instead of
            next_obs = torch.Tensor(new_obs)
# --- here
            next_obs = torch.Tensor(new_obs)
            obs[step] = next_obs

# === wrong: the last step of the rollout has no bootstrap | last (row|step)|bootstrap|end of the rollout|cut|value of
# --- instead of
                nextvalues = next_value if t == num_steps - 1 else values[t + 1]
# --- here
                nextvalues = torch.zeros(num_envs) if t == num_steps - 1 else values[t + 1]
