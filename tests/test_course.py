"""The right function is right, each well-known mistake is called by its name, and what is off is said."""

import importlib
import inspect
import json
import re
import sys
import time
import warnings
from functools import partial

import pytest
import torch

import lemniscate as lem
from course_findings import says
from lemniscate import UserError, course, maths
from lemniscate.course.exercise import Exercise
from lemniscate.course.loop import solution as solved
from lemniscate.course.solution import TooLong, limited

COMPARED = {name: exercise for name, exercise in course.EXERCISES.items() if isinstance(exercise, Exercise)}
MISTAKES = [(name, words) for name, exercise in COMPARED.items() for words in exercise.mistakes]


@pytest.mark.parametrize("name", COMPARED)
def test_the_library_passes(name, capsys):
    finding = course.check(getattr(maths, name, COMPARED[name].right), name)
    assert finding
    assert str(finding).startswith(f"✓ {name}: right")
    assert capsys.readouterr().err.strip() == str(finding)


@pytest.mark.parametrize(("name", "words"), MISTAKES, ids=[f"{name}-{words}" for name, words in MISTAKES])
@pytest.mark.one_in(3)
def test_a_known_mistake_is_called_by_its_name(name, words):
    """Alone, or beside one other that the cases do not tell apart; what raises is a sentence of its own."""
    finding = course.check(COMPARED[name].mistakes[words], name)
    assert not finding
    assert "it raised " in finding.sentence or words in finding.sentence.partition(" Likely: ")[2]


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
        (lambda a, t: a, r"should return both advantage and target, tensors; it returned Tensor"),
        (lambda a, t: (a, None), r"both advantage and target, tensors; it returned Tensor, NoneType"),
        (lambda a, t: (a[0], t), r"case 1 of 5, no end: advantage has shape \[1\]; it should be \[4, 1\]"),
        (lambda a, t: (a, t.round().int()), r"target\[0, 0\] is 3; it should be 2.606"),
        (lambda a, t: (a, t + (a < -1) * 0.5), r"target\[\d, 0\] is -?[\d.]+; it should be -?[\d.]+\.$"),
    ],
)
def test_what_is_off_is_said(spoil, said):
    def mine(*args, **options):
        return spoil(*maths.gae(*args, **options))

    finding = course.check(mine, "gae")
    assert not finding
    assert re.search(said, finding.sentence), finding.sentence


def test_arrays_that_training_could_not_use_are_noted():
    def arrays(*args, **options):
        return tuple(each.numpy() for each in gae(*args, **options))

    assert course.check(arrays, "gae").sentence.endswith(
        "right in all 5 cases. Note: it returns arrays of NumPy, where training with it needs tensors."
    )


def test_what_takes_the_rest_is_given_all_of_it_in_its_order():
    def first(reward, *rest):
        return gae(reward, *rest[:4], gamma=rest[4], lam=rest[5])

    def with_an_option(reward, debug=False, *args, **options):
        assert debug is False
        return gae(reward, *args, **options)

    assert course.check(first, "gae")
    assert course.check(with_an_option, "gae")


def test_several_tensors_may_come_as_a_list():
    assert course.check(lambda *args, **options: list(maths.gae(*args, **options)), "gae")
    says(lambda rewards, gamma: list(rewards), "discounted_returns", "returns[0] is ")


@pytest.mark.parametrize(
    ("ends", "wrong"),
    [(torch.all, "return["), (torch.any, "return["), (bool, "it raised RuntimeError: Boolean value of Tensor")],
)
def test_the_return_of_one_environment_is_not_ended_by_another(ends, wrong):
    def reward_to_go(reward, next_value, terminated, done, *, gamma):
        out, follows = torch.zeros_like(reward), next_value[-1]
        for t in reversed(range(len(reward))):
            if ends(done[t]):
                follows = next_value[t] * ~terminated[t]
            elif t == len(reward) - 1:
                follows = next_value[t]
            out[t] = follows = reward[t] + gamma * follows
        return out

    says(reward_to_go, "reward_to_go", f"case 4 of 4, two environments, ends of both kinds: {wrong}")


