# The method alone in its class, as a cell of a notebook, in many shapes.

# === right: deltas of all rows at once, torch.cat with next_value, a loop backwards
import torch


class PPOTrainer:
    def calculate_advantages(self, next_value):
        next_values = torch.cat([self.values_buffer[1:], next_value], dim=0)
        masks = 1 - self.terminated_buffer
        deltas = self.rewards_buffer + self.config.gamma * next_values * masks - self.values_buffer
        advantages = torch.zeros_like(deltas)
        last = 0
        for t in range(self.config.n_steps)[::-1]:
            last = deltas[t] + self.config.gamma * self.config.gae_lambda * masks[t] * last
            advantages[t] = last
        returns = advantages + self.values_buffer
        return returns, advantages

# === right: config["gamma"] and config.get, self is called trainer
import torch


class PPOTrainer:
    def calculate_advantages(trainer, next_value):
        gamma = trainer.config["gamma"]
        lam = trainer.config.get("gae_lambda", 0.95)
        rewards, values, terminated = trainer.rewards_buffer, trainer.values_buffer, trainer.terminated_buffer
        out = []
        acc = torch.zeros_like(next_value)
        v_next = next_value
        for r, v, d in zip(reversed(list(rewards)), reversed(list(values)), reversed(list(terminated))):
            acc = r + gamma * v_next * (1 - d) - v + gamma * lam * (1 - d) * acc
            v_next = v
            out.append(acc)
        advantages = torch.cat(out[::-1])
        return advantages + values, advantages

# === right: a matrix of discounts that the masks multiply, no loop over the rows of the result
import torch


class PPOTrainer:
    def calculate_advantages(self, next_value):
        c = self.config
        alive = 1.0 - self.terminated_buffer
        following = torch.roll(self.values_buffer, -1, dims=0)
        following[-1] = next_value[0]
        delta = self.rewards_buffer + c.gamma * alive * following - self.values_buffer
        T = delta.shape[0]
        weights = torch.zeros(T, T, delta.shape[1])
        for t in range(T):
            weights[t, t] = 1.0
            if t + 1 < T:
                weights[t, t + 1 :] = torch.cumprod(c.gamma * c.gae_lambda * alive[t : T - 1], dim=0)
        advantages = torch.einsum("tkn,kn->tn", weights, delta)
        return advantages + self.values_buffer, advantages

# === right: the course's own reading (t + 1) in vectors: flags are shifted with the values
import torch


class PPOTrainer:
    def calculate_advantages(self, next_value):
        rewards, values, terminated = self.rewards_buffer, self.values_buffer, self.terminated_buffer
        next_values = torch.cat((values[1:], next_value))
        next_nonterminal = 1.0 - torch.cat((terminated[1:], terminated[-1:]))
        delta = rewards + self.config.gamma * next_values * next_nonterminal - values
        decay = self.config.gamma * self.config.gae_lambda * next_nonterminal
        advantages = delta.clone()
        for t in range(len(delta) - 2, -1, -1):
            advantages[t] += decay[t] * advantages[t + 1]
        return advantages + values, advantages

# === right: NumPy in float64 inside, a tensor on the trainer's device outside
import numpy as np
import torch


class PPOTrainer:
    def calculate_advantages(self, next_value):
        rew = self.rewards_buffer.cpu().numpy().astype(np.float64)
        val = np.concatenate([self.values_buffer.cpu().numpy(), next_value.cpu().numpy()], axis=0).astype(np.float64)
        term = self.terminated_buffer.cpu().numpy()
        adv = np.zeros_like(rew)
        carry = np.zeros(rew.shape[1])
        for i in reversed(range(rew.shape[0])):
            on = 1.0 - term[i]
            carry = rew[i] + self.config.gamma * val[i + 1] * on - val[i] + self.config.gamma * self.config.gae_lambda * on * carry
            adv[i] = carry
        adv = torch.as_tensor(adv, dtype=torch.float32, device=self.rewards_buffer.device)
        return adv + self.values_buffer, adv

# === right: environment by environment in Python floats
import torch


class PPOTrainer:
    def _of_one(self, rewards, values, ends):
        g, l = self.config.gamma, self.config.gae_lambda
        result, a = [], 0.0
        for i in range(len(rewards) - 1, -1, -1):
            if ends[i]:
                a = rewards[i] - values[i]
            else:
                a = rewards[i] + g * values[i + 1] - values[i] + g * l * a
            result.append(a)
        return list(reversed(result))

    def calculate_advantages(self, next_value):
        columns = []
        for env in range(self.rewards_buffer.shape[1]):
            values = self.values_buffer[:, env].tolist() + [next_value[0, env].item()]
            columns.append(self._of_one(self.rewards_buffer[:, env].tolist(), values, self.terminated_buffer[:, env].tolist()))
        advantages = torch.tensor(columns).t().contiguous()
        return advantages + self.values_buffer, advantages

