"""Takes a gradient apart into those of the terms in the equations' loss; where it is of others, finds the mistake."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lemniscate.data.rollout import QBatch, SoftBatch
from lemniscate.maths import clipped_surrogate, policy_gradient, td_target, value_loss
from lemniscate.nn.actor_critic import ActorCritic, Value
from lemniscate.nn.critics import CategoricalQ, Critics
from lemniscate.nn.networks import Bfloat16Linear
from lemniscate.nn.policies import Policy
from lemniscate.optim.adam import Adam
from lemniscate.run.config import RunConfig
from lemniscate.types import Batch, DrawnBatch, Transition

ROUNDING = 1e-6
"""the share of a gradient's squares above which what no term explains cannot be rounding; healthy runs have 1e-12"""
MOST_PARAMETERS = 5_000_000
"""beyond which gradients are not taken apart, of which each term has a copy in float64"""


def gradient_signals(
    config: RunConfig, state: Any, optimizer: Adam, gradient: Tensor, args: tuple[Any, ...]
) -> dict[str, Tensor]:
    """What a gradient [P] is made of: the gradients of the terms in the equations' loss, by least squares.

    - gradient/policy, gradient/value: the weights of the terms in which actions, and V or Q, are judged.
    - gradient/entropy: the part that raises the entropy, as a signed share of the length of the policy's gradient.
    - gradient/policy_rest, gradient/value_rest: the share of the squares that no term explains, among the parameters
      that the terms move.
    """
    parameters, found = optimizer.parameters, dict[str, Tensor]()
    if len(gradient) > MOST_PARAMETERS or any(isinstance(m, Bfloat16Linear) for m in optimizer.networks.modules()):
        return found  # whose rounding is no share of 1e-12
    with torch.enable_grad():
        terms = loss_terms(config, state, optimizer.networks, *args)
        slopes = {
            name: torch.autograd.grad(term, parameters, retain_graph=True, allow_unused=True, materialize_grads=True)
            for name, term in terms.items()
            if term.requires_grad  # not of frozen networks
        }
    columns = {name: torch.cat([each.flatten() for each in slope]).cpu().double() for name, slope in slopes.items()}
    for part in (("policy", "entropy", "kl", "baseline"), ("value",)):
        own = {name: columns[name] for name in part if name in columns and columns[name].any()}
        moved = torch.stack([*own.values()]).any(0) if own else torch.zeros(len(gradient), dtype=torch.bool)
        whole = gradient.cpu().double()[moved]
        if part[0] in own and not whole.any():
            found[f"gradient/{part[0]}"] = whole.sum()
        elif whole.any():
            its = torch.stack([column[moved] for column in own.values()], 1)
            weights, found[f"gradient/{part[0]}_rest"] = fitted(its, whole)
            known = {name: weights[k] for k, name in enumerate(own) if _stands_alone(its, k, whole)}
            found |= {f"gradient/{part[0]}": known[part[0]]} if part[0] in known else {}
            if "entropy" in known:
                found["gradient/entropy"] = known["entropy"] * own["entropy"].norm() / whole.norm()
    return found


def _stands_alone(columns: Tensor, k: int, whole: Tensor) -> bool:
    """Whether the weight of column k of [P, K] is determined: it is not too small, and no other column is parallel.

    Those of a policy that has seen one observation alone are: its advantages and its entropy turn it the same way.
    """
    alike = torch.cosine_similarity(columns, columns[:, k : k + 1], 0).abs()
    return bool(columns[:, k].norm() > 1e-5 * whole.norm() and (alike > 0.999).sum() == 1)


