"""The contract of loggers: those that every run has, and one of a user's own."""

import runpy
from pathlib import Path

import pytest

import lemniscate as lem
from conftest import tiny_fields
from lemniscate.run.loggers import JsonLines, TensorBoard

EXAMPLES = Path(__file__).parents[2] / "examples"
EVERY = {
    "metrics.jsonl": JsonLines,
    "events.out.tfevents.*": TensorBoard,
    "metrics.csv": runpy.run_path(str(EXAMPLES / "own_logger.py"))["Csv"],
}
"""the file that each writes: its class"""


@pytest.mark.parametrize(("name", "logger"), EVERY.items(), ids=[logger.__name__ for logger in EVERY.values()])
def test_it_takes_a_run_a_resumed_one_and_one_with_nothing_left_to_do(name, logger, tmp_path):
    def size():
        return sum(file.stat().st_size for file in tmp_path.glob(name))

    first = logger(tmp_path, {"algorithm": "ppo", "seed": 1}, 0)
    first.write(16, {"losses/policy": 0.5, "episode/return": 3.0})
    written = size()
    first.write(32, {"losses/policy": 0.25})
    assert size() > written > 0, "what has been written is on the disk at once"
    first.close([tmp_path / "picture.png"])
    resumed = logger(tmp_path, {"algorithm": "ppo", "seed": 1}, 16)
    resumed.write(32, {"losses/policy": 0.25})
    resumed.close([])
    assert size() > written
    before = size()
    logger(tmp_path, {"algorithm": "ppo", "seed": 1}, 32).close([])
    assert size() == before
    if name == "metrics.csv":
        steps = [line.partition(",")[0] for line in (tmp_path / name).read_text().splitlines()]
        assert steps == ["16", "16", "32"], "what is done again stands once"


def test_a_tracker_gets_every_line_of_the_run_and_then_the_end(tmp_path):
    calls = []

    class Recorder:
        def __init__(self, path, config, step):
            calls.append(("begin", step, config["algorithm"], config["env"]))

        def write(self, step, metrics, episodes=None):
            assert all(isinstance(value, float) for value in metrics.values())
            calls.append(("write", step))

        def close(self, pictures):
            calls.append(("close", all(picture.is_file() for picture in pictures)))

    fields = tiny_fields(total_steps=64) | {"run": tmp_path / "run", "progress": False}
    lem.train("ppo", "Countdown-v0", track=Recorder, **fields)
    assert calls == [("begin", 0, "ppo", "Countdown-v0"), ("write", 32), ("write", 64), ("close", True)]
