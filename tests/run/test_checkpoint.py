"""Checkpoints: whole or absent, every damaged byte seen, nothing executed."""

import errno
import json
import os
import pickle
import random
import resource
import shutil
import signal
from types import SimpleNamespace

import pytest
import torch

from conftest import tiny
from lemniscate.algos import ppo
from lemniscate.errors import NonFiniteError, UserError
from lemniscate.run import checkpoint
from lemniscate.spec import Box, Discrete, MultiBinary, MultiDiscrete, ObservationPart, Spec
from lemniscate.system.files import DamagedFileError, read_json, write_json
from lemniscate.types import DrawnBatch

SPEC = Spec("x", (ObservationPart((), (3,)),), Box((-1.0,), (1.0,)), 500)
CPU = torch.device("cpu")


def learn(state):
    """One gradient step on noise."""
    batch = DrawnBatch(torch.randn(4, 3), torch.randn(4, 1), *torch.randn(4, 4))
    state.optimizer.learning_rate = 1e-3
    state.learn(tiny(), state, batch, torch.arange(4)[None], batch.advantage[None])


def state_with_history(seed=0):
    """A State whose optimizer, normalizer and generators have all moved."""
    torch.manual_seed(seed)
    state = ppo.init(tiny(normalize_observations=True), SPEC, CPU)
    learn(state)
    state.policy.observe(torch.randn(7, 3))
    state.reward_scale.var = torch.rand((), dtype=torch.float64)
    torch.rand(5, generator=state.rng.action)
    state.step = 123
    return state


def write(folder, state, step=123, keep=3):
    return checkpoint.write(folder, state.saved(), step, {"planned": True}, keep)


def same(a, b):
    """Equal in every bit that a checkpoint holds."""
    for name, value in a.saved().items():
        other = b.saved()[name]
        if hasattr(value, "state_dict"):
            assert all(torch.equal(t, other.state_dict()[k]) for k, t in value.state_dict().items())
        else:
            assert value == other
    return True


def test_a_state_comes_back_in_every_bit(tmp_path):
    state, other = state_with_history(0), state_with_history(1)
    checkpoint.read(write(tmp_path, state)).restore(other)
    assert same(state, other)
    for s in (state, other):  # and goes on alike
        torch.manual_seed(5)
        learn(s)
    assert same(state, other)


def test_the_policy_and_the_value_still_share_their_normalizer(tmp_path):
    other = state_with_history(1)
    checkpoint.read(write(tmp_path, state_with_history(0))).restore(other)
    other.policy.observe(torch.randn(4, 3))
    assert torch.equal(other.policy.normalizer.mean, other.networks.value.normalizer.mean)


@pytest.mark.parametrize(
    "spec",
    [
        SPEC,
        Spec("y", (ObservationPart(("a",), (), (4,), (1,)), ObservationPart(("b", 0), (2,))), Discrete(4, 1)),
        Spec("z", (ObservationPart((), (6, 6, 1), image=True),), MultiDiscrete((2, 3), (0, 1), (2,))),
        Spec("w", (), MultiBinary(3)),
        Spec("v", (ObservationPart((("arm", 1), "q"), (2,)),), MultiDiscrete((2, 3), (0, 1), (2,), True, "int8")),
    ],
)
def test_a_spec_survives_json(spec):
    assert checkpoint.spec_from_json(json.loads(json.dumps(checkpoint.spec_to_json(spec)))) == spec


def test_only_the_newest_are_kept(tmp_path):
    state = state_with_history()
    for step in range(5):
        write(tmp_path, state, step, keep=2)
    assert checkpoint.list_steps(tmp_path) == [3, 4]


def test_steps_are_numbers_not_words(tmp_path):
    state = state_with_history()
    for step in (9, 100, 20):
        write(tmp_path, state, step)
    assert checkpoint.list_steps(tmp_path) == [9, 20, 100]


def test_another_format_is_refused(tmp_path):
    path = write(tmp_path, state_with_history())
    manifest = read_json(path / checkpoint.MANIFEST)
    write_json(path / checkpoint.MANIFEST, manifest | {"format": checkpoint.FORMAT - 1})
    with pytest.raises(UserError, match=f"this version of lemniscate reads {checkpoint.FORMAT}"):
        checkpoint.read(path)


