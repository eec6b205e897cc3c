# === right: the critic's output is flattened, sums divided by the batch
import torch


class PPO:
    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        n = states.size(0)
        logits = self.actor(states)
        new = logits.gather(1, actions.view(-1, 1)).view(-1) - logits.logsumexp(1)
        r = (new - log_probs_old).exp()
        a, b = r * advantages, r.clip(1 - self.epsilon, 1 + self.epsilon) * advantages
        gap = torch.relu(a - b)
        actor = (gap - a).sum() / n
        v = self.critic(states).flatten()
        return actor, torch.sum((v - critic_targets) ** 2) / n

# === right: a child class with another network, the method stands in the parent
# solution: LanderPPO.compute_loss
import torch
from torch import nn


class PPO(nn.Module):
    def __init__(self, state_dim, num_actions, gamma, lmbda, epsilon, num_steps):
        super().__init__()
        self.gamma = gamma
        self.lmbda = lmbda
        self.epsilon = epsilon
        self.num_steps = num_steps
        self.build(state_dim, num_actions)

    def build(self, state_dim, num_actions):
        raise NotImplementedError

    def compute_log_probs(self, states, actions):
        log_probs = self.actor(states).log_softmax(-1)
        return torch.take_along_dim(log_probs, actions[:, None], dim=1)[:, 0]

    def compute_values(self, states):
        return self.critic(states).squeeze(-1)

    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        ratios = torch.exp(self.compute_log_probs(states, actions) - log_probs_old.detach())
        objective = torch.min(
            ratios * advantages.detach(),
            torch.clamp(ratios, min=1 - self.epsilon, max=1 + self.epsilon) * advantages.detach(),
        )
        return -objective.mean(), nn.MSELoss()(self.compute_values(states), critic_targets.detach())


class LanderPPO(PPO):
    def build(self, state_dim, num_actions):
        self.actor = nn.Sequential(nn.Linear(state_dim, 32), nn.Tanh(), nn.Linear(32, num_actions))
        self.critic = nn.Sequential(nn.Linear(state_dim, 32), nn.Tanh(), nn.Linear(32, 1))

# === right: a shared function of the module, another name for self, a decorator with wraps
from functools import wraps

import torch


def as_tuple(method):
    @wraps(method)
    def inner(self, *args, **kwargs):
        return tuple(method(self, *args, **kwargs))

    return inner


def clipped_objective(ratio, advantage, eps):
    return torch.fmin(ratio * advantage, torch.clip(ratio, 1 - eps, 1 + eps) * advantage)


class PPO:
    @as_tuple
    def compute_loss(agent, states, actions, advantages, critic_targets, log_probs_old):
        ratio = (agent.compute_log_probs(states, actions) - log_probs_old).exp()
        yield -clipped_objective(ratio, advantages, agent.epsilon).mean()
        yield (agent.compute_values(states) - critic_targets).square().mean()

# === right: the ratio as a quotient of probabilities, by softmax
import torch


class PPO:
    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        probs = torch.softmax(self.actor(states), dim=-1)
        mask = torch.nn.functional.one_hot(actions, probs.shape[-1]).to(probs.dtype)
        pi = (probs * mask).sum(-1)
        ratio = pi / torch.exp(log_probs_old)
        upper = torch.clamp(ratio, max=1 + self.epsilon)
        lower = torch.clamp(ratio, min=1 - self.epsilon)
        actor_loss = torch.mean(-torch.where(advantages >= 0, upper, lower) * advantages)
        delta = critic_targets - self.compute_values(states)
        critic_loss = torch.linalg.vector_norm(delta) ** 2 / delta.numel()
        return actor_loss, critic_loss

# === right: extra optional arguments and unused extras
import torch


class PPO:
    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old, epsilon=None, verbose=False):
        epsilon = self.epsilon if epsilon is None else epsilon
        ratio = torch.exp(self.compute_log_probs(states, actions) - log_probs_old)
        fraction = ((ratio - 1).abs() > epsilon).float().mean().item()
        if verbose:
            print(f"clip fraction {fraction:.2f}")
        loss = torch.maximum(-advantages * ratio, -advantages * torch.clamp(ratio, 1 - epsilon, 1 + epsilon))
        return loss.mean(), torch.pow(self.compute_values(states) - critic_targets, 2).mean()

# === wrong: the log-probabilities are computed without gradient | no gradient|without.{0,12}gradient|gradients? .{0,40}(miss|lost|cut|stop|disabled|\bno\b|noth|detach)|detach|no_grad|requires_grad|backward|grad_fn|differentia
import torch


class PPO:
    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        with torch.no_grad():
            log_probs = self.compute_log_probs(states, actions)
        ratio = torch.exp(log_probs - log_probs_old)
        actor_loss = -torch.min(ratio * advantages, ratio.clamp(1 - self.epsilon, 1 + self.epsilon) * advantages).mean()
        critic_loss = ((critic_targets - self.compute_values(states)) ** 2).mean()
        return actor_loss, critic_loss

