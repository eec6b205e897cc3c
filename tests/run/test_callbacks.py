"""Callbacks see a run and may stop it; nothing that they do changes a bit of it."""

import copy
import pickle
import random
import textwrap

import nbformat
import numpy as np
import pytest
import torch
from nbclient import NotebookClient
from test_run import final_hashes, history

import lemniscate as lem
import toy
from conftest import tiny_fields, tiny_off_policy
from helpers import long
from lemniscate.report import curves
from lemniscate.run import checkpoint
from lemniscate.run.metrics import read_metrics

CASES = {
    "ppo": ("CartPole-v1", tiny_fields("CartPole-v1", checkpoint_every=64)),
    "sac": ("Pendulum-v1", tiny_off_policy(checkpoint_every=64)),
}
OBS = {"ppo": np.zeros(4), "sac": np.zeros(3)}


def train(path, algorithm="ppo", callbacks=(), **changes):
    env, fields = CASES[algorithm]
    return lem.train(algorithm, env, run=path, progress=False, callbacks=callbacks, **{**fields, **changes})


@pytest.mark.parametrize("algorithm", ["ppo", *long(*(name for name in CASES if name != "ppo"))])
def test_callbacks_that_draw_and_scribble_change_no_bit(tmp_path, algorithm):
    def careless(step, metrics, policy):
        random.random()
        np.random.rand(3)  # noqa: NPY002
        torch.rand(3)
        policy.act(OBS[algorithm], deterministic=False)
        with torch.no_grad():
            for parameter in policy.networks.parameters():
                parameter.fill_(7.0)

    train(tmp_path / "without", algorithm, evaluate_every=64)
    train(tmp_path / "with", algorithm, [careless], evaluate_every=64)
    tensors = "tensors.safetensors"
    assert final_hashes(tmp_path / "with")[tensors] == final_hashes(tmp_path / "without")[tensors]
    assert history(tmp_path / "with") == history(tmp_path / "without")


def test_global_generators_that_an_environment_draws_from_are_not_moved(tmp_path, monkeypatch):
    class Careless(toy.Matching):
        def _draw(self, mask):
            self.secret = np.where(mask, np.random.randint(0, 2, self.num_envs), self.secret)  # noqa: NPY002

    monkeypatch.setattr(toy, "Matching", Careless)
    for name, callbacks in (("without", []), ("with", [lambda *_: np.random.seed(3)])):  # noqa: NPY002
        lem.train("ppo", "Matching-v0", run=tmp_path / name, progress=False, callbacks=callbacks, **tiny_fields())
    assert final_hashes(tmp_path / "with") == final_hashes(tmp_path / "without")


def test_every_logged_line_is_shown_once_in_order(tmp_path):
    seen = []
    train(tmp_path / "r", callbacks=[lambda step, metrics, _: seen.append((step, metrics))], evaluate_every=64)
    lines = read_metrics(tmp_path / "r")
    assert [step for step, _ in seen] == [line["step"] for line in lines]
    for (_, metrics), line in zip(seen, lines, strict=True):
        assert {name: x for name, x in line.items() if name in metrics} == {
            name: x for name, x in metrics.items() if np.isfinite(x)
        }
    with pytest.raises(TypeError):
        seen[0][1]["losses/policy"] = 0.0


def test_the_policy_is_that_of_its_step(tmp_path):
    kept = {}

    def keep(step, _, policy):
        policy.act(OBS["ppo"])  # from its first use on it can be kept
        kept[step] = policy

    train(tmp_path / "r", callbacks=[keep], keep_checkpoints=10)
    for step in checkpoint.list_steps(tmp_path / "r" / "checkpoints"):
        saved = lem.load(tmp_path / "r" / "checkpoints" / f"step-{step}")
        assert kept[step].step == step
        for name, tensor in saved.networks.state_dict().items():
            assert torch.equal(tensor, kept[step].networks.state_dict()[name])


def test_the_weights_are_copied_only_if_they_are_used(tmp_path, monkeypatch):
    from lemniscate.algos.ppo import Config

    made, kept = [], []
    networks = Config.networks
    monkeypatch.setattr(Config, "networks", lambda *args: made.append(1) or networks(*args))
    train(tmp_path / "r", callbacks=[lambda step, _, policy: kept.append(policy)])
    assert len(made) == 2  # those that are trained, and before them their shapes, for an estimate of the memory
    with pytest.raises(lem.UserError, match="not used while its callback ran"):
        kept[0].act(OBS["ppo"])


@pytest.mark.parametrize("stop_at", [32, 96, 128, 256])
def test_a_callback_stops_the_run_which_can_be_resumed(tmp_path, capsys, stop_at):
    train(tmp_path / "whole")
    path = tmp_path / "stopped"
    run = train(path, callbacks=[lambda step, *_: np.bool_(step >= stop_at)])
    assert run.policy.step == lem.load(path).step == stop_at
    said = capsys.readouterr().err
    if stop_at < 256:
        assert (
            f"Stopped by a callback at step {stop_at}; the policy is saved. Go on with: lemniscate resume {path}"
            in said
        )
        assert f"It resumes at step {stop_at // 64 * 64}, the last planned checkpoint" in said
    else:
        assert "Stopped" not in said
    lem.resume(path, progress=False)
    assert final_hashes(path) == final_hashes(tmp_path / "whole")
    assert history(path) == history(tmp_path / "whole")


def test_every_callback_sees_the_line_on_which_one_stops(tmp_path):
    seen = []
    train(tmp_path / "r", callbacks=[lambda step, *_: True, lambda step, *_: seen.append(step)])
    assert seen == [32]


