"""The right function is right, each well-known mistake is called by its name, and what is off is said."""

import re

import pytest
import torch

from lemniscate import UserError, course, maths
from lemniscate.course.exercise import Exercise

COMPARED = {name: exercise for name, exercise in course.EXERCISES.items() if isinstance(exercise, Exercise)}
MISTAKES = [(name, words) for name, exercise in COMPARED.items() for words in exercise.mistakes]


@pytest.mark.parametrize("name", COMPARED)
def test_the_library_passes(name, capsys):
    finding = course.check(getattr(maths, name, COMPARED[name].right))
    assert finding
    assert str(finding).startswith(f"✓ {name}: right")
    assert capsys.readouterr().err.strip() == str(finding)


@pytest.mark.parametrize(("name", "words"), MISTAKES, ids=[f"{name}-{words}" for name, words in MISTAKES])
def test_a_known_mistake_is_called_by_its_name_alone(name, words):
    finding = course.check(COMPARED[name].mistakes[words], name)
    assert not finding
    assert str(finding).endswith(f" Likely: {words}.")


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    """Written plainly by somebody else."""
    out = torch.zeros_like(reward)
    for n in range(reward.shape[1]):
        follows = 0.0
        for t in reversed(range(len(reward))):
            delta = reward[t, n] + (0 if terminated[t, n] else gamma * next_value[t, n]) - value[t, n]
            follows = delta + (0 if done[t, n] else gamma * lam * follows)
            out[t, n] = follows
    return out, out + value


def test_another_way_to_write_it_is_right_too():
    assert course.check(gae)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda a, t: a, r"should return advantage and target, each a tensor; it returned Tensor"),
        (lambda a, t: (a.numpy(), t.numpy()), r"each a tensor; it returned ndarray, ndarray"),
        (lambda a, t: (a[0], t), r"case 1 of 5, no end: advantage has shape \[1\]; it should be \[4, 1\]"),
        (lambda a, t: (a, t.double()), r"target is torch.float64; it should be torch.float32"),
        (lambda a, t: (a, t + (a < -1) * 0.5), r"target\[\d, 0\] is -?[\d.]+; it should be -?[\d.]+\.$"),
    ],
)
def test_what_is_off_is_said(spoil, said):
    def mine(*args, **options):
        return spoil(*maths.gae(*args, **options))

    finding = course.check(mine, "gae")
    assert not finding
    assert re.search(said, finding.sentence), finding.sentence


def test_what_it_raises_is_said():
    def gae(reward):
        return reward

    assert "it raised TypeError: " in course.check(gae).sentence


def test_a_loss_needs_its_gradient():
    detached = course.check(lambda x, a: maths.policy_gradient(x.detach(), a), "policy_gradient")
    assert "loss has no gradient; was something detached" in detached.sentence
    half = course.check(lambda x, a: maths.policy_gradient((x + x.detach()) / 2, a), "policy_gradient")
    assert "the value is right, but its gradient is not" in half.sentence


@pytest.mark.parametrize(
    ("move", "said"),
    [
        (
            lambda mine, theirs, tau: mine.lerp_(theirs, tau),
            "it raised RuntimeError: a leaf Variable that requires grad",
        ),
        (lambda mine, theirs, tau: mine.lerp(theirs, tau), "Likely: the target is to be changed in place."),
    ],
)
def test_a_target_is_moved_in_place_and_without_a_gradient(move, said):
    def polyak(target, online, tau):
        for mine, theirs in zip(target, online, strict=True):
            move(mine, theirs, tau)

    assert said in course.check(polyak).sentence


def test_what_a_function_that_works_in_place_returns_does_not_matter():
    def polyak(target, online, tau):
        target = list(target)
        maths.polyak(target, online, tau)
        return target

    assert course.check(polyak)


def test_what_a_gradient_raises_is_said():
    def clipped_surrogate(log_ratio, advantage, clip):
        ratio = log_ratio.exp()
        loss = -torch.min(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage).mean()
        ratio.data, _ = ratio.data, ratio.mul_(1.0)
        return loss

    assert "it raised RuntimeError: " in course.check(clipped_surrogate).sentence


def test_an_unknown_exercise_is_a_sentence():
    with pytest.raises(UserError, match="gae"):
        course.check(gae, "gea")
