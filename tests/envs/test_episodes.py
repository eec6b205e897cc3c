import numpy as np
import pytest
import torch

from lemniscate.envs.vec_env import LOG_ROWS, EpisodeStatistics, Stagger, episode_sums
from lemniscate.types import Step


def one_by_one(rewards, done, valid, whole):
    """Returns and lengths as a person would add them up."""
    running, returns, lengths = [[0.0, 0] for _ in range(done.shape[1])], [], []
    for t in range(len(done)):
        for n in range(done.shape[1]):
            if valid[t, n]:
                running[n][0] += rewards[t, n].item()
                running[n][1] += 1
                if done[t, n]:
                    if whole[t, n]:
                        returns.append(running[n][0])
                        lengths.append(running[n][1])
                    running[n] = [0.0, 0]
    return returns, lengths


@pytest.mark.parametrize("every", [1, 7, 10_000], ids=lambda every: f"asked every {every} steps")
def test_the_sums_agree_with_adding_up_one_by_one(rng, every):
    steps, copies = LOG_ROWS + 300, 3
    reward = torch.randn(steps, copies, generator=rng)
    terminated, truncated, ignored, fragment = torch.rand(4, steps, copies, generator=rng) < 0.05
    books, returns, lengths = EpisodeStatistics(copies, torch.device("cpu")), [], []
    for t in range(steps):
        nothing = torch.zeros(copies, 1)
        step = Step(nothing, nothing, reward[t], terminated[t], truncated[t], ~ignored[t])
        books.log(step, ~fragment[t], step)
        if t % every == every - 1 or t == steps - 1:
            ended = books.take()
            returns, lengths = returns + ended.returns, lengths + ended.lengths
    expected_returns, expected_lengths = one_by_one(reward, terminated | truncated, ~ignored, ~fragment)
    assert len(lengths) > 100
    assert lengths == expected_lengths
    assert returns == pytest.approx(expected_returns, abs=1e-9)


def test_sums_begin_anew_after_each_end():
    rows = torch.tensor([[[1.0], [2.0], [3.0], [4.0]]])
    done = torch.tensor([[False], [True], [False], [True]])
    assert episode_sums(rows, done, torch.tensor([[10.0]])).flatten().tolist() == [11.0, 13.0, 3.0, 7.0]


def test_first_episodes_are_cut_at_all_steps_up_to_the_limit_and_later_ones_are_not():
    num_envs, limit = 200, 10
    stagger, no = Stagger(num_envs, limit, seed=3), np.zeros(num_envs, dtype=bool)
    assert not stagger.counts.any()
    cuts = np.stack([stagger.apply(no, no) for _ in range(3 * limit)])
    assert (cuts.sum(0) == 1).all()
    assert set(cuts.argmax(0)) == set(range(limit))
    assert stagger.counts.all()
