import re
import resource
import signal
import sys
import time
from types import ModuleType, SimpleNamespace

import pytest

from lemniscate.envs.vec_env import Episodes
from lemniscate.report.curves import episode_returns
from lemniscate.run.loggers import JsonLines, TensorBoard, WeightsAndBiases
from lemniscate.run.metrics import damage, read_metrics, to_line


def test_a_resumed_log_drops_what_it_will_write_again(tmp_path):
    log = JsonLines(tmp_path, {}, 0)
    for step in (10, 20, 30):
        log.write(step, {"x": step / 3})
    log.close([])
    log = JsonLines(tmp_path, {}, 20)
    log.write(30, {"x": 0.5})
    log.close([])
    assert read_metrics(tmp_path) == [{"step": 10, "x": 10 / 3}, {"step": 20, "x": 20 / 3}, {"step": 30, "x": 0.5}]


def test_each_episode_is_written(tmp_path):
    log = JsonLines(tmp_path, {}, 0)
    log.write(10, {"x": 1.0}, Episodes([1.23456789, 2.0], [7, 9]))
    log.write(20, {"x": 1.0})
    log.write(30, {"x": 1.0}, Episodes([3.0], [4]))
    log.close([])
    assert read_metrics(tmp_path)[0] == {
        "step": 10,
        "x": 1.0,
        "episode/returns": [1.23457, 2.0],
        "episode/lengths": [7, 9],
    }
    steps, returns = episode_returns(tmp_path)
    assert steps.tolist() == [5.0, 10.0, 30.0]
    assert returns.tolist() == [1.23457, 2.0, 3.0]


def test_what_is_not_a_number_is_left_out(tmp_path):
    log = JsonLines(tmp_path, {}, 0)
    log.write(10, {"x": float("nan"), "y": float("inf"), "z": 1.0})
    log.close([])
    assert read_metrics(tmp_path) == [{"step": 10, "z": 1.0}]


def test_a_line_that_a_crash_cut_off_is_left_out(tmp_path):
    (tmp_path / "metrics.jsonl").write_bytes(to_line({"step": 1}) + to_line({"step": 2, "x": 1})[:-3])
    assert read_metrics(tmp_path) == [{"step": 1}]


def test_of_the_end_of_a_file_only_whole_lines_are_read(tmp_path):
    lines = [to_line({"step": step}) for step in range(8)]
    (tmp_path / "metrics.jsonl").write_bytes(b"".join(lines))
    for count in range(1, 9):
        size = count * len(lines[0])
        assert [line["step"] for line in read_metrics(tmp_path, size)] == list(range(8 - count, 8))
        assert [line["step"] for line in read_metrics(tmp_path, size + 1)] == list(range(8 - count, 8))
        assert [line["step"] for line in read_metrics(tmp_path, size - 1)] == list(range(9 - count, 8))


def test_every_flipped_bit_of_a_line_is_seen_and_no_other_line_is_lost(tmp_path):
    lines = [to_line({"step": step, "x": 0.5}) for step in (1, 2, 3)]
    for position in range(8 * len(lines[1])):
        damaged = bytearray(lines[1])
        damaged[position // 8] ^= 1 << position % 8
        (tmp_path / "metrics.jsonl").write_bytes(lines[0] + damaged + lines[2])
        assert {1, 3} >= {line["step"] for line in read_metrics(tmp_path)} >= {1}
        assert re.search("line 2 is damaged|lines 2, 3 are damaged", damage(tmp_path, 3) or "")


def test_lines_that_are_missing_at_the_end_are_told(tmp_path):
    (tmp_path / "metrics.jsonl").write_bytes(to_line({"step": 10}))
    assert damage(tmp_path, 10) is None
    assert "ends at step 10; its lines up to step 30 are lost" in damage(tmp_path, 30)


def test_lines_that_the_disk_refuses_are_written_later(tmp_path, capsys):
    """Beyond the limit on the size of files, write() fails as on a full disk; before it, it takes a part."""
    log = JsonLines(tmp_path, {}, 0)
    log.write(10, {"x": 1.0})
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (60, before[1]))
        for step in (20, 30, 40):
            log.write(step, {"x": 1.0})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    assert (tmp_path / "metrics.jsonl").stat().st_size == 60
    assert capsys.readouterr().err.count("cannot be written: File too large. Its lines are kept until it can.") == 1
    log.write(50, {"x": 1.0})
    log.close([])
    assert [line["step"] for line in read_metrics(tmp_path)] == [10, 20, 30, 40, 50]


class FakeWandb(ModuleType):
    """Enough of W&B to see what it is told."""

    def __init__(self, has_key, reachable):
        super().__init__("wandb")
        self.said, self.started = [], []
        self.errors = SimpleNamespace(CommError=ConnectionError, AuthenticationError=PermissionError)
        self.has_key, self.reachable = has_key, reachable
        self.Settings, self.Image = SimpleNamespace, lambda path: f"image of {path}"

    def login(self, prompt):
        return self.has_key

    def init(self, **options):
        if options["mode"] == "online" and not self.reachable:
            raise ConnectionError
        self.started.append(options)
        return SimpleNamespace(log=lambda row, step=None: self.said.append((step, row)), finish=lambda: None)

    def teardown(self):
        pass