# === wrong: the values of the critic are detached, the stop-gradient on the wrong side | no gradient|without.{0,12}gradient|gradients? .{0,40}(miss|lost|cut|stop|disabled|\bno\b|noth|detach)|detach|no_grad|requires_grad|backward|grad_fn|differentia
import torch


class PPO:
    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        ratio = torch.exp(self.compute_log_probs(states, actions) - log_probs_old)
        actor_loss = -torch.min(ratio * advantages, ratio.clamp(1 - self.epsilon, 1 + self.epsilon) * advantages).mean()
        critic_loss = ((critic_targets - self.compute_values(states).detach()) ** 2).mean()
        return actor_loss, critic_loss

# === wrong: values [B, 1] against targets [B]: every value with every target | broadcast|shape|outer|each|pair|B, ?1|squeeze|column
# --- instead of
        critic_loss = ((critic_targets - self.compute_values(states).detach()) ** 2).mean()
# --- here
        critic_loss = ((critic_targets - self.critic(states)) ** 2).mean()

# === wrong: L1 for the critic | \babs|squar|\*\* ?2|MSE|\bL1
import torch
import torch.nn.functional as F


class PPO:
    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        ratio = torch.exp(self.compute_log_probs(states, actions) - log_probs_old)
        actor_loss = -torch.min(ratio * advantages, ratio.clamp(1 - self.epsilon, 1 + self.epsilon) * advantages).mean()
        return actor_loss, F.l1_loss(self.compute_values(states), critic_targets)

# === wrong: smooth L1 for the critic, as in DQN | \babs|squar|\*\* ?2|MSE|\bL1|huber|half|halve|½|factor|twice|times (too|as|what)|0\.5 ?[·*×]|[·*×/] ?(2|0\.5)\b|\b2 ?[·*×]
# --- instead of
        return actor_loss, F.l1_loss(self.compute_values(states), critic_targets)
# --- here
        return actor_loss, F.smooth_l1_loss(self.compute_values(states), critic_targets)

# === wrong: epsilon is written as 0.1, not self.epsilon | ignor|hard|constant|fixed|whatever|does not (depend|change|use|follow)|not used|unused|always|another (clip|coef|eps)|(clip|coef|epsilon|config).{0,30}(not|other|another)
import torch


class PPO:
    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        epsilon = 0.1
        ratio = torch.exp(self.compute_log_probs(states, actions) - log_probs_old)
        actor_loss = -torch.min(ratio * advantages, ratio.clamp(1 - epsilon, 1 + epsilon) * advantages).mean()
        critic_loss = ((critic_targets - self.compute_values(states)) ** 2).mean()
        return actor_loss, critic_loss

# === wrong: an entropy bonus is in the actor's loss | entropy|bonus|extra|add
import torch


class PPO:
    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        dist = torch.distributions.Categorical(logits=self.actor(states))
        ratio = torch.exp(dist.log_prob(actions) - log_probs_old)
        actor_loss = -torch.min(ratio * advantages, ratio.clamp(1 - self.epsilon, 1 + self.epsilon) * advantages).mean()
        actor_loss = actor_loss - 0.01 * dist.entropy().mean()
        critic_loss = ((critic_targets - self.compute_values(states)) ** 2).mean()
        return actor_loss, critic_loss

# === wrong: the scores of the actor are taken for log-probabilities | softmax|normali|log.?prob|logit|score|log.?sum
import torch


class PPO:
    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        scores = self.actor(states)
        log_probs = scores.gather(1, actions.unsqueeze(1)).squeeze(1)
        ratio = torch.exp(log_probs - log_probs_old)
        actor_loss = -torch.min(ratio * advantages, ratio.clamp(1 - self.epsilon, 1 + self.epsilon) * advantages).mean()
        critic_loss = ((critic_targets - self.compute_values(states)) ** 2).mean()
        return actor_loss, critic_loss

# === wrong: log-probabilities of the likeliest action, not of the one that was taken | action|argmax|max|taken|likeliest
# --- instead of
        scores = self.actor(states)
        log_probs = scores.gather(1, actions.unsqueeze(1)).squeeze(1)
# --- here
        log_probs = torch.log_softmax(self.actor(states), dim=1).max(dim=1).values

# === wrong: log_probs_old is replaced by the present ones, so the ratio is always 1 | \bold\b|log_probs_old.{0,30}(not|ignor|unused)|always|ratio is 1|π_?old|present|clipp|not clip|no clip|unclip|clip.{0,20}(missing|absent|lacks|forgotten|not)|(missing|without|lacks|forgot).{0,20}clip
import torch


