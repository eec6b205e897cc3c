"""The running normalizer of observations, and the scale of rewards."""

import torch

from lemniscate.nn.normalizer import RewardScale, RunningNorm
from lemniscate.types import Rollout


def test_observations_are_standardized_and_clipped():
    norm = RunningNorm(2, clip=5.0)
    data = torch.randn(5000, 2) * torch.tensor([3.0, 0.1]) + torch.tensor([10.0, -4.0])
    assert torch.equal(norm(data[:3]).clamp(-5, 5), data[:3].clamp(-5, 5))  # no statistics: no change
    for part in data.split(500):
        norm.update(part)
    out = norm(data)
    torch.testing.assert_close(out.mean(0), torch.zeros(2), atol=1e-3, rtol=0)
    torch.testing.assert_close(out.std(0), torch.ones(2), atol=1e-2, rtol=0)
    assert norm(torch.tensor([[1e6, -1e6]])).tolist() == [[5.0, -5.0]]


def test_a_forward_pass_never_changes_the_statistics():
    norm = RunningNorm(2)
    norm.update(torch.randn(10, 2))
    before = {k: v.clone() for k, v in norm.state_dict().items()}
    norm.train()(torch.randn(100, 2))
    norm.eval()(torch.randn(100, 2))
    assert all(torch.equal(v, before[k]) for k, v in norm.state_dict().items())


def test_rewards_are_divided_by_the_std_of_the_discounted_return(rng):
    reward = torch.randn(3, 40, 2, generator=rng) + 1
    done, ignored = (torch.rand(3, 40, 2, generator=rng) < share for share in (0.1, 0.05))
    scale, expected, running = RewardScale(2, gamma=0.9), [], [0.0, 0.0]
    assert torch.equal(scale(reward[0]), reward[0])
    for part in range(3):
        no = torch.zeros(40, 2, dtype=torch.bool)
        scaled = scale.scale(Rollout(no, no, reward[part], no, done[part], no, ~ignored[part]))
        assert torch.equal(scaled.reward, scale(reward[part]))  # these returns are among the statistics
        for t in range(40):
            for n in range(2):
                if ignored[part, t, n]:
                    running[n] *= 0.9
                else:
                    running[n] = 0.9 * running[n] + reward[part, t, n].item()
                    expected.append(running[n])
                if done[part, t, n]:
                    running[n] = 0.0
    std = torch.tensor(expected, dtype=torch.float64).std(correction=0)
    torch.testing.assert_close(scale(reward[0]), reward[0] / std.float())
    assert scale(torch.tensor([1e6, -1e6])).tolist() == [10.0, -10.0]
    assert scale.running.any()
    scale.on_restart()
    assert not scale.running.any()