def test_a_row_of_the_result_that_is_left_out_is_the_cause_that_is_named():
    """A change of the result alone, in an exercise whose gradient does not count."""

    def reward_to_go(*args, **options):
        out = maths.reward_to_go(*args, **options)
        return torch.cat([torch.zeros_like(out[:1]), out[1:]])

    says(reward_to_go, "reward_to_go", "Likely: the first row of return is left out.")


def test_the_value_loss_is_given_an_old_value_without_a_clip_as_the_algorithm_gives_it():
    def value_loss(value, target, old_value=None, clip=None):
        if old_value is None:
            return 0.5 * (value - target).square().mean()
        near = old_value + (value - old_value).clamp(-clip, clip)
        return 0.5 * torch.max((value - target) ** 2, (near - target) ** 2).mean()

    says(value_loss, "value_loss", "case 3 of 4, with an old value, and None for the clip: it raised TypeError")


@pytest.mark.parametrize("kept", [0, 2])
def test_cases_that_were_not_tried_are_not_right(kept):
    """As where a hand-in ends its process, and leaves what was seen so far, or nothing."""
    exercise = course.EXERCISES["gae"]
    seen = [exercise.answer(exercise.right, case) for case in exercise.cases]
    assert exercise.judge("gae", {"cases": seen})
    finding = exercise.judge("gae", {"cases": seen[:kept]})
    assert not finding
    assert finding.sentence == f"it ended in case {kept + 1} of 5."


def test_a_constant_in_place_of_tau_is_found():
    def polyak(target, online, tau):
        with torch.no_grad():
            for mine, other in zip(target, online, strict=True):
                mine.lerp_(other, 0.1)

    says(polyak, "polyak", "case 2 of 2, another τ: ")


NUMBERS = [
    (name, option)
    for name, exercise in COMPARED.items()
    if "self" not in inspect.signature(exercise.right).parameters
    for option in exercise.cases[0].options
    if option in ("gamma", "lam", "clip", "clip_coef")
]


@pytest.mark.parametrize(("name", "option"), NUMBERS)
def test_a_number_in_place_of_an_argument_is_found(name, option):
    exercise = COMPARED[name]

    signature, number = inspect.signature(exercise.right), exercise.cases[0].options[option]

    def mine(*args, **options):
        bound = signature.bind(*args, **options)
        bound.arguments[option] = number
        return exercise.right(*bound.args, **bound.kwargs)

    mine.__signature__ = signature
    assert not course.check(mine, name)


class Constant:
    """Discounts that are not those of the course."""

    def calculate_advantages(self, next_value):
        following = torch.cat([self.values_buffer[1:], next_value.reshape(1, -1)])
        ends = self.terminated_buffer.bool()
        both = maths.gae(self.rewards_buffer, self.values_buffer, following, ends, ends, gamma=0.99, lam=0.95)
        return both[1], both[0]

    def compute_advantages(self, states, rewards, next_states, ended):
        values = self.compute_values(states), self.compute_values(next_states)
        columns = [each.reshape(-1, self.num_steps).T for each in (rewards, *values, ended, ended)]
        both = maths.gae(*columns, gamma=0.9, lam=self.lmbda)
        return tuple(each.T.reshape(-1).detach() for each in both)


@pytest.mark.parametrize("name", ["calculate_advantages", "compute_advantages"])
def test_a_number_in_place_of_a_setting_is_found(name):
    assert not course.check(getattr(Constant, name), name)


def test_a_constant_clip_is_found():
    def value_loss(value, target, old_value=None, clip=None):
        return maths.value_loss(value, target, old_value, None if clip is None else 0.2)

    says(value_loss, "value_loss", "case 4 of 4, with another clip: ")


def two_passes(target, online, tau):
    with torch.no_grad():
        for mine in target:
            mine.mul_(1 - tau)
        for mine, other in zip(target, online, strict=True):
            mine.add_(tau * other)


def by_number(target, online, tau):
    with torch.no_grad():
        for i in range(len(target)):
            target[i].lerp_(online[i], tau)


def test_a_polyak_that_replaces_the_items_of_a_list_moves_no_network():
    def polyak(target, online, tau):
        for i in range(len(target)):
            target[i] = (1 - tau) * target[i] + tau * online[i]

    says(polyak, "polyak", "case 1 of 2, three tensors: ")


