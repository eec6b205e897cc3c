"""Is Q honest: the prediction of the first action, and what followed it, by hand."""

import json
import math

import pytest
import torch

import lemniscate as lem
from conftest import tiny_off_policy
from helpers import Levers
from lemniscate.envs import registry
from lemniscate.nn.actor_q import ActorQ, SoftActorQ
from lemniscate.nn.networks import Layers
from lemniscate.report import curves
from lemniscate.report.pages import sentence
from lemniscate.run.evaluate import QBias, evaluate
from lemniscate.run.metrics import METRICS, read_metrics, to_line
from lemniscate.spec import Box, ObservationPart, Spec


def networks(spec, **fields):
    torch.manual_seed(0)
    return (SoftActorQ if fields else ActorQ)(spec, Layers((4,)), Layers((8,)), False, critics=2, **fields)


@pytest.mark.parametrize("mode", ["NEXT_STEP", "SAME_STEP", "DISABLED"])
@pytest.mark.parametrize(
    ("length", "horizon", "gamma"), [(5, None, 0.9), (None, 4, 0.9), (5, None, 1.0), (None, 4, 0.0)]
)
def test_what_followed_is_the_discounted_return_and_after_a_time_out_what_q_expects(mode, length, horizon, gamma):
    env = registry.make(Levers, 3, kwargs={"mode": mode, "length": length, "horizon": horizon})
    nets = networks(env.spec)
    q_bias = evaluate(nets.policy, env, 8, seed=0, critic=(nets, gamma)).q_bias
    predicted, realised = [], []
    for copy in range(3):
        for episode in range(3 if copy < 2 else 2):
            first, last = (torch.tensor([[copy, episode, t]]).float() for t in (0, length or horizon))
            predicted.append(nets.q(first, nets.policy(first).mode()).item())
            earned = sum(gamma**t for t in range(length or horizon))
            if horizon:
                earned += gamma**horizon * nets.q(last, nets.policy(last).mode()).item()
            realised.append(earned)
    assert q_bias.predicted == pytest.approx(predicted, abs=1e-5)  # in the order of the returns
    assert q_bias.realised == pytest.approx(realised, abs=1e-5)


@pytest.mark.parametrize("timed_out", [False, True])
def test_entropy_counts_from_the_second_step_on(monkeypatch, rng, timed_out):
    """Two steps of reward 1, γ = ½, at a temperature of 2; after a time-out with the state in which the clock stopped."""
    ends = {"length": None, "horizon": 2} if timed_out else {"length": 2}
    env = registry.make(Levers, 1, kwargs=ends)
    nets = networks(env.spec, initial_temperature=2.0)
    seen = []
    monkeypatch.setattr(SoftActorQ, "entropy_bonus", lambda *_: seen.append(1) or torch.tensor([10.0]))
    q_bias = evaluate(nets.policy, env, 1, seed=0, critic=(nets, 0.5)).q_bias
    last = torch.tensor([[0.0, 0.0, 2.0]])
    follows = nets.q(last, nets.policy(last).mode()).item() + 10 if timed_out else 0
    assert q_bias.realised == pytest.approx([1 + 0.5 * (1 + 10) + 0.25 * follows])
    monkeypatch.undo()
    obs = torch.randn(20_000, 3, generator=rng)
    policy = nets.policy(obs)
    noise = nets.policy.draw_noise((20_000,), torch.Generator().manual_seed(5))
    mine = -2 * policy.sample_with_log_prob(noise)[1].mean()
    assert nets.entropy_bonus(obs, torch.Generator().manual_seed(5)).mean().item() == pytest.approx(
        mine.item(), abs=1e-4
    )
    assert networks(env.spec).entropy_bonus(obs, rng).abs().max() == 0


@pytest.mark.parametrize(
    ("predicted", "said"),
    [
        ([69.0, 69.0], "Q(s₀, a₀) says 69, and 50 followed, discounted: it over-estimates by 38 %"),
        ([40.0, 20.0], "it under-estimates by 40 %"),
        ([50.1, 50.1], "it is right to a hundredth"),
        ([5000.0, 5000.0], "it over-estimates by 4,950"),
    ],
)
def test_the_sentence(predicted, said):
    assert said in str(QBias(predicted, [40.0, 60.0]))


def test_nothing_followed():
    assert math.isinf(QBias([1.0], [0.0]).bias)
    assert "over-estimates by 1" in str(QBias([1.0], [0.0]))
    assert "under-estimates by 1" in str(QBias([-1.0], [0.0]))
    assert "right to a hundredth" in str(QBias([0.0], [0.0]))
    assert QBias([1.0], [0.0]).to_json() == {"predicted": [1.0], "realised": [0.0]}  # JSON has no infinity


def test_of_two_critics_the_lower_is_asked(rng):
    nets = networks(Spec("x", (ObservationPart((), (3,)),), Box((-1.0,), (1.0,))))
    obs, action = torch.randn(50, 3, generator=rng), torch.randn(50, 1, generator=rng)
    one, two = nets.critics(obs, action)
    assert 0 < (one < two).sum() < 50
    assert torch.equal(nets.q(obs, action), torch.min(one, two))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run with two evaluations."""
    path = tmp_path_factory.mktemp("runs") / "r"
    return lem.train("td3", "Pendulum-v1", run=path, progress=False, **tiny_off_policy(evaluate_every=128))


@pytest.mark.long
def test_it_is_said_written_and_drawn(run, capsys):
    scores = lem.evaluate(run.policy, episodes=3)
    assert len(scores.q_bias.predicted) == 3
    assert sentence(scores.to_json()).count("\n") == 1
    assert json.loads(json.dumps(scores.to_json()))["q_bias"]["bias"] == scores.q_bias.bias
    assert sum("evaluation/q_bias" in line for line in read_metrics(run.path)) == 2
    assert run.path / "plots" / "q.png" in lem.plot(run.path)


@pytest.mark.parametrize("evaluated", [False, True])
def test_the_picture_has_what_the_evaluations_said_beside_what_is(run, tmp_path, monkeypatch, evaluated):
    lines = [line for line in read_metrics(run.path) if evaluated or "evaluation/q" not in line]
    (tmp_path / METRICS).write_bytes(b"".join(map(to_line, lines)))
    drawn = []
    monkeypatch.setattr(curves, "save", lambda figure, file: drawn.append(figure) or file)
    curves.draw_q_bias(QBias([1.0, 2.0], [3.0, 4.0]), tmp_path, tmp_path / "q.png")
    now, *history = drawn[0].axes
    assert now.lines[1].get_xydata().tolist() == [[3, 1], [4, 2]]
    logged = [line for line in lines if "evaluation/q" in line]
    assert len(history) == evaluated
    for axes in history:
        promised, realised = axes.lines
        assert promised.get_xydata().tolist() == [[line["step"], line["evaluation/q"]] for line in logged]
        assert realised.get_ydata().tolist() == [line["evaluation/q_realised"] for line in logged]


def test_the_dictionary_of_the_course(run):
    scores = lem.evaluate(run.policy, episodes=3)
    handed_in = scores.to_course()
    assert handed_in.pop("eval_datetime")[:2] == "20"
    assert handed_in == {
        "env_id": "Pendulum-v1",
        "mean_reward": scores.mean_return,
        "std_reward": scores.std_return,
        "n_evaluation_episodes": 3,
    }