# === right: recursion in a method of its own, where for the ends
import torch


class PPOTrainer:
    def advantage_of(self, t, next_value, rows):
        last_row = t == self.rewards_buffer.shape[0] - 1
        v_next = next_value.reshape(-1) if last_row else self.values_buffer[t + 1]
        a_next = torch.zeros_like(v_next) if last_row else self.advantage_of(t + 1, next_value, rows)
        future = self.config.gamma * (v_next + self.config.gae_lambda * a_next)
        dead = self.terminated_buffer[t] > 0.5
        rows[t] = self.rewards_buffer[t] - self.values_buffer[t] + torch.where(dead, torch.zeros_like(future), future)
        return rows[t]

    def calculate_advantages(self, next_value):
        rows = {}
        self.advantage_of(0, next_value, rows)
        advantages = torch.stack([rows[t] for t in sorted(rows)])
        returns = advantages + self.values_buffer
        return returns, advantages

# === right: the returns first, as a lambda-return; advantages are what they have over V
import torch


class PPOTrainer:
    @torch.no_grad()
    def calculate_advantages(self, next_value, gae_lambda=None):
        lam = self.config.gae_lambda if gae_lambda is None else gae_lambda
        returns = torch.empty_like(self.values_buffer)
        ret, nxt = next_value.squeeze(0), next_value.squeeze(0)
        for t in reversed(range(len(returns))):
            mixed = lam * ret + (1 - lam) * nxt
            ret = self.rewards_buffer[t] + self.config.gamma * (1 - self.terminated_buffer[t]) * mixed
            nxt = self.values_buffer[t]
            returns[t] = ret
        return returns, returns - self.values_buffer

# === right: a static helper takes everything, the method hands it over by name
import torch


class PPOTrainer:
    @staticmethod
    def _gae(*, rewards, values, bootstrap, terminated, gamma, lam):
        advantages = torch.zeros_like(rewards)
        step = rewards.shape[0]
        trace = 0
        while step > 0:
            step -= 1
            nonterminal = terminated[step].logical_not().float()
            delta = rewards[step] + gamma * nonterminal * bootstrap - values[step]
            trace = delta + gamma * lam * nonterminal * trace
            advantages[step] = trace
            bootstrap = values[step]
        return advantages

    def calculate_advantages(self, next_value):
        advantages = self._gae(
            rewards=self.rewards_buffer,
            values=self.values_buffer,
            bootstrap=next_value.flatten(),
            terminated=self.terminated_buffer,
            gamma=self.config.gamma,
            lam=self.config.gae_lambda,
        )
        return torch.add(advantages, self.values_buffer), advantages

# === wrong: advantages and returns come back the other way round | exchang|swap|order\b|other way|\(?returns, ?advantages
import torch


class PPOTrainer:
    def calculate_advantages(self, next_value):
        next_values = torch.cat([self.values_buffer[1:], next_value], dim=0)
        masks = 1 - self.terminated_buffer
        deltas = self.rewards_buffer + self.config.gamma * next_values * masks - self.values_buffer
        advantages = torch.zeros_like(deltas)
        last = 0
        for t in range(self.config.n_steps)[::-1]:
            last = deltas[t] + self.config.gamma * self.config.gae_lambda * masks[t] * last
            advantages[t] = last
        returns = advantages + self.values_buffer
        return advantages, returns

# === wrong: next_value is not used: the last row has no bootstrap | last (row|step)|bootstrap|next_value
import torch


class PPOTrainer:
    def calculate_advantages(self, next_value):
        advantages = torch.zeros_like(self.rewards_buffer)
        gae = torch.zeros_like(self.rewards_buffer[0])
        T = self.config.n_steps
        for t in reversed(range(T)):
            following = self.values_buffer[t + 1] if t < T - 1 else torch.zeros_like(gae)
            on = 1 - self.terminated_buffer[t]
            delta = self.rewards_buffer[t] + self.config.gamma * following * on - self.values_buffer[t]
            gae = delta + self.config.gamma * self.config.gae_lambda * on * gae
            advantages[t] = gae
        return advantages + self.values_buffer, advantages

