"""Long runs: memory and open files stay as they are, on every backend and in a sweep; what files grow by is printed."""

import json
import os
import statistics
import subprocess
import sys
import time
from contextlib import suppress

import psutil
import pytest

from run.test_run import words_for

ENDLESS = {"total_steps": 10**12, "compile": "off", "num_envs": 8, "hidden": (32,), "evaluate_episodes": 2}
ON_POLICY = {**ENDLESS, "num_steps": 64, "checkpoint_every": 50_000, "evaluate_every": 20_000}
OFF_POLICY = {**ENDLESS, "buffer_size": 5_000, "learning_starts": 500, "critic_hidden": (32,), "log_every": 800}
OFF_POLICY |= {"checkpoint_every": 8_000, "evaluate_every": 4_000}
KINDS = {
    "sync": ("ppo", "CartPole-v1", {**ON_POLICY, "backend": "gymnasium", "minibatch_size": 128}),
    "async": ("sac", "Pendulum-v1", {**OFF_POLICY, "backend": "gymnasium-async", "num_envs": 2}),
    "envpool": ("ppo", "HalfCheetah-v5", {**ON_POLICY, "minibatch_size": 128}),
    "envpool-compiled": ("ddpg", "Pendulum-v1", {**OFF_POLICY, "compile": "on"}),
    "crazyflow": ("ppo", "DroneFigureEightTrajectory-v0", {**ON_POLICY, "num_envs": 64, "minibatch_size": 512}),
    "recorded": ("a2c", "CartPole-v1", {**ON_POLICY, "num_steps": 8, "video_every": 50_000, "keep_checkpoints": 1}),
    "sweep": ("a2c,ppo", "toy:Countdown-v0", {**ON_POLICY, "total_steps": 20_000}),
}
WARM_UP = 0.4
"""part of the time after which memory is to stand still"""


def start(kind, folder):
    algorithm, env, fields = KINDS[kind]
    words = [word for name, value in fields.items() for word in words_for(name, value)]
    seeds = ["--seeds", "1-500"] if kind == "sweep" else []
    command = [sys.executable, "-m", "lemniscate", "train", algorithm, "--env", env, *seeds, *words, "--run"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}  # the tests' toy is on it
    with (folder / f"{kind}.txt").open("w") as said:
        return subprocess.Popen([*command, str(folder / kind)], stdout=said, stderr=said, env=environment)


def sample(kind, process):
    """(bytes in memory, open files, processes) of a run; of a sweep, without the runs that come and go."""
    owner = psutil.Process(process.pid)
    processes = [owner, *([] if kind == "sweep" else owner.children(recursive=True))]
    return sum(p.memory_info().rss for p in processes), sum(p.num_fds() for p in processes), len(processes)


def size(path, pattern="*"):
    """The bytes of the files below a folder."""
    return sum(file.stat().st_size for file in path.rglob(pattern) if file.is_file())


def steps_of(path):
    """The steps of a run so far; the runs of a sweep that have ended."""
    if (path / "sweep.json").exists():
        return len(list(path.glob("*/final.json")))
    with suppress(IndexError, OSError):
        return json.loads((path / "metrics.jsonl").read_text().splitlines()[-1])["step"]
    return 0


@pytest.mark.soak
def test_memory_and_open_files_of_a_long_run_stand_still(tmp_path):
    seconds = float(os.environ.get("SOAK_SECONDS", 7_200))
    runs = {kind: start(kind, tmp_path) for kind in KINDS}
    samples, began = {kind: [] for kind in KINDS}, time.monotonic()
    try:
        while (now := time.monotonic() - began) < seconds:
            for kind, process in runs.items():
                said = (tmp_path / f"{kind}.txt").read_text()
                assert process.poll() is None, (kind, said)
                if now > WARM_UP * seconds:
                    samples[kind].append(sample(kind, process))
            time.sleep(seconds / 120)
    finally:
        for process in runs.values():
            process.terminate()
        for process in runs.values():
            process.wait(60)
    grown = {}
    for kind, measured in samples.items():
        third = len(measured) // 3
        early, late = measured[:third], measured[-third:]
        memory, files, _ = (statistics.median(column) for column in zip(*late, strict=True))
        memory_before, files_before, _ = (statistics.median(column) for column in zip(*early, strict=True))
        grown[kind] = (memory - memory_before, files - files_before)
        path = tmp_path / kind
        print(
            f"{kind}: {steps_of(path):,} {'runs' if kind == 'sweep' else 'steps'}, {memory / 1e6:,.0f} MB"
            f" ({(memory - memory_before) / 1e6:+.1f}), {files:.0f} open files ({files - files_before:+.0f}); metrics"
            f" {size(path, 'metrics.jsonl') / 1e6:.1f} MB, TensorBoard {size(path, 'events.*') / 1e6:.1f} MB,"
            f" all files {size(path) / 1e6:.1f} MB"
        )
    for kind, (memory, files) in grown.items():
        assert memory < 10e6 + 0.03 * statistics.median(column[0] for column in samples[kind]), kind
        assert files <= 2, kind
