"""`lemniscate doctor RUN`: every damaged file is named, with what can be done; nothing is changed."""

import json
import shutil

import pytest
from filelock import FileLock

import lemniscate as lem
from conftest import tiny, tiny_fields
from lemniscate.api.results import final_return
from lemniscate.cli import main
from lemniscate.run.places import Sweep


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "r"
    run = lem.train("ppo", "Countdown-v0", run=path, progress=False, **{**tiny_fields(), "total_steps": 256})
    final_return(run)
    return path


@pytest.fixture
def run(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "r")


def contents(path):
    return {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}


def answer(path, capsys):
    """The exit code, and the lines that are said."""
    before = contents(path)
    try:
        code = main(["doctor", str(path)])
    except SystemExit as exit:
        code = exit.code
    assert contents(path) == before
    return code, " ".join(capsys.readouterr().err.split())


def flip(file, place=0.5):
    content = bytearray(file.read_bytes())
    content[int(place * len(content))] ^= 1
    file.write_bytes(content)


def test_a_whole_run_is_said_to_be_whole(run, capsys):
    code, said = answer(run, capsys)
    assert code in (0, None)
    assert f"{run} is whole." in said
    assert "✓ config.json: ppo on Countdown-v0." in said
    assert "it is finished" in said
    assert "✗" not in said


@pytest.mark.parametrize(
    ("file", "advice"),
    [
        ("config.json", "has a copy, which is taken"),
        ("checkpoints/step-256/tensors.safetensors", "resume goes on from step"),
        ("checkpoints/step-256/state.json", "resume goes on from step"),
        ("checkpoints/step-256/manifest.json", "resume goes on from step"),
    ],
)
def test_a_damaged_file_is_named_with_what_can_be_done(run, capsys, file, advice):
    flip(run / file)
    code, said = answer(run, capsys)
    assert code == 2
    assert f"✗ {run / file}" in said
    assert advice in said
    assert f"lemniscate resume {run}" in said


@pytest.mark.parametrize(("file", "said_too"), [("final.json", "computed again"), ("metrics.jsonl", "metrics.jsonl")])
def test_of_a_finished_run_resume_is_not_said_to_repair_anything(run, capsys, file, said_too):
    flip(run / file)
    code, said = answer(run, capsys)
    assert code == 2
    assert f"✗ {run / file}" in said
    assert said_too in said
    assert "It is finished, so that resume changes nothing; its policy serves." in said
    assert "lemniscate resume" not in said


def test_of_a_run_that_goes_on_resume_keeps_the_damaged_metrics(run, capsys):
    flip(run / "metrics.jsonl")
    shutil.rmtree(run / "checkpoints" / "step-256")
    said = answer(run, capsys)[1]
    assert "resume keeps the damaged file beside the new one" in said
    assert f"lemniscate resume {run}" in said


def test_a_run_whose_checkpoints_are_gone_keeps_its_metrics_when_it_begins_again(run, capsys):
    shutil.rmtree(run / "checkpoints")
    code, said = answer(run, capsys)
    assert code == 2
    assert f"✗ {run} came to step 256, its end; its checkpoints are gone, so that resume begins a new" in said
    before = (run / "metrics.jsonl").read_bytes()
    with pytest.raises(lem.UserError, match="its checkpoints are gone: nothing is left to go on from to 512 steps"):
        lem.resume(run, total_steps=512, progress=False)
    assert (run / "metrics.jsonl").read_bytes() == before
    assert lem.resume(run, progress=False).policy.step == 256
    said = capsys.readouterr().err
    assert "resume begins a new metrics.jsonl. It is kept as" in said
    assert (run / "metrics.damaged-1.jsonl").read_bytes() == before
    shutil.rmtree(run / "checkpoints")
    (run / "metrics.jsonl").write_bytes(b"".join(before.splitlines(keepends=True)[:-1]))  # stopped before its first one
    assert "There is no checkpoint yet: resume would begin at step 0." in answer(run, capsys)[1]


def test_what_is_bad_is_in_the_json_too(run, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "1")
    (run / "config.json").write_text("{")
    assert main(["doctor", str(run), "--json"]) == 2
    checked = json.loads(capsys.readouterr().out)["checked"]
    assert "bad" in {finding["grade"] for finding in checked}


def test_a_run_without_any_copy_is_beyond_repair(run, capsys):
    flip(run / "config.json")
    shutil.rmtree(run / "checkpoints")
    code, said = answer(run, capsys)
    assert code == 2
    assert "No checkpoint has a copy." in said
    assert said.endswith("There is nothing that it can be repaired from.")


def test_what_was_left_and_who_trains_is_noted(run, capsys):
    (run / "checkpoints" / "step-300.tmp").mkdir()
    with FileLock(run / ".lock"):
        code, said = answer(run, capsys)
    assert code in (0, None)
    assert "! Left by a write that was interrupted, and harmless: checkpoints/step-300.tmp." in said
    assert "! It is being trained by another process" in said


def test_a_sweep_is_checked_run_by_run(tmp_path, capsys):
    sweep = tmp_path / "s"
    config = {name: value for name, value in tiny().to_json().items() if name != "seed"}
    Sweep(sweep, [1, 2], {"ppo": config}).create()
    Sweep(sweep, [1, 2], {"ppo": config}).create_runs()
    code, said = answer(sweep, capsys)
    assert code in (0, None)
    assert "✓ sweep.json: ppo with 2 seeds." in said
    assert "ppo-1: It has not begun." in said
    flip(sweep / "ppo-2" / "config.json")
    code, said = answer(sweep, capsys)
    assert code == 2
    assert f"✗ ppo-2: {sweep / 'ppo-2' / 'config.json'} is damaged" in said
    flip(sweep / "sweep.json")
    code, said = answer(sweep, capsys)
    assert f"✗ {sweep} is not a sweep: {sweep / 'sweep.json'} is damaged" in said
    assert "ppo-1: config.json: ppo on Countdown-v0." in said


def test_from_python_it_takes_a_path_or_what_train_returned(run):
    assert [finding.grade for finding in lem.check(run)] == ["good"] * 4
    assert lem.check(str(run)) == lem.check(run)


def test_a_directory_in_the_place_of_the_metrics_is_said(run):
    (run / "metrics.jsonl").unlink()
    (run / "metrics.jsonl").mkdir()
    with pytest.raises(lem.UserError, match="is a directory, where the lines of metrics have their file"):
        lem.resume(run, total_steps=512, progress=False)


@pytest.mark.parametrize("verb", [lem.load, lem.resume, lambda path: lem.save(None, path)])
@pytest.mark.parametrize(("name", "said"), [("x" * 300, "a name of more than 255 bytes"), ("a\0b", "has a zero byte")])
def test_what_can_be_no_path_is_said(verb, name, said):
    with pytest.raises(lem.UserError, match=said):
        verb(name)


def test_an_export_is_no_run_and_a_dead_link_no_place(run, tmp_path):
    lem.export(run, to=tmp_path / "export")
    with pytest.raises(lem.UserError, match="is an export, for other programs: load the run"):
        lem.load(tmp_path / "export")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    with pytest.raises(lem.UserError, match="is a link that leads nowhere"):
        lem.save(lem.load(run), tmp_path / "link")
