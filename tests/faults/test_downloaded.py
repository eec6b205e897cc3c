"""Runs from elsewhere, made to do harm: nothing outside them is written, nothing waits for ever, all is one sentence."""

import hashlib
import json
import os
import random
import shutil

import pytest

import lemniscate as lem
from conftest import tiny_fields
from faults.runs import often
from forks import command
from lemniscate.api.results import final_scores
from lemniscate.errors import UserError
from lemniscate.run.check import each_finding
from lemniscate.run.directory import read_config
from lemniscate.system.files import read_json, write_json

STEP = "checkpoints/step-256"
PLACES = ["config.json", "metrics.jsonl", "final.json", ".lock", "plots", "videos", "checkpoints", STEP]
PLACES += [f"{STEP}/{name}" for name in ("manifest.json", "state.json", "tensors.safetensors")]
PLACES += ["plots/learning_curve.png", "plots/report.html", "videos/step-0.gif", f"{STEP}.tmp"]
PLACES += [f"{name}.tmp" for name in ("config.json", "metrics.jsonl", "final.json", "plots/report.html")]
VERBS = ["evaluate", "plot", "resume"]
ODD = [None, True, -1, 0, 1e308, 10**30, "x", "../../x", "/x", "evil:Env", [], [[]], {}, [1] * 5, {"kind": "Box"}]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("theirs") / "r"
    lem.train("ppo", "CartPole-v1", run=path, progress=False, **tiny_fields(checkpoint_every=128))
    final_scores(path)
    return path


def replaced(path, kind, outside):
    """In the place of `path`, a link to a file, one to a directory, one to nothing, a pipe, or a directory."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    makers = {
        "link to a file": lambda: path.symlink_to(outside / "file"),
        "link to a directory": lambda: path.symlink_to(outside),
        "link to nothing": lambda: path.symlink_to(outside / "new"),
        "pipe": lambda: os.mkfifo(path),
        "directory": path.mkdir,
    }
    makers[kind]()


KINDS = ["link to a file", "link to a directory", "link to nothing", "pipe", "directory"]
CASES = [(place, kind, verb) for place in PLACES for kind in KINDS for verb in VERBS]


whole = [pytest.param(first, 3, marks=pytest.mark.faults) for first in range(3)]


@pytest.mark.parametrize(("first", "every"), [*whole, (0, 61)])
def test_what_a_run_links_to_is_not_touched_and_no_pipe_is_waited_for(run, tmp_path, first, every):
    outside = tmp_path / "outside"
    for number, (place, kind, verb) in enumerate(CASES[first::every]):
        path = shutil.copytree(run, tmp_path / f"r{number}")
        shutil.rmtree(outside, ignore_errors=True)
        outside.mkdir()
        (outside / "file").write_text("precious")
        replaced(path / place, kind, outside)
        process = command(verb, path, *(["--episodes", "2"] if verb == "evaluate" else []))
        said = "".join(process.communicate(timeout=60))
        assert "Traceback" not in said, (place, kind, verb, said)
        assert process.returncode in (0, 1, 2), (place, kind, verb, said)
        assert [file.name for file in outside.iterdir()] == ["file"], (place, kind, verb, said)
        assert (outside / "file").read_text() == "precious", (place, kind, verb, said)
        shutil.rmtree(path)
    print(f"{len(CASES[first::every])} links, pipes and directories in the place of files: nothing outside changed")


def edited(record, rng):
    """A record with an odd value somewhere."""
    copy = json.loads(json.dumps(record))
    at = copy
    while True:
        keys = list(at) if isinstance(at, dict) else range(len(at))
        key = rng.choice(keys)
        if not isinstance(at[key], dict | list) or not at[key] or rng.random() < 0.2:
            at[key] = rng.choice(ODD)
            return copy
        at = at[key]


def edit(path, name, rng):
    """Edit a file of a run, with right hashes, so that only its content can give it away."""
    file = path / name
    write_json(file, edited(read_json(file), rng))
    if name.endswith("state.json"):
        manifest = read_json(file.with_name("manifest.json"))
        hashed = hashlib.sha256(file.read_bytes()).hexdigest()
        write_json(file.with_name("manifest.json"), {**manifest, "files": {**manifest["files"], "state.json": hashed}})


def checked(path):
    """What `lem.check` finds, each in a sentence."""
    assert all(finding.sentence.endswith(".") for finding in each_finding(path))


@pytest.mark.parametrize("times", [pytest.param(often(1500), marks=pytest.mark.faults), 40])
def test_records_of_odd_content_and_right_hashes_are_a_sentence(run, tmp_path, capsys, times):
    names = ["config.json", "final.json", f"{STEP}/state.json", f"{STEP}/manifest.json"]
    refused = 0
    for number in range(times):
        rng = random.Random(number)
        path = shutil.copytree(run, tmp_path / "r")
        name = rng.choice(names)
        edit(path, name, rng)
        for read in (lem.load, read_config, final_scores, checked, lem.evaluate if number % 10 == 0 else lem.load):
            try:
                read(path)
            except UserError:
                refused += 1
            except Exception as error:
                raise AssertionError(f"case {number}, {name}, {read}") from error
        shutil.rmtree(path)
    capsys.readouterr()
    print(f"{times} records of odd content: {refused} answers refused in a sentence, 0 tracebacks")
    assert refused > times / 10