def loss_terms(config: Any, state: Any, networks: Any, batch: Any, *noise: Tensor) -> dict[str, Tensor]:
    """The terms of the equations' loss for networks and rows [M, …], scalars to descend; none where it is unknown.

    "policy" judges actions, "value" V or Q, "entropy" is that of the policy with a minus, "kl" what holds it back, and
    "baseline" what a mean of the advantages does. Not known are TRPO's surrogate, temperatures and multipliers.
    """
    if isinstance(batch, Batch):
        return _advantage_terms(config, networks, batch)
    if isinstance(batch, SoftBatch) and isinstance(networks, Policy):
        distribution = networks(batch.obs)
        action, log_prob = distribution.sample_with_log_prob(*noise)
        kl, alpha = batch.kl_to(distribution), state.networks.multipliers().detach()[0]
        near, q = kl < config.max_kl, state.networks.critic(batch.obs, action)
        parts = {"policy": -q * near, "entropy": alpha * log_prob * near, "kl": kl * ~near}
        return {name: part.mean() for name, part in parts.items()}
    if isinstance(batch, QBatch) and isinstance(networks, Value):  # SHAC
        return {"value": value_loss(networks(batch.obs), batch.target)}
    if isinstance(batch, QBatch):
        soft = isinstance(networks, CategoricalQ)
        pair = batch.action, batch.target
        loss = networks.loss(batch.obs, *pair)[0] if soft else value_loss(networks.q(batch.obs, pair[0]), pair[1])
        return {"value": loss}
    if isinstance(batch, Transition) and isinstance(networks, Critics):
        with torch.set_grad_enabled(isinstance(state, Online) and state.follows):
            value, bonus = _next_of_q(config, state, batch, *noise)
            target = td_target(batch.reward, value + bonus, batch.terminated, gamma=config.gamma)
        return {"value": torch.stack([q.loss(batch.obs, batch.action, target)[0] for q in networks.members]).sum()}
    if isinstance(batch, Transition) and isinstance(networks, Policy):
        policy, critics = networks(batch.obs), state.networks.critics
        if not hasattr(state.networks, "temperature"):
            return {"policy": -critics.first(batch.obs, policy.mode()).mean()}
        action, log_prob = policy.sample_with_log_prob(*noise)
        alpha = state.networks.temperature().detach()
        return {"policy": -critics(batch.obs, action).amin(0).mean(), "entropy": (alpha * log_prob).mean()}
    return {}


def _advantage_terms(config: Any, networks: Any, batch: Batch) -> dict[str, Tensor]:
    """The terms of a policy that follows the advantages of rows [M, …], and of the V(s) beside it, if there is one."""
    of_both = networks(batch.obs)
    distribution, value = of_both if isinstance(networks, ActorCritic) else (of_both, of_both)
    terms = dict[str, Tensor]()
    if not isinstance(networks, Value):
        log_prob, advantage = distribution.log_prob(batch.action), batch.advantage
        if isinstance(batch, DrawnBatch):
            clip = getattr(config, "clip", math.inf)
            terms["policy"] = clipped_surrogate(log_prob - batch.log_prob, advantage, clip)
        else:
            terms["policy"] = policy_gradient(log_prob, advantage)
        terms |= {"entropy": -distribution.entropy().mean(), "baseline": -log_prob.mean()}
    if not isinstance(networks, Policy):
        terms["value"] = value_loss(value, batch.target, batch.value, getattr(config, "clip_value", None))
    return terms


def _next_of_q(config: Any, state: Any, batch: Transition, *noise: Tensor) -> tuple[Tensor, Tensor]:
    """What Q says of the next step in DDPG, TD3 and SAC, and what the entropy of the next action is worth, [M]."""
    if hasattr(state.networks, "temperature"):
        action, log_prob = state.networks.policy(batch.next_obs).sample_with_log_prob(*noise)
        next_value, bonus = state.targets(batch.next_obs, action).amin(0), -state.networks.temperature() * log_prob
    else:
        policy, limit = state.targets.policy(batch.next_obs), getattr(config, "target_noise_clip", 0.0)
        smoothing = [(config.target_noise * each).clamp(-limit, limit) for each in noise]
        action = policy.sample(*smoothing) if smoothing else policy.mode()
        next_value, bonus = state.targets.critics(batch.next_obs, action).amin(0), torch.zeros_like(batch.reward)
    return next_value, bonus


