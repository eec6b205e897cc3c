"""Compares an update of a run with the equations: the rows that it took, its targets, and its gradients.

`Watched` stands in the place of an algorithm's `learn` meanwhile. A healthy update fulfils the equations to rounding;
one with a mistake in a loss, in the targets or in the order of rows does not, whatever the environment.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.func import functional_call

from lemniscate.data.rollout import QBatch, SoftBatch
from lemniscate.maths import clipped_surrogate, explained_variance, gae, policy_gradient, td_target, value_loss
from lemniscate.nn.actor_critic import ActorCritic, Value, of_next
from lemniscate.nn.critics import CategoricalQ, Critics
from lemniscate.nn.networks import Bfloat16Linear
from lemniscate.nn.policies import Policy
from lemniscate.optim.adam import Adam, LossFunction
from lemniscate.optim.compiled import Learner
from lemniscate.run.config import RunConfig
from lemniscate.types import Batch, DrawnBatch, Metrics, Rollout, Transition, wide_float

Given = tuple[Any, tuple[Tensor, ...], bool]
"""what the gradient steps of an update were given: see `Watched.given`"""
ROUNDING = 1e-6
"""the share of a gradient's squares above which what no term explains cannot be rounding; healthy runs have 1e-12"""
MOST_CALLS = 8
"""calls of `learn` in which the first gradient of each optimizer is waited for; some are stepped elsewhere"""
MOST_PARAMETERS = 5_000_000
"""beyond which gradients are not taken apart, of which each term has a copy in float64"""
PARTS = "policy.", "value."
"""how the names of the parameters of a policy and of V(s) begin"""


def acted_with(state: Any) -> dict[str, Tensor]:
    """Copies of the parameters and buffers of a policy and of the V(s) beside it; none for others."""
    parts = state.networks.state_dict() if hasattr(state.networks, "value") else {}
    return {name: tensor.clone() for name, tensor in parts.items()}


class Watched:
    """The gradient steps of an algorithm, in an update that is looked at: what the first call was given is kept.

    Where it is looked at `closely`, `found` has the signals of the first gradient of each optimizer: `of_gradient`.
    """

    def __init__(self, state: Any, closely: bool = False) -> None:
        self._state, self._learn, self._closely, self._calls = state, state.learn, closely, 0
        self._given: tuple[Any, ...] = ()
        self._now: tuple[Any, ...] = ()
        self._unseen = [each for each in state.optimizers() if not each.over_shards] if closely else []
        self.found: dict[str, Tensor] = {}
        state.learn = self

    def __call__(self, *args: Any, **flags: Any) -> Any:
        """The gradient steps; of an algorithm of one's own they may take other arguments than those of ours."""
        self._calls += 1
        if not self._given and len(args) > 2:
            self._given = self._with_values(args[2]), *args[3:]
        if not self._unseen or self._calls > MOST_CALLS:
            return self._learn(*args, **flags)
        self._now, watched = args, [*self._unseen]
        for optimizer in watched:
            vars(optimizer)["gradient"] = partial(self._gradient, optimizer)
        try:
            if not isinstance(self._learn, Learner):
                return self._learn(*args, **flags)
            self._rehearse(self._learn, *args, **flags)
        finally:
            for optimizer in watched:
                vars(optimizer).pop("gradient", None)
        return self._learn(*args, **flags)

    def _with_values(self, data: Any) -> Any:
        """The data [B, …]; of Q, with max_a Q(s, a) [B] of the networks before this update as `value`."""
        if type(data) is not QBatch:
            return data
        with suppress(Exception), torch.no_grad():  # networks of one's own may have no such thing
            return replace(data, value=self._state.networks.value(data.obs)) if self._closely else None

    def _rehearse(self, learner: Learner, config: Any, state: Any, data: Any, *by_step: Tensor, **flags: Any) -> None:
        """A gradient step without the compiler, whose programs nobody can look into; it moves nothing."""
        several = [flag for flag in flags.values() if isinstance(flag, tuple)]
        k = next((k for k in range(len(by_step[0])) if all(flag[k] for flag in several)), 0)  # in which all move
        one = {name: flag[k : k + 1] if isinstance(flag, tuple) else flag for name, flag in flags.items()}
        self._now = config, state, data, *(tensor[k : k + 1] for tensor in by_step)
        modules = [each for each in vars(state).values() if isinstance(each, nn.Module)]
        tensors = [each for module in modules for each in (*module.parameters(), *module.buffers())]
        before = [each.detach().clone() for each in tensors]
        try:
            with suppress(Exception):  # what is wrong with it, the step itself says
                learner.rehearse(*self._now, **one)
        finally:
            for tensor, was in zip(tensors, before, strict=True):
                tensor.data.copy_(was)

    def _gradient(self, optimizer: Adam, loss: LossFunction, *args: Any) -> tuple[Tensor, Metrics]:
        """The gradient of an optimizer, which is looked at once."""
        is_first = len(self._unseen) == len(self._state.optimizers())
        del vars(optimizer)["gradient"]
        self._unseen.remove(optimizer)
        grads = [each.grad for each in optimizer.parameters]
        before = torch.cat([grad.flatten() for grad in grads if grad is not None] or [torch.zeros(0)])
        gradient, metrics = optimizer.gradient(loss, *args)
        # A loss of one's own may be given anything: then nothing is said of it.
        with suppress(Exception), torch.no_grad():
            if is_first:
                self.found |= of_minibatch(self._now[2], self._now[3][0], args[0])
        with suppress(Exception), torch.no_grad():
            self.found |= of_old_policy(optimizer.networks, args[0])
        with suppress(Exception):
            of_it = self._now[0], self._state, optimizer, gradient
            self.found |= (found := of_gradient(*of_it, args))
            if any(name.endswith("_rest") and share > ROUNDING for name, share in found.items()):
                self.found |= of_mistakes(*of_it, before, args)
        return gradient, metrics

    @property
    def given(self) -> Given:
        """The data, the tensors for each gradient step, the rows first; and whether there was one step alone."""
        data, *by_step = self._given or (None,)
        known = all(isinstance(each, Tensor) and each.dim() > 1 for each in by_step)
        tensors = tuple(by_step) if by_step and known and by_step[0].dtype == torch.int64 else ()
        return data, tensors, self._calls == 1 and len(tensors) > 0 and len(tensors[0]) == 1

    def end(self) -> None:
        """Watch no more."""
        self._state.learn = self._learn