# === wrong: next_value stands for V(s') at every row | next_value|V\(s|last (row|step)|values_buffer|every row
import torch


class PPOTrainer:
    def calculate_advantages(self, next_value):
        on = 1 - self.terminated_buffer
        deltas = self.rewards_buffer + self.config.gamma * next_value * on - self.values_buffer
        advantages = torch.zeros_like(deltas)
        gae = 0
        for t in reversed(range(self.config.n_steps)):
            gae = deltas[t] + self.config.gamma * self.config.gae_lambda * on[t] * gae
            advantages[t] = gae
        return advantages + self.values_buffer, advantages

# === wrong: the values of the row before: torch.roll by +1 | V\(s|roll|shift|(row|step) (before|early|off)|previous|direction|next_value|successor
import torch


class PPOTrainer:
    def calculate_advantages(self, next_value):
        c = self.config
        alive = 1.0 - self.terminated_buffer
        following = torch.roll(self.values_buffer, 1, dims=0)
        following[-1] = next_value[0]
        delta = self.rewards_buffer + c.gamma * alive * following - self.values_buffer
        adv = torch.zeros_like(delta)
        run = 0
        for t in reversed(range(len(delta))):
            run = delta[t] + c.gamma * c.gae_lambda * alive[t] * run
            adv[t] = run
        return adv + self.values_buffer, adv

# === wrong: the flags of the row before: t - 1 | (row|step|one) (too )?(late|early|off)|t ?[-−] ?1|shift|flag|row before|previous
import torch


class PPOTrainer:
    def calculate_advantages(self, next_value):
        c = self.config
        values = torch.cat([self.values_buffer, next_value])
        adv = torch.zeros_like(self.rewards_buffer)
        run = 0
        for t in reversed(range(len(adv))):
            on = 1.0 - self.terminated_buffer[t - 1] if t > 0 else torch.ones_like(adv[0])
            run = self.rewards_buffer[t] + c.gamma * on * values[t + 1] - values[t] + c.gamma * c.gae_lambda * on * run
            adv[t] = run
        return adv + self.values_buffer, adv

# === wrong: the chain is never cut where an episode ends | chain|trace|carr|run(s|ning)? on|next episode|across
import torch


class PPOTrainer:
    def calculate_advantages(self, next_value):
        c = self.config
        values = torch.cat([self.values_buffer, next_value])
        delta = self.rewards_buffer + c.gamma * values[1:] * (1 - self.terminated_buffer) - values[:-1]
        adv = torch.zeros_like(delta)
        run = 0
        for t in reversed(range(len(adv))):
            run = delta[t] + c.gamma * c.gae_lambda * run
            adv[t] = run
        return adv + self.values_buffer, adv

# === wrong: terminated_buffer is not used at all | terminat|mask|death|\bends?\b
import torch


class PPOTrainer:
    def calculate_advantages(self, next_value):
        g, l = self.config.gamma, self.config.gae_lambda
        adv, a, v_next = [], 0.0, next_value[0]
        for r, v in zip(self.rewards_buffer.flip(0), self.values_buffer.flip(0)):
            a = r + g * v_next - v + g * l * a
            v_next = v
            adv.insert(0, a)
        adv = torch.stack(adv)
        return adv + self.values_buffer, adv

# === wrong: gae_lambda is left out of the chain | λ|lam(bda)?\b|gae_lambda
import torch


class PPOTrainer:
    def calculate_advantages(self, next_value):
        values = torch.cat([self.values_buffer, next_value])
        adv = torch.zeros_like(self.rewards_buffer)
        last = 0
        for t in reversed(range(self.config.n_steps)):
            on = 1.0 - self.terminated_buffer[t]
            delta = self.rewards_buffer[t] + self.config.gamma * values[t + 1] * on - values[t]
            adv[t] = last = delta + self.config.gamma * on * last
        return adv + self.values_buffer, adv

# === wrong: gamma is left out of the chain | γ|gamma|discount
# --- instead of
            adv[t] = last = delta + self.config.gamma * on * last
# --- here
            adv[t] = last = delta + self.config.gae_lambda * on * last

# === wrong: returns are discounted rewards, not advantages + values | returns? .*(V|value|advantage)|\+ ?V|V\(s|advantages? ?(\+|plus)|Monte|rewards? alone
import torch