def fitted(columns: Tensor, whole: Tensor) -> tuple[Tensor, Tensor]:
    """The weights [K] of columns [P, K] in [P], by least squares, and the share of its squares that they leave."""
    weights = torch.linalg.lstsq(columns, whole[:, None], driver="gelsd").solution[:, 0]
    return weights, (whole - columns @ weights).square().sum() / whole.square().sum()


def difference(given: Tensor, right: Tensor) -> Tensor:
    """The squares of what numbers [B] differ by from those that are right, as a share of their squares."""
    return (given - right).square().mean() / given.square().mean().clamp(min=1e-12)


class Online(NamedTuple):
    """A training state with other target networks, with a gradient through them or without one."""

    networks: Any
    targets: Any
    follows: bool


def mistake_signals(
    config: RunConfig, state: Any, optimizer: Adam, gradient: Tensor, before: Tensor, args: tuple[Any, ...]
) -> dict[str, Tensor]:
    """The share of a gradient's squares that no term explains if a well-known mistake was made: "gradient/if_…".

    - ends_ignored: Q awaits something behind terminations, too.
    - mean_target: each value has the mean of all targets, as where [B, 1] less [B] is [B, B].
    - other_rows: an action, a target, a reward or a next observation is of the row beside, or of the reverse order.
    - other_action: Q(s, ·) of another action is moved.
    - online_target, followed_target: y is of Q itself; and the gradient goes through it.
    - own_obs, own_action: y is of s in the place of s'; Q is of the policy's action in the place of the stored one.
    - other_critic: y is of the larger of two critics, of their mean or of one of them.
    - advantage_target: V is to say the advantages.
    - no_clip, largest_clip: no ratio is clipped, or the larger of r A and clip(r) A is taken.
    - not_zeroed: the gradient [P] is added to the one `before`, [P].

    Also what `target_signals` finds.
    """
    batch, *noise = args
    parts = gradient_signals(config, state, optimizer, gradient, args)
    left: dict[str, list[dict[str, Tensor]]] = {}
    if len(before) == len(gradient) and before.any():
        left["not_zeroed"] = [gradient_signals(config, state, optimizer, gradient - before, args)]
    for name, its_config, its_state, rows in _mistaken(config, state, batch):
        left.setdefault(name, []).append(gradient_signals(its_config, its_state, optimizer, gradient, (rows, *noise)))
    rests, one = [name for name in parts if name.endswith("_rest")], torch.ones((), dtype=torch.float64)
    found = {
        f"gradient/if_{name}": torch.stack(
            [torch.stack([each.get(rest, one) for rest in rests]).max() for each in variants]
        ).min()
        for name, variants in left.items()
    }
    if "gradient/value_rest" in parts:
        found |= target_signals(config, state, optimizer, gradient, args)
    return found


def _mistaken(config: Any, state: Any, batch: Any) -> Iterator[tuple[str, Any, Any, Any]]:
    """Names of mistakes, with the Config, the state and the rows of which they would be right."""
    if isinstance(batch, Transition):
        yield from ((name, config, its, rows) for name, its, rows in _mistaken_of_q(state, batch))
    if isinstance(batch, DrawnBatch) and hasattr(config, "clip"):
        yield "no_clip", replace(config, clip=1e9), state, batch
        yield "largest_clip", config, state, replace(batch, advantage=-batch.advantage)
    if isinstance(batch, Batch):
        yield "advantage_target", config, state, replace(batch, target=batch.advantage)
    if isinstance(batch, Batch | QBatch):
        yield "mean_target", config, state, replace(batch, target=batch.target.mean().expand_as(batch.target))
    if type(batch) is QBatch:
        choices = int(batch.action.max()) + 1
        for k in range(1, choices):
            yield "other_action", config, state, replace(batch, action=(batch.action + k) % choices)
    for column in {"action", "target", "reward", "next_obs"} & vars(batch).keys():
        x = getattr(batch, column)
        for moved in (x.roll(1, 0), x.roll(-1, 0), x.flip(0)):
            yield "other_rows", config, state, replace(batch, **{column: moved})


