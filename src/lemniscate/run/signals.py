"""Signals: measurements of a run's newest rows and of its networks, from which `lemniscate doctor` reads what is wrong.

They are taken up to some twenty times in a run, and cost a hundredth of one of some seconds, less of longer ones.
Nothing learns from them.
"""

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import one_hot

from lemniscate.data.replay import ReplayBuffer
from lemniscate.maths import explained_by, explained_by_each, explained_variance, moments, td_target
from lemniscate.nn.actor_critic import next_values
from lemniscate.nn.networks import ACTIVATIONS
from lemniscate.nn.normalizer import RunningNorm
from lemniscate.run.config import RunConfig
from lemniscate.run.updates import Watched, batch_signals, old_value_of, spread, update_signals
from lemniscate.spec import Action, Box, Discrete, MultiDiscrete, Spec
from lemniscate.types import Rollout, Transition

LOOKS = 18
"""how often in a run the signals are measured"""
FIRST_CLOSE, EVERY_CLOSE = 3, 5
"""the looks in which gradients are taken apart: the first, before a policy collapses, and one of so many later"""
KINDS = (
    *("reward/", "observation/", "action/", "value/", "advantage/"),
    *("network/", "normalizer/", "td_error/", "replay/", "targets/", "gradient/"),
)
"""how the names of signals begin"""
LATEST = 6
"""steps until an action that is late takes effect, up to which it is looked for"""
SEEN = 256
"""rows that the networks are asked about"""
FEW = 40
"""rows of a choice below which it is not compared with others"""
MOST_CHOICES = 6
"""choices up to which each two are compared"""
MOST_ROWS = 4096
"""rows to which lines are fitted at most"""
MOST_NUMBERS = 32
"""numbers of an observation up to which lines are fitted to them; for more there are too few rows"""
UNITS = (*ACTIVATIONS.values(), nn.Tanh, nn.GELU, nn.LeakyReLU)
"""the modules whose outputs are hidden units; the last three are those of networks of one's own"""


@torch.no_grad()
def signals(
    state: Any,
    config: RunConfig,
    spec: Spec,
    rows: Rollout | None,
    acted: Mapping[str, Tensor] | None = None,
    ages: Tensor | None = None,
    watched: Watched | None = None,
) -> dict[str, float]:
    """The signals of a training state and of the newest rows [T, N, …] of its environments, by the glossary's names.

    `acted` are the parameters and buffers of the networks before their newest update, where that is known; `watched`
    has seen its gradient steps; `ages` [N] are the steps that each environment's episode had after the last row.
    """
    if rows is None or rows.valid.sum() < 2:
        return {}
    chosen, scaled = _valid(rows), rows
    if getattr(config, "scale_rewards", False) and hasattr(state, "reward_scale"):
        scaled = replace(rows, reward=state.reward_scale(rows.reward))
    found = network_signals(state, chosen) | value_signals(state, config, scaled)
    found |= update_signals(state, config, scaled, acted) | replay_signals(state, rows)
    found |= critic_signals(state, config, _valid(scaled), watched)
    if watched:
        found |= batch_signals(config, watched.given, scaled, old_value_of(state, acted)) | watched.found
    return environment_signals(rows, spec, ages) | {name: float(value) for name, value in found.items()}


def _valid(rows: Rollout) -> Rollout:
    """The valid of rows [T, N, …], [B, …]: views where all are, which costs nothing."""
    return rows.flatten() if rows.valid.all() else rows[rows.valid]


