"""Trust region policy optimization: Schulman et al. 2015, arXiv:1502.05477.

Collect a rollout, move the policy along the natural gradient as far as a bound on the KL allows, fit the value.
Departures from the paper, and why: docs/notes/trpo.md.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import torch
from torch import Tensor
from torch.func import grad

from lemniscate.data.rollout import collect, epoch_minibatches, one_minibatch, rows_of
from lemniscate.maths import backtrack, explained_variance, gae, means, natural_step, standardize, surrogate, value_loss
from lemniscate.nn.actor_critic import ActorCritic, Value
from lemniscate.nn.normalizer import RewardScale
from lemniscate.optim.adam import Adam, PolicyVector, linear
from lemniscate.run.config import Count, Fraction, NonNegative, Positive, Range, Repeats, Scheduled
from lemniscate.run.on_policy import OnPolicyState, RecurrentConfig
from lemniscate.run.run import Run
from lemniscate.spec import Spec
from lemniscate.types import Batch, Loss, Metrics, Rollout


@dataclass(frozen=True, kw_only=True)
class Config(RecurrentConfig):
    """The settings of TRPO."""

    num_steps: Count = 64
    """steps of each environment between updates, T; usually 64 to 1024"""
    max_kl: Scheduled[Positive] = 0.01
    """δ, the largest mean KL from the old policy to the new one in an update; usually 0.005 to 0.03"""
    line_search: bool = True
    """backtracking line search; without it this is the natural policy gradient"""
    shrink: Annotated[float, Range(0.01, 0.99)] = 0.8
    """backtracking factor of the step length; usually 0.5 to 0.8"""
    attempts: Repeats = 10
    """step lengths tried before the policy stays as it is; usually 10"""
    cg_iterations: Repeats = 10
    """iterations of the conjugate gradient; usually 10 to 25"""
    damping: NonNegative = 0.1
    """added to the diagonal of the Fisher matrix; usually 0.01 to 0.1"""
    gae_lambda: Fraction = 0.95
    """trace decay λ of the advantage estimate; usually 0.9 to 1"""
    normalize_advantage: bool = True
    """standardize advantages within each rollout"""
    critic_epochs: Repeats = 20
    """passes of the value over each rollout; usually 5 to 80"""
    critic_minibatch_size: Count = 128
    """rows of each gradient step of the value; usually 64 to 512"""
    critic_learning_rate: Scheduled[Positive] = 1e-3
    """initial step size of the value's Adam; usually 3e-4 to 3e-3"""
    final_critic_learning_rate: Fraction = 1.0
    """final critic learning rate as a fraction of the initial one, annealed linearly; 1: constant"""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_minibatch("critic_minibatch_size")
        self._require_rows("normalize_advantage", self.num_rows)


@dataclass(kw_only=True)
class State(OnPolicyState[ActorCritic]):
    """The training state of TRPO."""

    critic_optimizer: Adam

    def __post_init__(self) -> None:
        self.parameters = PolicyVector(self.policy)  # θ

    def per_step_methods(self) -> list[tuple[object, str]]:
        """The methods of every state, and the Fisher product."""
        return [*super().per_step_methods(), (self.parameters, "fisher")]


def init(config: Config, spec: Spec, device: torch.device) -> State:
    """A new state, seeded by the run's seed."""
    networks = config.make_networks(spec, device)
    return State(
        networks=networks,
        critic_optimizer=Adam(networks.value, name="value"),
        reward_scale=RewardScale(config.num_envs, config.gamma).to(device),
        rng=config.generators(device),
        learn=learn,
    )


@torch.no_grad()
def advantages(config: Config, networks: ActorCritic, rollout: Rollout) -> Batch:
    """The rows of a rollout with V(s), advantage and value target (arXiv:1506.02438, eq. 16)."""
    value, next_value = networks.estimates(rollout.obs, rollout.next_obs)
    gamma, lam = config.gamma, config.gae_lambda
    advantage, target = gae(rollout.reward, value, next_value, rollout.terminated, rollout.done, gamma=gamma, lam=lam)
    batch = Batch(rollout.obs, rollout.action, value, advantage, target)
    return batch.flatten()  # [T, N, …] -> [B, …]