@pytest.mark.parametrize("solution", [two_passes, by_number])
@pytest.mark.parametrize("name", ["ddpg", "td3", "sac"])
@pytest.mark.one_in(4)
def test_a_polyak_that_takes_lists_is_right_and_trains(solution, name, monkeypatch, tmp_path):
    assert course.check(solution, "polyak")
    settings = dict(num_envs=2, total_steps=64, learning_starts=16, batch_size=8, hidden=(8,), progress=False)
    settings |= {"evaluate_episodes": 1}
    ends = []
    for number, function in enumerate((maths.polyak, solution)):
        monkeypatch.setattr(importlib.import_module(f"lemniscate.algos.{name}"), "polyak", function)
        run = lem.train(name, "Pendulum-v1", seed=1, run=tmp_path / str(number), **settings)
        ends.append(json.loads((run.path / "metrics.jsonl").read_text().splitlines()[-1])["losses/critic"])
    assert ends[0] == pytest.approx(ends[1], rel=1e-4)


def test_no_warning_stands_above_a_finding():
    """The causes of a wrong surrogate are tried on one row too, whose standard deviation torch warns of."""

    def clipped_surrogate(log_ratio, advantage, clip):
        return -1.3 * (log_ratio.exp() * advantage).clamp(1 - clip, 1 + clip).mean()

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not course.check(clipped_surrogate)


def test_what_the_skeleton_promises_to_judge_passes_in_its_solution():
    written = {"__name__": "ppo"}
    exec(compile(solved("ppo"), "ppo.py", "exec"), written)
    names = re.findall(r"`course.check\((\w+)\)`", written["__doc__"])
    assert names == ["gae", "clipped_surrogate", "value_loss"]
    assert all(course.check(written[name]) for name in names)
    assert str(course.check(written["value_loss"])).endswith(
        "right in 1 of 4 cases; it takes too few arguments for the others: "
        "with a clip, with an old value, and None for the clip, with another clip."
    )
    says(lambda value, target: (value - target).square().mean(), "value_loss", "Likely: the conventional half")


def test_what_it_raises_is_said_with_the_line_that_raised(tmp_path):
    def gae(reward):
        return reward

    assert (
        "no end: it takes too few arguments, no value, next_value, terminated, done; there are"
        in course.check(gae).sentence
    )
    says(lambda a, b, c, d, e: None, "td_target", "its parameter e is none of those that this exercise has: reward, ")
    file = tmp_path / "mine.py"
    file.write_text("def polyak(*args):\n    later()\n\ndef later():\n    raise NotImplementedError('to be written')\n")
    scope = {}
    exec(compile(file.read_text(), file, "exec"), scope)
    says(scope["polyak"], "polyak", "it raised NotImplementedError: to be written, in later (mine.py:5)")
    exec(compile(file.read_text(), "<cell>", "exec"), scope)
    says(scope["polyak"], "polyak", "to be written, in later (line 5)")
    says(lambda *args: torch.zeros(2) + torch.zeros(3), "polyak", "in <lambda> (test_course.py:")


def test_a_loss_needs_its_gradient():
    detached = course.check(lambda x, a: maths.policy_gradient(x.detach(), a), "policy_gradient")
    assert "loss has no gradient; was something detached" in detached.sentence
    half = course.check(lambda x, a: maths.policy_gradient((x + x.detach()) / 2, a), "policy_gradient")
    assert "its gradient is wrong." in half.sentence


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


class PPO:
    def compute_advantages(self): ...

    def compute_loss(self): ...

    def select_actions(self): ...


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((gae, "gea"), "There is no exercise 'gea': did you mean gae"),
        ((None,), 'Which exercise is None? Name it: course.check(solution, "gae").'),
        ((partial(gae, lam=1.0),), "Which exercise is functools.partial("),
        ((lambda x: x,), "Which exercise is lambda(x)? Name it"),
        ((None, "gae"), "What can be checked is a function or a class, not None."),
        ((PPO,), "PPO is judged by its methods: course.check(PPO.compute_advantages), course.check(PPO.compute_loss)."),
    ],
)
def test_what_is_no_exercise_is_a_sentence(arguments, said):
    with pytest.raises(UserError, match=re.escape(said)):
        course.check(*arguments)


