# The method alone in its class, or with what it calls.

# === right: a class without torch's Module, strings of small steps
import torch


class PPO:
    def compute_advantages(self, states, rewards, next_states, terminations):
        values = self.compute_values(states).detach()
        next_values = self.compute_values(next_states).detach()
        n = len(rewards)
        advantages = torch.zeros(n)
        for i in range(n - 1, -1, -1):
            bootstrap = 0.0 if terminations[i] else next_values[i]
            td_error = rewards[i] + self.gamma * bootstrap - values[i]
            last_of_env = (i + 1) % self.num_steps == 0
            if last_of_env or terminations[i]:
                advantages[i] = td_error
            else:
                advantages[i] = td_error + self.gamma * self.lmbda * advantages[i + 1]
        critic_targets = advantages + values
        return advantages, critic_targets

# === right: forwards sums, each row until its death or its environment's last row
import torch


class PPO:
    def _delta(self, reward, value, next_value, terminated):
        return reward + (0 if terminated else self.gamma * next_value) - value

    def compute_advantages(self, states, rewards, next_states, terminations):
        with torch.no_grad():
            v, w = self.compute_values(states), self.compute_values(next_states)
        deltas = [self._delta(*row) for row in zip(rewards.tolist(), v.tolist(), w.tolist(), terminations.tolist())]
        advantages = []
        for i in range(len(deltas)):
            total, weight = 0.0, 1.0
            end_of_env = (i // self.num_steps + 1) * self.num_steps
            for k in range(i, end_of_env):
                total += weight * deltas[k]
                if terminations[k]:
                    break
                weight *= self.gamma * self.lmbda
            advantages.append(total)
        advantages = torch.tensor(advantages)
        return advantages, advantages + v

# === right: one matrix for each environment, the cumulative product of masks, bmm
import torch


class PPO:
    @torch.no_grad()
    def compute_advantages(self, states, rewards, next_states, terminations):
        T = self.num_steps
        N = states.shape[0] // T
        v = self.compute_values(states).reshape(N, T)
        vn = self.compute_values(next_states).reshape(N, T)
        keep = (~terminations).float().reshape(N, T)
        delta = rewards.reshape(N, T) + self.gamma * keep * vn - v
        W = torch.eye(T).repeat(N, 1, 1)
        for k in range(1, T):
            W[:, :k, k] = W[:, :k, k - 1] * (self.gamma * self.lmbda * keep[:, k - 1 : k])
        adv = torch.bmm(W, delta.unsqueeze(-1)).squeeze(-1)
        return adv.reshape(-1), (adv + v).reshape(-1)

# === right: NumPy inside, float64, float32 at the end, self is called agent
import numpy as np
import torch


class PPO:
    def compute_advantages(agent, states, rewards, next_states, terminations):
        v = agent.compute_values(states).detach().numpy().astype(np.float64)
        vn = agent.compute_values(next_states).detach().numpy().astype(np.float64)
        r, d = rewards.numpy().astype(np.float64), terminations.numpy()
        adv = np.zeros_like(r)
        for start in range(0, len(r), agent.num_steps):
            gae = 0.0
            for t in range(start + agent.num_steps - 1, start - 1, -1):
                delta = r[t] + agent.gamma * vn[t] * (1 - d[t]) - v[t]
                gae = delta + agent.gamma * agent.lmbda * (1 - d[t]) * gae
                adv[t] = gae
        return torch.from_numpy(adv).float(), torch.from_numpy(adv + v).float()

# === right: torch.chunk for the environments, a recursion within each
import torch


class PPO:
    def _recursive(self, deltas, going):
        if len(deltas) == 1:
            return deltas
        rest = self._recursive(deltas[1:], going[1:])
        first = deltas[:1] + self.gamma * self.lmbda * going[:1] * rest[:1]
        return torch.cat([first, rest])

    def compute_advantages(self, states, rewards, next_states, terminations):
        values = self.compute_values(states)
        going = torch.ones_like(values).masked_fill(terminations, 0.0)
        deltas = rewards + self.gamma * self.compute_values(next_states) * going - values
        n_envs = len(rewards) // self.num_steps
        advantages = torch.cat(
            [self._recursive(d, g) for d, g in zip(torch.chunk(deltas, n_envs), torch.chunk(going, n_envs))]
        )
        return advantages.detach(), (advantages + values).detach()

# === right: the critic is called directly on both at once; transposed to [T, N]
import torch


class PPO:
    def compute_advantages(self, states, rewards, next_states, terminations):
        both = self.critic(torch.cat([states, next_states])).squeeze(-1).detach()
        values, next_values = both.chunk(2)
        to_time_major = lambda x: x.view(-1, self.num_steps).t()
        r, v, vn = map(to_time_major, (rewards, values, next_values))
        alive = to_time_major(terminations.logical_not().float())
        adv = torch.zeros_like(r)
        last = torch.zeros(r.shape[1])
        for t in reversed(range(self.num_steps)):
            last = r[t] + self.gamma * vn[t] * alive[t] - v[t] + self.gamma * self.lmbda * alive[t] * last
            adv[t] = last
        advantages = adv.t().reshape(-1)
        return advantages, advantages + values

# === right: a mask of boundaries is computed once, the targets first
import torch


class PPO:
    def _boundaries(self, n):
        index = torch.arange(1, n + 1)
        return index.remainder(self.num_steps).eq(0)

    def compute_advantages(self, states, rewards, next_states, terminations):
        with torch.no_grad():
            values = self.compute_values(states)
            next_values = self.compute_values(next_states)
            decay = self.gamma * self.lmbda * (~(terminations | self._boundaries(len(rewards)))).float()
            td_target = torch.where(terminations, rewards, rewards + self.gamma * next_values)
            targets = td_target.clone()
            for i in range(len(rewards) - 2, -1, -1):
                targets[i] += decay[i] * (targets[i + 1] - values[i + 1])
            advantages = targets - values
        return advantages, targets

# === right: own names and an extra argument, a generator for the rows of one environment
import torch


class PPO:
    def _backwards(self, rows):
        a = 0.0
        for r, v, v2, dead in rows:
            nonterminal = 0.0 if dead else 1.0
            a = r - v + nonterminal * self.gamma * (v2 + self.lmbda * a)
            yield a

    def compute_advantages(self, states, rewards, next_states, terminations, num_steps=None):
        T = num_steps or self.num_steps
        v = self.compute_values(states).detach()
        v2 = self.compute_values(next_states).detach()
        out = []
        for n in range(0, len(v), T):
            rows = list(zip(rewards[n : n + T], v[n : n + T], v2[n : n + T], terminations[n : n + T]))
            out.extend(reversed(list(self._backwards(reversed(rows)))))
        advantages = torch.stack(out)
        return advantages.detach(), (advantages + v).detach()

# === wrong: terminations do not cut the chain | chain|trace|carr|run(s|ning)? on|next episode|across
import torch


class PPO:
    def compute_advantages(self, states, rewards, next_states, terminations):
        values = self.compute_values(states)
        next_values = self.compute_values(next_states)
        deltas = rewards + self.gamma * next_values * (~terminations) - values
        adv, a = torch.zeros_like(deltas), 0.0
        for i in reversed(range(len(deltas))):
            if (i + 1) % self.num_steps == 0:
                a = 0.0
            a = deltas[i] + self.gamma * self.lmbda * a
            adv[i] = a
        return adv.detach(), (adv + values).detach()

# === wrong: terminations do not mask V(s') | terminat|mask|death|bootstrap
import torch


class PPO:
    def compute_advantages(self, states, rewards, next_states, terminations):
        values = self.compute_values(states)
        next_values = self.compute_values(next_states)
        deltas = rewards + self.gamma * next_values - values
        adv, a = torch.zeros_like(deltas), 0.0
        for i in reversed(range(len(deltas))):
            if (i + 1) % self.num_steps == 0:
                a = 0.0
            a = deltas[i] + self.gamma * self.lmbda * a * (~terminations[i])
            adv[i] = a
        return adv.detach(), (adv + values).detach()

# === wrong: terminations are not used at all | terminat|mask|death|\bends?\b
import torch


class PPO:
    def compute_advantages(self, states, rewards, next_states, terminations):
        T = self.num_steps
        values = self.compute_values(states).view(-1, T)
        next_values = self.compute_values(next_states).view(-1, T)
        deltas = rewards.view(-1, T) + self.gamma * next_values - values
        adv, a = torch.zeros_like(deltas), 0.0
        for t in reversed(range(T)):
            a = deltas[:, t] + self.gamma * self.lmbda * a
            adv[:, t] = a
        return adv.flatten().detach(), (adv + values).flatten().detach()

# === wrong: `1 - terminations` on a bool tensor | bool|subtract
import torch


class PPO:
    def compute_advantages(self, states, rewards, next_states, terminations):
        values = self.compute_values(states)
        next_values = self.compute_values(next_states)
        deltas = rewards + self.gamma * next_values * (1 - terminations) - values
        adv, a = torch.zeros_like(deltas), 0.0
        for i in reversed(range(len(deltas))):
            if (i + 1) % self.num_steps == 0:
                a = 0.0
            a = deltas[i] + self.gamma * self.lmbda * a * (1 - terminations[i])
            adv[i] = a
        return adv.detach(), (adv + values).detach()

# === wrong: V(s') is V of the next row: the next environment's state at the last rows, and none at the end | next_states|V\(s|next row|following row|successor|roll|(next|another|other) environment|shift
import torch


class PPO:
    def compute_advantages(self, states, rewards, next_states, terminations):
        values = self.compute_values(states).detach()
        next_values = torch.cat([values[1:], torch.zeros(1)])
        going = (~terminations).float()
        deltas = rewards + self.gamma * next_values * going - values
        adv, a = torch.zeros_like(deltas), 0.0
        for i in reversed(range(len(deltas))):
            if (i + 1) % self.num_steps == 0:
                a = 0.0
            a = deltas[i] + self.gamma * self.lmbda * a * going[i]
            adv[i] = a
        return adv, adv + values

# === wrong: compute_values(states) twice: V(s) in place of V(s') | next_states|V\(s|successor|next state
# --- instead of
        next_values = torch.cat([values[1:], torch.zeros(1)])
# --- here
        next_values = self.compute_values(states).detach()

# === wrong: the rows are taken as [T, N], time first | time|layout|env(ironment)?s?[- ](major|first|after)|reshape|\[N|environments\b|one environment|transpos|axis
import torch


class PPO:
    def compute_advantages(self, states, rewards, next_states, terminations):
        T = self.num_steps
        values = self.compute_values(states).detach()
        next_values = self.compute_values(next_states).detach()
        r, v, vn = rewards.view(T, -1), values.view(T, -1), next_values.view(T, -1)
        going = (~terminations).float().view(T, -1)
        adv, a = torch.zeros_like(r), 0.0
        for t in reversed(range(T)):
            a = r[t] + self.gamma * vn[t] * going[t] - v[t] + self.gamma * self.lmbda * going[t] * a
            adv[t] = a
        adv = adv.flatten()
        return adv, adv + values

# === wrong: only the first environment is filled in | environments\b|(first|other|one|another|each) environment|num_steps|range|zero
import torch


class PPO:
    def compute_advantages(self, states, rewards, next_states, terminations):
        values = self.compute_values(states).detach()
        next_values = self.compute_values(next_states).detach()
        adv, a = torch.zeros_like(values), 0.0
        for t in reversed(range(self.num_steps)):
            going = 1.0 - terminations[t].float()
            delta = rewards[t] + self.gamma * next_values[t] * going - values[t]
            a = delta + self.gamma * self.lmbda * going * a
            adv[t] = a
        return adv, adv + values

# === wrong: the critic's targets are r + gamma V(s'), last week's TD target | target.*(advantage|\+|TD|V\()|\+ ?V|V\(s|advantages? ?(\+|plus)|TD
import torch


class PPO:
    def compute_advantages(self, states, rewards, next_states, terminations):
        values = self.compute_values(states).detach()
        next_values = self.compute_values(next_states).detach()
        going = (~terminations).float()
        td_targets = rewards + self.gamma * next_values * going
        deltas = td_targets - values
        adv, a = torch.zeros_like(deltas), 0.0
        for i in reversed(range(len(deltas))):
            if (i + 1) % self.num_steps == 0:
                a = 0.0
            a = deltas[i] + self.gamma * self.lmbda * a * going[i]
            adv[i] = a
        return adv, td_targets

# === wrong: the critic's targets are advantages - values | minus|sign|\+ ?V|V\(s|advantages? ?(\+|plus)|subtract
import torch


class PPO:
    def compute_advantages(self, states, rewards, next_states, terminations):
        values = self.compute_values(states).detach()
        next_values = self.compute_values(next_states).detach()
        going = (~terminations).float()
        deltas = rewards + self.gamma * next_values * going - values
        adv, a = torch.zeros_like(deltas), 0.0
        for i in reversed(range(len(deltas))):
            if (i + 1) % self.num_steps == 0:
                a = 0.0
            a = deltas[i] + self.gamma * self.lmbda * a * going[i]
            adv[i] = a
        return adv, adv - values

# === wrong: gamma instead of gamma lambda in the chain | λ|lam(bda)?\b|lmbda
import torch


class PPO:
    def compute_advantages(self, states, rewards, next_states, terminations):
        values = self.compute_values(states).detach()
        next_values = self.compute_values(next_states).detach()
        adv, a = [], 0.0
        for i in reversed(range(len(values))):
            if (i + 1) % self.num_steps == 0:
                a = 0.0
            going = 0.0 if terminations[i] else 1.0
            a = rewards[i] + self.gamma * next_values[i] * going - values[i] + self.gamma * a * going
            adv.append(a)
        adv = torch.stack(adv[::-1])
        return adv, adv + values

# === wrong: lambda squared in the chain | λ|lam(bda)?\b|lmbda|squar|twice
import torch


class PPO:
    def compute_advantages(self, states, rewards, next_states, terminations):
        values = self.compute_values(states).detach()
        next_values = self.compute_values(next_states).detach()
        decay = self.gamma * self.lmbda
        adv, a = [], 0.0
        for i in reversed(range(len(values))):
            if (i + 1) % self.num_steps == 0:
                a = 0.0
            going = 0.0 if terminations[i] else 1.0
            a = rewards[i] + self.gamma * next_values[i] * going - values[i] + self.lmbda * decay * a * going
            adv.append(a)
        adv = torch.stack(adv[::-1])
        return adv, adv + values

# === wrong: the exponent of the notebook's text, (gamma lambda)^(T - t + 1), at the last delta | exponent|power|γλ|gamma.*la?m|factor|last (row|step|delta)|off by
import torch


class PPO:
    def compute_advantages(self, states, rewards, next_states, terminations):
        T = self.num_steps
        v = self.compute_values(states).detach().view(-1, T)
        vn = self.compute_values(next_states).detach().view(-1, T)
        going = (~terminations).float().view(-1, T)
        deltas = rewards.view(-1, T) + self.gamma * vn * going - v
        adv = torch.zeros_like(deltas)
        for t in range(T):
            weight = torch.ones(len(deltas))
            for k in range(t, T):
                power = 2 if k == T - 1 else 0
                adv[:, t] += weight * (self.gamma * self.lmbda) ** power * deltas[:, k]
                weight = weight * self.gamma * self.lmbda * going[:, k]
        return adv.flatten(), (adv + v).flatten()

# === wrong: rewards are changed in place, which the next epoch sees | in place|changes|overw|modif|caller|(written|changed)|epoch|clone
import torch


class PPO:
    def compute_advantages(self, states, rewards, next_states, terminations):
        with torch.no_grad():
            values = self.compute_values(states)
            next_values = self.compute_values(next_states)
        going = (~terminations).float()
        rewards += self.gamma * next_values * going - values
        for i in reversed(range(len(rewards) - 1)):
            if (i + 1) % self.num_steps != 0:
                rewards[i] += self.gamma * self.lmbda * going[i] * rewards[i + 1]
        return rewards, rewards + values

# === wrong: a typing error in an attribute: self.lambda_ | AttributeError|lambda_|no attribute
import torch


class PPO:
    def compute_advantages(self, states, rewards, next_states, terminations):
        values = self.compute_values(states).detach()
        next_values = self.compute_values(next_states).detach()
        adv, a = [], 0.0
        for i in reversed(range(len(values))):
            if (i + 1) % self.num_steps == 0:
                a = 0.0
            going = 0.0 if terminations[i] else 1.0
            a = rewards[i] + self.gamma * next_values[i] * going - values[i] + self.gamma * self.lambda_ * a * going
            adv.append(a)
        adv = torch.stack(adv[::-1])
        return adv, adv + values

# === wrong: the TODO is still there: advantages is not defined | NameError|UnboundLocal|not (defined|associated)|advantages. (is|where)|yet|filled
import torch


class PPO:
    def compute_advantages(self, states, rewards, next_states, terminations):
        gamma = self.gamma
        lmbda = self.lmbda
        T = self.num_steps
        num_states = states.size()[0]
        # TODO

        return advantages.detach(), critic_targets.detach()

# === wrong: a list of numbers comes back for the advantages, on which .detach() is called | AttributeError|list|detach|tensor
import torch


class PPO:
    def compute_advantages(self, states, rewards, next_states, terminations):
        values = self.compute_values(states)
        next_values = self.compute_values(next_states)
        advantages, a = [], 0.0
        for i in reversed(range(len(values))):
            if (i + 1) % self.num_steps == 0:
                a = 0.0
            going = 0.0 if terminations[i] else 1.0
            a = rewards[i] + self.gamma * next_values[i] * going - values[i] + self.gamma * self.lmbda * a * going
            advantages.append(a.item())
        advantages.reverse()
        critic_targets = torch.tensor(advantages) + values
        return advantages.detach(), critic_targets.detach()

# === wrong: the order of what comes back: targets first | exchang|swap|order\b|other way|\(?advantages, ?(critic_)?targets
import torch


class PPO:
    def compute_advantages(self, states, rewards, next_states, terminations):
        values = self.compute_values(states).detach()
        next_values = self.compute_values(next_states).detach()
        adv, a = [], 0.0
        for i in reversed(range(len(values))):
            if (i + 1) % self.num_steps == 0:
                a = 0.0
            going = 0.0 if terminations[i] else 1.0
            a = rewards[i] + self.gamma * next_values[i] * going - values[i] + self.gamma * self.lmbda * a * going
            adv.append(a)
        adv = torch.stack(adv[::-1])
        return adv + values, adv

# === wrong: each environment's list is right, but the environments come back in reversed order | environments\b|revers|order\b|(other|another|each) environment
import torch


class PPO:
    def compute_advantages(self, states, rewards, next_states, terminations):
        T = self.num_steps
        v = self.compute_values(states).detach()
        vn = self.compute_values(next_states).detach()
        advantages = []
        for n in reversed(range(len(v) // T)):
            env, a = [], 0.0
            for t in reversed(range(n * T, (n + 1) * T)):
                going = 1.0 - terminations[t].float()
                a = rewards[t] + self.gamma * vn[t] * going - v[t] + self.gamma * self.lmbda * going * a
                env.insert(0, a)
            advantages += env
        advantages = torch.stack(advantages)
        return advantages, advantages + v

# === wrong: the advantages are normalized over the batch | normali[sz]|standardi[sz]|zero mean|mean 0|std\b|deviation
import torch


class PPO:
    def compute_advantages(self, states, rewards, next_states, terminations):
        v = self.compute_values(states).detach()
        vn = self.compute_values(next_states).detach()
        advantages, a = torch.zeros_like(v), 0.0
        for t in reversed(range(len(v))):
            going = 1.0 - terminations[t].float()
            if t % self.num_steps == self.num_steps - 1:
                a = 0.0
            a = rewards[t] + self.gamma * vn[t] * going - v[t] + self.gamma * self.lmbda * going * a
            advantages[t] = a
        targets = advantages + v
        advantages = (advantages - advantages.mean()) / (advantages.std(unbiased=False) + 1e-8)
        return advantages, targets

# === wrong: every step takes a whole environment's end: the last rows do not bootstrap at all | last (row|step)|bootstrap|end of the rollout|rows run out|terminat
import torch


class PPO:
    def compute_advantages(self, states, rewards, next_states, terminations):
        v = self.compute_values(states).detach()
        vn = self.compute_values(next_states).detach()
        going = (~terminations).float()
        going[self.num_steps - 1 :: self.num_steps] = 0.0
        deltas = rewards + self.gamma * vn * going - v
        advantages, a = torch.zeros_like(v), 0.0
        for t in reversed(range(len(v))):
            a = deltas[t] + self.gamma * self.lmbda * going[t] * a
            advantages[t] = a
        return advantages, advantages + v
