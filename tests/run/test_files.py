"""Files of a run: whole or absent when written, and read without trust."""

import os
from contextlib import suppress

import pytest

import lemniscate as lem
from conftest import tiny_fields
from lemniscate.api.results import final_scores
from lemniscate.run.directory import read_config
from lemniscate.system.files import DamagedFileError, make_directory, read_json, replace_file, write_json

RECORD = {"algorithm": "ppo", "config": {"env": "CartPole-v1", "gamma": 0.99, "hidden": [64, 64], "preset": None}}


def test_a_flipped_bit_is_found_or_changes_nothing(tmp_path):
    write_json(tmp_path / "x.json", RECORD)
    content, unchanged = (tmp_path / "x.json").read_bytes(), 0
    tried = range(0, 8 * len(content), 5)  # each bit of a byte, in some byte; `make test-faults` tries all
    for position in tried:
        damaged = bytearray(content)
        damaged[position // 8] ^= 1 << position % 8
        (tmp_path / "x.json").write_bytes(damaged)
        with suppress(DamagedFileError):
            assert read_json(tmp_path / "x.json") == RECORD
            unchanged += 1
    assert unchanged < 0.02 * len(tried)  # white space


def test_every_truncation_is_found(tmp_path):
    write_json(tmp_path / "x.json", RECORD)
    content = (tmp_path / "x.json").read_bytes()
    for length in range(len(content) - 1):
        (tmp_path / "x.json").write_bytes(content[:length])
        with pytest.raises(DamagedFileError, match=r"x\.json"):
            read_json(tmp_path / "x.json")


def a_link(path):
    path.with_name("target").write_text("{}")
    path.symlink_to(path.with_name("target"))


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (a_link, "it is a link"),
        (os.mkfifo, "no regular file"),
        (os.mkdir, "no regular file"),
        (lambda path: None, "is missing"),
        (lambda path: path.write_text("[" * 100_000), "not JSON"),
        (lambda path: path.write_bytes(b"\xff\xfe"), "not JSON"),
        (lambda path: path.write_text("[]"), "sha256 differs"),
        (lambda path: path.write_text('{"a": 1}'), "has no sha256"),
        (lambda path: path.write_text('{"a": ' + "9" * 10_000 + "}"), "not JSON"),
    ],
)
def test_what_is_no_file_of_ours_is_refused_without_waiting(tmp_path, make, said):
    make(tmp_path / "x.json")
    with pytest.raises(DamagedFileError, match=said):
        read_json(tmp_path / "x.json")


def test_nothing_is_written_through_a_link(tmp_path):
    outside = tmp_path / "outside"
    outside.write_text("mine")
    for name in ("x.json", "x.json.tmp"):
        (tmp_path / name).symlink_to(outside)
    replace_file(tmp_path / "x.json", b"new")
    assert (outside.read_text(), (tmp_path / "x.json").read_text()) == ("mine", "new")
    (tmp_path / "folder").symlink_to(tmp_path)
    with pytest.raises(FileExistsError, match="link"):
        make_directory(tmp_path / "folder")


def test_a_damaged_config_is_taken_from_the_checkpoint_and_mended(tmp_path, capsys):
    fields = tiny_fields(checkpoint_every=64)
    lem.train(
        "ppo", "Countdown-v0", run=tmp_path / "r", progress=False, callbacks=[lambda step, *_: step >= 128], **fields
    )
    file = tmp_path / "r" / "config.json"
    whole = file.read_bytes()
    for damaged in (whole.replace(b'"gamma": 0.99', b'"gamma": 0.98'), whole[:40], None):
        file.unlink()
        if damaged:
            file.write_bytes(damaged)
        assert read_config(tmp_path / "r")[1]["gamma"] == 0.99
        assert f"Taking the config in {tmp_path / 'r' / 'checkpoints' / 'step-128'}" in capsys.readouterr().err
        read_config(tmp_path / "r")
        assert not capsys.readouterr().err  # a command says so once
    assert lem.resume(tmp_path / "r", progress=False).policy.step == 256
    assert file.read_bytes() == whole


def test_damaged_metrics_are_kept_aside_and_damaged_scores_found_again(tmp_path, capsys):
    fields = tiny_fields(checkpoint_every=64)
    run = tmp_path / "r"
    lem.train("ppo", "Countdown-v0", run=run, progress=False, callbacks=[lambda step, *_: step >= 128], **fields)
    metrics = run / "metrics.jsonl"
    damaged = metrics.read_bytes().replace(b'"step": 64', b'"step": 65')
    metrics.write_bytes(damaged)
    lem.resume(run, progress=False)
    assert (
        f"line 2 is damaged, and left out. It is kept as {run / 'metrics.damaged-1.jsonl'}." in capsys.readouterr().err
    )
    assert (run / "metrics.damaged-1.jsonl").read_bytes() == damaged
    scores = final_scores(run)
    (run / "final.json").write_text('{"mean_return": 1000000.0}')
    assert final_scores(run) == scores
    assert "final.json has no sha256" in capsys.readouterr().err
