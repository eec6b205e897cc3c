"""A run directory as bytes: what is sent, and what stays where it is."""

import threading
from pathlib import Path

import pytest

from lemniscate.cluster.connection import ITS_OWN, Cluster, find_cluster, pack, unpack
from lemniscate.cluster.job import line_to_resume, require_no_other_job, take_back
from lemniscate.errors import UserError


def run(path, config, *steps):
    """A run directory with these checkpoints."""
    for step in steps:
        (path / "checkpoints" / f"step-{step}").mkdir(parents=True)
        (path / "checkpoints" / f"step-{step}" / "state.json").write_text(f"{step}")
    (path / "config.json").write_text(config)
    (path / "metrics.jsonl").write_text(f"up to {steps[-1]}")
    return path


def test_a_new_place_gets_the_whole_run_but_what_is_only_of_its_machine(tmp_path):
    here = run(tmp_path / "here", "seed 1", 10, 20)
    (here / "videos").mkdir()
    (here / "videos" / "video.gif").touch()
    (here / "checkpoints" / "step-30.tmp").touch()
    unpack(pack(here), tmp_path / "there")
    files = {file.relative_to(tmp_path / "there").as_posix() for file in (tmp_path / "there").rglob("*.j*")}
    assert files == {"config.json", "metrics.jsonl", "checkpoints/step-10/state.json", "checkpoints/step-20/state.json"}
    assert {file.name for file in (tmp_path / "there").iterdir()} == {"config.json", "metrics.jsonl", "checkpoints"}


def test_a_run_that_is_there_gets_what_is_new_and_keeps_its_config(tmp_path):
    here, there = run(tmp_path / "here", "seed 1", 20, 30), run(tmp_path / "there", "seed 2", 10, 20)
    (there / "checkpoints" / "step-20" / "mark").touch()
    unpack(pack(here), there)
    assert (there / "config.json").read_text() == "seed 2"
    assert (there / "metrics.jsonl").read_text() == "up to 30"
    assert {path.name for path in (there / "checkpoints").iterdir()} == {"step-20", "step-30"}
    assert (there / "checkpoints" / "step-20" / "mark").exists(), "a checkpoint that is there is not sent again"


def test_a_run_whose_checkpoints_are_renamed_meanwhile_is_packed(tmp_path):
    here, done = run(tmp_path / "here", "seed 1", *range(40)), threading.Event()
    folder = here / "checkpoints"

    def rename():
        while not done.is_set():
            for step in range(40):
                (folder / f"step-{step}").rename(folder / f"step-{step}.old")
            for step in range(40):
                (folder / f"step-{step}.old").rename(folder / f"step-{step}")

    thread = threading.Thread(target=rename)
    thread.start()
    try:
        for _ in range(100):
            pack(here)
    finally:
        done.set()
        thread.join()


def test_what_a_job_has_stored_is_taken_back_before_anything_is_removed(tmp_path):
    here, stored = run(tmp_path / "here", "seed 1", 10, 20), run(tmp_path / "stored", "another", 20, 30)
    with pytest.raises(OSError, match="gone"):
        take_back(tmp_path / "gone", here)
    assert {file.name for file in (here / "checkpoints").iterdir()} == {"step-10", "step-20"}
    take_back(stored, here)
    assert {file.name for file in (here / "checkpoints").iterdir()} == {"step-20", "step-30"}
    assert (here / "config.json").read_text() == "seed 1"


def test_a_stopped_job_goes_on_in_its_own_place():
    line = line_to_resume(Path("runs/it"), Cluster("10.0.0.1:6379", 2, "/mnt/my disk"), 2)
    assert line == "lemniscate resume runs/it --cluster ray=10.0.0.1:6379 --workers 2 --storage '/mnt/my disk'"
    assert line_to_resume(Path("runs/it"), Cluster(None, 2, None), 2).endswith("runs/it --cluster ray --workers 2")


def test_the_best_checkpoint_is_sent_again_and_a_half_written_one_not(tmp_path):
    """Others never change under their name."""
    here = run(tmp_path / "here", "seed 1", 10)
    best = here / "checkpoints" / "best" / "state.json"
    best.parent.mkdir()
    best.write_text("of step 10")
    half = here / "checkpoints" / "step-20.tmp" / "tensors.safetensors"
    half.parent.mkdir()
    half.touch()
    unpack(pack(here), tmp_path / "there")
    best.write_text("of step 20")
    unpack(pack(here), tmp_path / "there")
    assert (tmp_path / "there" / "checkpoints" / "best" / "state.json").read_text() == "of step 20"
    assert {path.name for path in (tmp_path / "there" / "checkpoints").iterdir()} == {"step-10", "best"}


def test_at_the_end_its_pictures_come_too(tmp_path):
    here = run(tmp_path / "here", "seed 1", 10)
    for name in ("plots/report.html", "videos/step-10.gif", "ray/inside"):
        (here / name).parent.mkdir()
        (here / name).touch()
    (tmp_path / "there" / "videos").mkdir(parents=True)
    (tmp_path / "there" / "videos" / "older.gif").touch()
    unpack(pack(here, ITS_OWN), tmp_path / "there")
    there = {file.relative_to(tmp_path / "there").as_posix() for file in (tmp_path / "there").rglob("*.*")}
    assert {"plots/report.html", "videos/step-10.gif", "videos/older.gif"} <= there
    assert not (tmp_path / "there" / "ray").exists()


def test_a_storage_that_has_a_job_of_that_name_is_refused_for_a_new_run(tmp_path):
    """Ray would begin it with the other one's checkpoint."""
    pytest.importorskip("pyarrow")
    require_no_other_job(str(tmp_path), "CartPole-v1-ppo")
    require_no_other_job(None, "CartPole-v1-ppo")
    (tmp_path / "CartPole-v1-ppo").mkdir()
    with pytest.raises(UserError, match="has a job CartPole-v1-ppo of another run: choose another --run, or"):
        require_no_other_job(str(tmp_path), "CartPole-v1-ppo")
    with pytest.raises(UserError, match="The storage nowhere://x cannot be reached"):
        require_no_other_job("nowhere://x", "run")


def test_a_folder_that_is_named_relatively_is_that_folder_for_ray(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("lemniscate.cluster.connection.is_installed", lambda _: True)
    assert find_cluster("ray", storage="out").storage == str(tmp_path / "out")
    assert find_cluster("ray", storage="s3://bucket/x").storage == "s3://bucket/x"