def spread(x: Tensor) -> Tensor:
    """The standard deviation of each column of rows [B, K]."""
    return (x - x.mean(0)).square().mean(0).sqrt()  # `Tensor.std` takes five times as long


def of_update(state: Any, config: RunConfig, rows: Rollout, acted: Mapping[str, Tensor] | None) -> dict[str, Tensor]:
    """Of the newest update, from rows [T, N, …] and the networks before it, for algorithms with a V(s).

    - network/moved and value/moved: how far the parameters of the policy and of V moved, as a share of their length.
    - advantage/followed: the correlation of A(s, a) and of the change of log π(a|s).
    - value/explained: the explained variance of the targets of V, of γ and λ = 0.95, by V before the update.
    """
    found, networks = dict[str, Tensor](), state.networks
    if acted is None or not hasattr(networks, "value"):
        return {}
    for name, beginning in zip(("network/moved", "value/moved"), PARTS, strict=True):
        own = [(acted[key], now) for key, now in networks.named_parameters() if key.startswith(beginning)]
        if own:
            before, after = (torch.cat([x.flatten() for x in each]) for each in zip(*own, strict=True))
            found[name] = (after - before).norm() / after.norm()
    if not (old_value := old_value_of(state, acted)):  # but the largest of Q
        return found
    before = {key.removeprefix(PARTS[0]): x for key, x in acted.items() if key.startswith(PARTS[0])}
    old = partial(_of_old, state.policy, before)
    rows = rows[-getattr(config, "num_steps", len(rows.done)) :]  # REINFORCE collects whole episodes
    obs, action, done, newest = rows.obs.flatten(0, 1), rows.action.flatten(0, 1), rows.done, rows.valid
    value, gamma = old_value(obs).view(done.shape), getattr(config, "gamma", 1.0)
    next_value = of_next(old_value, value, rows.obs, rows.next_obs)
    advantage, target = gae(rows.reward, value, next_value, rows.terminated, done, gamma=gamma, lam=0.95)
    now = state.policy(obs)
    if not hasattr(now, "log_prob"):  # of a squashed or a deterministic policy there is none
        return found
    change = (now.log_prob(action) - old(obs).log_prob(action)).view(done.shape)
    if newest.sum() > 1:
        found["advantage/followed"] = torch.corrcoef(torch.stack([advantage, change])[:, newest])[0, 1].nan_to_num()
        if spread(target[newest]) > 1e-3 * target[newest].abs().mean():  # else there is nothing to explain
            found["value/explained"] = explained_variance(value[newest], target[newest])
    return found


