"""The signals of a run: oracles for what is measured, and that measuring changes nothing."""

import math
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, NamedTuple
from unittest.mock import patch

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import nn

import lemniscate as lem
from conftest import tiny_fields, tiny_off_policy
from lemniscate import algos
from lemniscate.algos import ppo
from lemniscate.data.hindsight import HindsightReplay
from lemniscate.data.replay import ReplayBuffer
from lemniscate.maths import Deterministic, explained_by, explained_by_each, gae, td_target, value_loss
from lemniscate.nn.actor_critic import ActorCritic
from lemniscate.nn.networks import Layers
from lemniscate.nn.normalizer import NoNorm, RunningNorm
from lemniscate.optim.adam import Adam
from lemniscate.run.metrics import read_metrics
from lemniscate.run.signals import (
    KINDS,
    LOOKS,
    critic_signals,
    effect_beside,
    effect_signals,
    environment_signals,
    late_effect,
    network_signals,
    paid_before,
    replay_signals,
    row_signals,
    signals,
    start_signals,
    time_signals,
    value_signals,
)
from lemniscate.run.updates import Watched, acted_with, batch_signals, update_signals
from lemniscate.spec import Box, Discrete, MultiDiscrete, ObservationPart, Spec
from lemniscate.types import Batch, Rollout, Step, Transition

B, O, A = 400, 3, 2


def numbers(*shape, seed=0):
    return torch.from_numpy(np.random.default_rng(seed).normal(size=shape))


def spec_of(action=None):
    return Spec("x", (ObservationPart((), (O,)),), action or Box((-1.0,) * A, (1.0,) * A))


def rows(**changed):
    flags = torch.zeros(B, dtype=torch.bool)
    given = {
        "obs": numbers(B, O).float(), "action": numbers(B, A, seed=1).float(), "reward": numbers(B, seed=2).float(),
        "next_obs": numbers(B, O, seed=3).float(), "terminated": flags, "truncated": flags, "valid": ~flags,
    }  # fmt: skip
    return Rollout(**{**given, **changed})


@pytest.mark.parametrize("beside", [0, 2])
def test_what_features_explain_is_the_partial_coefficient_of_determination(beside):
    x, z = numbers(B, 3), numbers(B, beside, seed=1)
    y = x @ numbers(3, 2, seed=2) + 0.3 * numbers(B, 2, seed=3) + z.sum(1, keepdim=True)

    def rss(*columns):
        design = np.concatenate([np.ones((B, 1)), *columns], axis=1)
        return ((y.numpy() - design @ np.linalg.lstsq(design, y.numpy(), rcond=None)[0]) ** 2).sum(0)

    few, many = B - beside - 1, B - beside - 1 - 3
    expected = 1 - (rss(z, x) / many) / (rss(z) / few)
    assert np.allclose(explained_by(x, y, z), expected, atol=1e-6)


def test_what_each_column_explains_is_what_it_explains_beside_the_others():
    x = numbers(B, 5)
    x[:, 4] = x[:, 3] + 0.1 * x[:, 4]
    y = x @ numbers(5, 2, seed=2) + 0.3 * numbers(B, 2, seed=3)
    alone = [explained_by(x[:, [i]], y, torch.cat([x[:, :i], x[:, i + 1 :]], dim=1)) for i in range(5)]
    torch.testing.assert_close(explained_by_each(x, y), torch.stack(alone), rtol=1e-5, atol=1e-6)
    twice = explained_by_each(torch.cat([x, x[:, :1]], dim=1), y)
    assert twice[[0, 5]].abs().max() < 0.01  # each says what the other does
    assert torch.isnan(explained_by_each(x[:5], y[:5])).all()


def test_noise_explains_nothing_and_too_few_rows_are_not_a_number():
    shares = [explained_by(numbers(B, 5, seed=s), numbers(B, 1, seed=99 + s), numbers(B, 0)).item() for s in range(50)]
    assert abs(np.mean(shares)) < 0.005
    assert torch.isnan(explained_by(numbers(4, 5), numbers(4, 1), numbers(4, 0))).all()
    assert explained_by(numbers(B, 2), torch.ones(B, 1, dtype=torch.float64), numbers(B, 0)).item() == 0


def test_columns_that_are_multiples_of_each_other_change_nothing():
    x, y = numbers(B, 2), numbers(B, 1, seed=1) + numbers(B, 2)[:, :1]
    twice = torch.cat([x, 3 * x, torch.zeros(B, 1)], dim=1)
    share, again = (explained_by(each, y, x[:, :0]).item() for each in (x, twice))
    assert share == pytest.approx(again, abs=0.01)


def delayed(late, ends=False):
    """Rows [T, N, …] of a number that is changed by the action of so many steps before."""
    steps, envs = 200, 4
    action, obs = numbers(steps, envs, A).float(), torch.zeros(steps + 1, envs, O)
    done = torch.zeros(steps, envs, dtype=torch.bool)
    done[9::10] = ends
    for t in range(steps):
        change = 0.01 * numbers(envs, O, seed=t).float()
        if t >= late:
            change[:, :A] += action[t - late]
        obs[t + 1] = 0.9 * obs[t] + change
    whole = {"obs": obs[:-1], "next_obs": obs[1:], "action": action, "reward": torch.zeros(steps, envs)}
    return Rollout(**whole, terminated=done, truncated=~done & done, valid=torch.ones_like(done))


@pytest.mark.parametrize("late", [1, 3, 6])
def test_an_action_that_is_late_is_found(late):
    rows = delayed(late)
    assert late_effect(rows, spec_of()).item() > 0.9
    assert effect_signals(rows[rows.valid], spec_of())["action/effect"].item() < 0.1
    assert late_effect(delayed(0), spec_of()).item() < 0.1


