"""Whole training loops: the solution passes, each mistake is caught by the small world that is made for it."""

import re

import pytest

from lemniscate import UserError, course
from lemniscate.course import loop

SOLUTION = loop.solution("ppo")

MISTAKES = {
    "sign": ("return -torch.min(ratio", "return torch.min(ratio", "the sign of the policy's loss is turned"),
    "chain": ("trace = delta + gamma * lam * trace * ~done[t]", "trace = delta", "there is no chain in the advantage"),
    "death": ("next_value[t] * ~terminated[t]", "next_value[t]", "a value follows a death"),
    "uncut": ("lam * trace * ~done[t]", "lam * trace", "the chain is not cut where an episode ends"),
    "cut at deaths alone": ("lam * trace * ~done[t]", "lam * trace * ~terminated[t]", "the chain is cut at deaths alone"),
    "time-out": ("next_value[t] * ~terminated[t]", "next_value[t] * ~done[t]", "a time-out is taken for a death"),
    "final_obs": ('next_obs[i] = infos["final_obs"][i]', "pass", 'infos["final_obs"] is not used'),
    "old probabilities": (
        "log_prob(a) - old,",
        "log_prob(a) - agent.distribution(x).log_prob(a).detach(),",
        "the old log-probabilities are computed again",
    ),
    "other rows": ("x, a, adv, goal, old = (column[rows] for column in columns)",
                   "x, a, adv, goal, old = (*(column[rows] for column in columns[:4]), columns[4][: len(rows)])",
                   "the ratio is not 1 in the first gradient step"),
}  # fmt: skip


@pytest.fixture(autouse=True)
def fewer_steps(request, monkeypatch):
    """Half the steps show every mistake too; the long test takes all."""
    if "long" not in request.keywords:
        monkeypatch.setattr(loop, "STEPS", loop.STEPS // 2)


def program(changes=()):
    """`train` of the solution with some of its lines changed."""
    text = SOLUTION
    for right, wrong in changes:
        assert text.count(right) == 1
        text = text.replace(right, wrong)
    scope = {"__name__": "mine"}
    exec(compile(text, "mine.py", "exec"), scope)
    return scope["train"]


def in_worlds(train, *numbers):
    """The first finding in some of the small worlds, as `loop.train` looks for it."""
    return next((sentence for number in numbers for sentence in loop.in_world(train, number)), None)


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_found_where_it_shows(name, monkeypatch):
    right, wrong, words = MISTAKES[name]
    number = next((i for i, world in enumerate(loop.WORLDS) if words in world.mistake), 0)
    if number == 0 and name != "sign":  # seen by the ratio, in the first updates
        monkeypatch.setattr(loop, "STEPS", 512)
        assert words in list(loop.in_world(program([(right, wrong)]), 0))[-1]
    else:
        assert words in in_worlds(program([(right, wrong)]), number)


def test_the_solution_finds_the_better_action_of_the_hardest_worlds():
    assert in_worlds(program(), 1, 6) is None


def test_a_clipped_loss_of_the_ratio_is_none_of_the_log_ratio(monkeypatch):
    monkeypatch.setattr(loop, "STEPS", 256)
    ratios = [
        ("def clipped_surrogate(log_ratio: Tensor,", "def clipped_surrogate(ratio: Tensor,"),
        ("    ratio = log_ratio.exp()\n", ""),
        ("distribution.log_prob(a) - old, adv", "(distribution.log_prob(a) - old).exp(), adv"),
    ]
    assert not any("the ratio" in sentence for sentence in loop.in_world(program(ratios), 0))


def of_box(changes=()):
    return next(loop.with_box_actions(program(changes)), None)


def test_a_loop_is_judged_with_box_actions_too():
    assert of_box() is None
    one_each = [("Independent(Normal(out, self.log_std.exp()), 1)", "Normal(out, self.log_std.exp())")]
    assert of_box(one_each).startswith("in the small world with Box actions it raised RuntimeError: ")
    other = [("action = agent.distribution(torch.as_tensor(obs)).sample().numpy()",
              "action = agent.distribution(torch.as_tensor(obs)).sample().numpy()[:, ::-1].copy()"),
             ("step = (obs, action,", "step = (obs, action[:, ::-1].copy(),")]  # fmt: skip
    assert "it takes" in of_box(other)
    discrete = [("action.shape[0]", "action.n")]
    assert "has no attribute 'n', in __init__ (line " in of_box(discrete)


@pytest.mark.long
def test_the_solution_passes():
    assert str(course.check(program(), "train")) == "✓ train: right."


def test_the_skeleton_is_the_solution_with_its_gaps(tmp_path):
    file = course.skeleton("ppo", tmp_path / "mine.py")
    text = file.read_text()
    assert "solution" not in text
    assert "    python mine.py" in text
    assert text.count('raise NotImplementedError("to be written")') == SOLUTION.count("# <solution>") == 5
    kept = re.sub(r"# <solution>.*?# </solution>", "", SOLUTION, flags=re.DOTALL)
    assert (
        text.replace("python mine.py", "python ppo.py")
        .replace('raise NotImplementedError("to be written")', "")
        .split()
        == kept.split()
    )
    scope = {"__name__": "mine"}
    exec(compile(text, "mine.py", "exec"), scope)
    finding = course.check(scope["train"])
    assert "it raised NotImplementedError: to be written" in finding.sentence
    with pytest.raises(UserError, match="exists already"):
        course.skeleton("ppo", file)
    with pytest.raises(UserError, match="There is no skeleton 'sac'"):
        course.skeleton("sac", tmp_path / "sac.py")