def old_value_of(state: Any, acted: Mapping[str, Tensor] | None) -> Callable[[Tensor], Tensor] | None:
    """V(s) as it was before the newest update, [B, O] to [B]; None where there is none, or it is not known."""
    value = getattr(state.networks, "value", None)
    if acted is None or not isinstance(value, nn.Module):
        return None
    return partial(
        _of_old, value, {key.removeprefix(PARTS[1]): x for key, x in acted.items() if key.startswith(PARTS[1])}
    )


def _of_old(module: nn.Module, tensors: Mapping[str, Tensor], obs: Tensor) -> Any:
    """What a module says with other parameters and buffers."""
    return functional_call(module, dict(tensors), (obs,), tie_weights=False)


def of_batch(
    config: RunConfig, given: Given, rows: Rollout, old_value: Callable[[Tensor], Tensor] | None = None
) -> dict[str, Tensor]:
    """Of the rows that an update learned from, where they are the newest, [T, N, …]: whether they follow from these.

    - targets/discount: the factor by which targets follow from the values and the targets of the row after.
    - targets/unexplained: the share of their squares that does not follow so.
    - targets/beyond_ends: the share of the squares of the targets where an episode terminated that is not the reward's.
    - advantage/own: the correlation of the advantages with what the targets are above the values.
    - advantage/used: that of the advantages in the first gradient step with those of its rows.
    - value/loss: half the mean of the squared differences of values and targets, in an update of one gradient step.
    - targets/other_actions: the share of the rows whose action is not the one that was taken.
    - targets/missing: see `of_cuts`; where V before the update, `old_value`, is known.

    Of PQN the value is the largest Q(s, ·), and there are no advantages.
    """
    data, by_step, is_one = given
    columns, found = _columns_of(config, data, rows), dict[str, Tensor]()
    if not columns:
        return found
    steps = min(len(columns[0]), len(rows.done))
    (v, g, *a), newest = (x[-steps:] for x in columns), rows[-steps:]
    if data.action.dtype == newest.action.dtype and data.action.shape[1:] == newest.action.shape[2:]:
        other = data.action.reshape(-1, *newest.action.shape[1:])[-steps:] != newest.action
        found["targets/other_actions"] = other.reshape(*g.shape, -1).any(-1)[newest.valid].float().mean()
    beyond, size = g - newest.reward.to(g.dtype), g.square().mean()
    lam = getattr(config, "gae_lambda", getattr(config, "td_lambda", 1.0))
    on, ends = ~newest.done[:-1] & newest.valid[:-1] & newest.valid[1:], newest.terminated & newest.valid
    ahead, rest = torch.lerp(v[1:], g[1:], lam)[on], beyond[:-1][on]
    if size > 0 and ahead.any():
        found["targets/discount"] = (ahead * rest).sum() / ahead.square().sum()
        found["targets/unexplained"] = (rest - found["targets/discount"] * ahead).square().mean() / size
    if size > 0 and ends.any():
        found["targets/beyond_ends"] = beyond[ends].square().mean() / size
    found |= of_cuts(config, newest, g, old_value) if old_value else {}
    pairs = {"advantage/own": (a[0][newest.valid], (g - v)[newest.valid])} if a else {}
    if by_step and a:
        value, target, advantage = (x.flatten()[by_step[0][0].flatten()] for x in columns)
        found |= {"value/loss": 0.5 * (value - target).square().mean()} if is_one else {}
        if len(by_step) > 1 and by_step[1].shape == by_step[0].shape:
            pairs["advantage/used"] = by_step[1][0].flatten().to(g.dtype), advantage
    for name, (one, right) in pairs.items():
        if spread(right) > 1e-4 * g.abs().mean():  # else it is of rounding
            found[name] = torch.corrcoef(torch.stack([one, right]))[0, 1].nan_to_num()
    return found


