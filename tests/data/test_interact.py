"""`interact`: what is stored, which noise acts, and what the normalizer learns."""

import pytest
import torch

from helpers import MODES, begin_off_policy, play, small_off_policy
from lemniscate.algos import ddpg, sac, td3
from lemniscate.data.replay import interact
from lemniscate.maths import uniform

ALGORITHMS = {"ddpg": ddpg, "td3": td3, "sac": sac}
EACH = pytest.mark.parametrize("algo", ALGORITHMS.values(), ids=ALGORITHMS)


@EACH
@pytest.mark.parametrize("mode", MODES)
def test_transitions_have_their_true_successors_and_terminations(algo, mode):
    """Observations are (environment, episode, step): the successor is of the same episode; each ends at step 3."""
    state, _ = begin_off_policy(algo, small_off_policy(algo), mode, length=3)
    rows = state.replay.transitions[: len(state.replay)]
    assert len(state.replay) == (120 if mode == "NEXT_STEP" else 160)
    assert torch.equal(rows.next_obs, rows.obs + torch.tensor([0.0, 0.0, 1.0]))
    assert torch.equal(rows.terminated, rows.next_obs[:, 2] == 3)


@EACH
@pytest.mark.parametrize("mode", MODES)
def test_an_episode_has_a_sequence_of_noise_from_its_beginning(algo, mode):
    config = small_off_policy(algo, action_noise="ou")
    state, env = begin_off_policy(algo, config, mode, length=3)
    action_noise, counted = state.action_noise.state_dict(), 0
    length = action_noise["sequences"].shape[-1]
    for _ in range(12):
        age, size, before = env.obs[:, 2].long(), len(state.replay), action_noise["position"].clone()
        play(config, state, env)
        if len(state.replay) > size:  # else the action was ignored
            assert torch.equal(before % length, age)  # at its end the next one begins
            counted += 1
    assert counted == (9 if mode == "NEXT_STEP" else 12)


@EACH
@pytest.mark.parametrize("mode", MODES)
def test_the_normalizer_learns_from_the_stored_rows_and_no_others(algo, mode):
    state, _ = begin_off_policy(algo, small_off_policy(algo, normalize_observations=True), mode, length=3)
    stored, normalizer = state.replay.transitions.obs[: len(state.replay)].double(), state.policy.normalizer
    assert normalizer.count == len(stored)
    torch.testing.assert_close(normalizer.mean, stored.mean(0))
    torch.testing.assert_close(normalizer.var, stored.var(0, correction=0))


@EACH
@pytest.mark.parametrize("random", [False, True])
def test_actions_are_those_of_the_policy_with_noise_or_uniform(algo, random):
    state, env = begin_off_policy(algo, small_off_policy(algo), length=None)
    obs, noise = env.obs, torch.randn(4, 1)
    action_noise = state.action_noise
    drawn = lambda generator: noise  # noqa: E731
    drawn.on_episode_end = action_noise.on_episode_end
    interact(env, state.policy, state.replay, drawn, state.rng.action, noise_std=0.3, random=random)
    action = state.replay.transitions.action[160:164]
    assert torch.equal(action, uniform(noise) if random else state.policy.act(obs, 0.3 * noise))
