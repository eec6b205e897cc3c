"""A run directory as bytes: what is sent, and what stays where it is."""

from lemniscate.cluster.connection import pack, unpack


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
