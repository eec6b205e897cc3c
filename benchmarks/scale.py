"""What several processes gain, what shards cost, and how far an exchange of gradients carries.

    .venv/bin/python benchmarks/scale.py                   everything; `exchange` needs to be root
    .venv/bin/python benchmarks/scale.py processes         only this
    .venv/bin/python benchmarks/scale.py --table           the tables of docs/scale.md of what has been measured

    processes    PPO as in docs/speed.md, 16 environments, but minibatches of 512: two processes beside one, no shards
    shards       the same, 16 × HalfCheetah-v5, one process: eight shards beside one
    exchange     milliseconds to gather what each rank has, by its size, by the number of ranks, and by the time that a
                 packet takes from host to host: simulated hosts, each with one rank, of which at most two compute
    rllib        RLlib's PPO with our settings beside ours; PYTHON names an interpreter that has `ray[rllib]`

Every line of `benchmarks/results/scale.jsonl` carries commit, versions and machine. Rounds are interleaved, and what is
reported is the median over rounds of the ratios within each.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import harmonic_mean, median

from common import append, provenance, rows
from hosts import hosts
from peers import EXCHANGE, RLLIB, RLLIB_LANDER

SIZE = {"num_envs": 16, "num_steps": 128, "minibatch_size": 64, "epochs": 10, "learning_rate": 3e-4}
LARGE = {"minibatch_size": 512}
STEPS = 100_000
PAPER, PAIR = (2, 4, 8, 16, 64, 256, 1024), (2, 12_000)
DELAYS, RANKS, FLOATS = (0.0, 0.0001, 0.0005, 0.002), (2, 4, 8, 16), (16, 12_000, 120_000)


def say(*words):
    print(*words, file=sys.stderr, flush=True)


def train(env, **fields):
    """Steps per second of PPO after the third update, and milliseconds of its two halves: medians over updates."""
    with tempfile.TemporaryDirectory() as scratch:
        given = {**SIZE, "total_steps": STEPS, "checkpoint_every": STEPS, **fields}
        flags = [part for name, value in given.items() for part in (f"--{name.replace('_', '-')}", str(value))]
        command = [sys.executable, "-m", "lemniscate", "train", "ppo", "--env", env, "--preset", "paper"]
        done = subprocess.run(
            [*command, "--run", scratch + "/run", "--compile", "on", "--quiet", *flags], capture_output=True, text=True
        )
        if done.returncode:
            raise SystemExit(done.stderr)
        lines = [json.loads(line) for line in (Path(scratch) / "run" / "metrics.jsonl").read_text().splitlines()][3:]
        of = {name: median(line[f"time/{name}"] for line in lines) for name in ("collect", "learn")}
        return harmonic_mean(line["time/steps_per_second"] for line in lines), of


def compare(what, env, ways, rounds, stamp):
    """One round after the other, each way in turn."""
    for _ in range(rounds):
        speeds, halves = {}, {}
        for name, fields in ways.items():
            speeds[name], halves[name] = train(env, **fields)
        say(what, env, {name: round(speed) for name, speed in speeds.items()}, halves)
        append("scale", {"what": what, "env": env, "steps_per_second": speeds, "seconds": halves} | stamp)


def processes(rounds, stamp):
    for env in ("Ant-v5", "Humanoid-v5"):
        compare("processes", env, {"1": LARGE, "2": {**LARGE, "processes": 2}}, rounds, stamp)


def shards(rounds, stamp):
    compare("shards", "HalfCheetah-v5", {"1": LARGE, "8": {**LARGE, "shards": 8}}, rounds, stamp)


def exchange(rounds, stamp):
    """The gather that makes the mean of gradients, in the ring of gloo."""
    for delay in DELAYS:
        for size in RANKS:
            with hosts(size, delay) as commands:
                world = {"WORLD_SIZE": size, "MASTER_ADDR": "10.77.0.1", "MASTER_PORT": 29_500}
                program = [sys.executable, "-c", EXCHANGE, str(rounds), *map(str, FLOATS)]
                ranks = [
                    subprocess.Popen(
                        [*there, *program],
                        env={**os.environ, **{k: str(v) for k, v in world.items()}, "RANK": str(rank)}
                        | {"GLOO_SOCKET_IFNAME": f"lem{rank}", "TORCH_CPP_LOG_LEVEL": "ERROR"},
                        stdout=subprocess.PIPE,
                        text=True,
                    )
                    for rank, there in enumerate(commands)
                ]
                said = [rank.communicate()[0] for rank in ranks]
            for floats, milliseconds in json.loads(said[0].splitlines()[-1]).items():
                say(f"{size} ranks, {1e3 * delay:g} ms a packet, {floats} numbers: {milliseconds:.2f} ms")
                row = {"ranks": size, "delay": delay, "floats": int(floats), "milliseconds": milliseconds}
                append("scale", {"what": "exchange"} | row | stamp)


def rllib(rounds, stamp):
    """Steps per second with the settings of docs/speed.md; then seconds to a mean return of 250 on LunarLander-v3."""
    python = os.environ.get("PYTHON", sys.executable)

    def theirs(program, *arguments):
        done = subprocess.run([python, "-c", program, *map(str, arguments)], capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(done.stderr[-2000:])
        return json.loads(done.stdout.splitlines()[-1])

    for _ in range(rounds):
        speeds = {"lemniscate": train("HalfCheetah-v5")[0]}
        speeds |= {f"RLlib, {n} runners": theirs(RLLIB, n) for n in (0, 1, 2)}
        say("rllib", {name: round(speed) for name, speed in speeds.items()})
        append("scale", {"what": "rllib", "env": "HalfCheetah-v5", "steps_per_second": speeds} | stamp)
    for seed in range(1, rounds + 1):
        began = time.monotonic()
        steps, reached = theirs(RLLIB_LANDER, seed)
        row = {"what": "rllib lander", "seed": seed, "seconds": time.monotonic() - began, "steps": steps}
        say(f"RLlib, seed {seed}: {reached:.0f} after {row['seconds']:.0f} s, {steps:,} steps")
        append("scale", row | {"return": reached} | stamp)


MEASURES = {"processes": processes, "shards": shards, "exchange": exchange, "rllib": rllib}


def measured(what):
    """The lines of the newest commit that has any."""
    of = [row for row in rows("scale") if row["what"] == what]
    return [row for row in of if row["commit"] == of[-1]["commit"]]


def ratios(what, env):
    """For each other way: its name, the median speeds of both, and the median of the ratios within a round."""
    speeds = [row["steps_per_second"] for row in measured(what) if row["env"] == env]
    first, *others = speeds[0]
    for other in others:
        mine, its = (median(row[way] for row in speeds) for way in (first, other))
        yield other, mine, its, median(row[other] / row[first] for row in speeds)


def table():
    print("| PPO | one process | beside it | | ratio |")
    print("|---|--:|---|--:|--:|")
    for what in ("processes", "shards"):
        for env in dict.fromkeys(row["env"] for row in measured(what)):
            for other, mine, its, ratio in ratios(what, env):
                print(f"| {env} | {mine:,.0f} steps/s | {other} {what} | {its:,.0f} steps/s | {ratio:.2f} × |")
    print("\n| lemniscate | RLlib 2.60 | | lemniscate is |")
    print("|--:|---|--:|--:|")
    for other, mine, its, ratio in ratios("rllib", "HalfCheetah-v5"):
        runners = other.removeprefix("RLlib, ")
        print(f"| {mine:,.0f} steps/s | {runners} | {its:,.0f} steps/s | {1 / ratio:.1f} × |")
    print("\n| ms to gather | " + " | ".join(f"{size} ranks" for size in RANKS) + " |")
    print("|---|" + "--:|" * len(RANKS))
    of = {(row["delay"], row["floats"], row["ranks"]): row["milliseconds"] for row in measured("exchange")}
    for delay, floats in dict.fromkeys(key[:2] for key in of):
        cells = " | ".join(f"{of[delay, floats, size]:.1f}" for size in RANKS)
        print(f"| {floats:,} numbers, {1e3 * delay:g} ms a packet | {cells} |")


def on_paper():
    """The share of perfect scaling, by ranks and by gradient steps an update, each rank with 2048 rows of its own.

    An update takes as long as one process takes for Ant-v5, and a gather of 12,000 numbers for each gradient step: in
    a ring of W ranks W − 1 times that of two ranks.
    """
    alone = [row["seconds"]["1"] for row in measured("processes") if row["env"] == "Ant-v5"]
    update = 1e3 * median(half["collect"] + half["learn"] for half in alone)
    ring = {row["delay"]: row["milliseconds"] for row in measured("exchange") if (row["ranks"], row["floats"]) == PAIR}
    print("\n| share of perfect scaling | " + " | ".join(f"{ranks:,} ranks" for ranks in PAPER) + " |")
    print("|---|" + "--:|" * len(PAPER))
    for steps in (40, 4):
        for delay, hop in ring.items():
            shares = [update / (update + steps * (ranks - 1) * hop) for ranks in PAPER]
            name = f"{steps} gradient steps, {1e3 * delay:g} ms a packet"
            print(f"| {name} | " + " | ".join(f"{share:.0%}" for share in shares) + " |")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("measures", nargs="*", metavar="MEASURE", help=", ".join(MEASURES))
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--table", action="store_true", help="run nothing")
    given = parser.parse_args()
    wrong = set(given.measures) - set(MEASURES)
    if wrong:
        parser.error(f"there is no measure {', '.join(wrong)}; there is {', '.join(MEASURES)}")
    for name in [] if given.table else given.measures or MEASURES:
        MEASURES[name](given.rounds, provenance())
    table()
    on_paper()


if __name__ == "__main__":
    main()
