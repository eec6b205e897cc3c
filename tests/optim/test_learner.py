"""Compiled gradient steps: equal to eager ones, and each program for what it was compiled for."""

from dataclasses import dataclass
from functools import partial

import pytest
import torch
from torch import Tensor

from helpers import COMPILERS, CPU, CompiledCalls, long, numbers, require_in_own_process, small_networks
from lemniscate.algos import ppo
from lemniscate.maths import means, standardize
from lemniscate.optim.adam import Adam
from lemniscate.optim.compiled import Compiled, Compiler, Learner
from lemniscate.run.state import TrainState


@dataclass
class State:
    """Networks and their optimizer, in this place of an algorithm's state."""

    networks: ppo.ActorCritic
    optimizer: Adam


def new_state(actions="box", max_grad_norm=None, **fields):
    networks, config = small_networks(actions, **fields)
    state = State(networks, Adam(networks, max_grad_norm=max_grad_norm))
    state.optimizer.learning_rate = 0.01
    return config, state


def compiled_equals_eager(actions):
    compiled = CompiledCalls()
    config, one = new_state(actions, max_grad_norm=0.1)
    _, two = new_state(actions, max_grad_norm=0.1)
    learner = Learner(ppo.learn, [two.optimizer], Compiler())
    batch, minibatches = numbers(actions), torch.randint(24, (6, 8), generator=torch.Generator().manual_seed(1))
    given = config, batch, minibatches, standardize(batch.advantage[minibatches])
    for _ in range(2):
        a, b = (means(learn(given[0], state, *given[1:])) for learn, state in ((ppo.learn, one), (learner, two)))
        assert a.keys() == b.keys()
        for name in a:
            torch.testing.assert_close(a[name], b[name])
    for p, q in zip(one.networks.parameters(), two.networks.parameters(), strict=True):
        torch.testing.assert_close(p, q)
    assert compiled.calls == [4]  # six minibatches in two calls of three, twice


def programs_are_not_mixed_up():
    """Three runs of one process, of other sizes and other constants; without checks one program would serve all."""
    for clip, size in ((0.2, 8), (1e-3, 8), (0.2, 4)):
        config, one = new_state(clip=clip)
        _, two = new_state(clip=clip)
        learner = Learner(ppo.learn, [two.optimizer], Compiler())
        act = Compiled(two.networks.policy.act, CPU, Compiler())
        minibatches = torch.arange(24).view(-1, size)
        for _ in range(2):
            data = numbers(), minibatches, numbers().advantage[minibatches]
            a, b = (means(f(config, s, *data)) for f, s in ((ppo.learn, one), (learner, two)))
            torch.testing.assert_close(a, b)
        obs = torch.randn(size, 5, dtype=torch.float64)
        noise = torch.zeros(size, 2, dtype=torch.float64)
        torch.testing.assert_close(act(obs, noise), one.networks.policy.act(obs, noise))


def schedules_act():
    """One program, compiled at the beginning of a run, at three of its steps: the number is that of the step."""
    compiled = CompiledCalls()
    config, one = new_state(clip="0.2>0.001", clip_value="0.3>0.001", entropy_coef="0.5>0", total_steps=1000)
    _, two = new_state()
    learner = Learner(ppo.learn, [two.optimizer], Compiler())
    batch, minibatches = numbers(), torch.arange(24).view(3, 8)
    given = batch, minibatches, standardize(batch.advantage[minibatches])
    for step in (0, 500, 1000):
        one.step = step
        now = TrainState.apply_schedules(one, config)
        a, b = (means(learn(now, state, *given)) for learn, state in ((ppo.learn, one), (learner, two)))
        torch.testing.assert_close(a["clip_fraction"], b["clip_fraction"])
        for p, q in zip(one.networks.parameters(), two.networks.parameters(), strict=True):
            torch.testing.assert_close(p, q)
    assert compiled.calls == [3]


@pytest.mark.long
def test_a_schedule_acts_in_a_compiled_step():
    require_in_own_process(__name__, "schedules_act()")


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize(
    "call",
    long("compiled_equals_eager('discrete')", "programs_are_not_mixed_up()"),
)
def test_traced_steps_equal_eager_ones(call, compiler):
    require_in_own_process(__name__, call, compiler)


def test_compiled_steps_equal_eager_ones():
    require_in_own_process(__name__, "compiled_equals_eager('box')")


def count(config, state, data, minibatches, *, weight, update):
    """Instead of gradient steps: the sum of each minibatch times `weight`, where `update`."""
    return [{"total": weight * rows.sum()} if update[k] else {"none": rows.sum()} for k, rows in enumerate(minibatches)]


def test_each_combination_of_flags_is_a_program_of_its_own(monkeypatch):
    """The stand-in for the compiler makes programs with the flags of their first call, as the compiler does."""
    programs = []

    def compile_once(function, **_):
        first = {}
        programs.append(first)

        def program(config, state, data, *chunk, **flags):
            first.update({name: flag for name, flag in flags.items() if name not in first})
            return means(count(config, state, data, *chunk, **first))

        return program

    monkeypatch.setattr(torch, "compile", compile_once)
    learner = Learner(count, [Adam(small_networks()[0])], Compiler())
    rows = torch.arange(12.0).view(6, 2)
    update = (True, False, False, True, False, True)
    for weight in (1.0, 2.0):
        eager = count(None, None, None, rows, weight=weight, update=update)
        metrics = learner(None, None, None, rows, weight=weight, update=update)
        chunks = [means(eager[:3]), means(eager[3:])]
        assert metrics == chunks
    assert programs == [
        {"weight": weight, "update": update[part]} for weight in (1.0, 2.0) for part in (slice(0, 3), slice(3, 6))
    ]
    learner(None, None, None, rows, weight=1.0, update=update)
    assert len(programs) == 4


@pytest.mark.parametrize(("steps", "calls"), [(1, 1), (4, 1), (5, 5), (6, 2), (7, 7), (8, 2), (10, 5), (12, 3)])
def test_calls_are_of_one_size_and_of_at_most_four_steps(monkeypatch, steps, calls):
    monkeypatch.setattr(torch, "compile", lambda *_, **__: lambda *args, **flags: means(count(*args, **flags)))
    learner = Learner(count, [Adam(small_networks()[0])], Compiler())
    rows = torch.arange(2.0 * steps).view(steps, 2)
    metrics = learner(None, None, None, rows, weight=1.0, update=(True,) * steps)
    assert len(metrics) == calls
    assert sum(part["total"] for part in metrics) / calls == rows.sum(1).mean()


def test_without_a_compiler_it_prints_so_and_continues(monkeypatch, capsys):
    def fails(*_, **__):
        raise RuntimeError("no compiler\nand a long trace")

    monkeypatch.setattr(torch, "compile", lambda *_, **__: fails)
    config, one = new_state()
    _, two = new_state()
    learner = Learner(ppo.learn, [two.optimizer], Compiler())
    eager = partial(ppo.learn, config, one)
    for _ in range(2):
        minibatches: Tensor = torch.arange(24).view(3, 8)
        given = numbers(), minibatches, numbers().advantage[minibatches]
        assert means(eager(*given)) == means(learner(config, two, *given))
    assert capsys.readouterr().err == "torch.compile failed (no compiler); continuing without compilation.\n"
