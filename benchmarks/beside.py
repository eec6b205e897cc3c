"""The training loop of this checkout beside that of another one, in lockstep: what a change costs, to about 1 %.

    git worktree add ../old 42897e5
    .venv/bin/python benchmarks/beside.py ../old
    .venv/bin/python benchmarks/beside.py ../old --algorithm sac

Two processes train with the preset, compiled, and take turns of four logged lines, so that both see the same machine.
Printed are the median and the quartiles of this checkout's time over the other's, in all, in `time/collect` and in
`time/learn` of the metrics. A callback makes them wait, so any two versions can be compared that have callbacks.
"""

import argparse
import os
import subprocess
import sys
from pathlib import Path
from statistics import median, quantiles

ROOT = Path(__file__).parents[1]
LOOP = """
import sys
import tempfile

import lemniscate as lem

lines = []


def take_turns(step, metrics, policy):
    lines.append((metrics["time/collect"], metrics["time/learn"]))
    if len(lines) < 4:
        return False
    print(*map(sum, zip(*lines)), flush=True)
    lines.clear()
    return not sys.stdin.readline()


with tempfile.TemporaryDirectory() as folder:
    settings = {"checkpoint_every": 10**9, "total_steps": 10**8, "buffer_size": 10**5, "learning_starts": 1000}
    given = {name: value for name, value in settings.items() if hasattr(lem.config_for(sys.argv[1], sys.argv[2]), name)}
    callbacks = {"callbacks": take_turns, "progress": False, "run": folder + "/run"}
    lem.train(sys.argv[1], sys.argv[2], backend=sys.argv[3], compile="on", threads=1, **given, **callbacks)
"""
WARM_UP = 3
"""turns that are not counted: compilation, and what SAC collects before it learns"""


def begin(source, algorithm, env, backend):
    """A process that trains four lines of metrics for each line it reads."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    command = [sys.executable, "-c", LOOP, algorithm, env, backend]
    process = subprocess.Popen(command, env={**os.environ, "PYTHONPATH": str(source)}, **pipes)
    process.stdout.readline()
    return process


def turn(process):
    """Seconds in `collect` and in `learn`."""
    process.stdin.write("\n")
    process.stdin.flush()
    words = process.stdout.readline().split()
    if not words:
        raise SystemExit("One of the two has ended; see above.")
    return [float(word) for word in words]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("other", type=Path, help="the other checkout")
    parser.add_argument("--algorithm", default="ppo")
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--backend", default="envpool")
    parser.add_argument("--turns", type=int, default=60)
    given = parser.parse_args()
    what = given.algorithm, given.env, given.backend
    here, there = (begin(it.resolve() / "src", *what) for it in (ROOT, given.other))
    ratios = {"all": [], "collect": [], "learn": []}
    for k in range(-WARM_UP, given.turns):
        order = (here, there) if k % 2 else (there, here)
        seconds = {process: turn(process) for process in order}
        for name, of in (("all", sum), ("collect", lambda both: both[0]), ("learn", lambda both: both[1])):
            if k >= 0:
                ratios[name].append(of(seconds[here]) / of(seconds[there]))
    for name, found in ratios.items():
        first, _, third = quantiles(found, n=4)
        print(f"{name}: {median(found):.3f} of the other's time ({first:.3f} to {third:.3f})")
    for process in (here, there):
        process.stdin.close()
        process.wait()


if __name__ == "__main__":
    main()