class PPOTrainer:
    def calculate_advantages(self, next_value):
        values = torch.cat([self.values_buffer, next_value])
        adv, returns = torch.zeros_like(self.rewards_buffer), torch.zeros_like(self.rewards_buffer)
        last, g = 0, 0
        for t in reversed(range(self.config.n_steps)):
            on = 1.0 - self.terminated_buffer[t]
            delta = self.rewards_buffer[t] + self.config.gamma * values[t + 1] * on - values[t]
            adv[t] = last = delta + self.config.gamma * self.config.gae_lambda * on * last
            returns[t] = g = self.rewards_buffer[t] + self.config.gamma * on * g
        return returns, adv

# === wrong: returns are advantages + rewards | returns? .*(V|value|advantage)|\+ ?V|V\(s|advantages? ?(\+|plus)|reward
import torch


class PPOTrainer:
    def calculate_advantages(self, next_value):
        values = torch.cat([self.values_buffer, next_value])
        adv = torch.zeros_like(self.rewards_buffer)
        last = 0
        for t in reversed(range(self.config.n_steps)):
            on = 1.0 - self.terminated_buffer[t]
            delta = self.rewards_buffer[t] + self.config.gamma * values[t + 1] * on - values[t]
            adv[t] = last = delta + self.config.gamma * self.config.gae_lambda * on * last
        return adv + self.rewards_buffer, adv

# === wrong: advantages are normalized here, which the course does later for each minibatch | normali[sz]|standardi[sz]|zero mean|mean 0|std\b|deviation
# --- instead of
        return adv + self.rewards_buffer, adv
# --- here
        returns = adv + self.values_buffer
        if adv.numel() > 1:
            adv = (adv - adv.mean()) / (adv.std() + 1e-8)
        return returns, adv

# === wrong: rewards_buffer is overwritten: advantages is another name for it | in place|changes|overw|modif|rewards_buffer|(written|changed)|clone|alias
import torch


class PPOTrainer:
    def calculate_advantages(self, next_value):
        advantages = self.rewards_buffer
        values = torch.cat([self.values_buffer, next_value])
        last = 0
        for t in reversed(range(self.config.n_steps)):
            on = 1.0 - self.terminated_buffer[t]
            delta = self.rewards_buffer[t] + self.config.gamma * values[t + 1] * on - values[t]
            last = delta + self.config.gamma * self.config.gae_lambda * on * last
            advantages[t] = last
        return advantages + self.values_buffer, advantages

# === wrong: `~` on flags that are floats | TypeError|bitwise|~|float|bool|integral
import torch


class PPOTrainer:
    def calculate_advantages(self, next_value):
        values = torch.cat([self.values_buffer, next_value])
        adv = torch.zeros_like(self.rewards_buffer)
        last = 0
        for t in reversed(range(self.config.n_steps)):
            on = ~self.terminated_buffer[t]
            delta = self.rewards_buffer[t] + self.config.gamma * values[t + 1] * on - values[t]
            adv[t] = last = delta + self.config.gamma * self.config.gae_lambda * on * last
        return adv + self.values_buffer, adv

# === wrong: self.gamma, which the trainer does not have: it is in the config | AttributeError|gamma|no attribute
import torch


class PPOTrainer:
    def calculate_advantages(self, next_value):
        values = torch.cat([self.values_buffer, next_value])
        adv = torch.zeros_like(self.rewards_buffer)
        last = 0
        for t in reversed(range(len(adv))):
            on = 1.0 - self.terminated_buffer[t]
            delta = self.rewards_buffer[t] + self.gamma * values[t + 1] * on - values[t]
            adv[t] = last = delta + self.gamma * self.gae_lambda * on * last
        return adv + self.values_buffer, adv

# === wrong: config.lam, which the config does not have: it is gae_lambda | AttributeError|\blam\b|no attribute|KeyError
# --- instead of
            delta = self.rewards_buffer[t] + self.gamma * values[t + 1] * on - values[t]
            adv[t] = last = delta + self.gamma * self.gae_lambda * on * last
# --- here
            delta = self.rewards_buffer[t] + self.config.gamma * values[t + 1] * on - values[t]
            adv[t] = last = delta + self.config.gamma * self.config.lam * on * last

# === wrong: values_buffer[t + 1] is read at the last row, too | IndexError|out of (bounds|range)|last (row|step)|index
import torch


class PPOTrainer:
    def calculate_advantages(self, next_value):
        adv = torch.zeros_like(self.rewards_buffer)
        last = 0
        for t in reversed(range(self.config.n_steps)):
            on = 1.0 - self.terminated_buffer[t]
            delta = self.rewards_buffer[t] + self.config.gamma * self.values_buffer[t + 1] * on - self.values_buffer[t]
            adv[t] = last = delta + self.config.gamma * self.config.gae_lambda * on * last
        return adv + self.values_buffer, adv