class PPO:
    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        log_probs = self.compute_log_probs(states, actions)
        log_probs_old = log_probs.detach()
        ratio = torch.exp(log_probs - log_probs_old)
        actor_loss = -torch.min(ratio * advantages, ratio.clamp(1 - self.epsilon, 1 + self.epsilon) * advantages).mean()
        critic_loss = ((critic_targets - self.compute_values(states)) ** 2).mean()
        return actor_loss, critic_loss

# === wrong: log_probs_old is exponentiated, the new ones are not | exp|log|ratio
import torch


class PPO:
    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        ratio = self.compute_log_probs(states, actions) / torch.exp(log_probs_old)
        actor_loss = -torch.min(ratio * advantages, ratio.clamp(1 - self.epsilon, 1 + self.epsilon) * advantages).mean()
        critic_loss = ((critic_targets - self.compute_values(states)) ** 2).mean()
        return actor_loss, critic_loss

# === wrong: the advantages are normalised | normali|standard|mean|std|deviation
# --- instead of
        ratio = self.compute_log_probs(states, actions) / torch.exp(log_probs_old)
# --- here
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        ratio = torch.exp(self.compute_log_probs(states, actions) - log_probs_old)

# === wrong: the actor is trained on an advantage through which the gradient reaches the critic | actor.{0,60}(depend|reach|gradient).{0,60}critic|critic.{0,20}(parameters|network|weights)|advantages?.{0,30}(gradient|detach)|gradient.{0,40}(critic|advantage)|detach
import torch


class PPO:
    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        values = self.compute_values(states)
        advantages = advantages + values.detach() - values
        ratio = torch.exp(self.compute_log_probs(states, actions) - log_probs_old)
        actor_loss = -torch.min(ratio * advantages, ratio.clamp(1 - self.epsilon, 1 + self.epsilon) * advantages).mean()
        critic_loss = ((critic_targets - values) ** 2).mean()
        return actor_loss, critic_loss

# === wrong: the critic is fitted to the advantages, not to the targets | advantages?|critic_targets|target
import torch


class PPO:
    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        ratio = torch.exp(self.compute_log_probs(states, actions) - log_probs_old)
        actor_loss = -torch.min(ratio * advantages, ratio.clamp(1 - self.epsilon, 1 + self.epsilon) * advantages).mean()
        critic_loss = ((advantages - self.compute_values(states)) ** 2).mean()
        return actor_loss, critic_loss

# === wrong: sums in place of means, in both | \bsum|mean|averag|batch|times too|divid
import torch


class PPO:
    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        ratio = torch.exp(self.compute_log_probs(states, actions) - log_probs_old)
        actor_loss = -torch.min(ratio * advantages, ratio.clamp(1 - self.epsilon, 1 + self.epsilon) * advantages).sum()
        critic_loss = ((critic_targets - self.compute_values(states)) ** 2).sum()
        return actor_loss, critic_loss

# === wrong: a name from another notebook, self.policy | AttributeError|policy|has no|attribute
import torch
from torch import nn


class PPO(nn.Module):
    def __init__(self, state_dim, num_actions, gamma, lmbda, epsilon, num_steps):
        super().__init__()
        self.gamma, self.lmbda, self.epsilon, self.num_steps = gamma, lmbda, epsilon, num_steps
        self.actor = nn.Linear(state_dim, num_actions)
        self.critic = nn.Linear(state_dim, 1)

    def compute_values(self, states):
        return self.critic(states).squeeze(-1)

    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        log_probs = self.policy(states).log_softmax(-1).gather(-1, actions[:, None])[:, 0]
        ratio = torch.exp(log_probs - log_probs_old)
        actor_loss = -torch.min(ratio * advantages, ratio.clamp(1 - self.epsilon, 1 + self.epsilon) * advantages).mean()
        return actor_loss, ((critic_targets - self.compute_values(states)) ** 2).mean()

# === wrong: the losses are floats, for the plot | no gradient|without.{0,12}gradient|gradients? .{0,40}(miss|lost|cut|stop|disabled|\bno\b|noth|detach)|detach|no_grad|requires_grad|backward|grad_fn|differentia|tensor|float|\bitem
import torch


class PPO:
    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        ratio = torch.exp(self.compute_log_probs(states, actions) - log_probs_old)
        actor_loss = -torch.min(ratio * advantages, ratio.clamp(1 - self.epsilon, 1 + self.epsilon) * advantages).mean()
        critic_loss = ((critic_targets - self.compute_values(states)) ** 2).mean()
        return actor_loss.item(), critic_loss.item()

# === wrong: only the clip's upper side, wrong where the advantage is negative | negativ|lower|below|1.?[-−].?(clip|ε|eps)|both
import torch


class PPO:
    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        ratio = torch.exp(self.compute_log_probs(states, actions) - log_probs_old)
        bounded = torch.minimum(ratio, torch.as_tensor(1 + self.epsilon))
        actor_loss = -torch.min(ratio * advantages, bounded * advantages).mean()
        critic_loss = torch.square(critic_targets - self.compute_values(states)).mean()
        return actor_loss, critic_loss
