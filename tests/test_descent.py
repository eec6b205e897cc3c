"""One loss on two engines: both are Adam, and they agree."""

import copy
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import nn

from lemniscate.algos import ppo
from lemniscate.nn.descent import Descent
from lemniscate.nn.networks import Layers
from lemniscate.spec import Box, Discrete, ObservationPart, Spec
from lemniscate.types import Batch

ACTIONS = {"box": Box((-1.0, -1.0), (1.0, 1.0)), "discrete": Discrete(3)}


def numbers(actions="box", size=24, dtype=torch.float64):
    generator = torch.Generator().manual_seed(3)
    obs, rest = (torch.randn(size, n, generator=generator, dtype=dtype) for n in (5, 4))
    box = torch.randn(size, 2, generator=generator, dtype=dtype)
    discrete = torch.randint(3, (size,), generator=generator)
    return Batch(obs, box if actions == "box" else discrete, *rest.unbind(-1))


def fresh(actions="box", dtype=torch.float64, **fields):
    torch.manual_seed(0)
    config = ppo.Config(num_envs=4, num_steps=6, minibatch_size=8, clip_value=0.3, entropy_coef=0.01, **fields)
    networks = ppo.ActorCritic(
        Spec("x", (ObservationPart((), (5,)),), ACTIONS[actions]), Layers((8,)), normalize_observations=True
    )
    networks.policy.observe(torch.randn(50, 5))
    networks.to(dtype)
    return networks, lambda nets, batch: ppo.loss(config, nets, batch)


@pytest.mark.parametrize("limit", [0.05, 1e6])
def test_it_is_torchs_adam(limit):
    networks, loss = fresh()
    reference = copy.deepcopy(networks)
    batch, parts = numbers(), torch.arange(24).view(3, 1, 8)
    descent = Descent(networks, loss, betas=(0.8, 0.9), eps=1e-4, max_grad_norm=limit)
    optimizer = torch.optim.Adam(reference.parameters(), betas=(0.8, 0.9), eps=1e-4)
    for step in range(9):
        rate = 0.01 / (step + 1)
        optimizer.param_groups[0]["lr"] = rate
        optimizer.zero_grad()
        loss(reference, batch[parts[step % 3, 0]])[0].backward()
        norm = nn.utils.clip_grad_norm_(reference.parameters(), limit)
        optimizer.step()
        metrics = descent(batch, parts[step % 3], rate)
        assert descent.steps == step + 1
        torch.testing.assert_close(metrics["gradient_norm"], norm)
    for mine, theirs in zip(networks.parameters(), reference.parameters(), strict=True):
        torch.testing.assert_close(mine, theirs)


def engines_agree(actions):
    (one, loss), (two, _) = fresh(actions), fresh(actions)
    eager, compiled = (Descent(nets, loss, max_grad_norm=0.1) for nets in (one, two))
    compiled.make_native()
    batch, parts = numbers(actions), torch.randint(24, (6, 8), generator=torch.Generator().manual_seed(1))
    for _ in range(2):
        a, b = eager(batch, parts, 0.01), compiled(batch, parts, 0.01)
        assert a.keys() == b.keys()
        for name in a:
            torch.testing.assert_close(a[name], b[name])
    for p, q in zip(one.parameters(), two.parameters(), strict=True):
        torch.testing.assert_close(p, q)
    assert compiled._engine._chosen is compiled._engine._compiled


def programs_are_not_mixed_up():
    """Two runs of one process, of other sizes and other constants; without checks one program would serve both."""
    for clip, size in ((0.2, 8), (1e-3, 8), (0.2, 4)):
        (one, loss), (two, _) = fresh(clip=clip), fresh(clip=clip)
        eager, compiled = Descent(one, loss), Descent(two, loss)
        compiled.make_native()
        two.policy.make_native()
        parts = torch.arange(24).view(-1, size)
        for _ in range(2):
            a, b = eager(numbers(), parts, 0.01), compiled(numbers(), parts, 0.01)
            torch.testing.assert_close(a, b)
        obs = torch.randn(size, 5, dtype=torch.float64)
        noise = torch.zeros(size, 2, dtype=torch.float64)
        torch.testing.assert_close(two.policy.act(obs, noise), one.policy.act(obs, noise))


@pytest.mark.parametrize("call", ["engines_agree('box')", "engines_agree('discrete')", "programs_are_not_mixed_up()"])
def test_the_two_engines_agree(call):
    """In a process of its own: the shape checks of this one are not for the compiler."""
    code = f"from test_descent import *; {call}"
    done = subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parent, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_parameters_stay_the_modules_own():
    networks, loss = fresh()
    before = {name: p.clone() for name, p in networks.named_parameters()}
    descent = Descent(networks, loss)
    assert all(torch.equal(p, before[name]) for name, p in networks.named_parameters())
    descent(numbers(), torch.arange(8)[None], 0.1)
    assert all(not torch.equal(p, before[name]) for name, p in networks.named_parameters())
    networks.load_state_dict({**networks.state_dict(), **before})
    assert torch.equal(descent._vector, torch.cat([p.flatten() for p in before.values()]))


def test_without_a_compiler_it_says_so_and_goes_on(monkeypatch, capsys):
    def fails(*_, **__):
        raise RuntimeError("no compiler\nand a long trace")

    monkeypatch.setattr(torch, "compile", lambda *_, **__: fails)
    (one, loss), (two, _) = fresh(), fresh()
    eager, compiled = Descent(one, loss), Descent(two, loss)
    compiled.make_native()
    for _ in range(2):
        a, b = (descent(numbers(), torch.arange(24).view(3, 8), 0.01) for descent in (eager, compiled))
        assert a == b
    assert capsys.readouterr().err == "Nothing can be compiled here (no compiler); going on without.\n"