# === wrong: the loop ends before row 0 | row 0|first (row|step)|range|left out|never (filled|written|computed)|stays? (0|zero)
import torch


class PPOTrainer:
    def calculate_advantages(self, next_value):
        values = torch.cat([self.values_buffer, next_value])
        adv = torch.zeros_like(self.rewards_buffer)
        last = 0
        for t in range(self.config.n_steps - 1, 0, -1):
            on = 1.0 - self.terminated_buffer[t]
            delta = self.rewards_buffer[t] + self.config.gamma * values[t + 1] * on - values[t]
            adv[t] = last = delta + self.config.gamma * self.config.gae_lambda * on * last
        return adv + self.values_buffer, adv

# === wrong: the loop runs forwards over the rows | forward|backward|past|direction|order\b|revers
# --- instead of
        for t in range(self.config.n_steps - 1, 0, -1):
# --- here
        for t in range(self.config.n_steps):

# === wrong: axis 1 is taken for time: the chain runs along the environments | axis|dim|environments?\b.*(chain|next|along)|transpos|time\b|across
import torch


class PPOTrainer:
    def calculate_advantages(self, next_value):
        values = torch.cat([self.values_buffer, next_value])
        on = 1.0 - self.terminated_buffer
        delta = self.rewards_buffer + self.config.gamma * values[1:] * on - values[:-1]
        adv = torch.zeros_like(delta)
        last = 0
        for i in reversed(range(delta.shape[1])):
            last = delta[:, i] + self.config.gamma * self.config.gae_lambda * on[:, i] * last
            adv[:, i] = last
        return adv + self.values_buffer, adv

# === wrong: the sum over the environments is taken for the reward of each | sum|axis|dim|environments\b|each environment|other environment
import torch


class PPOTrainer:
    def calculate_advantages(self, next_value):
        values = torch.cat([self.values_buffer, next_value])
        adv = torch.zeros_like(self.rewards_buffer)
        last = 0
        for t in reversed(range(len(adv))):
            on = 1.0 - self.terminated_buffer[t]
            delta = self.rewards_buffer[t].sum() + self.config.gamma * values[t + 1] * on - values[t]
            adv[t] = last = delta + self.config.gamma * self.config.gae_lambda * on * last
        return adv + self.values_buffer, adv

# === wrong: nothing comes back: the results are kept as attributes | None|return(s|ed)? nothing|nothing (is|was|came)|no return|without a? ?return
import torch


class PPOTrainer:
    def calculate_advantages(self, next_value):
        values = torch.cat([self.values_buffer, next_value])
        self.advantages = torch.zeros_like(self.rewards_buffer)
        last = 0
        for t in reversed(range(self.config.n_steps)):
            on = 1.0 - self.terminated_buffer[t]
            delta = self.rewards_buffer[t] + self.config.gamma * values[t + 1] * on - values[t]
            self.advantages[t] = last = delta + self.config.gamma * self.config.gae_lambda * on * last
        self.returns = self.advantages + self.values_buffer

# === wrong: the advantages are multiplied by the mask, so that the row of a death has none | mask|terminat|death|\bends?\b|zero|own delta|own reward
import torch


class PPOTrainer:
    def calculate_advantages(self, next_value):
        values = torch.cat([self.values_buffer, next_value])
        adv = torch.zeros_like(self.rewards_buffer)
        last = 0
        for t in reversed(range(self.config.n_steps)):
            on = 1.0 - self.terminated_buffer[t]
            delta = self.rewards_buffer[t] + self.config.gamma * values[t + 1] - values[t]
            adv[t] = last = (delta + self.config.gamma * self.config.gae_lambda * last) * on
        return adv + self.values_buffer, adv

# === wrong: next_value is waited for in a loop that never ends | never end|time limit|endless|seconds|too long|did not (end|finish|return)|no end|still running|took
import torch


class PPOTrainer:
    def calculate_advantages(self, next_value):
        values = torch.cat([self.values_buffer, next_value])
        adv = torch.zeros_like(self.rewards_buffer)
        last, t = 0, self.config.n_steps
        while True:
            t = max(t - 1, 0)
            on = 1.0 - self.terminated_buffer[t]
            delta = self.rewards_buffer[t] + self.config.gamma * values[t + 1] * on - values[t]
            adv[t] = last = delta + self.config.gamma * self.config.gae_lambda * on * last
            if t < 0:
                break
        return adv + self.values_buffer, adv