def of_cuts(
    config: RunConfig, rows: Rollout, target: Tensor, old_value: Callable[[Tensor], Tensor]
) -> dict[str, Tensor]:
    """The share of γ V(s') that targets [T, N] lack where a time limit, or the end of the rows, cuts an episode.

    Of rows [T, N, …], and of V before the update, whose targets they are.
    """
    cut = rows.done.clone()
    cut[-1] = True
    cut &= rows.valid & ~rows.terminated
    beyond = (target - rows.reward)[cut]
    ahead = getattr(config, "gamma", 1.0) * old_value(rows.next_obs[cut]).to(target.dtype)
    if ahead.square().sum() <= 1e-6 * target[cut].square().sum():  # else it is of rounding
        return {}
    return {"targets/missing": 1 - (beyond * ahead).sum() / ahead.square().sum()}


def _columns_of(config: RunConfig, data: Any, rows: Rollout) -> list[Tensor]:
    """Value, target and, where there are any, advantage [T, N] of a batch whose last rows are the newest; else none."""
    envs = rows.done.shape[1]
    known = isinstance(data, Batch) or type(data) is QBatch
    if not known or getattr(config, "episodes", 0) or len(data.obs) % envs:
        return []
    columns = [getattr(data, name) for name in ("value", "target", "advantage") if hasattr(data, name)]
    if any(not isinstance(x, Tensor) or x.shape != data.obs.shape[:1] for x in columns):
        return []
    obs = data.obs.unflatten(0, (-1, envs))
    steps = min(len(obs), len(rows.done))
    if steps < 3 or not torch.equal(obs[-steps:], rows.obs[-steps:]):
        return []  # mirror images, pieces of a memory, rows of other processes
    return [x.to(wide_float(x.device)).reshape(-1, envs) for x in columns]


def of_minibatch(data: Any, rows: Tensor, batch: Any) -> dict[str, Tensor]:
    """The share of the rows of a gradient step, [M, …], that are not those of the data [B, …] that it was to take.

    Advantages are left out, which are standardized on the way, and images and rewards, which may be changed on purpose.
    """
    if type(data) is not type(batch):
        return {}
    right, size = data[rows], rows.shape
    names = {"action", "target", "log_prob", *(["obs"] if batch.obs.is_floating_point() else [])} & vars(batch).keys()
    others = [(getattr(batch, name) != getattr(right, name)).reshape(*size, -1).any(-1) for name in names]
    return {"gradient/other_rows": torch.stack(others).any(0).float().mean()}


def of_old_policy(networks: Any, batch: Any) -> dict[str, Tensor]:
    """The mean of |log π − log π_old| in a minibatch [M, …] before the first gradient step, where both are one policy.

    Of REPPO it is the KL divergence, of which the policy's μ and log σ are stored.
    """
    policy = getattr(networks, "policy", networks)
    if isinstance(batch, DrawnBatch):
        distribution = networks(batch.obs)[0] if isinstance(networks, ActorCritic) else policy(batch.obs)
        return {"gradient/old_policy": (distribution.log_prob(batch.action) - batch.log_prob).abs().mean()}
    if isinstance(batch, SoftBatch) and isinstance(policy, Policy):
        return {"gradient/old_policy": batch.kl_to(policy(batch.obs)).abs().mean()}
    return {}


