"""Environments of any backend, disturbed by known amounts: what they bear is known too."""

import gymnasium as gym
import numpy as np
import pytest
import torch

from lemniscate.envs.probe import CHANNEL_AXES
from lemniscate.errors import UserError
from lemniscate.margins.record import margins_of, worst_accepted
from lemniscate.margins.vector_probe import Channel, ModelFactors, VectorProbe, has_model


class Follow(gym.Env):
    """A ramp to be repeated: reward 1 for an action within 0.25 of what is seen, which rises by 0.1 a step."""

    observation_space = gym.spaces.Box(-10, 10, (2,), np.float32)
    action_space = gym.spaces.Box(-10, 10, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.first = 0, self.np_random.uniform(-1, 1)
        return self._look(), {}

    def step(self, action):
        reward = float(abs(action[0] - self._look()[0]) < 0.25)
        self.t += 1
        return self._look(), reward, False, self.t == 30, {}

    def _look(self):
        return np.float32([self.first + 0.1 * self.t, self.first])


gym.register("Follow-v0", entry_point="test_vector_probe:Follow")


def repeat(obs):
    """The policy that follows: the first number seen, in units of the action's bounds."""
    return obs[:, :1] / 10


def flown(act=repeat, env="Follow-v0", starts=8, wrappers=(), **kwargs):
    probe = VectorProbe(env, starts, kwargs, wrappers, None)
    nominal, points = probe.fly(lambda: act, 3)
    least = worst_accepted(nominal)
    return {axis.name: margins_of(axis, points[axis.name], least) for axis in probe.axes}, nominal, points


@pytest.fixture(scope="module")
def follow():
    return flown()


def test_the_margin_of_a_delay_is_what_the_environment_forgives(follow):
    found, nominal, _ = follow
    assert nominal.returns.tolist() == [30.0] * 8
    side = found["action_delay"].sides["above"]
    assert (side.last, side.first) == (2, 3)
    assert found["action_delay"].return_at(3) == 3.0  # the first three actions are those of the beginning


def test_lost_actions_are_held_and_their_margin_is_found(follow):
    margins = follow[0]["lost_actions"]
    assert margins.sides["above"].last >= 0.1
    assert margins.mean_returns[0] == 30.0
    assert margins.return_at(0.5) < 29.5


def test_noise_is_in_standard_deviations_of_what_was_seen(follow):
    """The ramp has a spread of about 0.95 beside that of the starts, so 0.05 of it are 0.05, and 1 of it fails."""
    margins = follow[0]["observation_noise"]
    assert margins.return_at(0.05) > 29
    assert margins.sides["above"].first is not None
    assert margins.return_at(1.0) < 15


def test_the_starts_are_the_same_at_each_point():
    seen = []

    def act(obs):
        seen.append(obs[:, 1].clone())
        return repeat(obs)

    flown(act)
    noiseless = [rows for rows in torch.stack(seen).unique(dim=0) if (rows == seen[0]).all()]
    assert len(noiseless) == 1
    begins = torch.stack(seen[::30])
    assert torch.equal(begins[:7], begins[:1].expand(7, 8))


def test_a_channel_without_disturbance_changes_nothing():
    rng = torch.Generator().manual_seed(0)
    channel = Channel(lambda obs: 2 * obs, rng=rng)
    assert channel(torch.ones(3, 1)).tolist() == [[2.0]] * 3


def test_a_late_action_acts_so_many_steps_later():
    channel = Channel(lambda obs: obs, action_delay=2, rng=torch.Generator())
    assert [float(channel(torch.full((1, 1), float(t)))) for t in range(6)] == [0, 0, 0, 1, 2, 3]


def test_an_action_of_choices_can_be_lost():
    channel = Channel(lambda obs: obs[:, 0].long(), lost_actions=0.5, rng=torch.Generator().manual_seed(0))
    acted = torch.stack([channel(torch.full((500, 1), t)) for t in range(2)])
    assert (acted[1] == 0).float().mean() == pytest.approx(0.5, abs=0.06)


@pytest.mark.parametrize(("env", "expected"), [("CartPole-v1", False), ("Hopper-v5", True)])
def test_models_of_mujoco_have_masses_and_frictions(env, expected):
    if expected:
        pytest.importorskip("mujoco")
    assert has_model(env, {}) == expected


def test_factors_change_the_model_and_what_is_derived_from_it():
    pytest.importorskip("mujoco")
    plain, heavy = (
        gym.make("Hopper-v5").unwrapped,
        ModelFactors(gym.make("Hopper-v5"), mass=1.3, friction=0.5).unwrapped,
    )
    np.testing.assert_allclose(heavy.model.body_mass, 1.3 * plain.model.body_mass)
    np.testing.assert_allclose(heavy.model.body_inertia, 1.3 * plain.model.body_inertia)
    np.testing.assert_allclose(heavy.model.body_subtreemass, 1.3 * plain.model.body_subtreemass)
    np.testing.assert_allclose(heavy.model.geom_friction, 0.5 * plain.model.geom_friction)


def test_a_model_is_flown_with_other_masses_and_frictions():
    """A push of constant size: a heavier cart moves less, and its pole falls later."""
    pytest.importorskip("mujoco")
    found, nominal, points = flown(lambda obs: torch.full((len(obs), 1), 0.5), env="InvertedPendulum-v5", starts=4)
    assert list(found) == ["action_delay", "observation_noise", "lost_actions", "mass", "friction"]
    falls = [one.returns.mean() for one in points["mass"]]
    assert falls[0] < nominal.returns.mean() < falls[-1]
    assert points["mass"][3] is nominal


def test_what_cannot_be_disturbed_has_no_axis():
    names = [axis.name for axis in CHANNEL_AXES]
    assert [a.name for a in VectorProbe("CartPole-v1", 4, {}, (), None).axes] == names
    import environments  # noqa: F401

    assert [a.name for a in VectorProbe("Copy-discrete-v0", 4, {}, (), None).axes] == ["action_delay", "lost_actions"]
    assert VectorProbe("Copy-masked-v0", 4, {}, (), None).axes == ()


def test_wrappers_of_training_stay():
    _, nominal, _ = flown(wrappers=("gymnasium.wrappers:TimeLimit(max_episode_steps=7)",))
    assert nominal.returns.tolist() == [7.0] * 8


def test_an_episode_without_an_end_is_refused(monkeypatch):
    from lemniscate.envs import vec_env

    monkeypatch.setattr(vec_env, "PATIENCE", 20)
    with pytest.raises(UserError, match="has not ended after 20 steps"):
        flown()