def test_an_exception_of_a_callback_is_the_callers_and_leaves_the_run_saved(tmp_path):
    class Mine(Exception):
        pass

    def fails(step, *_):
        if step == 96:
            raise Mine("enough")

    train(tmp_path / "whole")
    path = tmp_path / "r"
    with pytest.raises(Mine, match="enough"):
        train(path, callbacks=[fails])
    assert lem.load(path).step == 96
    lem.resume(path, callbacks=[lambda *_: None], progress=False)
    assert final_hashes(path) == final_hashes(tmp_path / "whole")


def test_a_callback_is_named_as_module_and_function(tmp_path, monkeypatch):
    (tmp_path / "my_callbacks.py").write_text("def stop(step, metrics, policy):\n    return step == 64\n")
    monkeypatch.chdir(tmp_path)
    assert train(tmp_path / "r", callbacks=["my_callbacks:stop"]).policy.step == 64


@pytest.mark.parametrize("said", ["stop", 1, 0.0, np.float64(3), {"stop": False}])
def test_a_callback_that_returns_something_else_is_told_so(tmp_path, said):
    """A number or a text would be taken for a wish to stop, or pass for none, without a word."""
    with pytest.raises(lem.UserError, match=r"A callback returns True to stop, or False or None; .* returned "):
        train(tmp_path / "r", callbacks=[lambda *_: said])


def test_a_callback_may_stop_by_a_boolean_of_numpy(tmp_path):
    assert train(tmp_path / "r", callbacks=[lambda step, *_: np.float64(step) >= 64]).policy.step == 64


def test_the_policy_of_a_callback_can_be_pickled_and_copied(tmp_path):
    """Also one that was not used before: the weights are those of its step."""
    kept = {}

    def keep(step, _, policy):
        kept[step] = pickle.dumps(policy), copy.deepcopy(policy)

    run = train(tmp_path / "r", callbacks=[keep])
    saved = run.policy.networks.state_dict()
    for policy in (pickle.loads(kept[256][0]), kept[256][1]):
        assert policy.act(OBS["ppo"]) == run.policy.act(OBS["ppo"])
        assert all(torch.equal(tensor, saved[name]) for name, tensor in policy.networks.state_dict().items())
    early = pickle.loads(kept[32][0]).networks.state_dict()
    assert not all(torch.equal(tensor, saved[name]) for name, tensor in early.items())


class Above:
    def __init__(self, limit):
        self.limit = limit

    def __call__(self, step, metrics, policy):
        return step >= self.limit


def test_a_callback_of_a_class_is_named_with_its_arguments(tmp_path):
    assert train(tmp_path / "r", callbacks=["test_callbacks:Above(limit=64)"]).policy.step == 64


@pytest.mark.parametrize(
    ("callback", "said"),
    [
        ("stop", "'stop' is no name of an object; it has the form module:name"),
        (
            "no_such_module:stop",
            "no_such_module:stop cannot be found: there is no module no_such_module here; run in its folder",
        ),
        ("math:cosin", "math:cosin cannot be found: math has no cosin"),
        ("math:pi", "math:pi is neither a function nor a class"),
        ("test_callbacks:Above", r"test_callbacks:Above cannot be made; .*required positional argument: 'limit'"),
        ("test_callbacks:Above(limits=64)", "unexpected keyword argument 'limits'"),
        ("math:pow", r"A callback must be a function of \(step, metrics, policy\), not pow\(x, y\)"),
    ],
)
def test_a_callback_that_cannot_be_called_is_told_before_anything_is_made(tmp_path, callback, said):
    with pytest.raises(lem.UserError, match=said):
        train(tmp_path / "r", callbacks=[callback])
    assert not (tmp_path / "r").exists()


class _Policy:
    config = lem.config_for("ppo", "CartPole-v1", total_steps=1000)


def test_the_live_curve_is_drawn_at_most_once_a_second_and_at_the_end(monkeypatch):
    now, shown = [0.0], []

    class Place:
        def update(self, picture):
            shown.append(picture.data)

    monkeypatch.setattr(curves, "in_notebook", lambda: True)
    monkeypatch.setattr("IPython.display.display", lambda picture, display_id: shown.append(picture.data) or Place())
    monkeypatch.setattr(curves.time, "monotonic", lambda: now[0])
    curve = curves.LiveCurve()
    curve(10, {"losses/policy": 1.0}, _Policy)
    assert not shown  # no episode has ended
    for step in range(100, 1000, 100):
        now[0] += 0.4
        curve(step, {"episode/return": float(step)}, _Policy)
    assert len(shown) == 3  # after 0.4, 1.6 and 2.8 seconds
    curve(1000, {"evaluation/return": 5.0}, _Policy)
    assert len(shown) == 4
    assert len(set(shown)) == 4
    assert all(png.startswith(b"\x89PNG") for png in shown)


def test_outside_a_notebook_no_live_curve_is_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr("IPython.display.display", None)
    train(tmp_path / "r", callbacks=[curves.LiveCurve(seconds=0)])


@pytest.mark.long
def test_the_live_curve_grows_in_one_place_below_the_cell(tmp_path):
    """A real kernel runs the cell of a real notebook."""
    cell = textwrap.dedent(
        f"""
        import lemniscate as lem
        from lemniscate.report.curves import LiveCurve
        lem.train("ppo", "CartPole-v1", run={str(tmp_path / "run")!r}, progress=False, total_steps=8192,
                  callbacks=[LiveCurve(seconds=0)])
        """
    )
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell)])
    client = NotebookClient(notebook, timeout=120)
    updates = []
    heard = client.process_message

    def listen(message, *rest):
        updates.append(message["msg_type"] == "update_display_data")
        return heard(message, *rest)

    client.process_message = listen
    client.execute()
    pictures = [output for output in notebook.cells[0].outputs if output.output_type == "display_data"]
    assert len(pictures) == 1
    assert sum(updates) >= 2
