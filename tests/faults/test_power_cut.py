"""Power cuts: whatever the disk may hold then, the newest synced checkpoint is there, with its config and metrics."""

import random
import re

import pytest

import lemniscate as lem
from faults.disk import fresh, read_log, states
from faults.runs import recorded, trials
from lemniscate.errors import UserError
from lemniscate.run.directory import find_checkpoint, read_config
from lemniscate.run.metrics import read_metrics
from run.test_run import final_hashes, history


def promised(events):
    """After each event, the step of the newest checkpoint whose name has been synced; 0 while there is none."""
    renamed, steps = 0, []
    for event in events:
        if event.kind == "rename" and re.fullmatch(r"step-\d+", event.second.name):
            renamed = int(event.second.name.removeprefix("step-"))
        is_synced = event.kind == "sync" and event.path.name == "checkpoints"
        steps.append(renamed if is_synced else steps[-1] if steps else 0)
    return steps


def check_state(run, step):
    """A run directory after a power cut, in which the checkpoint at `step` is to be."""
    try:
        found = find_checkpoint(run)
    except UserError:
        assert step == 0
        return
    assert found.numbers["step"] >= step
    assert read_config(run)[1] == found.record["config"]
    logged = found.record["logged"]
    assert [line["step"] for line in read_metrics(run) if line["step"] <= logged] == list(range(32, logged + 1, 32))


@pytest.mark.parametrize(("every", "draws"), [pytest.param(1, 12, marks=pytest.mark.faults), (7, 1)])
def test_whatever_a_power_cut_leaves_the_newest_synced_checkpoint_is_there(recorded, tmp_path, capsys, every, draws):
    whole, log = recorded
    events = read_log(log)
    steps, count, rng, left = promised(events), 0, random.Random(1), tmp_path / "left"
    assert sorted(set(steps)) == [0, 192, 384, 576, 768]
    for number, how, write in states(events, whole.parent, every=every, draws=draws):
        write(fresh(left))
        check_state(left / "r", steps[number - 1])
        count += 1
        if how == "any" and steps[number - 1] and rng.random() < 0.04:
            lem.resume(left / "r", progress=False)
            assert final_hashes(left / "r") == final_hashes(whole)
            assert history(left / "r") == history(whole)
    capsys.readouterr()
    print(f"{count} states after a power cut, 0 bad")
    assert count == (3 + draws) * (len(events) // every)


def test_the_model_of_the_disk_ends_in_what_the_disk_holds(recorded, tmp_path):
    whole, log = recorded
    root = whole.parent
    *_, (_, _, write) = [state for state in states(read_log(log), root) if state[1] == "all"]
    write(fresh(tmp_path / "left"))
    files = {path.relative_to(root): path.read_bytes() for path in root.rglob("*") if path.is_file()}
    assert files == {
        p.relative_to(tmp_path / "left"): p.read_bytes() for p in (tmp_path / "left").rglob("*") if p.is_file()
    }
    assert len(files) > 12