def of_gradient(
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
        terms = terms_of(config, state, optimizer.networks, *args)
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
            weights = torch.linalg.lstsq(its, whole[:, None], driver="gelsd").solution[:, 0]
            found[f"gradient/{part[0]}_rest"] = (whole - its @ weights).square().sum() / whole.square().sum()
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


class Online(NamedTuple):
    """A training state whose target networks are the networks that learn, with a gradient or without one."""

    networks: Any
    targets: Any
    follows: bool


def of_mistakes(
    config: RunConfig, state: Any, optimizer: Adam, gradient: Tensor, before: Tensor, args: tuple[Any, ...]
) -> dict[str, Tensor]:
    """The share of a gradient's squares that no term explains if a well-known mistake was made: "gradient/if_…".

    - ends_ignored: Q awaits something behind terminations, too.
    - mean_target: each value has the mean of all targets, as where [B, 1] less [B] is [B, B].
    - other_rows: an action, a target, a reward or a next observation is of the row beside, or of the reverse order.
    - other_action: Q(s, ·) of another action is moved.
    - online_target, followed_target: y is of Q itself; and the gradient goes through it.
    - own_obs, own_action: y is of s in the place of s'; Q is of the policy's action in the place of the stored one.
    - not_zeroed: the gradient [P] is added to the one `before`, [P].
    """
    batch, *noise = args
    parts = of_gradient(config, state, optimizer, gradient, args)
    left: dict[str, list[dict[str, Tensor]]] = {}
    if len(before) == len(gradient) and before.any():
        left["not_zeroed"] = [of_gradient(config, state, optimizer, gradient - before, args)]
    for name, its_state, rows in _mistaken(state, batch):
        left.setdefault(name, []).append(of_gradient(config, its_state, optimizer, gradient, (rows, *noise)))
    rests, one = [name for name in parts if name.endswith("_rest")], torch.ones((), dtype=torch.float64)
    return {
        f"gradient/if_{name}": torch.stack(
            [torch.stack([each.get(rest, one) for rest in rests]).max() for each in variants]
        ).min()
        for name, variants in left.items()
    }


def _mistaken(state: Any, batch: Any) -> Iterator[tuple[str, Any, Any]]:
    """Names of mistakes, with the state and the rows of which they would be right."""
    if isinstance(batch, Transition):
        targets = state.networks if hasattr(state.targets, "critics") else state.networks.critics
        yield "online_target", Online(state.networks, targets, False), batch
        yield "followed_target", Online(state.networks, targets, True), batch
        yield "own_obs", state, replace(batch, next_obs=batch.obs)
        yield "own_action", state, replace(batch, action=state.networks.policy(batch.obs).mode().detach())
        if batch.terminated.any():
            yield "ends_ignored", state, replace(batch, terminated=torch.zeros_like(batch.terminated))
    if isinstance(batch, Batch | QBatch):
        yield "mean_target", state, replace(batch, target=batch.target.mean().expand_as(batch.target))
    if type(batch) is QBatch:
        choices = int(batch.action.max()) + 1
        yield from (
            ("other_action", state, replace(batch, action=(batch.action + k) % choices)) for k in range(1, choices)
        )
    for column in {"action", "target", "reward", "next_obs"} & vars(batch).keys():
        x = getattr(batch, column)
        for moved in (x.roll(1, 0), x.roll(-1, 0), x.flip(0)):
            yield "other_rows", state, replace(batch, **{column: moved})


def terms_of(config: Any, state: Any, networks: Any, batch: Any, *noise: Tensor) -> dict[str, Tensor]:
    """The terms of the equations' loss for networks and rows [M, …], scalars to descend; none where it is unknown.

    "policy" judges actions, "value" V or Q, "entropy" is that of the policy with a minus, "kl" what holds it back, and
    "baseline" what a mean of the advantages does. Not known are TRPO's surrogate, temperatures and multipliers.
    """
    if isinstance(batch, Batch):
        return _of_advantages(config, networks, batch)
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
            target = _target_of_q(config, state, batch, *noise)
        return {"value": torch.stack([q.loss(batch.obs, batch.action, target)[0] for q in networks.members]).sum()}
    if isinstance(batch, Transition) and isinstance(networks, Policy):
        policy, critics = networks(batch.obs), state.networks.critics
        if not hasattr(state.networks, "temperature"):
            return {"policy": -critics.first(batch.obs, policy.mode()).mean()}
        action, log_prob = policy.sample_with_log_prob(*noise)
        alpha = state.networks.temperature().detach()
        return {"policy": -critics(batch.obs, action).amin(0).mean(), "entropy": (alpha * log_prob).mean()}
    return {}


def _of_advantages(config: Any, networks: Any, batch: Batch) -> dict[str, Tensor]:
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


def _target_of_q(config: Any, state: Any, batch: Transition, *noise: Tensor) -> Tensor:
    """What Q(s, a) is to say in DDPG, TD3 and SAC, [M]."""
    if hasattr(state.networks, "temperature"):
        action, log_prob = state.networks.policy(batch.next_obs).sample_with_log_prob(*noise)
        next_value = state.targets(batch.next_obs, action).amin(0) - state.networks.temperature() * log_prob
    else:
        policy, limit = state.targets.policy(batch.next_obs), getattr(config, "target_noise_clip", 0.0)
        smoothing = [(config.target_noise * each).clamp(-limit, limit) for each in noise]
        action = policy.sample(*smoothing) if smoothing else policy.mode()
        next_value = state.targets.critics(batch.next_obs, action).amin(0)
    return td_target(batch.reward, next_value, batch.terminated, gamma=config.gamma)
