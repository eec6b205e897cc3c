"""Compares an update of a run with the equations: the rows that it took, its targets, and its gradients.

`Watched` stands in the place of an algorithm's `learn` meanwhile. A healthy update fulfils the equations to rounding;
one with a mistake in a loss, in the targets or in the order of rows does not, whatever the environment.
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

from lemniscate.data.rollout import QBatch, SoftBatch
from lemniscate.maths import explained_variance, gae
from lemniscate.nn.actor_critic import ActorCritic, next_values
from lemniscate.nn.policies import Policy
from lemniscate.optim.adam import Adam, LossFunction
from lemniscate.optim.compiled import Learner
from lemniscate.run.config import RunConfig
from lemniscate.run.terms import ROUNDING, difference, fitted, gradient_signals, mistake_signals
from lemniscate.types import Batch, DrawnBatch, Metrics, Rollout, wide_float

Given = tuple[Any, tuple[Tensor, ...], bool]
"""what the gradient steps of an update were given: see `Watched.given`"""
TARGET_ROUNDING = 1e-8
"""the share of the squares of targets above which what does not follow cannot be rounding; healthy runs have 1e-12"""
MOST_CALLS = 8
"""calls of `learn` in which the first gradient of each optimizer is waited for; some are stepped elsewhere"""
PARTS = "policy.", "value."
"""how the names of the parameters of a policy and of V(s) begin"""


def acted_with(state: Any) -> dict[str, Tensor]:
    """Copies of the parameters and buffers of a policy and of the V(s) beside it; none for others."""
    parts = state.networks.state_dict() if hasattr(state.networks, "value") else {}
    return {name: tensor.clone() for name, tensor in parts.items()}


class Watched:
    """The gradient steps of an algorithm, in an update that is looked at: what the first call was given is kept.

    In a close look, which has a number, `found` has the signals of the first gradient of each optimizer
    (`gradient_signals`). In every second one it is the first gradient of the second call: before the policy has moved,
    neither a clip nor a bound on the KL divergence does anything.
    """

    def __init__(self, state: Any, close: int | None = None) -> None:
        self._state, self._learn, self._close, self._calls = state, state.learn, close, 0
        self._given: tuple[Any, ...] = ()
        self._now: tuple[Any, ...] = ()
        self._unseen = [] if close is None else [each for each in state.optimizers() if not each.over_shards]
        self.found: dict[str, Tensor] = {}
        self.stored = 0
        """rows of the replay buffer, if there is one, at the first call"""
        state.learn = self

    def __call__(self, *args: Any, **flags: Any) -> Any:
        """The gradient steps; of an algorithm of one's own they may take other arguments than those of ours."""
        self._calls += 1
        data, *by_step = args[2:] or (None,)
        if not self._given and len(args) > 2:
            self._given = self._add_values(data) if type(data) is QBatch else data, *by_step
            self.stored = len(self._state.replay) if hasattr(self._state, "replay") else 0
        if not self._unseen or self._calls > MOST_CALLS or (self._calls == 1 and self._is_later(data)):
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

    def _is_later(self, data: Any) -> bool:
        """Whether a later gradient than the first of this data is looked at."""
        return (self._close or 0) % 2 == 1 and isinstance(data, DrawnBatch | SoftBatch)

    def _add_values(self, data: Any) -> Any:
        """The data [B, …] of Q, with max_a Q(s, a) [B] of the networks before this update as `value`."""
        with suppress(Exception), torch.no_grad():  # networks of one's own may have no such thing
            return replace(data, value=self._state.networks.value(data.obs)) if self._close is not None else None

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
        is_first, is_later = len(self._unseen) == len(self._state.optimizers()), self._is_later(args[0])
        del vars(optimizer)["gradient"]
        self._unseen.remove(optimizer)
        grads = [each.grad for each in optimizer.parameters]
        before = torch.cat([grad.flatten() for grad in grads if grad is not None] or [torch.zeros(0)])
        gradient, metrics = optimizer.gradient(loss, *args)
        # A loss of one's own may be given anything: then nothing is said of it.
        with suppress(Exception), torch.no_grad():
            if is_first and not is_later:
                self.found |= minibatch_signals(self._now[2], self._now[3][0], args[0])
        with suppress(Exception), torch.no_grad():
            self.found |= {} if is_later else old_policy_signals(optimizer.networks, args[0])
        with suppress(Exception):
            of_it = self._now[0], self._state, optimizer, gradient
            found = gradient_signals(*of_it, args)
            rest = max(share for name, share in found.items() if name.endswith("_rest"))
            self.found |= {"gradient/later_rest": rest} if is_later else found
            if rest > ROUNDING:
                self.found |= mistake_signals(*of_it, before, args)
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


def update_signals(
    state: Any, config: RunConfig, rows: Rollout, acted: Mapping[str, Tensor] | None
) -> dict[str, Tensor]:
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
    old = partial(_call_with, state.policy, before)
    rows = rows[-getattr(config, "num_steps", len(rows.done)) :]  # REINFORCE collects whole episodes
    obs, action, done, newest = rows.obs.flatten(0, 1), rows.action.flatten(0, 1), rows.done, rows.valid
    value, gamma = old_value(obs).view(done.shape), getattr(config, "gamma", 1.0)
    next_value = next_values(old_value, value, rows.obs, rows.next_obs)
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
        _call_with, value, {key.removeprefix(PARTS[1]): x for key, x in acted.items() if key.startswith(PARTS[1])}
    )