def environment_signals(rows: Rollout, spec: Spec, ages: Tensor | None = None) -> dict[str, float]:
    """The signals of rows [T, N, …] alone, two of which are valid at least; with `ages` [N] as in `signals`."""
    found = row_signals(_valid(rows), spec) | time_signals(rows) | start_signals(rows, spec)
    if not spec.has_images and spec.observation_size <= MOST_NUMBERS:
        few = slice(max(2, MOST_ROWS // len(rows.done)))  # of the environments
        rows = rows[:, few]
        found |= effect_signals(_valid(rows), spec)
        found |= age_signals(rows, spec, ages[few], found) if ages is not None else {}
        if found["reward/explained"] < 0.8 and found["reward/std"] > 0:  # else no other row has more to explain
            found["reward/before"] = paid_before(rows, spec, found["reward/explained"])
        if found["action/effect"] < 0.2:
            found |= {"action/late": late_effect(rows, spec), "action/beside": effect_beside(rows, spec)}
    return {name: float(value) for name, value in found.items()}


def row_signals(rows: Rollout, spec: Spec) -> dict[str, Tensor]:
    """Sizes of rewards and observations, and shares of rows [B, …].

    The shares are of rewards that are 0, of numbers that never change, of observations that are as the one before, of
    numbers that are the largest or the smallest of their column, of whole numbers, of actions at their bounds, and of
    ends that are terminations.
    """
    obs, after = (x[:, : spec.observation_size].float() for x in (rows.obs, rows.next_obs))
    ends = rows.done.sum()
    found = {
        "reward/mean": rows.reward.mean(),
        "reward/std": moments(rows.reward)[1].sqrt(),
        "reward/largest": rows.reward.abs().max(),
        "reward/zero": (rows.reward == 0).float().mean(),
        "observation/largest": obs.abs().max(),
        "observation/constant": (obs == obs[0]).all(0).float().mean(),
    }
    if not ((obs == 0) | (obs == 1)).all():  # one of n is often the same
        found["observation/repeated"] = (obs == after).all(1).float().mean()
    low, high = obs.amin(0), obs.amax(0)
    numbers = ((obs > low) & (obs < high)).any(0)  # not what is 0 or 1
    if numbers.any() and not spec.has_images:
        found["observation/at_limits"] = ((obs == low) | (obs == high))[:, numbers].float().mean()
        found["observation/whole"] = (obs == obs.round())[:, numbers].float().mean()
    if isinstance(spec.action, Box):
        found["action/at_bounds"] = (rows.action.abs() > 0.99).float().mean()
    return found | ({"episode/terminated": rows.terminated.sum() / ends} if ends else {})


def start_signals(rows: Rollout, spec: Spec) -> dict[str, Tensor]:
    """Whether episodes begin alike, and where the ones before have ended, of rows [T, N, …] with three beginnings.

    The second is the share of the ends, where one row follows the other, after which the observation is as far from the
    last one as a tenth of its standard deviation at most.
    """
    begins, size, found = rows.valid[1:] & (rows.done | ~rows.valid)[:-1], spec.observation_size, dict[str, Tensor]()
    first = rows.obs[1:][begins][:, :size]
    if len(first) > 2:
        found["observation/starts_alike"] = (first == first[:1]).all().float()
    ended = (rows.done & rows.valid)[:-1] & rows.valid[1:]
    wide = spread(rows.obs[..., :size].flatten(0, 1).float())
    if ended.sum() > 2 and (moves := wide > 0).any() and not spec.has_images:
        away = (rows.obs[1:][ended] - rows.next_obs[:-1][ended])[:, :size][:, moves] / wide[moves]
        found["observation/goes_on"] = (away.square().mean(1).sqrt() < 0.1).float().mean()
    return found


def time_signals(rows: Rollout) -> dict[str, Tensor]:
    """The share of the rewards' variance that is within episodes, and of that what a line over time explains.

    Of rows [T, N, …]; both are 0 for rewards that never change.
    """
    steps, envs = rows.done.shape
    episode = (_ended(rows) * envs + torch.arange(envs, device=rows.done.device))[rows.valid].cpu()
    time = torch.arange(steps).double()[:, None].expand(steps, envs)[rows.valid.cpu()]
    count = torch.bincount(episode).clamp(min=1)
    time, reward = (
        x - (torch.bincount(episode, weights=x) / count)[episode]
        for x in (time, rows.reward[rows.valid].cpu().double())
    )
    by_time = (time * reward).sum().square() / (time.square().sum() * reward.square().sum()).clamp(min=1e-12)
    if count.max() < 2:  # of one step each
        return {"reward/by_time": by_time}
    varies = (len(reward) * moments(rows.reward[rows.valid].cpu().double())[1]).clamp(min=1e-12)
    return {"reward/by_time": by_time, "reward/within": reward.square().sum() / varies}


def age_signals(rows: Rollout, spec: Spec, ages: Tensor, known: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """What recurs at the same steps of episodes, of rows [T, N, …] whose environments have had `ages` [N] steps since.

    - reward/by_age: the share of the rewards' variance that a line over the steps since an episode's beginning explains
      beyond the rows; not where these explain most of it, by the signals that are `known`.
    - reward/age: where hardly any reward is not 0, the mean of the steps since then of those, over that of all rows.
    - observation/jumps_every: the steps after which, and after whose multiples alone, observations change as if
      others were drawn, though no end is reported; nothing where there are none.
    """
    explained, jumps, found = known["reward/explained"].clamp(min=0), _jumps(rows, spec), dict[str, Tensor]()
    pays, recur = explained < 0.8 and known["reward/std"] > 0, jumps.sum() >= 8
    if not (pays or recur or known["reward/zero"] > 0.9):
        return {}
    running = rows.valid & (_ended(rows) == rows.done.sum(0))
    age = (ages - running.flip(0).cumsum(0).flip(0) + 1)[running]  # after the row
    if pays and running.sum() >= FEW:
        present = rows[running]
        line, reward = age[:, None].cpu().double(), present.reward[:, None].cpu().double()
        others = explained_by(line, reward, _everything(present, spec))
        found["reward/by_age"] = (1 - explained) * others.nan_to_num()[0]
    jumps, paid = jumps[running], rows.reward[running] != 0
    if 0 < paid.float().mean() < 0.1:
        found["reward/age"] = age[paid].mean() / age.mean()
    for period in age[jumps].unique()[:6] if jumps.sum() >= 8 else ():
        due = age % period == 0
        if period >= 5 and jumps[due].float().mean() > 0.5 and due[jumps].float().mean() > 0.9:
            return found | {"observation/jumps_every": period}
    return found


def _jumps(rows: Rollout, spec: Spec) -> Tensor:
    """Whether an observation of rows [T, N, …] changes within an episode as if another one were drawn, [T, N]."""
    obs, after = (x[..., : spec.observation_size].float() for x in (rows.obs, rows.next_obs))
    change = ((after - obs) / spread(obs.flatten(0, 1)).clamp(min=1e-6)).square().mean(-1)
    return (change > (10 * change.median()).clamp(min=0.5)) & ~rows.done & rows.valid


def effect_signals(rows: Rollout, spec: Spec) -> dict[str, Tensor]:
    """How actions, observations and rewards depend on each other, by linear regression (`explained_by`).

    - action/effect: the share of the observations' change that actions explain beyond the observations, where most.
    - action/share: the same as a share of the whole change.
    - action/paid: the share of the rewards that actions explain beyond the observations.
    - action/by_sign: what the signs of actions explain of the change beyond observations and actions.
    - action/weakest: what that number of an action explains of it that explains least.
    - action/half, action/alike: see `_weaker_half` and `_choices_alike`.
    - reward/explained: the share of the rewards that observations, actions, next observations and their squares
      explain, as of a squared distance.
    - observation/predicted: the share of the next observations that these explain, on average.
    - observation/pace: the root mean square of a change over the standard deviation, where most.
    """
    obs, after = (x[:, : spec.observation_size].cpu().double() for x in (rows.obs, rows.next_obs))
    action, inside = _numbers(rows.action.cpu(), spec.action), ~rows.done.cpu()
    reward = rows.reward[:, None].cpu().double()
    everything, nothing = _everything(rows, spec), obs[:, :0]
    change, effect = (after - obs)[inside], explained_by(action[inside], (after - obs)[inside], obs[inside])
    both = explained_by(obs[inside], torch.cat([change, after[inside]], dim=-1), nothing[inside])
    explained_change, explained_next = both.tensor_split(2)
    found = {
        "action/effect": effect.max(),
        "action/share": (effect * (1 - explained_change)).max(),
        "action/paid": explained_by(action, reward, obs).max(),
        "reward/explained": explained_by(everything, reward, nothing).max(),
    }
    if isinstance(spec.action, Box):
        known = torch.cat([obs, action], dim=-1)[inside]
        found["action/by_sign"] = explained_by(action.sign()[inside], change, known).nan_to_num().max()
        if action.shape[1] > 1:
            found["action/weakest"] = explained_by_each(known, change)[obs.shape[1] :].nan_to_num().amax(1).min()
        found |= _weaker_half(known, change, obs.shape[1])
    elif isinstance(spec.action, Discrete) and 2 < spec.action.n <= MOST_CHOICES:  # of two, the effect says as much
        found |= _choices_alike(action[inside], change, obs[inside])
    std = spread(obs[inside])
    if (std > 1e-9).any():
        found["observation/pace"] = (change.square().mean(0).sqrt() / std)[std > 1e-9].max()
    if not ((obs == 0) | (obs == 1)).all():  # one of n says nothing of the next
        found["observation/predicted"] = explained_next.mean()
    return found


def _weaker_half(known: Tensor, change: Tensor, size: int) -> dict[str, Tensor]:
    """What actions of one sign explain of the change, over what those of the other do, in the number where most.

    Of rows `known` [B, O + A], the first O of them, `size`, the observations; nothing where neither explains much, or
    where a sign is rare.
    """
    obs, action = known[:, :size], known[:, size:]
    if min((action > 0).any(1).sum(), (action < 0).any(1).sum()) < FEW:
        return {}
    halves = torch.cat([obs, action.clamp(min=0), action.clamp(max=0)], dim=-1)
    weak, strong = explained_by_each(halves, change)[size:].nan_to_num().view(2, -1).amax(1).sort().values
    return {"action/half": weak.clamp(min=0) / strong} if strong > 0.1 else {}


def _choices_alike(action: Tensor, change: Tensor, obs: Tensor) -> dict[str, Tensor]:
    """What it explains of the change which of two choices was made, of the pair of which it is least.

    Of choices [B, n], one of n each, that were made `FEW` times at least; nothing where there are no two of these.
    """
    often = (action.sum(0) >= FEW).nonzero()[:, 0].tolist()
    found = []
    for one, other in combinations(often, 2):
        rows = (action[:, one] + action[:, other]) > 0
        found.append(explained_by(action[rows, one : one + 1], change[rows], obs[rows]).nan_to_num().max())
    return {"action/alike": torch.stack(found).min()} if found else {}


def late_effect(rows: Rollout, spec: Spec) -> Tensor:
    """What earlier actions explain of how observations change, of rows [T, N, …]: one of up to `LATEST` steps, or all.

    Where an observation tells the state, that is nothing: what an action did is in the observations since. All, as a
    sum over the episode, where an action is a step of a servo, say, whose position is not observed.
    """
    obs, after = (x[..., : spec.observation_size].cpu().double() for x in (rows.obs, rows.next_obs))
    action, found = _numbers(rows.action.cpu(), spec.action), [torch.zeros((), dtype=torch.float64)]
    ended = _ended(rows).cpu()
    for steps in range(1, min(LATEST, len(obs) - 2) + 1):
        one = (ended[steps:] == ended[:-steps]) & (rows.valid & ~rows.done).cpu()[steps:]
        change = (after - obs)[steps:][one]
        found.append(explained_by(action[:-steps][one], change, obs[steps:][one]).nan_to_num().max())
    valid = rows.valid.cpu()
    moved = ((action - action[valid].mean(0)) * valid[..., None]).cumsum(0)  # less their mean, which tells the time
    begins = torch.cat([torch.ones_like(valid[:1]), ended.diff(dim=0) > 0])
    first = torch.where(begins, torch.arange(len(valid))[:, None], 0).cummax(0).values[..., None].expand_as(moved)
    before = torch.cat([torch.zeros_like(moved[:1]), moved[:-1]])
    inside, sums = valid & ~rows.done.cpu(), before - before.gather(0, first)
    found.append(explained_by(sums[inside], (after - obs)[inside], obs[inside]).nan_to_num().max())
    return torch.stack(found).max()


def effect_beside(rows: Rollout, spec: Spec) -> Tensor:
    """What the action in the environment beside explains of how observations change, of rows [T, N, …]; 0 for one.

    Where that is much, an observation is of that environment: all write into one array, say.
    """
    inside = (rows.valid & ~rows.done).cpu()
    obs, after = (x[..., : spec.observation_size].cpu().double()[inside] for x in (rows.obs, rows.next_obs))
    others = [rows.action.cpu().roll(side, 1)[inside] for side in (1, -1) if inside.shape[1] > 1]
    shares = [explained_by(_numbers(other, spec.action), after - obs, obs).nan_to_num().max() for other in others]
    return torch.stack([torch.zeros((), dtype=torch.float64), *shares]).max()


def paid_before(rows: Rollout, spec: Spec, present: Tensor) -> Tensor:
    """What a row before explains of the rewards beyond what their own row does, `present`, of rows [T, N, …].

    The most of up to `LATEST` steps, or of one where their own row explains most of them. Above 0 a reward is that of
    an earlier step: its own row knows no more of the action that earned it.
    """
    ended, found = _ended(rows), torch.zeros_like(present)
    for steps in range(1, min(LATEST, len(rows.done) - 1) + 1 if present < 0.5 else 2):
        one = (ended[steps:] == ended[:-steps]) & rows.valid[steps:] & rows.valid[:-steps]
        before, reward = _everything(rows[:-steps][one], spec), rows.reward[steps:][one].cpu().double()
        found = torch.maximum(found, explained_by(before, reward[:, None], before[:, :0])[0].nan_to_num())
    return found - present


def _ended(rows: Rollout) -> Tensor:
    """The number of episodes that ended before each row, [T, N]: rows of one number are of one episode."""
    return rows.done.cumsum(0) - rows.done.int()


def _everything(rows: Rollout, spec: Spec) -> Tensor:
    """Observations, actions and next observations of rows [B, …], with their squares, as numbers [B, F]."""
    obs, after = (x[:, : spec.observation_size].cpu().double() for x in (rows.obs, rows.next_obs))
    action = _numbers(rows.action.cpu(), spec.action)
    return torch.cat([obs, obs.square(), action, action.square(), after, after.square()], dim=-1)


def _numbers(action: Tensor, kind: Action) -> Tensor:
    """Actions as numbers, a choice as one of n: [B, A]."""
    if isinstance(kind, Discrete):
        return one_hot(action, kind.n).double()
    if isinstance(kind, MultiDiscrete):
        return torch.cat([one_hot(x, n) for x, n in zip(action.unbind(-1), kind.nvec, strict=True)], dim=-1).double()
    return action.double()


def network_signals(state: Any, rows: Rollout) -> dict[str, Tensor]:
    """Of the policy: shares of units that never change, are at ±1, and are alike; its rank, its normalizer's state.

    Inactive is a unit whose standard deviation over rows is below a fortieth of its layer's mean, as the dormant units
    of Sokar et al. 2023, arXiv:2302.12902, definition 3.1; a unit at a bound of tanh counts too. The rank is the
    effective one, δ = 0.01, of Kumar et al. 2021, arXiv:2010.14498, section 3, as a share of the last features.
    """
    obs, layers = rows.obs[-SEEN:], list[Tensor]()
    modules = [module for module in state.policy.modules() if isinstance(module, UNITS)]
    hooks = [module.register_forward_hook(lambda _module, _inputs, output: layers.append(output)) for module in modules]
    try:
        distribution = state.policy(obs)
    finally:
        for hook in hooks:
            hook.remove()
    found = dict[str, Tensor]()
    if hasattr(distribution, "sample"):  # a policy of one's own may say something else
        found |= _distance_from_mode(state.policy, distribution, obs, rows.action[-SEEN:])
    if units := [layer.flatten(1).float() for layer in layers if layer.ndim > 1 and len(layer) == len(obs)]:
        stds = [spread(layer) for layer in units]
        inactive = [std < (std.mean() / 40).clamp(min=1e-3) for std in stds]
        sizes = torch.linalg.svdvals(units[-1].cpu()).cumsum(0)
        found["network/saturated"] = (
            torch.cat([(unit.abs() > 0.97) & (unit.abs() <= 1) for unit in units], 1).float().mean()
        )
        if units[-1].shape[1] > 3 and stds[-1].max() > 0:
            found["network/alike"] = (units[-1] - units[-1][:, :1]).abs().amax(0).le(1e-5).float().mean()
        found["network/inactive"] = torch.cat(inactive).float().mean()
        found["network/rank"] = ((sizes < 0.99 * sizes[-1]).sum() + 1) / min(units[-1].shape)
    if isinstance(normalizer := state.policy.normalizer, RunningNorm):
        found["normalizer/count"] = normalizer.count
        found["normalizer/offset"] = normalizer(rows.obs).mean(0).abs().max()
    return found


def _distance_from_mode(policy: Any, distribution: Any, obs: Tensor, action: Tensor) -> dict[str, Tensor]:
    """The distance of actions from the policy's mode over that of actions drawn from it.

    Of a deterministic policy it is the distance itself, in units of half the action range. Nothing where so few choices
    would leave the mode that it could be chance that none did.
    """
    drawn = distribution.sample(policy.draw_noise(obs.shape[:1], torch.Generator(obs.device).manual_seed(0)))
    away, usual = ((x - distribution.mode()).float().square().mean().sqrt() for x in (action, drawn))
    if usual == 0 and action.is_floating_point():
        return {"action/off_mode": away}
    return {"action/off_mode": away / usual} if action.is_floating_point() or usual > 0.2 else {}


def value_signals(state: Any, config: RunConfig, rows: Rollout) -> dict[str, Tensor]:
    """Of V, from rows [T, N, …], for algorithms with a V(s); of Q(s, ·) it is the largest. value/mean is its mean.

    - value/missing: the mean of r + γ V(s') − V(s) over (1 − γ) |V|, above 0 where V is too small. That mean is 1 − γ
      times the difference of the policy's value and V. Where learning takes the value behind a time limit for 0, the
      share is that of the discounted steps which the limit cuts off.
    - value/at_ends: the mean of V(s) − r, or of V(s) where that is less, over |V| where an episode terminated: what V
      awaits beyond its end. Where V knows nothing of a large last reward, V(s) says so.
    """
    gamma, valid, found = getattr(config, "gamma", 1.0), rows.valid, dict[str, Tensor]()
    if not hasattr(state.networks, "value"):
        return {}
    value = state.networks.value(rows.obs.flatten(0, 1)).view(valid.shape)  # of rows, not of pieces
    after = next_values(state.networks.value, value, rows.obs, rows.next_obs)
    chosen, value, after = rows[valid], value[valid], after[valid]
    found["value/mean"] = value.mean()
    if gamma < 1:
        found["value/missing"] = _missing(td_target(chosen.reward, after, chosen.terminated, gamma=gamma), value, gamma)
    if chosen.terminated.any():
        found["value/at_ends"] = _awaited(value, chosen.reward, chosen.terminated)
    return found


def replay_signals(state: Any, rows: Rollout) -> dict[str, Tensor]:
    """The shares of the ends, and of the last, of the newest rows [T, N, …] that the replay buffer has otherwise.

    They are found there by their observation.

    - replay/other_actions, replay/other_next: rows that have another action, another next observation.
    - replay/other_signs: rows whose reward has another sign, of which 0 is one.
    - replay/other_ends: terminations that are stored as none; replay/other_limits: truncations stored as terminations.
    """
    replay = getattr(state, "replay", None)
    if type(replay) is not ReplayBuffer or replay.mirror:  # hindsight stores an episode when it has ended
        return {}
    newest = rows[rows.valid][-min(4 * SEEN, len(replay)) :]  # what is older may have been written over
    if newest.obs.shape[1] > 2 * MOST_NUMBERS:
        return {}
    last = torch.arange(len(newest.reward), device=newest.done.device) >= len(newest.reward) - SEEN // 4
    given, stored = newest[newest.done | last], replay.transitions[replay.newest(2 * len(newest.reward))]
    column = int(spread(given.obs.float()).argmax())  # an image has bytes
    pairs = (given.obs[:, column, None] == stored.obs[:, column]).nonzero()
    row, place = pairs[(given.obs[pairs[:, 0]] == stored.obs[pairs[:, 1]]).all(1)].unbind(1)
    new, kept = given[row], stored[place]
    found, every = dict[str, Tensor](), torch.ones_like(given.done)
    for name, agrees, which in (
        ("actions", (new.action - kept.action).abs().amax(-1) < 1e-5, every),
        ("next", (new.next_obs == kept.next_obs).all(-1), every),
        ("signs", new.reward.sign() == kept.reward.sign(), every),
        ("ends", kept.terminated, given.terminated),
        ("limits", ~kept.terminated, given.truncated & ~given.terminated),
    ):
        there = which[row]
        known, right = (set(row[each].tolist()) for each in (there, there & agrees))
        if known:
            found[f"replay/other_{name}"] = torch.tensor(1 - len(right) / len(known))
    return found


def critic_signals(state: Any, config: RunConfig, rows: Rollout, watched: Watched | None = None) -> dict[str, Tensor]:
    """The mean squared error of Q over one step, of the newest rows and of sampled ones, and the share that is missing.

    For algorithms that learn Q(s, a) of continuous actions; those that have no replay sample the newest rows. Also what
    Q awaits where an episode terminated, beyond its reward, over |Q|; the explained variance of the sampled targets by
    Q; the share of the buffer that the sampled rows are from; the length of the target networks' weights, their
    distance from Q's as a share of the length of these; the share of the sampled transitions in which Q of the policy's
    action is above that of one at random; and the entropy of uniform actions, which no other policy within the bounds
    has.
    """
    replay, networks, gamma = getattr(state, "replay", None), state.networks, getattr(config, "gamma", 1.0)
    if not hasattr(networks, "entropy_bonus") or not getattr(state, "updates", replay is None):
        return {}
    generator = torch.Generator(rows.reward.device).manual_seed(getattr(state, "updates", 0))  # none of the run's own
    newest = sampled = Transition(rows.obs, rows.action, rows.reward, rows.next_obs, rows.terminated)[-SEEN:]
    critics, targets, share = None, None, torch.ones(())
    if replay is not None:
        drawn = replay.sample_indices(1, SEEN, generator)[0]
        sampled, by_step = replay.transitions[drawn], watched.given[1] if watched else ()
        taken, stored = (by_step[0], watched.stored) if watched and by_step else (drawn, len(replay))
        share = (taken.max() - taken.min() + 1) / stored
        critics, targets = networks.critics, getattr(state.targets, "critics", state.targets)

    def critic(*pair: Tensor) -> Tensor:
        return critics(*pair)[0] if critics else networks.q(*pair)

    def estimates(batch: Transition) -> tuple[Tensor, Tensor]:
        pair = batch.next_obs, state.policy(batch.next_obs).mode()
        value = targets(*pair).amin(0) if targets else networks.q(*pair)
        value = value + networks.entropy_bonus(batch.next_obs, generator)
        return td_target(batch.reward, value, batch.terminated, gamma=gamma), critic(batch.obs, batch.action)

    (target, q), (other_target, other_q) = map(estimates, (newest, sampled))
    chosen = state.policy(sampled.obs).mode()
    chance = torch.empty_like(chosen).uniform_(-1, 1, generator=generator)
    better = critic(sampled.obs, chosen) - critic(sampled.obs, chance)
    found = {
        "action/preferred": (0.5 + 0.5 * better.sign()).mean(),  # where Q is flat, neither
        "action/most_entropy": torch.tensor(2.0).log() * chosen.shape[1],
    }
    if spread(other_target) > 1e-3 * other_target.abs().mean():  # else there is nothing to explain
        found["value/explained"] = explained_variance(other_q, other_target)
    if gamma < 1:
        found["value/missing"] = _missing(target, q, gamma)
    ends = torch.cat([newest.terminated, sampled.terminated])
    if ends.any():
        found["value/at_ends"] = _awaited(torch.cat([q, other_q]), torch.cat([newest.reward, sampled.reward]), ends)
    if critics and targets:
        everything = torch.cat([x.flatten(1) for x in (sampled.obs, sampled.next_obs, sampled.action)], 1)
        own, behind = (torch.cat([p.flatten() for p in each.parameters()]) for each in (critics, targets))
        found |= {
            "td_error/newest": (q - target).square().mean(),
            "td_error/sampled": (other_q - other_target).square().mean(),
            "replay/drawn": share,
            "replay/repeated": (sampled.obs == sampled.next_obs).flatten(1).all(1).float().mean(),
            "replay/empty": (everything == 0).all(1).float().mean(),
            "targets/behind": (own - behind).norm() / own.norm(),
            "targets/length": behind.norm(),
        }
    return found


def _missing(target: Tensor, value: Tensor, gamma: float) -> Tensor:
    return (target - value).mean() * value.mean().sign() / ((1 - gamma) * value.abs().mean())


def _awaited(value: Tensor, reward: Tensor, ends: Tensor) -> Tensor:
    """The mean of what values [B] await at ends beyond the reward, or of themselves where that is less, over |V|."""
    last, beyond = value[ends], (value - reward)[ends]
    awaited = torch.where(last.abs() < beyond.abs(), last, beyond)
    return awaited.mean() * value.mean().sign() / value.abs().mean()