def critic_loss(value: Value, batch: Batch) -> Loss:
    """½ (V(s) − target)², and its metrics."""
    loss = value_loss(value(batch.obs), batch.target)
    return loss, {"losses/value": loss.detach()}


def improve(config: Config, state: State, batch: Batch, fisher_obs: Tensor) -> dict[str, Tensor | float]:
    """Maximize L(θ) subject to KL(θ_old ‖ θ) ≤ δ, to first and to second order (eq. 14, appendix C).

    L and the KL are means over the rows of `batch`, the Fisher matrix over `fisher_obs`.
    """
    here, pi = state.parameters.vector.clone(), state.parameters.at
    if config.normalize_advantage:
        batch = replace(batch, advantage=standardize(batch.advantage.flatten()).view_as(batch.advantage))

    with torch.no_grad():
        old_log_prob = pi(here, batch.obs).log_prob(batch.action)

    def loss(theta: Tensor) -> Tensor:
        return surrogate(pi(theta, batch.obs).log_prob(batch.action) - old_log_prob, batch.advantage)

    def kl(theta: Tensor) -> Tensor:
        return pi(here, batch.obs).kl(pi(theta, batch.obs)).mean()

    def fisher(vector: Tensor) -> Tensor:
        return state.parameters.fisher(vector, fisher_obs) + config.damping * vector

    gradient = grad(loss)(here)
    with torch.no_grad():
        step = natural_step(fisher, gradient, config.max_kl, iterations=config.cg_iterations)
        limits = {"max_kl": config.max_kl, "shrink": config.shrink, "attempts": config.attempts}
        there, fraction = here + step, 1.0
        if config.line_search:
            there, fraction = backtrack(lambda theta: (loss(theta), kl(theta)), here, step, **limits)
        metrics: dict[str, Tensor | float] = {"losses/policy": loss(there), "kl": kl(there), "step_fraction": fraction}
        metrics |= {"losses/entropy": pi(here, batch.obs).entropy().mean(), "gradient_norm": gradient.norm()}
        state.parameters.vector.copy_(there)
    return metrics


def learn(config: Config, state: State, batch: Batch, minibatches: Tensor) -> list[Metrics]:
    """A gradient step of the value on each minibatch, rows [K, M] of the batch."""
    return [state.critic_optimizer.step(critic_loss, batch[rows]) for rows in minibatches]


def update(config: Config, state: State, rollout: Rollout) -> dict[str, Tensor | float]:
    """One step of the policy on one rollout, some epochs of the value; returns the metrics."""
    rate = linear(config.critic_learning_rate, config.final_critic_learning_rate, state.step / config.total_steps)
    state.critic_optimizer.learning_rate = rate
    config = state.apply_schedules(config) if config.schedules else config
    if config.scale_rewards:
        rollout = state.reward_scale.scale(rollout)
    batch, rows = advantages(config, state.networks, rollout), rows_of(rollout, state.networks.piece_length)
    same_size = one_minibatch(rows, rollout.num_rows)[0]  # in every update, since the product is compiled
    metrics = improve(config, state, batch[rows], batch.obs[same_size])
    size = config.critic_minibatch_size
    for _ in range(config.critic_epochs):
        minibatches = epoch_minibatches(rows, rollout.num_rows, size, state.rng.minibatch)
        metrics |= means(state.learn(config, state, batch, minibatches))
    state.networks.policy.observe(rollout.obs, rollout.valid)  # last: old and new probabilities share a normalizer
    state.step += config.num_steps * config.num_envs
    valid_rows = rollout.valid_rows
    explained = explained_variance(batch.value[valid_rows], batch.target[valid_rows])
    return {**metrics, **state.networks.policy.metrics(), "explained_variance": explained, "learning_rate": rate}


def train(config: Config, run: Run) -> State:
    """Algorithm 1: collect with π_old, update, repeat."""
    state = run.restore(init(config, run.spec, run.env.device))
    for env in run.until(config.total_steps, state):
        rollout = collect(env, state.networks.policy, config.num_steps, state.rng.action)
        run.log(state, update(config, state, rollout), env.take_episodes())
    return state