def _call_with(module: nn.Module, tensors: Mapping[str, Tensor], obs: Tensor) -> Any:
    """What a module says with other parameters and buffers."""
    return functional_call(module, dict(tensors), (obs,), tie_weights=False)


def batch_signals(
    config: RunConfig, given: Given, rows: Rollout, old_value: Callable[[Tensor], Tensor] | None = None
) -> dict[str, Tensor]:
    """Of the rows that an update learned from, where they are the newest, [T, N, …]: whether they follow from these.

    - targets/beyond_ends: the share of the squares of the targets where an episode terminated that is not the reward's.
    - advantage/own: the correlation of the advantages with what the targets are above the values.
    - advantage/used: that of the advantages in the first gradient step with those of its rows.
    - value/loss: half the mean of the squared differences of values and targets, in an update of one gradient step.
    - targets/other_actions: the share of the rows whose action is not the one that was taken.
    - targets/missing: see `cut_signals`; where V before the update, `old_value`, is known.

    Also what `recursion_signals` finds. Of PQN the value is the largest Q(s, ·), and there are no advantages.
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
    found |= recursion_signals(config, newest, v, g)
    beyond, size, ends = g - newest.reward.to(g.dtype), g.square().mean(), newest.terminated & newest.valid
    if size > 0 and ends.any():
        found["targets/beyond_ends"] = beyond[ends].square().mean() / size
    found |= cut_signals(config, newest, g, old_value) if old_value else {}
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


def recursion_signals(config: RunConfig, rows: Rollout, value: Tensor, target: Tensor) -> dict[str, Tensor]:
    """How the targets [T, N] of rows follow from their rewards, and from the values and targets of the rows after.

    - targets/discount: the factor by which they follow from those, which λ mixes.
    - targets/unexplained: the share of their squares that does not follow so.

    Where that is more than rounding, what explains it, if one thing alone does:

    - targets/trace: another λ, and targets/discount is γ.
    - targets/other_rewards: the difference of a r + b, which stands there for r, from r, as a share of its squares.
    - targets/rescaled: the share that is left of a y in the place of the targets y, (1 − a)².
    - targets/less_values: 1 where they are advantages, without the values.
    - targets/forward: 1 where they are made of the row before in the place of the row after.
    """
    on = ~rows.done[:-1] & rows.valid[:-1] & rows.valid[1:]
    lam = getattr(config, "gae_lambda", getattr(config, "td_lambda", 1.0))
    ahead, rest = torch.lerp(value[1:], target[1:], lam)[on], (target - rows.reward)[:-1][on]
    size = target.square().mean()
    if size == 0 or not ahead.any():
        return {}
    discount = (ahead * rest).sum() / ahead.square().sum()
    found = {"targets/discount": discount, "targets/unexplained": (rest - discount * ahead).square().mean() / size}
    if found["targets/unexplained"] <= TARGET_ROUNDING:
        return found
    v, g, r, on = (x.cpu().double() for x in (value, target, rows.reward, on))
    one, on, gamma = torch.ones_like(g), on.bool(), getattr(config, "gamma", 1.0)
    after = [r[:-1], one[1:], v[:-1], v[1:], g[1:]]
    weights, left = fitted(torch.stack([x[on] for x in after], 1), g[:-1][on])
    if v[1:][on].std() < 1e-3 * g[1:][on].std():  # then no fit knows what V counts
        return found
    if left < TARGET_ROUNDING / 10:
        a, b, own, next_weight, chain = weights.tolist()
        right = [abs(x - y) < 1e-3 for x, y in ((next_weight, gamma * (1 - lam)), (chain, gamma * lam))]
        if abs(own + 1) < 1e-3:
            return found | {"targets/less_values": torch.ones(())}
        if all(right):
            return found | {"targets/other_rewards": difference(a * r[:-1][on] + b, r[:-1][on])}
        if abs(next_weight + chain - gamma) < 1e-3:
            return found | {"targets/discount": torch.tensor(gamma), "targets/trace": torch.tensor(chain / gamma)}
        times = next_weight / (gamma * (1 - lam)) if lam < 1 else 1.0
        return found | ({"targets/rescaled": torch.tensor((1 - times) ** 2)} if right[1] else {})
    both = on[:-1] & on[1:]  # A = δ + γ λ of the row before
    before = r[1:-1], one[1:-1], v[1:-1], v[2:], v[:-2], g[:-2]
    weights, left = fitted(torch.stack([x[both] for x in before], 1), g[1:-1][both])
    forward = left < TARGET_ROUNDING / 10 and 0 < weights[-1] <= 1  # above 1 it is backward, solved for this row
    return found | ({"targets/forward": torch.ones(())} if forward else {})


def cut_signals(
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


def minibatch_signals(data: Any, rows: Tensor, batch: Any) -> dict[str, Tensor]:
    """The share of the rows of a gradient step, [M, …], that are not those of the data [B, …] that it was to take.

    Advantages are left out, which are standardized on the way, and images and rewards, which may be changed on purpose.
    """
    if type(data) is not type(batch):
        return {}
    right, size = data[rows], rows.shape
    names = {"action", "target", "log_prob", *(["obs"] if batch.obs.is_floating_point() else [])} & vars(batch).keys()
    others = [(getattr(batch, name) != getattr(right, name)).reshape(*size, -1).any(-1) for name in names]
    return {"gradient/other_rows": torch.stack(others).any(0).float().mean()}


def old_policy_signals(networks: Any, batch: Any) -> dict[str, Tensor]:
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