def test_of_a_servo_that_is_not_observed_the_sum_of_the_actions_is_found():
    rows = delayed(0)
    done = torch.zeros_like(rows.terminated)
    done[9::10] = True
    sums = torch.stack([rows.action[10 * (t // 10) : t + 1].sum(0) for t in range(len(rows.action))])
    moved = rows.obs + 0.1 * numbers(*rows.obs.shape, seed=9).float()
    moved[..., :A] += sums
    late = Rollout(**{**vars(rows), "next_obs": moved, "terminated": done})
    assert late_effect(late, spec_of()).item() > 0.6


def test_an_action_that_is_late_is_found_within_episodes():
    """Where episodes end every three steps, actions of more than two steps before are of another one."""
    rows = delayed(3)
    done = torch.zeros_like(rows.terminated)
    done[2::3] = True
    rows = Rollout(**{**vars(rows), "terminated": done})
    assert late_effect(rows, spec_of()).item() < 0.1


def test_an_observation_of_the_environment_beside_shows_its_action():
    own, one = delayed(0), delayed(0)[:, :1]
    exchanged = Rollout(**{name: x if name == "action" else x.roll(1, 1) for name, x in vars(own).items()})
    assert effect_beside(exchanged, spec_of()).item() > 0.9
    assert effect_beside(own, spec_of()).item() < 0.1
    assert effect_beside(one, spec_of()).item() == 0


def test_rewards_of_nothing_and_observations_that_repeat_are_counted():
    obs = numbers(B, O).float()
    after = torch.where(torch.arange(B)[:, None] % 4 == 0, obs, obs + 1)
    reward = (torch.arange(B) % 10 == 0).float()
    found = row_signals(rows(obs=obs, next_obs=after, reward=reward), spec_of())
    assert found["reward/zero"].item() == pytest.approx(0.9)
    assert found["observation/repeated"].item() == pytest.approx(0.25)
    assert "observation/repeated" not in row_signals(rows(obs=(obs > 0).float()), spec_of())


def test_an_observation_of_noise_says_nothing_of_the_next():
    obs = numbers(B, O).float()
    still = effect_signals(rows(obs=obs, next_obs=obs + 0.1 * numbers(B, O, seed=5).float()), spec_of())
    noise = effect_signals(rows(), spec_of())
    assert still["observation/predicted"].item() > 0.95
    assert abs(noise["observation/predicted"].item()) < 0.05


def test_a_weak_action_has_a_small_share_of_the_change():
    obs, action = numbers(B, O), numbers(B, A, seed=1)
    after = 0.5 * obs
    after[:, :A] += 0.01 * action
    found = effect_signals(rows(obs=obs.float(), action=action.float(), next_obs=after.float()), spec_of())
    assert found["action/effect"].item() > 0.99
    assert found["action/share"].item() == pytest.approx((0.01 / 0.5) ** 2, rel=0.3)


def test_rewards_that_tell_the_time_do_so_within_each_episode():
    steps, envs = 40, 3
    done = torch.zeros(steps, envs, dtype=torch.bool)
    done[9::10] = True
    age = torch.arange(steps) % 10
    reward = (age[:, None] + 100.0 * torch.arange(envs)).float()  # another level in each environment
    shape = {"terminated": done, "truncated": ~done & done, "valid": torch.ones_like(done), "reward": reward}
    assert time_signals(SimpleNamespace(done=done, **shape))["reward/by_time"].item() == pytest.approx(1)
    noise = numbers(steps, envs).float()
    assert time_signals(SimpleNamespace(done=done, **{**shape, "reward": noise}))["reward/by_time"].item() < 0.1
    assert (
        time_signals(SimpleNamespace(done=done, **{**shape, "reward": torch.ones_like(reward)}))["reward/by_time"] == 0
    )


def aged(steps, ages):
    """Rows [T, N] of episodes that go on, and the number of steps that each had before them, [T, N]."""
    flags = dict.fromkeys(("terminated", "truncated"), torch.zeros(steps, len(ages), dtype=torch.bool))
    start = ages - steps + torch.arange(steps)[:, None]
    given = {name: numbers(steps, len(ages), size, seed=i).float() for i, (name, size) in enumerate(SIZES.items())}
    reward, valid = numbers(steps, len(ages), seed=9).float(), torch.ones_like(flags["truncated"])
    return Rollout(**given, **flags, reward=reward, valid=valid), start


SIZES = {"obs": O, "action": A, "next_obs": O}


def test_rewards_that_grow_with_the_age_of_an_episode_are_explained_by_it_alone():
    ages = torch.tensor([50.0, 400.0, 800.0, 990.0])
    rows, age = aged(40, ages)
    grown = replace(rows, reward=rows.reward + 0.05 * age)
    found, noise = (environment_signals(each, spec_of(), ages)["reward/by_age"] for each in (grown, rows))
    assert found > 0.9
    assert noise < 0.1
    seen = replace(grown, obs=torch.cat([age[..., None].float(), rows.obs[..., 1:]], -1))  # an observation tells it
    assert "reward/by_age" not in environment_signals(seen, spec_of(), ages)
    assert "reward/by_age" not in environment_signals(grown, spec_of())


def test_the_age_at_which_rare_rewards_are_paid_is_a_share_of_that_of_all_rows():
    ages = torch.tensor([80.0, 80.0, 80.0])
    rows, age = aged(80, ages)
    early, late = ((replace(rows, reward=(at).float())) for at in (age < 4, age >= 76))
    assert environment_signals(early, spec_of(), ages)["reward/age"] == pytest.approx(2.5 / 40.5)
    assert environment_signals(late, spec_of(), ages)["reward/age"] == pytest.approx(78.5 / 40.5)
    assert "reward/age" not in environment_signals(rows, spec_of(), ages)


def test_observations_that_jump_at_the_same_ages_are_of_ends_that_nobody_reports():
    ages = torch.tensor([97.0, 110.0, 83.0, 120.0])
    rows, age = aged(80, ages)
    places = numbers(80, 4, O, seed=3).float()

    def moved(at):
        place = places.gather(0, at.cumsum(0)[..., None].expand_as(places))  # another one from each of these steps on
        obs = torch.cat([places[:1], place[:-1]]) + 0.01 * rows.obs
        return environment_signals(replace(rows, obs=obs, next_obs=place), spec_of(), ages)

    every = moved((age + 1) % 25 == 0)
    assert every["observation/jumps_every"] == 25
    assert "observation/jumps_every" not in moved(numbers(80, 4, seed=5) > 1.5)
    assert "observation/jumps_every" not in moved(torch.zeros(80, 4, dtype=torch.bool))


def test_the_variance_of_rewards_within_episodes_is_what_their_means_leave():
    steps, envs = 40, 3
    done = torch.zeros(steps, envs, dtype=torch.bool)
    done[9::10] = True
    level = numbers(4, envs, seed=1).repeat_interleave(10, dim=0)  # one for each episode
    noise = numbers(steps, envs)

    def within(reward):
        shape = {"terminated": done, "truncated": ~done & done, "valid": torch.ones_like(done)}
        return time_signals(SimpleNamespace(done=done, reward=reward.float(), **shape))["reward/within"].item()

    episodes = (level + noise).view(4, 10, envs)
    expected = (episodes - episodes.mean(1, keepdim=True)).square().mean() / (level + noise).var(correction=0)
    assert within(level) == pytest.approx(0, abs=1e-9)
    each = {"terminated": ~(done & ~done), "truncated": done & ~done, "valid": torch.ones_like(done)}
    assert "reward/within" not in time_signals(SimpleNamespace(done=each["terminated"], reward=noise.float(), **each))
    assert within(level + noise) == pytest.approx(expected.item(), rel=1e-4)


@pytest.mark.parametrize("late", [0, 1, 3])
def test_a_reward_of_an_earlier_step_is_explained_by_its_row(late):
    steps, envs = 200, 4
    obs, action = numbers(steps + 1, envs, O).float(), numbers(steps, envs, A, seed=1).float()
    earned, done = obs[:-1].sum(-1) + action.sum(-1), torch.zeros(steps, envs, dtype=torch.bool)
    done[19::20] = True
    reward = torch.cat([torch.zeros(late, envs), earned[: steps - late]])
    shape = {"obs": obs[:-1], "action": action, "reward": reward, "next_obs": obs[1:], "terminated": done}
    rows = Rollout(**shape, truncated=~done & done, valid=torch.ones_like(done))
    share = paid_before(rows, spec_of(), effect_signals(rows[rows.valid], spec_of())["reward/explained"]).item()
    assert share > 0.7 if late else share < -0.3  # the row before knows the observation, and no action


def test_actions_explain_what_they_do():
    obs, action = numbers(B, O).float(), numbers(B, A, seed=1).float()
    moved = obs.clone()
    moved[:, 1] += action[:, 0]
    pays = action.square().sum(1)
    found = effect_signals(rows(obs=obs, action=action, next_obs=moved, reward=pays), spec_of())
    assert found["action/effect"] == pytest.approx(1)
    assert found["reward/explained"] == pytest.approx(1)
    assert found["action/paid"] < 0.1  # of squares, no line explains anything
    paid = effect_signals(rows(obs=obs, action=action, reward=action.sum(1)), spec_of())
    assert paid["action/paid"] == pytest.approx(1)
    still = effect_signals(rows(obs=obs, action=action, next_obs=obs + 0.1 * numbers(B, O, seed=5).float()), spec_of())
    assert still["action/effect"] < 0.05
    assert abs(still["reward/explained"]) < 0.1


def test_a_number_of_the_action_without_effect_is_the_weakest():
    obs, action = numbers(B, O).float(), numbers(B, A, seed=1).float()

    def weakest(*effects):
        moved = obs + 0.1 * numbers(B, O, seed=5).float()
        for column, effect in enumerate(effects):
            moved[:, column] += effect * action[:, column]
        return effect_signals(rows(obs=obs, action=action, next_obs=moved), spec_of())["action/weakest"].item()

    assert weakest(1.0, 1.0) > 0.9
    assert weakest(1.0, 0.0) < 0.02
    alone = rows(action=action[:, :1])
    assert "action/weakest" not in effect_signals(alone, spec_of(Box((-1.0,), (1.0,))))


def test_actions_of_a_sign_without_effect_explain_nothing():
    obs, action = numbers(B, O).float(), numbers(B, A, seed=1).float()

    def half(moved):
        return effect_signals(rows(obs=obs, action=action, next_obs=moved), spec_of())["action/half"].item()

    moved = obs + 0.1 * numbers(B, O, seed=5).float()
    moved[:, :A] += action
    assert half(moved) > 0.9
    moved[:, :A] -= action.clamp(max=0)
    assert half(moved) < 0.02
    moved[:, 1] += action[:, 1].clamp(max=0)  # of one number they have an effect
    assert half(moved) > 0.9
    by_sign = rows(obs=obs, action=action, next_obs=obs + action.sign() @ torch.eye(A, O))
    assert effect_signals(by_sign, spec_of())["action/half"] > 0.5
    positive = rows(obs=obs, action=action.abs(), next_obs=obs + action.abs() @ torch.eye(A, O))
    assert "action/half" not in effect_signals(positive, spec_of())


def test_the_time_is_no_servo():
    """An observation that drifts within an episode is explained by no sum of choices, which add up to the time."""
    steps, envs = 120, 4
    action = torch.from_numpy(np.random.default_rng(0).integers(0, 3, (steps, envs)))
    done = (torch.arange(steps) % 20 == 19)[:, None].expand(steps, envs)
    obs = 0.01 * numbers(steps, envs, O).float()
    drift = (torch.arange(steps) % 20)[:, None, None] * torch.ones(1, envs, O)
    whole = {"obs": obs, "next_obs": obs + drift, "action": action, "reward": torch.zeros(steps, envs)}
    drifting = Rollout(**whole, terminated=done, truncated=done & ~done, valid=torch.ones_like(done))
    assert late_effect(drifting, spec_of(Discrete(3))).item() < 0.15


@pytest.mark.filterwarnings("error")
def test_one_step_episodes_have_signals():
    obs = numbers(B, O).float()
    found = effect_signals(rows(obs=obs, terminated=torch.ones(B, dtype=torch.bool)), spec_of())
    assert "observation/pace" not in found


def test_of_many_environments_some_are_looked_at():
    """Of the first there are lines; those beyond `MOST_ROWS` rows change nothing of them."""
    many = {name: torch.cat([column] * 30, 1) for name, column in vars(delayed(3)).items()}
    other = many | {"next_obs": torch.cat([many["next_obs"][:, :60], numbers(200, 60, O, seed=7).float()], 1)}
    one, two = (environment_signals(Rollout(**columns), spec_of()) for columns in (many, other))
    assert one["action/late"] == two["action/late"] > 0.9


def test_of_several_choices_at_once_none_are_compared():
    obs, action = numbers(B, O).float(), torch.randint(0, 2, (B, 2), generator=torch.Generator().manual_seed(0))
    moved = obs + (action[:, :1] + 2 * action[:, 1:])
    found = effect_signals(rows(obs=obs, action=action, next_obs=moved), spec_of(MultiDiscrete((2, 2), (0, 0))))
    assert "action/alike" not in found


def test_two_choices_that_do_the_same_are_alike():
    obs, action = numbers(B, O).float(), torch.arange(B) % 4

    def alike(*effects, action=action):
        moved = obs + 0.1 * numbers(B, O, seed=5).float() + torch.tensor(effects)[action][:, None]
        return effect_signals(rows(obs=obs, action=action, next_obs=moved), spec_of(Discrete(4))).get("action/alike")

    assert alike(0.0, 5.0, -1.0, 2.0) > 0.9
    assert alike(0.0, 5.0, -1.0, 5.0) < 0.02
    assert alike(0.0, 5.0, 5.0, 5.0, action=action.clamp(max=1)) > 0.9  # the others are hardly made
    assert alike(1.0, 1.0, 1.0, 1.0, action=torch.zeros_like(action)) is None


def test_the_pace_is_that_of_the_number_that_moves_most():
    obs = numbers(B, O).float()
    moved = obs + torch.tensor([0.0, 0.5, 0.01])[:O]
    found = effect_signals(rows(obs=obs, next_obs=moved), spec_of())
    assert found["observation/pace"] == pytest.approx(0.5 / obs[:, 1].std(correction=0).item(), rel=1e-5)


def test_choices_explain_what_they_do():
    obs, action = numbers(B, O).float(), torch.arange(B) % 4
    moved = obs + torch.tensor([0.0, 5.0, -1.0, 2.0])[action][:, None]
    found = effect_signals(rows(obs=obs, action=action, next_obs=moved), spec_of(Discrete(4)))
    assert found["action/effect"] == pytest.approx(1)


def test_sizes_and_shares():
    obs = numbers(B, O).float()
    obs[:, 2] = 7
    ends = torch.arange(B) % 10 == 9
    action = torch.where(torch.arange(B)[:, None] % 4 == 0, 1.0, 0.5).expand(B, A)
    truncated = ends & (torch.arange(B) % 20 == 19)
    found = row_signals(rows(obs=obs, action=action, terminated=ends & ~truncated, truncated=truncated), spec_of())
    assert found["observation/constant"] == pytest.approx(1 / 3)
    assert found["observation/largest"] == 7
    assert found["action/at_bounds"] == 0.25
    assert found["episode/terminated"] == 0.5
    assert "action/at_bounds" not in row_signals(rows(action=torch.zeros(B, dtype=torch.int64)), spec_of(Discrete(2)))


def stop_at(at):
    return lambda step, _metrics, _policy: step >= at


class Policy(nn.Module):
    def __init__(self, net, normalizer):
        super().__init__()
        self.net, self.normalizer = net, normalizer

    def forward(self, obs):
        return self.net(self.normalizer(obs))


@pytest.mark.parametrize("kind", [nn.ReLU, nn.Tanh])
def test_inactive_units_are_counted(kind):
    layer = nn.Linear(O, 8)
    with torch.no_grad():
        layer.weight.copy_(0.5 * numbers(8, O, seed=2))
        layer.bias.zero_()
        layer.bias[:6] = -50.0  # of ReLU zero, of tanh at its bound
    found = network_signals(SimpleNamespace(policy=Policy(nn.Sequential(layer, kind()), NoNorm(O))), rows())
    assert found["network/inactive"] == 0.75
    assert found["network/rank"] <= 3 / 8
    assert found["network/saturated"] == pytest.approx(0.75 * (kind is nn.Tanh), abs=0.1)
    assert "normalizer/count" not in found


def test_the_rank_is_that_of_the_features():
    layer = nn.Linear(O, 8)
    with torch.no_grad():
        layer.weight.copy_(1e-4 * torch.outer(torch.arange(1.0, 9), torch.tensor([1.0, 2, 3])))
        layer.bias.zero_()
    found = network_signals(SimpleNamespace(policy=Policy(nn.Sequential(layer, nn.Tanh()), NoNorm(O))), rows())
    assert found["network/rank"] == 1 / 8


def test_units_that_begin_with_one_number_are_alike():
    layer = nn.Linear(O, 8)

    def alike(weights):
        with torch.no_grad():
            layer.weight.copy_(weights)
            layer.bias.zero_()
        return network_signals(SimpleNamespace(policy=Policy(nn.Sequential(layer, nn.Tanh()), NoNorm(O))), rows())

    assert alike(torch.full((8, O), 0.1))["network/alike"] == 1
    assert alike(torch.arange(8.0)[:, None] * torch.ones(O))["network/alike"] == 1 / 8  # of rank 1, too
    assert "network/alike" not in alike(torch.zeros(8, O))


def test_a_normalizer_that_is_behind_shows_its_offset():
    normalizer = RunningNorm(O)
    normalizer.update(numbers(B, O, seed=7).float())
    policy = Policy(nn.Identity(), normalizer)
    assert network_signals(SimpleNamespace(policy=policy), rows())["normalizer/offset"] < 0.2
    found = network_signals(SimpleNamespace(policy=policy), rows(obs=numbers(B, O).float() + 5))
    assert found["normalizer/offset"] == pytest.approx(5, abs=0.5)
    assert found["normalizer/count"] == B


def test_there_are_signals_in_a_known_number_of_lines_of_a_run_and_in_its_first(tmp_path):
    fields = tiny_fields(total_steps=32 * 200)
    run = lem.train("ppo", "Countdown-v0", run=tmp_path / "r", progress=False, **fields)
    lines = read_metrics(run.path)
    looked = [line["step"] for line in lines if "reward/largest" in line]
    assert len(lines) == 200
    assert LOOKS - 4 <= len(looked) <= LOOKS + 1
    assert looked[0] == lines[0]["step"]
    assert len({after - before for before, after in pairwise(looked)}) == 1
    assert {"normalizer/count", "network/inactive", "action/effect", "value/missing", "advantage/followed"} <= lines[
        0
    ].keys()


@pytest.mark.parametrize(
    ("algorithm", "compiled"), [("ppo", "off"), ("sac", "off"), ("sac", "on"), ("pqn", "off"), ("reinforce", "off")]
)
@pytest.mark.one_in(2)
def test_measuring_changes_no_bit_of_a_run(tmp_path, monkeypatch, algorithm, compiled):
    env = "Pendulum-v1" if algorithm == "sac" else "Matching-v0"
    fields = tiny_off_policy() if algorithm == "sac" else {"num_envs": 2, "num_steps": 8, "total_steps": 128}
    fields |= {
        "ppo": {"minibatch_size": 8},
        "pqn": {"minibatch_size": 8},
        "reinforce": {"critic_minibatch_size": 8},
    }.get(algorithm, {})
    fields |= {"compile": compiled}
    looking = lem.train(algorithm, env, run=tmp_path / "a", progress=False, **fields)
    monkeypatch.setattr("lemniscate.run.run.signals", lambda *_: {})
    monkeypatch.setattr("lemniscate.run.run.Watched", lambda *_: None)
    blind = lem.train(algorithm, env, run=tmp_path / "b", progress=False, **fields)
    assert "reward/mean" in read_metrics(looking.path)[0]
    assert "reward/mean" not in read_metrics(blind.path)[0]
    one, other = (run.policy.networks.state_dict() for run in (looking, blind))
    assert all(torch.equal(one[name], other[name]) for name in other)


def test_of_the_largest_q_is_known_what_is_known_of_a_value(tmp_path):
    fields = {"num_envs": 2, "num_steps": 8, "minibatch_size": 8, "total_steps": 128}
    run = lem.train("pqn", "CartPole-v1", run=tmp_path / "r", progress=False, **fields)
    line = read_metrics(run.path)[0]
    assert line["network/moved"] > 0
    assert "value/missing" in line
    assert not {"value/moved", "advantage/followed"} & line.keys()


def test_of_replay_the_errors_of_new_and_of_sampled_transitions_stand_side_by_side(tmp_path):
    run = lem.train("td3", "Pendulum-v1", run=tmp_path / "r", progress=False, **tiny_off_policy())
    last = [line for line in read_metrics(run.path) if "td_error/newest" in line][-1]
    assert last["td_error/newest"] > 0
    assert last["td_error/sampled"] > 0


def test_a_resumed_run_has_signals_where_the_uninterrupted_one_has_them(tmp_path):
    fields = tiny_fields(total_steps=32 * 30, checkpoint_every=32 * 5)

    def looked(path):
        return [line["step"] for line in read_metrics(path) if "reward/mean" in line]

    whole = lem.train("ppo", "Countdown-v0", run=tmp_path / "a", progress=False, **fields)
    lem.train("ppo", "Countdown-v0", run=tmp_path / "b", progress=False, callbacks=[stop_at(32 * 17)], **fields)
    lem.resume(tmp_path / "b", progress=False)
    assert looked(whole.path) == looked(tmp_path / "b")


class Steady(nn.Module):
    """V of every state is `size`."""

    def __init__(self, size):
        super().__init__()
        self.value = lambda obs: torch.full(obs.shape[:-1], size)


@pytest.mark.parametrize(
    ("size", "reward", "missing"), [(10.0, 1.0, 0.0), (4.0, 1.0, 1.5), (-4.0, -1.0, 1.5), (20.0, 1.0, -0.5)]
)
def test_the_share_of_the_value_that_is_missing(size, reward, missing):
    state, config = SimpleNamespace(networks=Steady(size)), SimpleNamespace(gamma=0.9)
    found = value_signals(state, config, rows(reward=torch.full((B,), reward))[None])
    assert found["value/missing"] == pytest.approx(missing, abs=1e-5)  # (V of the policy, 10, less V) / |V|
    assert found["value/mean"] == size
    assert value_signals(state, SimpleNamespace(gamma=1.0), rows()[None]).keys() == {"value/mean"}


def test_what_the_value_awaits_beyond_an_end():
    """V is 4 everywhere, and the last rewards are 1 and 2: 3 and 2 of 4 too much; it knows nothing of a reward of −9."""
    reward, terminated = torch.zeros(B), torch.zeros(B, dtype=torch.bool)
    reward[[5, 9]], terminated[[5, 9]] = torch.tensor([1.0, 2.0]), True
    state, config = SimpleNamespace(networks=Steady(4.0)), SimpleNamespace(gamma=0.9)
    assert value_signals(state, config, rows(reward=reward, terminated=terminated)[None])["value/at_ends"] == 2.5 / 4
    assert value_signals(state, config, rows(reward=reward - 11, terminated=terminated)[None])["value/at_ends"] == 1
    state = SimpleNamespace(networks=Steady(-4.0))
    assert value_signals(state, config, rows(reward=-reward, terminated=terminated)[None])["value/at_ends"] == 2.5 / 4
    assert "value/at_ends" not in value_signals(state, config, rows(truncated=terminated)[None])


T, N = 16, 4


def stateful(action):
    """A training state with a policy for `action` spaces and V(s), and rows [T, N] of its own actions."""
    torch.manual_seed(0)
    networks = ActorCritic(spec_of(action), Layers((8,)), -0.5, normalize_observations=True)
    obs = numbers(T, N, O).float()
    acted, flags = (
        networks.policy(obs).sample(networks.policy.draw_noise((T, N), torch.Generator().manual_seed(1))),
        torch.zeros(T, N).bool(),
    )
    found = {"obs": obs, "action": acted, "reward": numbers(T, N, seed=2).float()}
    ends = {"terminated": flags.clone(), "truncated": flags.clone(), "valid": ~flags}
    ends["terminated"][[3, 8], [1, 2]] = ends["truncated"][6, 0] = True
    ends["valid"][9, 2] = False
    return SimpleNamespace(networks=networks, policy=networks.policy), Rollout(
        **found, **ends, next_obs=numbers(T, N, O, seed=3).float()
    )


@pytest.mark.parametrize("action", [None, Discrete(3)])
def test_the_correlation_of_advantages_and_of_what_an_update_did_to_the_policy(action):
    state, rows = stateful(action)
    before = acted_with(state)
    old = state.policy(rows.obs).log_prob(rows.action).detach()
    value, after = state.networks.value(rows.obs).detach(), state.networks.value(rows.next_obs).detach()
    with torch.no_grad():
        for parameter in state.policy.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    state.policy.observe(5 * rows.obs, rows.valid)  # the normalizer is a part of what changed
    with torch.no_grad():  # V of before the update is what advantages are of
        for parameter in state.networks.value.parameters():
            parameter.add_(0.1)
    advantage = np.zeros((T, N))
    for n in range(N):
        for t in reversed(range(T)):
            delta = rows.reward[t, n] + 0.9 * after[t, n] * (not rows.terminated[t, n]) - value[t, n]
            follows = 0.0 if rows.done[t, n] or t == T - 1 else advantage[t + 1, n]
            advantage[t, n] = delta + 0.9 * 0.95 * follows
    change = (state.policy(rows.obs).log_prob(rows.action).detach() - old).numpy()
    newest = rows.valid.numpy() & (np.arange(T) >= T - 12)[:, None]
    expected = np.corrcoef(advantage[newest], change[newest])[0, 1]
    config = SimpleNamespace(gamma=0.9, num_steps=12)
    found = update_signals(state, config, rows, before)
    assert found["advantage/followed"].item() == pytest.approx(expected, abs=1e-4)
    target = (advantage + value.numpy())[newest]
    left = np.var(target - value.numpy()[newest]) / np.var(target)
    assert found["value/explained"].item() == pytest.approx(1 - left, abs=1e-4)
    still = update_signals(state, config, rows, acted_with(state))
    assert still["advantage/followed"] == still["network/moved"] == 0
    assert update_signals(state, config, rows, None) == {}


def test_where_every_target_is_the_same_there_is_nothing_to_explain():
    state, rows = stateful(None)
    with torch.no_grad():
        for parameter in state.networks.value.parameters():
            parameter.zero_()
    rows = replace(rows, reward=torch.ones(T, N), terminated=torch.ones(T, N).bool())
    config = SimpleNamespace(gamma=0.9, num_steps=T)
    assert "value/explained" not in update_signals(state, config, rows, acted_with(state))


def test_v_is_measured_in_units_of_scaled_rewards():
    """V of 1 everywhere, rewards of 10 that are scaled to 1, γ = 0.5: half of the value that follows is missing."""
    state = SimpleNamespace(
        networks=Steady(1.0), policy=stateful(None)[0].policy, reward_scale=lambda reward: reward / 10
    )
    given = rows(reward=torch.full((B,), 10.0))[None]
    config = SimpleNamespace(gamma=0.5, scale_rewards=True)
    found = signals(state, config, spec_of(), given)
    assert found["value/missing"] == pytest.approx(1.0)
    assert found["reward/mean"] == 10


def test_the_way_of_a_policy_is_that_of_its_parameters_alone():
    state, rows = stateful(Discrete(3))
    before = acted_with(state)
    state.policy.observe(5 * rows.obs, rows.valid)
    config = SimpleNamespace(gamma=0.9, num_steps=12)
    assert update_signals(state, config, rows, before)["network/moved"] == 0
    with torch.no_grad():
        for parameter in state.policy.parameters():
            parameter *= 1.25
    found = update_signals(state, config, rows, before)
    assert found["network/moved"].item() == pytest.approx(0.2)
    assert found["value/moved"] == 0
    with torch.no_grad():
        for parameter in state.networks.value.parameters():
            parameter *= 0.5
    assert update_signals(state, config, rows, before)["value/moved"].item() == pytest.approx(1.0)


def test_ppo_follows_its_advantages_and_with_a_wrong_sign_it_does_not(tmp_path):
    fields = {"num_envs": 4, "num_steps": 64, "total_steps": 4 * 64 * 20, "minibatch_size": 64, "progress": False}

    def followed(path):
        lines = read_metrics(lem.train("ppo", "CartPole-v1", run=path, **fields).path)
        return np.mean([line["advantage/followed"] for line in lines if "advantage/followed" in line])

    assert followed(tmp_path / "right") > 0.05
    with patch.object(ppo, "gae", lambda *a, **options: (lambda found: (-found[0], found[1]))(gae(*a, **options))):
        assert followed(tmp_path / "wrong") < -0.05


def test_numbers_that_are_cut_off_stand_at_their_limits():
    obs = numbers(B, O).float()
    assert row_signals(rows(obs=obs), spec_of())["observation/at_limits"].item() == pytest.approx(2 / B)
    assert row_signals(rows(obs=obs), spec_of())["observation/whole"] == 0
    half = torch.cat([(3 * obs[:, :2]).round(), obs[:, 2:]], dim=1)
    assert row_signals(rows(obs=half), spec_of())["observation/whole"].item() == pytest.approx(2 / O)
    cut = torch.cat([(obs[:, :2] * 100).clamp(-1, 1), (obs[:, 2:] > 0).float()], dim=1)  # the last has two values alone
    expected = (cut[:, :2].abs() == 1).float().mean().item()
    assert expected > 0.9
    assert row_signals(rows(obs=cut), spec_of())["observation/at_limits"].item() == pytest.approx(expected)
    assert "observation/at_limits" not in row_signals(rows(obs=(obs > 0).float()), spec_of())


@pytest.mark.parametrize("times", [0.5, 100.0])
def test_the_signs_of_actions_that_are_cut_off_explain_what_is_left(times):
    action = numbers(B, A, seed=1).clamp(-1, 1)
    moved = torch.cat([(times * action).clamp(-1, 1), torch.zeros(B, 1)], dim=1)
    found = effect_signals(rows(action=action.float(), next_obs=(numbers(B, O) + moved).float()), spec_of())
    assert (found["action/by_sign"] > 0.9) == (times > 1)


def test_episodes_that_begin_alike():
    """Two environments of six steps; in the second, the row of a reset stands between two episodes."""
    obs = torch.arange(6.0)[:, None, None].repeat(1, 2, O)
    terminated, valid = torch.zeros(6, 2, dtype=torch.bool), torch.ones(6, 2, dtype=torch.bool)
    terminated[[1, 3], 0] = terminated[1, 1] = True
    valid[2, 1] = False
    obs[[2, 4], 0] = obs[3, 1] = 7.0
    flags = {"terminated": terminated, "truncated": torch.zeros_like(terminated), "valid": valid}
    found = {"obs": obs, "next_obs": obs, "action": torch.zeros(6, 2, A), "reward": torch.zeros(6, 2), **flags}
    assert start_signals(Rollout(**found), spec_of())["observation/starts_alike"] == 1
    found["obs"][3, 1, 0] = 6.0
    assert start_signals(Rollout(**found), spec_of())["observation/starts_alike"] == 0
    terminated[1] = False
    assert start_signals(Rollout(**found), spec_of()) == {}  # two beginnings say nothing


def test_of_targets_the_distance_and_of_replay_what_stands_still(tmp_path):
    def last(path):
        lines = read_metrics(lem.train("td3", "Pendulum-v1", run=path, progress=False, **tiny_off_policy()).path)
        return [line for line in lines if "targets/behind" in line][-1]

    moved = last(tmp_path / "moved")
    with patch("lemniscate.algos.td3.polyak", lambda *_: None):
        stayed = last(tmp_path / "stayed")
    assert 0 < moved["targets/behind"] < stayed["targets/behind"]
    assert moved["targets/length"] != stayed["targets/length"] > 0
    assert moved["replay/repeated"] == 0


class AtAnEnd(nn.Module):
    """A policy with one action everywhere."""

    def __init__(self, action):
        super().__init__()
        self.action = action

    def forward(self, obs):
        return Deterministic(torch.full((len(obs), 1), self.action))


class QIsTheAction(nn.Module):
    """Q(s, a) = w a, of one critic."""

    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(1))

    def forward(self, obs, action):
        return self.weight * action.T


class Drawn:
    """A replay buffer of B rows, of which these are drawn."""

    def __init__(self, transitions, rows):
        self.transitions, self.rows = transitions, rows

    def __len__(self):
        return B

    def sample_indices(self, *_):
        return self.rows[None]


@pytest.mark.parametrize(("action", "weight", "share"), [(1.0, 1.0, 1.0), (-1.0, 1.0, 0.0), (1.0, 0.0, 0.5)])
def test_the_policys_action_stands_beside_one_at_random(action, weight, share):
    columns = Transition(
        numbers(B, O).float(), torch.zeros(B, 1), torch.zeros(B), numbers(B, O).float(), torch.zeros(B).bool()
    )
    replay = Drawn(columns, torch.arange(B))
    networks = SimpleNamespace(critics=QIsTheAction(), entropy_bonus=lambda *_: 0.0)
    networks.critics.weight.data.fill_(weight)
    state = SimpleNamespace(replay=replay, updates=1, networks=networks, targets=QIsTheAction(), policy=AtAnEnd(action))
    rows = Rollout(**vars(columns), truncated=columns.terminated, valid=~columns.terminated)
    found = critic_signals(state, SimpleNamespace(gamma=0.9), rows)
    assert found["action/preferred"] == share
    assert "value/explained" not in found  # targets that are all alike


@pytest.mark.parametrize(("drawn", "share"), [(range(B), 1.0), (range(B // 4), 0.25), (range(B - 10, B), 10 / B)])
def test_the_share_of_the_buffer_that_is_drawn_from_is_told(drawn, share):
    taken = rows(action=numbers(B, 1).float())
    columns = Transition(taken.obs, taken.action, taken.reward, taken.next_obs, taken.terminated)
    networks = SimpleNamespace(critics=QIsTheAction(), entropy_bonus=lambda *_: 0.0)
    of = {"networks": networks, "targets": QIsTheAction(), "policy": AtAnEnd(1.0)}
    state = SimpleNamespace(replay=Drawn(columns, torch.tensor(drawn)), updates=1, **of)
    assert critic_signals(state, SimpleNamespace(gamma=0.9), taken)["replay/drawn"].item() == pytest.approx(share)


def test_of_the_sampled_targets_q_explains_its_share():
    """Targets are the rewards, as every row ends; Q is the action, which is the reward and noise of a fourth of it."""
    reward, noise = numbers(B).float(), numbers(B, seed=1).float()
    ends = torch.ones(B, dtype=torch.bool)
    taken = rows(action=(reward + 0.5 * noise)[:, None], reward=reward, terminated=ends)
    columns = Transition(taken.obs, taken.action, taken.reward, taken.next_obs, taken.terminated)
    replay = Drawn(columns, torch.arange(B))
    networks = SimpleNamespace(critics=QIsTheAction(), entropy_bonus=lambda *_: 0.0)
    state = SimpleNamespace(replay=replay, updates=1, networks=networks, targets=QIsTheAction(), policy=AtAnEnd(1.0))
    found = critic_signals(state, SimpleNamespace(gamma=0.9), taken)
    expected = 1 - 0.25 * noise.var() / reward.var()
    assert found["value/explained"].item() == pytest.approx(expected.item(), rel=1e-5)


def test_a_q_without_replay_is_measured_at_the_newest_rows():
    """Q is the action: 1 at the policy's, 0 at those that were taken; γ = 0.9, rewards of −2, ends at every other row."""
    ends = torch.arange(B) % 2 == 0
    networks = SimpleNamespace(q=lambda obs, action: action[:, 0] + 0 * obs[:, 0], entropy_bonus=lambda *_: 0.5)
    state = SimpleNamespace(networks=networks, policy=AtAnEnd(1.0))
    taken = rows(action=torch.full((B, 1), 0.5), reward=torch.full((B,), -2.0), terminated=ends)
    found = critic_signals(state, SimpleNamespace(gamma=0.9), taken)
    names = {"action/preferred", "action/most_entropy", "value/missing", "value/at_ends", "value/explained"}
    assert found.keys() == names
    assert found["action/preferred"] == 1
    assert found["value/explained"].abs() < 1e-5  # Q is the same everywhere
    assert found["action/most_entropy"] == pytest.approx(math.log(2))
    target = -2 + 0.9 * 1.5 / 2  # on average
    assert found["value/missing"] == pytest.approx((target - 0.5) / (0.1 * 0.5), rel=1e-5)
    assert found["value/at_ends"] == 1  # 0.5 is less than 0.5 + 2


@pytest.mark.parametrize("changed", ["actions", "next", "signs", "ends", "limits", None])
def test_what_stands_otherwise_in_the_replay_buffer_is_found(changed):
    """Rows of two environments, some of them not valid, in a ring that they fill more than once."""
    steps, envs = 40, 2
    obs, after = numbers(steps, envs, O).float(), numbers(steps, envs, O, seed=1).float()
    flags = torch.zeros(steps, envs, dtype=torch.bool)
    terminated, truncated, valid = flags.clone(), flags.clone(), ~flags
    terminated[[30, 35], 0] = truncated[33, 1] = True
    valid[34, 1] = False
    recent = Rollout(
        obs,
        numbers(steps, envs, A, seed=2).float(),
        numbers(steps, envs, seed=3).float(),
        after,
        terminated,
        truncated,
        valid,
    )
    replay = ReplayBuffer(spec_of(), 70, torch.device("cpu"))
    for row in range(steps):
        one = recent[row]
        replay.add(
            one.obs,
            one.action + (changed == "actions"),
            Step(
                one.obs,
                obs[row] if changed == "next" else one.next_obs,
                -one.reward if changed == "signs" else one.reward,
                one.terminated | one.truncated if changed == "limits" else one.terminated & (changed != "ends"),
                one.truncated,
                one.valid,
            ),
        )
    found = replay_signals(SimpleNamespace(replay=replay), recent)
    assert found == {
        f"replay/other_{name}": float(name == changed) for name in ("actions", "next", "signs", "ends", "limits")
    }
    assert replay_signals(SimpleNamespace(replay=None), recent) == {}


def test_rows_that_look_alike_differ_where_none_of_them_agrees():
    same = rows(obs=torch.zeros(B, O), action=torch.zeros(B, A))
    replay = ReplayBuffer(spec_of(), B, torch.device("cpu"))
    replay.extend(Transition(same.obs, same.action, same.reward, same.next_obs, same.terminated))
    found = replay_signals(SimpleNamespace(replay=replay), same[None])
    assert len(found) == 3
    assert not any(found.values())


def test_the_distance_from_the_mode_is_one_for_actions_that_were_drawn():
    networks = ActorCritic(spec_of(), Layers((8,)), -0.5)
    obs = numbers(B, O).float()
    noise = networks.policy.draw_noise((B,), torch.Generator().manual_seed(1))
    for action, away in ((networks.policy.act(obs, noise), 1.0), (networks.policy.act(obs, 0 * noise), 0.0)):
        found = network_signals(SimpleNamespace(policy=networks.policy), rows(obs=obs, action=action))
        assert found["action/off_mode"].item() == pytest.approx(away, abs=0.1)


def test_a_choice_that_hardly_ever_leaves_the_mode_says_nothing():
    networks = ActorCritic(spec_of(Discrete(3)), Layers((8,)), 0.0)
    given = rows(action=torch.zeros(B, dtype=torch.int64))
    state = SimpleNamespace(policy=networks.policy)
    assert network_signals(state, given)["action/off_mode"] > 0.5
    networks.policy.net[-1].bias.data[0] = 10.0
    assert "action/off_mode" not in network_signals(state, given)


def test_rows_that_were_written_over_and_episodes_under_way_are_not_looked_for():
    given = rows(obs=torch.zeros(B, O), terminated=torch.arange(B) < 100)
    full = ReplayBuffer(spec_of(), 50, torch.device("cpu"))
    late = given[-50:]
    full.extend(Transition(late.obs, late.action, late.reward, late.next_obs, late.terminated))
    assert not any(replay_signals(SimpleNamespace(replay=full), given[None]).values())
    hindsight = object.__new__(HindsightReplay)
    assert replay_signals(SimpleNamespace(replay=hindsight), given[None]) == {}


def test_before_there_are_rows_there_are_no_signals():
    assert signals(None, None, spec_of(), None) == {}  # pyright: ignore[reportArgumentType]
    none = torch.zeros(4, 2, dtype=torch.bool)
    assert signals(None, None, spec_of(), SimpleNamespace(valid=none)) == {}  # pyright: ignore[reportArgumentType]


def test_signals_are_drawn_beside_findings_and_not_among_the_diagnostics(tmp_path):
    from matplotlib import pyplot

    from lemniscate.report import curves

    run = lem.train("ppo", "Countdown-v0", run=tmp_path / "r", progress=False, **tiny_fields())
    logged = {name for line in read_metrics(run.path) for name in line}
    signals_of = {name for name in logged if name.startswith(KINDS)}
    assert len(signals_of) > 8
    titles = []
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(pyplot.Axes, "set_title", lambda _axes, title, *_args, **_options: titles.append(title))
        curves.plot_runs([run.path], tmp_path / "plots")
    assert titles
    assert not signals_of & set(titles)


def of_update_of(algorithm, tmp_path, **fields):
    """The signals of what the updates of a run learned from: their greatest and least values."""
    given = {"num_envs": 4, "num_steps": 16, "total_steps": 640, "hidden": (8,), "progress": False, **fields}
    given |= {name: 2 for name in ("epochs", "critic_epochs") if hasattr(algos.find(algorithm).Config, name)}
    if algorithm != "a2c":
        given |= {"minibatch_size" if algorithm == "ppo" else "critic_minibatch_size": 16}
    lines = read_metrics(lem.train(algorithm, "CartPole-v1", run=tmp_path / algorithm, **given).path)
    found = {name for line in lines for name in line if name.startswith(("targets/", "advantage/", "value/loss"))}
    return {name: [line[name] for line in lines if name in line] for name in found}


@pytest.mark.parametrize("algorithm", ["ppo", "a2c", "trpo", "reinforce"])
@pytest.mark.parametrize("backend", ["envpool", "gymnasium"])
def test_what_an_update_learns_from_follows_from_its_rows(algorithm, backend, tmp_path):
    found = of_update_of(algorithm, tmp_path, backend=backend)
    gamma = algos.find(algorithm).Config.gamma
    assert found["targets/discount"] == pytest.approx([gamma] * len(found["targets/discount"]), abs=1e-5)
    assert max(found["targets/unexplained"]) < 1e-10
    assert max(found["targets/beyond_ends"]) < 1e-10
    assert min(found["advantage/own"]) > 0.9999
    assert ("advantage/used" in found) == (algorithm in ("ppo", "a2c"))
    assert min(found.get("advantage/used", [1.0])) > 0.9999


def wrongly(change):
    """GAE with a mistake."""

    def mistaken(reward, value, next_value, terminated, done, *, gamma, lam):
        return change(reward, value, next_value, terminated, done, gamma, lam)

    return mistaken


def advantages(reward, value, *rest):
    *rest, gamma, lam = rest
    return gae(reward, value, *rest, gamma=gamma, lam=lam)


def near(number):
    return pytest.approx(number, abs=1e-3)


def forward(reward, value, next_value, terminated, done, gamma, lam):
    """Advantages that follow from those of the row before."""
    delta, found = reward + gamma * next_value * ~terminated - value, []
    for t in range(len(delta)):
        chained = gamma * lam * ~done[t - 1] * found[-1] if t else 0.0
        found.append(delta[t] + chained)
    return torch.stack(found), torch.stack(found) + value


MISTAKES = {
    "1 / gamma": (
        lambda *given: advantages(*given[:-2], 1 / given[-2], given[-1]),
        lambda found: found["targets/discount"] == pytest.approx([1 / 0.99] * len(found["targets/discount"]), abs=1e-4),
    ),
    "rewards of another row": (
        lambda reward, *given: advantages(reward + torch.arange(len(reward))[:, None] % 3, *given),
        lambda found: min(found["targets/unexplained"]) > 0.01,
    ),
    "a value at terminations": (
        lambda reward, value, next_value, terminated, *given: advantages(
            reward, value, next_value + 1, torch.zeros_like(terminated), *given
        ),
        lambda found: min(found["targets/beyond_ends"]) > 0.01,
    ),
    "rewards less their mean": (
        lambda reward, *given: advantages(reward * 2 - 1, *given),
        lambda found: min(found["targets/other_rewards"]) > 1e-3 and "targets/trace" not in found,
    ),
    "another λ": (
        lambda *given: advantages(*given[:-1], 0.6),
        lambda found: found["targets/trace"][0] == near(0.6) and "targets/other_rewards" not in found,
    ),
    "another γ": (
        lambda *given: advantages(*given[:-2], 0.9, given[-1]),
        lambda found: found["targets/discount"][0] == near(0.9) and "targets/trace" not in found,
    ),
    "advantages": (
        lambda *given: (advantages(*given)[0],) * 2,
        lambda found: set(found["targets/less_values"]) == {1.0} and "targets/forward" not in found,
    ),
    "standardized returns": (
        lambda *given: (lambda a, target: (a, (target - 3) / 2))(*advantages(*given)),
        lambda found: found["targets/rescaled"][0] == near(0.25) and "targets/other_rewards" not in found,
    ),
    "from the first row on": (lambda *given: forward(*given), lambda found: set(found["targets/forward"]) == {1.0}),
    "no baseline": (
        lambda reward, value, *given: (lambda target: (target + 3 * value, target))(
            advantages(reward, value, *given)[1]
        ),
        lambda found: max(found["advantage/own"]) < 0.95,
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_targets_that_do_not_follow_show(mistake, tmp_path, monkeypatch):
    change, shows = MISTAKES[mistake]
    monkeypatch.setattr(ppo, "gae", wrongly(change))
    assert shows(of_update_of("ppo", tmp_path))


def test_advantages_in_another_order_than_their_rows_show(tmp_path, monkeypatch):
    learn = ppo.learn
    monkeypatch.setattr(
        ppo, "learn", lambda config, state, batch, rows, advantage: learn(config, state, batch, rows, advantage.flip(1))
    )
    assert max(of_update_of("ppo", tmp_path)["advantage/used"]) > 0.9999, "what is given is right there"


def looked_at(algorithm, tmp_path, env="CartPole-v1", **fields):
    """The signals of what gradients are made of, and of targets, in a short run: their values by name."""
    small = {"num_envs": 4, "num_steps": 16, "total_steps": 1280, "hidden": (8,)}
    if algorithm in ("sac", "td3", "ddpg"):
        env = "InvertedPendulum-v5"
        small = {"total_steps": 400, "learning_starts": 100, "batch_size": 32, "log_every": 25}
        small |= {"hidden": (16,), "critic_hidden": (16,)}
    small |= {name: 2 for name in ("epochs", "critic_epochs") if hasattr(algos.find(algorithm).Config, name)}
    small |= {"minibatch_size": 16} if algorithm in ("ppo", "reppo", "pqn") else {}
    small |= {"critic_minibatch_size": 16} if algorithm in ("trpo", "reinforce") else {}
    env = "Pendulum-v1" if algorithm == "reppo" else env
    lines = read_metrics(
        lem.train(algorithm, env, run=tmp_path / "run", progress=False, **{"compile": "off", **small, **fields}).path
    )
    names = {name for line in lines for name in line if name.startswith(("gradient/", "targets/"))}
    return {name: np.array([line[name] for line in lines if name in line]) for name in names}


@pytest.mark.parametrize(
    ("algorithm", "fields"),
    [
        ("ppo", {"entropy_coef": 1.0, "clip": 1e-4}),
        ("ppo", {"network": "gru", "sequence_length": 8, "clip_value": 0.2}),
        ("ppo", {"compile": "on", "env": "Pendulum-v1"}),
        ("a2c", {"entropy_coef": "0.1>0.01"}),
        ("trpo", {}),
        ("reinforce", {}),
        ("reppo", {}),
        ("pqn", {}),
        ("sac", {}),
        ("sac", {"value_range": 10.0}),
        ("sac", {"num_updates": 4, "policy_delay": 2}),
        ("ppo", {"env": "MountainCar-v0", "backend": "gymnasium"}),
        ("td3", {}),
        pytest.param("ddpg", {"compile": "on"}, marks=pytest.mark.long),
        pytest.param("sac", {"compile": "on", "num_updates": 4, "policy_delay": 2}, marks=pytest.mark.long),
    ],
)
def test_a_gradient_is_of_the_terms_of_its_loss(algorithm, fields, tmp_path):
    found = looked_at(algorithm, tmp_path, **fields)
    assert found["gradient/other_rows"].max() == 0
    if algorithm in ("ppo", "reppo"):
        assert found["gradient/old_policy"].max() < 1e-5
        assert found["gradient/later_rest"].max() < 1e-9
    if algorithm in ("ppo", "a2c", "trpo", "reinforce") and fields.get("network") != "gru":
        assert abs(found["targets/missing"]).max() < 1e-5
    heads = {"trpo": ("value",), "pqn": ("value",)}.get(algorithm, ("policy", "value"))
    for head in heads:
        weight = 0.5 if (algorithm, head) in (("ppo", "value"), ("a2c", "value")) and "env" not in fields else 1.0
        assert len(found[f"gradient/{head}"]) >= 2
        assert found[f"gradient/{head}"] == pytest.approx(weight, rel=1e-4)
        assert found[f"gradient/{head}_rest"].max() < 1e-9
    if algorithm in ("sac", "reppo") or "entropy_coef" in fields:
        assert found["gradient/entropy"].max() > 1e-3
        assert found["gradient/entropy"].min() > -1e-5
    if algorithm == "pqn":
        assert found["targets/unexplained"].max() < 1e-10
        assert found["targets/discount"] == pytest.approx(0.99, abs=1e-5)


def test_a_gradient_that_does_not_reach_the_policy_has_no_weight(tmp_path, monkeypatch):
    right = ppo.clipped_surrogate
    monkeypatch.setattr(ppo, "clipped_surrogate", lambda log_ratio, *given: right(log_ratio.detach(), *given))
    found = looked_at("ppo", tmp_path)
    assert found["gradient/policy"].max() == 0
    assert found["gradient/value_rest"].max() < 1e-9


def test_of_frozen_networks_nothing_is_said_and_of_the_others_all(tmp_path):
    found = looked_at("ppo", tmp_path, freeze=("policy",))
    assert "gradient/policy" not in found
    assert found["gradient/value_rest"].max() < 1e-9


def test_of_one_observation_alone_the_weights_are_not_judged(tmp_path):
    """A bandit: its advantages and its entropy turn the policy the same way."""

    class Bandit(gym.Env):
        observation_space, action_space = gym.spaces.Box(1, 1, (1,)), gym.spaces.Discrete(2)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return np.ones(1, np.float32), {}

        def step(self, action):
            return np.ones(1, np.float32), float(action), True, False, {}

    found = looked_at("a2c", tmp_path, env=Bandit, entropy_coef=0.5)
    assert not {"gradient/policy", "gradient/entropy"} & found.keys()
    assert found["gradient/policy_rest"].max() < 1e-9


def test_a_learner_of_ones_own_may_leave_no_gradients_and_take_other_arguments(tmp_path, monkeypatch):
    """Nothing is said then, and the run goes on."""
    right = ppo.learn

    def learn(config, state, batch, *others):
        for parameter in state.networks.parameters():
            parameter.grad = None
        return right(config, state, batch, *others)

    monkeypatch.setattr(ppo, "learn", learn)
    assert looked_at("ppo", tmp_path)
    state = SimpleNamespace(learn=lambda *args: args, optimizers=list)
    watched = Watched(state, 0)
    assert state.learn(1, 2, 3) == (1, 2, 3)
    assert watched.found == {}


def entropy_punished(right):
    def wrong(config, networks, batch):
        total, metrics = right(config, networks, batch)
        return total + 2 * config.entropy_coef * networks.policy(batch.obs).entropy().mean(), metrics

    return wrong


def actions_of_others(right):
    return lambda config, networks, batch: right(config, networks, replace(batch, action=batch.action.roll(1, 0)))


def rewards_of_others(right):
    return lambda config, state, critics, batch, *noise: right(
        config, state, critics, replace(batch, reward=batch.reward.flip(0)), *noise
    )


def a_row_further(right):
    def wrong(config, state, batch, minibatches, advantage):
        return right(config, state, replace(batch, action=batch.action.roll(1, 0)), minibatches, advantage)

    return wrong


def next_values(right):
    def wrong(reward, next_value, *ends, **rest):
        return right(reward, next_value.roll(1, 0), *ends, **rest)

    return wrong


LOSSES = {
    "entropy punished": ("ppo", "loss", entropy_punished, {"entropy_coef": 0.01}, ("entropy", lambda x: x.max() < 0)),
    "actions of other rows": ("a2c", "loss", actions_of_others, {}, ("policy_rest", lambda x: x.min() > 1e-4)),
    "log π that is none": (
        "a2c",
        "policy_gradient",
        lambda _: lambda log_prob, weight: -(log_prob.exp() * weight).mean(),
        {},
        ("policy_rest", lambda x: np.median(x) > 1e-6),
    ),
    "values of other rows": (
        "trpo",
        "value_loss",
        lambda right: lambda value, target: right(value, target.flip(0)),
        {},
        ("value_rest", lambda x: np.median(x) > 1e-4),
    ),
    "a loss that is climbed": (
        "ppo",
        "value_loss",
        lambda right: lambda *given: -right(*given),
        {},
        ("value", lambda x: x.max() < 0),
    ),
    "rewards of other rows": ("td3", "critic_loss", rewards_of_others, {}, ("value_rest", lambda x: x.min() > 1e-4)),
    "the same, compiled": (
        "td3",
        "critic_loss",
        rewards_of_others,
        {"compile": "on"},
        ("value_rest", lambda x: x.min() > 1e-4),
    ),
    "actions of the row before": ("a2c", "learn", a_row_further, {}, ("other_rows", lambda x: x.min() > 0.1)),
}


@pytest.mark.parametrize("mistake", LOSSES)
def test_a_mistake_in_a_loss_shows_in_its_gradient(mistake, tmp_path, monkeypatch):
    algorithm, name, wrong, fields, (signal, shows) = LOSSES[mistake]
    module = algos.find(algorithm)
    monkeypatch.setattr(module, name, wrong(getattr(module, name)))
    assert shows(looked_at(algorithm, tmp_path, **fields)[f"gradient/{signal}"])


def online(follows):
    """The loss of DDPG's Q, whose targets are of Q itself."""

    def wrong(_):
        def critic_loss(config, state, critics, batch):
            action = state.networks.policy(batch.next_obs).mode()
            target = td_target(batch.reward, critics.first(batch.next_obs, action), batch.terminated, gamma=0.99)
            loss = value_loss(critics.first(batch.obs, batch.action), target if follows else target.detach())
            return loss, {"losses/critic": loss.detach()}

        return critic_loss

    return wrong


KNOWN = {
    "ends_ignored": (
        "ddpg",
        "td_target",
        lambda right: lambda reward, after, ends, *, gamma: right(reward, after, ends & False, gamma=gamma),
    ),
    "mean_target": (
        "a2c",
        "value_loss",
        lambda right: lambda value, target: right(*torch.broadcast_tensors(value[:, None], target)),
    ),
    "other_rows": ("a2c", "loss", actions_of_others),
    "other_action": ("pqn", "loss", lambda right: lambda q, batch: right(q, replace(batch, action=1 - batch.action))),
    "online_target": ("ddpg", "critic_loss", online(False)),
    "own_obs": (
        "ddpg",
        "critic_loss",
        lambda right: lambda c, s, q, batch: right(c, s, q, replace(batch, next_obs=batch.obs)),
    ),
    "own_action": (
        "td3",
        "critic_loss",
        lambda right: (
            lambda c, s, q, batch, noise: right(
                c, s, q, replace(batch, action=s.networks.policy(batch.obs).mode().detach()), noise
            )
        ),
    ),
    "followed_target": ("ddpg", "critic_loss", online(True)),
    "other_critic": (
        "sac",
        "critic_loss",
        lambda right: lambda c, s, *rest: right(c, Largest(s.networks, s.targets), *rest),
    ),
    "advantage_target": (
        "a2c",
        "loss",
        lambda right: lambda config, networks, batch: right(config, networks, replace(batch, target=batch.advantage)),
    ),
    "largest_clip": (
        "ppo",
        "clipped_surrogate",
        lambda right: lambda log_ratio, advantage, clip: -right(log_ratio, -advantage, clip),
    ),
    "no_clip": (
        "ppo",
        "clipped_surrogate",
        lambda right: lambda log_ratio, advantage, _: right(log_ratio, advantage, 1e6),
    ),
}


class Largest(NamedTuple):
    """A state whose target networks say the larger of what they say."""

    networks: Any
    critics: Any

    def targets(self, obs, action):
        return self.critics(obs, action).amax(0, keepdim=True)


@pytest.mark.parametrize("mistake", KNOWN)
def test_a_well_known_mistake_is_told_by_the_gradient_that_it_makes(mistake, tmp_path, monkeypatch):
    algorithm, name, wrong = KNOWN[mistake]
    module = algos.find(algorithm)
    monkeypatch.setattr(module, name, wrong(getattr(module, name)))
    fields = {"clip": 1e-4} if "clip" in mistake else {}
    found = looked_at(algorithm, tmp_path, **fields)
    assert found[f"gradient/if_{mistake}"].max() < 1e-9
    others = KNOWN.keys() - {mistake, "other_action"}  # of which one may be right by chance, where there are two
    assert all(found[other].max() > 1e-6 for each in others if (other := f"gradient/if_{each}") in found)


@pytest.mark.parametrize("algorithm", ["ddpg", "td3"])
@pytest.mark.parametrize(("times", "discount"), [(0.5, 0.99), (1.0, 0.9)])
def test_the_discount_and_the_rewards_in_targets_of_q_are_told_by_the_gradient(
    times, discount, algorithm, tmp_path, monkeypatch
):
    module = algos.find(algorithm)
    monkeypatch.setattr(
        module,
        "td_target",
        lambda reward, after, ends, *, gamma: td_target(times * reward, after, ends, gamma=discount),
    )
    found = looked_at(algorithm, tmp_path)
    assert found["targets/discount"] == near(discount)
    assert found["targets/other_rewards"] == pytest.approx(1.0 if times == 0.5 else 0.0, abs=1e-5)
    assert "targets/entropy" not in found


@pytest.mark.parametrize(("algorithm", "name"), [("a2c", "value_loss"), ("ppo", "value_loss"), ("pqn", "value_loss")])
def test_targets_that_are_standardized_are_told_by_the_gradient(algorithm, name, tmp_path, monkeypatch):
    module = algos.find(algorithm)
    right = getattr(module, name)
    monkeypatch.setattr(module, name, lambda value, target, *rest: right(value, (target - target.mean()) / 3, *rest))
    assert looked_at(algorithm, tmp_path)["targets/rescaled"].min() > 0.1


@pytest.mark.parametrize("part", [20, 10_000])
def test_rows_that_an_update_takes_from_a_part_of_the_buffer_are_told(part, tmp_path, monkeypatch):
    """The buffer grows to twice its length after the first update of a line."""
    module = algos.find("ddpg")
    right = module.update

    def update(config, state):
        learn, state.learn = state.learn, lambda c, s, replay, rows, **flags: learn(c, s, replay, rows % part, **flags)
        try:
            return right(config, state)
        finally:
            state.learn = learn

    monkeypatch.setattr(module, "update", update)
    fields = {"total_steps": 1000, "learning_starts": 250, "log_every": 250, "progress": False}
    lines = read_metrics(lem.train("ddpg", "Pendulum-v1", run=tmp_path / "run", **fields).path)
    shares = [line["replay/drawn"] for line in lines if "replay/drawn" in line]
    assert len(shares) == 3
    assert max(shares) < 0.1 if part == 20 else min(shares) > 0.9


@pytest.mark.parametrize("times", [-1.0, 0.0])
def test_an_entropy_that_targets_of_q_take_otherwise_is_told_by_the_gradient(times, tmp_path, monkeypatch):
    def critic_loss(config, state, critics, batch, noise):
        action, log_prob = state.networks.policy(batch.next_obs).sample_with_log_prob(noise)
        bonus = -times * state.networks.temperature() * log_prob
        after = state.targets(batch.next_obs, action).amin(0) + bonus
        target = td_target(batch.reward, after, batch.terminated, gamma=config.gamma).detach()
        loss = sum(each.loss(batch.obs, batch.action, target)[0] for each in critics.members)
        return loss, {"losses/critic": loss.detach(), "q": loss.detach()}

    monkeypatch.setattr(algos.find("sac"), "critic_loss", critic_loss)
    found = looked_at("sac", tmp_path)
    assert found["targets/entropy"] == near(times)
    assert found["targets/discount"] == near(0.99)


def test_a_gradient_that_is_added_up_is_told(tmp_path, monkeypatch):
    right = Adam.gradient

    def added(optimizer, loss, *args):
        before = optimizer._gradient.clone()
        gradient, metrics = right(optimizer, loss, *args)
        return gradient.add_(before), metrics

    monkeypatch.setattr(Adam, "gradient", added)
    assert looked_at("a2c", tmp_path)["gradient/if_not_zeroed"].max() < 1e-9


@pytest.mark.parametrize("algorithm", ["ppo", "a2c", "trpo"])
def test_a_bootstrap_that_targets_lack_is_told(algorithm, tmp_path, monkeypatch):
    module = algos.find(algorithm)
    monkeypatch.setattr(module, "gae", wrongly(without_the_last))
    found = looked_at(algorithm, tmp_path)
    assert "targets/missing" in found, "each rollout has an end"
    assert found["targets/missing"] == pytest.approx(1.0, abs=0.05)
    assert found["targets/unexplained"].max() < 1e-10, "within the rollout they follow"


def without_the_last(reward, value, next_value, *given):
    """Advantages that take the value behind the last row, and behind time limits, for 0."""
    terminated, done = given[:2]
    after = next_value * ~(done & ~terminated)
    after[-1] = 0
    return advantages(reward, value, after, *given)


@pytest.mark.parametrize("algorithm", ["ppo", "reppo"])
def test_a_policy_that_is_not_the_one_that_acted_is_told(algorithm, tmp_path, monkeypatch):
    """It is moved before the first gradient step."""
    module = algos.find(algorithm)
    name = {"ppo": "advantages", "reppo": "targets"}[algorithm]
    right = getattr(module, name)

    def then_moved(config, networks, *rest):
        batch = right(config, networks, *rest)
        for parameter in networks.policy.parameters():
            parameter.data += 0.1
        return batch

    monkeypatch.setattr(module, name, then_moved)
    assert looked_at(algorithm, tmp_path)["gradient/old_policy"].min() > 1e-4


def test_the_largest_q_follows_in_the_targets_of_q(tmp_path, monkeypatch):
    monkeypatch.setattr(algos.find("pqn"), "q_lambda", next_values(algos.find("pqn").q_lambda))
    assert looked_at("pqn", tmp_path)["targets/unexplained"].max() > 1e-9


def test_the_loss_of_a_single_step_is_half_the_mean_squared_error(tmp_path):
    lines = read_metrics(
        lem.train(
            "a2c", "CartPole-v1", run=tmp_path / "run", num_envs=4, num_steps=16, total_steps=1280, progress=False
        ).path
    )
    pairs = [(line["losses/value"], line["value/loss"]) for line in lines if "value/loss" in line]
    assert len(pairs) >= 3
    for loss, own in pairs:
        assert loss == pytest.approx(own, rel=1e-4)


def test_watching_ends_with_the_update(tmp_path):
    """The gradient steps of an update that is not looked at are the algorithm's own."""
    seen = []
    update = ppo.update

    def noted(config, state, rollout):
        seen.append(type(state.learn).__name__)
        return update(config, state, rollout)

    with patch.object(ppo, "update", noted):
        lem.train("ppo", "CartPole-v1", run=tmp_path / "run", progress=False, **tiny_fields(total_steps=32 * 8))
    assert seen == ["Watched", *["function"] * 4, "Watched", *["function"] * 2]


class OwnSteps:
    """Gradient steps of algorithms of one's own, which take other arguments than those of the library."""

    def __init__(self, **kept):
        self.learn, self.kept = lambda *args, **flags: (args, flags), kept


@pytest.mark.parametrize("given", [((1, 2), {"batch": 3}), ((1, 2, 3), {}), ((1, 2, 3, 8), {}), ((), {})])
def test_gradient_steps_of_ones_own_are_given_what_they_are_given(given):
    state = OwnSteps()
    watched = Watched(state)
    assert state.learn(*given[0], **given[1]) == given
    data, by_step, is_one = watched.given
    assert (data, by_step, is_one) == (given[0][2] if len(given[0]) > 2 else None, (), False)
    assert batch_signals(SimpleNamespace(), watched.given, time_rows()) == {}
    watched.end()
    assert state.learn() == ((), {})


def time_rows(steps=8, envs=2):
    """Rows of one number each, that go on."""
    obs = torch.arange(steps * envs, dtype=torch.float32).view(steps, envs, 1)
    no = torch.zeros(steps, envs, dtype=torch.bool)
    return Rollout(obs, obs, torch.zeros(steps, envs), obs + envs, no, no, ~no)


def test_targets_that_are_all_zero_say_nothing_of_a_discount():
    newest = time_rows()
    batch = Batch(newest.obs.flatten(0, 1), newest.action.flatten(0, 1), *torch.zeros(3, 16))
    found = batch_signals(SimpleNamespace(gae_lambda=0.95), (batch, (), False), newest)
    assert not {"targets/discount", "targets/unexplained"} & found.keys()
    whole = batch_signals(SimpleNamespace(episodes=1), (batch, (), False), newest)
    assert whole == {}, "of whole episodes the rows have been moved together"


@pytest.mark.parametrize("resets", [True, False])
def test_an_episode_that_begins_where_the_last_one_ended_goes_on(resets):
    """Walks of two environments that end every ten steps; a reset brings them back, or does not."""
    steps = torch.randn(40, 2, O, generator=torch.Generator().manual_seed(0))
    obs, next_obs, place = torch.zeros(40, 2, O), torch.zeros(40, 2, O), torch.zeros(2, O)
    ends = torch.zeros(40, 2, dtype=torch.bool)
    ends[9::10] = True
    for t in range(40):
        obs[t], next_obs[t] = place, place + steps[t] + 1
        place = torch.zeros(2, O) if resets and ends[t, 0] else next_obs[t]
    no = torch.zeros_like(ends)
    found = start_signals(Rollout(obs, torch.zeros(40, 2, A), torch.zeros(40, 2), next_obs, ends, no, ~no), spec_of())
    assert found["observation/goes_on"] == float(not resets)
    behind = start_signals(
        Rollout(obs, torch.zeros(40, 2, A), torch.zeros(40, 2), next_obs, ends, no, ~ends.roll(1, 0)), spec_of()
    )
    assert "observation/goes_on" not in behind, "between them stands the row of a reset"
