"""Files of a run: whole or absent when written, and read without trust."""

import errno
import os
import threading
from contextlib import suppress

import pytest

import lemniscate as lem
from conftest import tiny_fields
from lemniscate.api.results import final_scores
from lemniscate.errors import UserError
from lemniscate.report.pages import newest_video
from lemniscate.run import checkpoint
from lemniscate.run.checkpoint import list_steps
from lemniscate.run.directory import find_checkpoint, read_config
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


def test_two_that_write_one_file_at_a_time_leave_one_of_both_whole(tmp_path, monkeypatch):
    """The second begins and ends while the first has the disk store its own."""
    path, sync = tmp_path / "x", os.fsync

    def meanwhile(handle):
        monkeypatch.setattr(os, "fsync", sync)
        thread = threading.Thread(target=replace_file, args=(path, b"second"))
        thread.start()
        thread.join()
        sync(handle)

    monkeypatch.setattr(os, "fsync", meanwhile)
    replace_file(path, b"first")
    assert path.read_bytes() == b"first"
    assert [file.name for file in tmp_path.iterdir()] == ["x"]


def test_a_checkpoint_that_cannot_be_opened_now_is_not_removed(tmp_path, monkeypatch):
    """As on a network's disk that is away for a moment."""
    run = lem.train("ppo", "CartPole-v1", run=tmp_path / "run", progress=False, **tiny_fields(checkpoint_every=128))
    opened = os.open

    def away(path, *args, **kwargs):
        if str(path).endswith("step-256/manifest.json"):
            raise OSError(errno.ESTALE, "Stale file handle", str(path))
        return opened(path, *args, **kwargs)

    monkeypatch.setattr(os, "open", away)
    with pytest.raises(UserError, match=r"cannot be opened: Stale file handle. Nothing is changed: resume once it can"):
        lem.resume(run, total_steps=512, progress=False)
    monkeypatch.undo()
    assert list_steps(run.path / "checkpoints") == [128, 256]
    assert lem.resume(run, total_steps=512, progress=False).policy.step == 512


def test_metrics_are_kept_where_no_checkpoint_is_left_to_go_on_from(tmp_path, capsys):
    run = lem.train("ppo", "CartPole-v1", run=tmp_path / "run", progress=False, **tiny_fields(checkpoint_every=128))
    for file in run.path.glob("checkpoints/*/manifest.json"):
        file.write_text("{}")
    lem.resume(run, progress=False)
    assert "no planned checkpoint to go on from; it begins again at step 0. It is kept as" in capsys.readouterr().err
    assert (run.path / "metrics.damaged-1.jsonl").stat().st_size > 0


def test_a_best_checkpoint_whose_replacement_was_killed_in_the_middle_is_found(tmp_path):
    """Between the two renames there is none of that name."""
    fields = tiny_fields(keep_best=True, evaluate_every=64, checkpoint_every=128, total_steps=256)
    run = lem.train("ppo", "CartPole-v1", run=tmp_path / "run", progress=False, **fields)
    folder = run.path / "checkpoints"
    kept = lem.load(run, checkpoint="best").step
    (folder / "best").rename(folder / "best.old.tmp")
    lem.resume(run, total_steps=288, progress=False)
    assert lem.load(run, checkpoint="best").step >= kept
    assert not (folder / "best.old.tmp").exists()


def test_the_best_checkpoint_is_read_again_where_it_was_replaced_meanwhile(tmp_path, monkeypatch):
    fields = tiny_fields(keep_best=True, evaluate_every=64, total_steps=256)
    run = lem.train("ppo", "CartPole-v1", run=tmp_path / "run", progress=False, **fields)
    read, times = checkpoint.read, []

    def once_replaced(path):
        times.append(path)
        if len(times) == 1:
            raise DamagedFileError(f"{path} is damaged.")
        return read(path)

    monkeypatch.setattr(checkpoint, "read", once_replaced)
    assert find_checkpoint(run.path, "best").numbers["step"] <= 256
    assert len(times) == 2


def test_scores_in_a_folder_that_may_only_be_read_are_known_all_the_same(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("lemniscate.api.results.FINAL_EPISODES", 2)
    run = lem.train("ppo", "CartPole-v1", run=tmp_path / "run", progress=False, **tiny_fields(total_steps=32))

    def refused(path, content):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr("lemniscate.system.files.replace_file", refused)
    assert final_scores(run)["step"] == 32
    assert "final.json cannot be written, so the scores are not kept: Permission denied." in capsys.readouterr().err


def test_a_video_that_is_being_written_is_not_the_newest(tmp_path):
    (tmp_path / "videos").mkdir()
    for number, name in enumerate(("step-10.gif", "step-20.tmp.gif")):
        (tmp_path / "videos" / name).touch()
        os.utime(tmp_path / "videos" / name, (number, number))
    assert newest_video(tmp_path).name == "step-10.gif"
