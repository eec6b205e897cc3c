"""Damage: a flipped bit or a missing end of any file of a run or a sweep is named, or changes nothing."""

import random
import shutil

import pytest

import lemniscate as lem
from conftest import tiny_fields
from faults.runs import SHARE, often
from lemniscate.api.results import _known_scores, final_scores
from lemniscate.errors import UserError
from lemniscate.run.directory import find_checkpoint, read_config
from lemniscate.run.metrics import damage, read_metrics
from lemniscate.run.places import LOG, Sweep, failure_of, read_sweep
from run.test_run import final_hashes, history

FIELDS = {**tiny_fields(hidden=(2,)), "checkpoint_every": 128, "keep_checkpoints": 2}
RUN = ["config.json", "metrics.jsonl", "final.json"]
RUN += [f"checkpoints/step-256/{name}" for name in ("manifest.json", "state.json", "tensors.safetensors")]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished run with its final scores."""
    path = tmp_path_factory.mktemp("whole") / "r"
    lem.train("ppo", "Countdown-v0", run=path, progress=False, **FIELDS)
    final_scores(path)
    return path


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """A sweep whose runs have not begun; one has a log."""
    path = tmp_path_factory.mktemp("sweeps") / "s"
    made = Sweep(path, [1, 2], {"ppo": lem.config_for("ppo", "Countdown-v0", **FIELDS).to_json()})
    made.create()
    made.create_runs()
    (path / "ppo-1" / LOG).write_text("Training ±.\nOut of memory.\n")
    return path


def found_in(path):
    """The checkpoint that a run is loaded from, and all that is in it."""
    found = find_checkpoint(path)
    return found.numbers, found.record, {name: tensor.tolist() for name, tensor in found.tensors.items()}


READERS = {
    # name of the file: what depends on it
    "config.json": read_config,
    "metrics.jsonl": read_metrics,
    "final.json": lambda path: _known_scores(path / "final.json"),
    "manifest.json": found_in,
    "state.json": found_in,
    "tensors.safetensors": found_in,
    "sweep.json": lambda path: (read_sweep(path).seeds, read_sweep(path).configs),
    LOG: lambda path: bool(failure_of(path, 1)),
}


def damages(content, every):
    """(description, content) with a flipped bit, each `every`-th; then what is cut off, at each `every`-th byte."""
    for bit in range(0, 8 * len(content), every):
        flipped = bytearray(content)
        flipped[bit // 8] ^= 1 << bit % 8
        yield f"bit {bit}", bytes(flipped)
    for size in range(0, len(content), every):
        yield f"{size} bytes", content[:size]


def check_damage(path, name, every, capsys):
    """What is read from a directory whose file `name` is damaged is what was written, or a sentence names the file."""
    file = path / name
    read, content, count = READERS[file.name], file.read_bytes(), 0
    whole = read(path)
    before = found_in(path.parent / "before") if file.parent.name.startswith("step-") else {}
    try:
        for how, damaged in damages(content, every):
            file.write_bytes(damaged)
            capsys.readouterr()
            try:
                found = read(path)
                said = capsys.readouterr().err
            except UserError as error:
                found, said = None, str(error)
            if file.name == "metrics.jsonl":
                assert all(line in whole for line in found), how
                said = damage(path, logged=256) or said
            assert found in (whole, before, None) or file.name == "metrics.jsonl", how
            assert found == whole or str(file) in said, (how, said)
            assert "Traceback" not in said, how
            count += 1
    finally:
        file.write_bytes(content)
    return count


def copy_of(run, folder):
    """A run, and beside it the same as it was one checkpoint before."""
    shutil.copytree(run, folder / "r")
    shutil.copytree(run, folder / "before")
    shutil.rmtree(folder / "before" / "checkpoints" / "step-256")
    return folder / "r"


EVERY = pytest.param(1 if SHARE == 1 else 3, marks=pytest.mark.faults)
"""bits from one damage to the next: three is odd, so that each bit of a byte is flipped in some byte"""


@pytest.mark.parametrize("every", [EVERY, 397])
@pytest.mark.parametrize("name", RUN)
def test_damage_of_a_run_is_named_or_changes_nothing(run, tmp_path, capsys, name, every):
    count = check_damage(copy_of(run, tmp_path), name, every, capsys)
    print(f"{name}: {count:,} damages, 0 silent, 0 tracebacks")


@pytest.mark.parametrize("every", [EVERY, 97])
@pytest.mark.parametrize("name", ["sweep.json", f"ppo-1/{LOG}"])
def test_damage_of_a_sweep_is_named_or_changes_nothing(sweep, capsys, name, every):
    path = sweep / "ppo-1" if name.endswith(LOG) else sweep
    count = check_damage(path, name.split("/")[-1], every, capsys)
    print(f"{name}: {count:,} damages, 0 silent, 0 tracebacks")


@pytest.mark.parametrize("times", [pytest.param(often(500), marks=pytest.mark.faults), 4])
def test_a_damaged_run_goes_on_to_the_same_bits(run, tmp_path, capsys, times):
    """Damage anywhere, its pictures and TensorBoard's events included; then it is resumed."""
    seed = random.SystemRandom().randrange(10**6)
    rng = random.Random(seed)
    files = [file.relative_to(run) for file in sorted(run.rglob("*")) if file.is_file() and file.stat().st_size]
    for _ in range(times):
        path = shutil.copytree(run, tmp_path / "r", dirs_exist_ok=False)
        name = rng.choice(files)
        content = (path / name).read_bytes()
        flipped = bytearray(content)
        flipped[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
        (path / name).write_bytes(flipped if rng.random() < 0.7 else content[: rng.randrange(len(content))])
        lem.resume(path, progress=False)
        kept = [line for line in history(run) if line in history(path)]
        assert final_hashes(path) == final_hashes(run), (seed, name)
        assert final_scores(path) == final_scores(run), (seed, name)
        assert history(path) == kept, (seed, name)
        shutil.rmtree(path)
    capsys.readouterr()
    print(f"{times} damaged runs went on to the same bits")