def test_an_import_that_was_broken_off_can_be_made_again(tmp_path, monkeypatch):
    """A package of which only the parts were left would fail in every later solution."""
    (tmp_path / "slow_package").mkdir()
    (tmp_path / "slow_package" / "part.py").write_text("")
    text = "import sys\nfrom slow_package import part\nwhile not hasattr(sys, 'no_hurry'): pass\n"
    (tmp_path / "slow_package" / "__init__.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(TooLong), limited(0.3):
        importlib.import_module("slow_package")
    monkeypatch.setattr(sys, "no_hurry", True, raising=False)
    assert importlib.import_module("slow_package").part


def test_the_time_of_a_solution_is_the_processors_and_an_import_may_take_longer(tmp_path, monkeypatch):
    text = "import time\nend = time.thread_time() + 1.1\nwhile time.thread_time() < end: pass\n"
    (tmp_path / "late_package.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    with limited(1.0):  # and so 4 s by the clock, of a busy machine
        importlib.import_module("late_package")
    with limited(0.3):
        time.sleep(0.6)
    with pytest.raises(TooLong), limited(0.1):
        [time.sleep(0.01) for _ in range(1000)]


@pytest.mark.parametrize(
    ("solution", "said"),
    [
        ("while True: pass", "it did not end within 0.5 seconds, in polyak (line "),
        ("exit(0)", "it raised SystemExit: 0"),
    ],
)
def test_a_solution_that_never_ends_or_leaves_is_a_finding(monkeypatch, solution, said):
    monkeypatch.setattr("lemniscate.course.exercise.LIMIT", 0.5)
    scope = {}
    exec(compile(f"def polyak(*args):\n    {solution}\n", "<cell>", "exec"), scope)
    says(scope["polyak"], "polyak", said)


def test_what_is_in_the_place_of_comparisons_deceives_nobody(monkeypatch):
    for name in ("allclose", "isclose", "equal"):
        monkeypatch.setattr(torch, name, lambda *args, **options: True)
    says(lambda reward, value, next_value, terminated, done, *, gamma, lam: (reward, value), "gae", "advantage[0, 0]")


def moved(target, online, tau):
    for theirs, mine in zip(target, online, strict=True):
        theirs.data.mul_(1 - tau).add_(tau * mine.data)


@pytest.mark.parametrize(
    "solution",
    [
        lambda local_model, target_model, tau: moved(target_model, local_model, tau),
        lambda q_net, q_target, tau: moved(q_target, q_net, tau),
        lambda critic, critic_target, tau: moved(critic_target, critic, tau),
        lambda policy_net, target_net, tau: moved(target_net, policy_net, tau),
    ],
)
def test_networks_have_names_of_ones_own(solution):
    assert course.check(solution, "polyak")
    names = inspect.signature(solution).parameters
    other = eval(f"lambda {', '.join(names)}: moved({', '.join([*names][:2])}, tau)", {"moved": moved})
    assert not course.check(other, "polyak")


@pytest.mark.parametrize("name", ["next_q", "q_next", "next_q_values"])
def test_an_end_may_be_called_done_where_there_is_no_other(name):
    right = eval(f"lambda rewards, dones, {name}, gamma: rewards + gamma * (1 - dones.float()) * {name}")
    wrong = eval(f"lambda rewards, dones, {name}, gamma: rewards + gamma * dones.float() * {name}")
    assert course.check(right, "td_target")
    assert "the mask is turned round" in course.check(wrong, "td_target").sentence


def test_what_a_solution_leaves_behind_does_not_reach_the_next():
    def careless(*args, **options):
        torch.set_grad_enabled(False)
        torch.set_default_dtype(torch.float64)
        torch.manual_seed(0)
        return maths.gae(*args, **options)

    torch.manual_seed(3)
    expected = torch.rand(())
    torch.manual_seed(3)
    course.check(careless, "gae")
    assert torch.equal(torch.rand(()), expected)
    assert course.check(maths.value_loss, "value_loss")
    assert torch.get_default_dtype() == torch.float32


def test_complex_numbers_are_named():
    def discounted_returns(rewards, gamma):
        returns = [sum(gamma ** (k - t) * rewards[k] for k in range(t, len(rewards))) for t in range(len(rewards))]
        return torch.stack(returns) + 0j

    says(discounted_returns, "discounted_returns", "is of complex numbers; its real part is asked for")
