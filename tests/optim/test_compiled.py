"""`Compiled` methods: the fallback where torch.compile fails, and code of their own."""

import pytest
import torch

from helpers import CPU
from lemniscate.optim.compiled import Compiled, Compiler


class Scale:
    """x to `factor` times x."""

    def __init__(self, factor):
        self.factor = factor

    def __call__(self, x):
        return self.factor * x

    def twice(self, x, *, plus=0.0):
        return 2 * self.factor * x + plus


def test_the_method_is_compiled_once_and_called_with_all_arguments(monkeypatch):
    compiled = []
    monkeypatch.setattr(torch, "compile", lambda method, **_: compiled.append(method) or method)
    method = Compiled(Scale(3).twice, CPU, Compiler())
    assert [method(torch.tensor(2.0), plus=1.0).item() for _ in range(3)] == [13, 13, 13]
    assert len(compiled) == 1


def test_every_compiled_method_has_code_of_its_own(monkeypatch):
    """Programs are cached by code object: one of another object's must not be found."""
    compiled = []
    monkeypatch.setattr(torch, "compile", lambda method, **_: compiled.append(method) or method)
    one, two = Compiled(Scale(3).twice, CPU, Compiler()), Compiled(Scale(5).twice, CPU, Compiler())
    assert (one(torch.tensor(1.0)), two(torch.tensor(1.0))) == (6, 10)
    codes = [method.__code__ for method in compiled]
    assert len({id(code) for code in (*codes, Scale.twice.__code__)}) == 3


def test_decorated_methods_of_two_objects_are_two_programs():
    """All methods that torch.no_grad decorates share the code of its wrapper."""

    class Frozen(Scale):
        @torch.no_grad()
        def twice(self, x):
            return 2 * self.factor * x

    one, two = (Compiled(Frozen(factor).twice, CPU, Compiler()) for factor in (3, 5))
    assert (one(torch.tensor(1.0)), two(torch.tensor(1.0))) == (6, 10)


def test_methods_keep_their_defaults_and_may_call_super(monkeypatch):
    class Shifted(Scale):
        def twice(self, x, offset=1.0, *, plus=0.5):
            return super().twice(x, plus=plus) + offset

    monkeypatch.setattr(torch, "compile", lambda method, **_: method)
    assert Compiled(Shifted(3).twice, CPU, Compiler())(torch.tensor(1.0)) == 7.5


@pytest.mark.parametrize("fallback", [False, True])
def test_where_the_compiler_fails_it_prints_one_sentence_and_calls_the_fallback(monkeypatch, capsys, fallback):
    def fails(*_):
        raise RuntimeError("no compiler\nand a long trace")

    monkeypatch.setattr(torch, "compile", lambda *_, **__: fails)
    method = Compiled(Scale(3).twice, CPU, Compiler(), fallback=Scale(-1) if fallback else None)
    for _ in range(2):
        assert method(torch.tensor(1.0)) == (-1 if fallback else 6)
    assert capsys.readouterr().err == "torch.compile failed (no compiler); continuing without compilation.\n"


def test_a_compiler_that_ctrl_c_has_stopped_is_no_failure_to_report(monkeypatch, capsys):
    called, compiler = [], Compiler()

    def interrupted(*_):
        called.append(True)
        compiler.stopping.set()
        raise RuntimeError("the compiler got the signal, too")

    monkeypatch.setattr(torch, "compile", lambda *_, **__: interrupted)
    for _ in range(2):  # and the next method is not compiled any more
        assert Compiled(Scale(3).twice, CPU, compiler)(torch.tensor(1.0)) == 6
    assert len(called) == 1
    assert capsys.readouterr().err == ""