def test_what_is_not_finite_is_not_written_and_leaves_the_checkpoint_before(tmp_path):
    state = state_with_history()
    write(tmp_path, state, 1)
    state.optimizer.vector[0] = torch.nan
    with pytest.raises(NonFiniteError, match="is not written"):
        write(tmp_path, state, 2)
    assert checkpoint.list_steps(tmp_path) == [1]


def test_every_flipped_bit_is_seen(tmp_path):
    path = write(tmp_path / "good", state_with_history())
    rng = random.Random(0)
    for trial in range(150):
        bad = tmp_path / f"bad{trial}"
        shutil.copytree(path, bad)
        victim = bad / rng.choice([*checkpoint.FILES])
        data = bytearray(victim.read_bytes())
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        victim.write_bytes(data)
        with pytest.raises(DamagedFileError, match=victim.name):
            checkpoint.read(bad)


@pytest.mark.parametrize("name", [*checkpoint.FILES, "manifest.json"])
def test_missing_truncated_and_foreign_files_are_named(tmp_path, name):
    path = write(tmp_path / "c", state_with_history())
    for damage in (lambda f: f.unlink(), lambda f: f.write_bytes(f.read_bytes()[:10]) if f.exists() else f.touch()):
        damage(path / name)
        with pytest.raises(DamagedFileError, match=name):
            checkpoint.read(path)


def test_a_pickle_is_never_executed(tmp_path):
    marker = tmp_path / "marker"

    class Evil:
        def __reduce__(self):
            return (os.system, (f"touch {marker}",))

    path = write(tmp_path / "c", state_with_history())
    evil = pickle.dumps(Evil())
    for name in (*checkpoint.FILES, "manifest.json"):
        kept = (path / name).read_bytes()
        (path / name).write_bytes(evil)
        with pytest.raises(DamagedFileError):
            checkpoint.read(path)
        (path / name).write_bytes(kept)
    assert not marker.exists()
    checkpoint.read(path)


def test_a_full_disk_leaves_the_checkpoint_before(tmp_path, monkeypatch):
    state = state_with_history()
    write(tmp_path, state, 1)

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write(tmp_path, state, 2)
    monkeypatch.undo()
    assert checkpoint.list_steps(tmp_path) == [1]
    checkpoint.read(tmp_path / "step-1")
    write(tmp_path, state, 3)
    assert not list(tmp_path.glob("*.tmp"))


TYPES = (torch.float64, torch.float32, torch.float16, torch.bfloat16, torch.bool)
TYPES += (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8)


def test_tensors_of_every_type_and_shape_come_back(tmp_path):
    vector = torch.arange(10.0)
    tensors = {"part": vector[:5], "rest": vector[5:], "number": torch.tensor(3), "none": torch.zeros(0, 4)}
    tensors |= {str(dtype): torch.ones(3, 1).to(dtype) for dtype in TYPES} | {"turned": torch.arange(6.0).view(2, 3).T}
    tensors |= {"again": tensors["part"], "whole": vector, "gradient": vector.clone().requires_grad_()}
    checkpoint.write_fields(tmp_path / "step-1", {"x": SimpleNamespace(state_dict=lambda: tensors)}, {})
    found = checkpoint.read(tmp_path / "step-1").tensors_of("x")
    assert found.keys() == tensors.keys()
    assert all(torch.equal(found[name], tensors[name]) and found[name].dtype == tensors[name].dtype for name in tensors)


def test_all_files_of_a_checkpoint_have_the_permissions_of_new_files(tmp_path):
    path = write(tmp_path, state_with_history())
    (tmp_path / "new").touch()
    assert {file.stat().st_mode for file in path.iterdir()} == {(tmp_path / "new").stat().st_mode}


def test_the_error_of_a_full_disk_is_that_of_the_system(tmp_path):
    """Beyond the limit on the size of files, the library's write fails as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (3000, before[1]))
        with pytest.raises(OSError, match="File too large") as raised:
            checkpoint.write(tmp_path, {"x": torch.nn.Linear(100, 10)}, 1, {}, 3)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    assert raised.value.errno == errno.EFBIG
    assert list(tmp_path.iterdir()) == []