def _mistaken_of_q(state: Any, batch: Transition) -> Iterator[tuple[str, Any, Any]]:
    """Names of mistakes of DDPG, TD3 and SAC, with the state and the rows of which they would be right."""
    networks, of_policy = state.networks, hasattr(state.targets, "critics")
    targets = networks if of_policy else networks.critics
    yield "online_target", Online(networks, targets, False), batch
    yield "followed_target", Online(networks, targets, True), batch
    yield "own_obs", state, replace(batch, next_obs=batch.obs)
    yield "own_action", state, replace(batch, action=networks.policy(batch.obs).mode().detach())
    if batch.terminated.any():
        yield "ends_ignored", state, replace(batch, terminated=torch.zeros_like(batch.terminated))
    judges = (lambda q: q.amax(0), lambda q: q.mean(0), lambda q: q[0], lambda q: q[1])
    for judge in judges if len(networks.critics.members) > 1 else ():
        judged = Judged(state.targets.critics if of_policy else state.targets, judge)
        targets = SimpleNamespace(policy=state.targets.policy, critics=judged) if of_policy else judged
        yield "other_critic", Online(networks, targets, False), batch


class Judged(NamedTuple):
    """Target networks that are taken for one: `judge` takes what they say, [C, M], to [M]."""

    critics: Any
    judge: Callable[[Tensor], Tensor]

    def __call__(self, obs: Tensor, action: Tensor) -> Tensor:
        """[M, O] and [M, A] to [1, M]."""
        return self.judge(self.critics(obs, action))[None]


def target_signals(
    config: Any, state: Any, optimizer: Adam, gradient: Tensor, args: tuple[Any, ...]
) -> dict[str, Tensor]:
    """What differs in the targets of V or Q, by the gradient [P] that they make, where that is one thing alone.

    - targets/other_rewards, targets/discount: as of `updates.recursion_signals`, of Q(s, a) of continuous actions.
    - targets/entropy: how often the entropy of the next action counts there.
    - targets/rescaled: the difference of a y + b, which stands there for y, from y, as a share of its squares; of V and
      of Q(s, ·).
    """
    batch, *noise = args
    networks: Any = optimizer.networks
    of_q = isinstance(batch, Transition)
    with torch.no_grad():
        next_value, bonus = _next_of_q(config, state, batch, *noise) if of_q else (torch.zeros(1), torch.zeros(1))
        wanted, ahead = (batch.reward, ~batch.terminated * config.gamma) if of_q else (batch.target, torch.zeros(1))
    with torch.enable_grad():
        if of_q:
            said = networks(batch.obs, batch.action)
        elif isinstance(batch, QBatch):
            said = networks.q(batch.obs, batch.action)
        else:
            said = networks(batch.obs)[1] if isinstance(networks, ActorCritic) else networks(batch.obs)
        parts = [
            said.detach(),
            -wanted,
            -torch.ones_like(wanted),
            *((-ahead * next_value, -ahead * bonus) if of_q else ()),
        ]
        grad = partial(torch.autograd.grad, inputs=optimizer.parameters, retain_graph=True, materialize_grads=True)
        slopes = [grad((part * said).mean(-1).sum(), allow_unused=True) for part in parts]
    columns = torch.stack([torch.cat([each.flatten() for each in slope]) for slope in slopes], 1).cpu().double()
    moved = columns.any(1)
    weights, rest = fitted(columns[moved], gradient.cpu().double()[moved])
    if rest > ROUNDING:
        return {}
    a, b, *others = (weights[1:] / weights[0]).tolist()
    wanted = wanted.cpu().double()
    other = difference(a * wanted + b, wanted)
    if not of_q:
        return {"targets/rescaled": other}
    if abs(a) < 1e-3 and abs(others[0]) < 1e-3:  # a number for all rows
        return {"gradient/if_mean_target": rest}
    if min(abs(a - 1), abs(others[0] - 1)) > 1e-2:  # two things at once, or a fit that says nothing
        return {}
    found = {"targets/discount": torch.tensor(config.gamma * others[0]), "targets/other_rewards": other}
    return found | ({"targets/entropy": torch.tensor(others[1] / others[0])} if bonus.any() else {})