@pytest.mark.parametrize(
    ("has_key", "reachable", "mode"), [(True, True, "online"), (True, False, "offline"), (False, True, "offline")]
)
def test_wandb_gets_everything_and_works_offline(tmp_path, monkeypatch, capsys, has_key, reachable, mode):
    fake = FakeWandb(has_key, reachable)
    monkeypatch.setitem(sys.modules, "wandb", fake)
    for name, value in {"WANDB_PROJECT": "course", "WANDB_NAME": "first", "WANDB_TAGS": "a,b"}.items():
        monkeypatch.setenv(name, value)
    for name in ("WANDB_API_KEY", "WANDB_MODE"):
        monkeypatch.delenv(name, raising=False)
    logger = WeightsAndBiases(tmp_path, {"env": "CartPole-v1", "gamma": 0.9}, 0)
    logger.write(7, {"losses/policy": 0.5})
    logger.close([tmp_path / "curve.png"])
    (started,) = fake.started
    assert started["mode"] == mode
    assert (started["project"], started["name"]) == ("course", "first")
    assert started["tags"] == ["CartPole-v1", "a", "b"]
    assert started["config"] == {"env": "CartPole-v1", "gamma": 0.9}
    assert fake.said == [(7, {"losses/policy": 0.5}), (None, {"curve": f"image of {tmp_path / 'curve.png'}"})]
    assert ("upload later with: wandb sync" in capsys.readouterr().err) == (mode == "offline")


def test_no_secret_of_the_environment_is_written(tmp_path, monkeypatch):
    import lemniscate as lem
    from conftest import tiny_fields

    secret = "canary-0123456789"
    for name in ("WANDB_API_KEY", "HF_TOKEN", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, secret)
    run = lem.train("ppo", "Countdown-v0", run=tmp_path / "r", progress=False, **tiny_fields())
    files = [file for file in run.path.rglob("*") if file.is_file()]
    assert len(files) > 5
    assert not any(secret.encode() in file.read_bytes() for file in files)


LOGGER = """
class Lines:
    def __init__(self, path, config, step):
        self.file = (path / "lines.txt").open("a")
        print(config["algorithm"], config["env"], step, file=self.file)

    def write(self, step, metrics, episodes=None):
        print(step, sorted(metrics)[0], file=self.file)

    def close(self, pictures):
        print("pictures", len(pictures), file=self.file)
        self.file.close()
"""


def test_a_logger_of_ones_own_is_named_as_module_and_class(tmp_path, monkeypatch):
    import lemniscate as lem
    from conftest import tiny_fields

    (tmp_path / "my_logger.py").write_text(LOGGER)
    monkeypatch.chdir(tmp_path)
    fields = {"total_steps": 64, "progress": False, "track": "my_logger:Lines"}
    run = lem.train("ppo", "Countdown-v0", run=tmp_path / "r", **{**tiny_fields(), **fields})
    first, *lines, last = (run.path / "lines.txt").read_text().splitlines()
    assert first == "ppo Countdown-v0 0"
    assert [line.split()[0] for line in lines] == ["32", "64"]
    assert last == "pictures 2"


def test_seconds_spent_collecting_and_learning_are_logged(tmp_path, monkeypatch):
    """An environment that takes its time makes collecting slow; the rest of an update is learning."""
    import lemniscate as lem
    import toy
    from conftest import tiny_fields

    class Slow(toy.Countdown):
        def step(self, actions):
            time.sleep(0.01)
            return super().step(actions)

    monkeypatch.setattr(toy, "Countdown", Slow)
    run = lem.train("ppo", "Countdown-v0", run=tmp_path / "r", progress=False, **tiny_fields(total_steps=64))
    for line in read_metrics(run.path):
        assert line["time/collect"] >= 0.08  # 8 steps of all environments
        assert line["time/learn"] > 0
        seconds = 32 / line["time/steps_per_second"]
        assert line["time/collect"] + line["time/learn"] <= seconds + 1e-6


def points(folder):
    """(TensorBoard's name of each run, the steps and values of `x` in it)."""
    from tensorboard.backend.event_processing.event_multiplexer import EventMultiplexer

    runs = EventMultiplexer().AddRunsFromDirectory(str(folder)).Reload()
    return {name: [(e.step, e.value) for e in runs.Scalars(name, "x")] for name in runs.Runs()}


def write_events(path, step, steps, value):
    path.mkdir(parents=True, exist_ok=True)
    board = TensorBoard(path, {"gamma": 0.9}, step)
    for at in steps:
        board.write(at, {"x": value})
    board.close([])


def test_tensorboard_names_each_run_after_its_directory(tmp_path):
    write_events(tmp_path / "runs" / "first", 0, [10], 1.0)
    write_events(tmp_path / "runs" / "sweep" / "ppo-1", 0, [10], 2.0)
    assert points(tmp_path / "runs") == {"first": [(10, 1.0)], "sweep/ppo-1": [(10, 2.0)]}


def test_tensorboard_forgets_what_was_logged_after_the_checkpoint(tmp_path):
    write_events(tmp_path / "runs" / "r", 0, [10, 20, 30], 1.0)
    write_events(tmp_path / "runs" / "r", 20, [30, 40], 2.0)
    assert points(tmp_path / "runs") == {"r": [(10, 1.0), (20, 1.0), (30, 2.0), (40, 2.0)]}


def test_a_run_with_nothing_left_to_do_adds_no_event_file(tmp_path):
    write_events(tmp_path, 20, [], 1.0)
    assert list(tmp_path.iterdir()) == []
