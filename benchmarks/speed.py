"""Steps per second, side by side in one run: ours, Stable-Baselines3, SBX, and the bare physics.

    make bench                                               installs the peers and measures everything
    .venv/bin/python benchmarks/speed.py throughput parts    only these
    .venv/bin/python benchmarks/speed.py --table             the table of what has been measured, and its picture

    throughput   PPO, 2048 rows × 10 epochs × minibatches of 64, 64 × 64 tanh. 16 × HalfCheetah, each peer at its best
                 number of threads and kind of vector; 64 × each of the others, beside EnvPool alone
    parts        the parts of one update, eager and compiled
    startup      from the command to the first update: eager, compiled with a cold cache and with a warm one
    trust        TRPO on 16 × HalfCheetah-v5, 2048 rows, beside sb3-contrib with the same settings
    replay       DDPG on Hopper-v5: batches of 256, 256 × 256, one gradient step for each step, in turns of 500
    pace         minutes of a million steps of HalfCheetah-v5, each algorithm with its preset
    lander       from process start to a policy of mean return 250 over 100 episodes of LunarLander-v3

Every line of `benchmarks/results/speed.jsonl` carries commit, versions and machine. Rounds are interleaved, and what is
reported is the median over rounds of the ratios within each.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from functools import partial
from itertools import product
from pathlib import Path
from statistics import harmonic_mean, median

from common import RESULTS, append, provenance, random_rollout, rows
from peers import BARE, PEER, PEER_LANDER, PEER_REPLAY, PEER_TRPO, REPLAY

NUM_ENVS = {"HalfCheetah-v5": 16, "Ant-v5": 64, "Humanoid-v5": 64, "Hopper-v5": 64}
ENVS = tuple(NUM_ENVS)
SHARED = {"num_envs": 16, "num_steps": 128, "minibatch_size": 64, "epochs": 10, "learning_rate": 3e-4}
OURS, PHYSICS = "lemniscate", "EnvPool alone"
PEERS = [("sb3", threads, kind) for threads in (1, 2) for kind in ("dummy", "subproc")]
PEERS += [("sbx", 2, kind) for kind in ("dummy", "subproc")]  # XLA takes a thread for each processor, asked or not

TRUST = {
    "sb3-contrib's defaults": {"cg_iterations": 15, "critic_epochs": 10, "max_kl": 0.01},
    "its zoo, for this environment": {"cg_iterations": 25, "critic_epochs": 20, "max_kl": 0.04},
}
DDPG = {"batch_size": 256, "learning_starts": 500, "buffer_size": 100_000, "log_every": 500, "compile": "on"}
DDPG |= {"total_steps": 1_000_000, "checkpoint_every": 1_000_000}
PACE = {"reinforce": 400_000, "a2c": 200_000, "trpo": 200_000, "ppo": 300_000, "reppo": 100_000}
PACE |= {"ddpg": 14_000, "td3": 14_000, "sac": 40_000}
WAYS = {
    OURS: {},
    "lemniscate, bfloat16 products": {"matmul": "bfloat16"},
    "lemniscate, 4 environments, 4 updates a step": {
        "num_envs": 4,
        "num_updates": 4,
        "log_every": 125,
    },
}


def say(*words):
    print(*words, file=sys.stderr, flush=True)


def python(code, *arguments):
    """The last line that a program prints, as a number."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "program.py"
        file.write_text(code)
        done = subprocess.run([sys.executable, file, *map(str, arguments)], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr[-2000:])
    return float(done.stdout.split()[-1])


def train(folder, env, *, algorithm="ppo", environment=None, wait=True, **fields):
    """`lemniscate train` in a process of its own."""
    flags = [part for name, value in fields.items() for part in (f"--{name.replace('_', '-')}", str(value))]
    command = [sys.executable, "-m", "lemniscate", "train", algorithm, "--env", env, "--run", str(folder), *flags]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, env={**os.environ, **(environment or {})}, text=True)
    if wait and process.wait():
        raise SystemExit(process.stderr.read())
    return process


def lines(folder):
    from lemniscate.run.loggers import read_metrics

    return read_metrics(folder)


def ours(env, steps):
    """Steps per second after the third update: the first compiles."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "run"
        size = {**SHARED, "num_envs": NUM_ENVS[env], "num_steps": 2048 // NUM_ENVS[env]}
        train(folder, env, preset="paper", total_steps=steps, checkpoint_every=steps, compile="on", **size)
        return harmonic_mean(line["time/steps_per_second"] for line in lines(folder)[3:])


def throughput(rounds, stamp, envs=ENVS):
    best = {}
    for env in envs:
        for _ in range(rounds):
            alone = python(BARE, env, 100_000 if env == ENVS[0] else 40_000, NUM_ENVS[env])
            row = {PHYSICS: alone, OURS: ours(env, 100_000)}
            for peer in ("sb3", "sbx") if env == ENVS[0] else ():
                if peer not in best:  # the first round tries all, the others what was best
                    tried = {way: python(PEER, peer, env, *way[1:], 16384) for way in PEERS if way[0] == peer}
                    best[peer] = max(tried, key=tried.__getitem__)
                    say(f"{peer} is fastest with {best[peer][1]} threads and {best[peer][2]} vectors")
                row[peer] = python(PEER, peer, env, *best[peer][1:], 30_000)
            say(env, {name: round(speed) for name, speed in row.items()})
            append(
                "speed",
                {"what": "throughput", "env": env, "num_envs": NUM_ENVS[env], "steps_per_second": row, "peers": best}
                | stamp,
            )


def measured(what, env=None):
    """The rounds of the newest commit that has any: a dictionary of speeds for each."""
    of = [row for row in rows("speed") if row["what"] == what and row.get("env") == env]
    return [row["steps_per_second"] for row in of if row["commit"] == of[-1]["commit"]]


def summary():
    """The table of docs/speed.md: medians, and the medians of ratios within a round."""
    print("| environment | lemniscate | beside it | | lemniscate is |")
    print("|---|---|---|---|---|")
    for env in ENVS:
        speeds = measured("throughput", env)
        for name in [name for name in speeds[0] if name != OURS] if speeds else []:
            mine = median(row[OURS] for row in speeds)
            ratio, other = median(row[OURS] / row[name] for row in speeds), median(row[name] for row in speeds)
            times = f"{100 * ratio:.0f} %" if name == PHYSICS else f"{ratio:.1f} ×"
            print(f"| {env} | {mine:,.0f} steps/s | {name} | {other:,.0f} steps/s | {times} |")


def draw():
    """HalfCheetah beside the peers; every environment as a share of its physics."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3), layout="constrained")
    left, right = figure.subplots(1, 2)
    speeds = measured("throughput", ENVS[0])
    names = sorted(speeds[0], key=lambda name: median(row[name] for row in speeds))
    medians = [median(row[name] for row in speeds) for name in names]
    colors = ["#3465a4" if name == OURS else "#d3d7cf" for name in names]
    left.barh(names, medians, color=colors)
    for i, value in enumerate(medians):
        left.text(value, i, f" {value:,.0f}", va="center", fontsize=9)
    left.set_xlim(0, 1.15 * max(medians))
    left.set_title(f"{ENVS[0]}, PPO, steps per second", loc="left", fontsize=10)
    shares = [100 * median(row[OURS] / row[PHYSICS] for row in measured("throughput", env)) for env in ENVS]
    right.barh(ENVS[::-1], shares[::-1], color="#3465a4")
    for i, share in enumerate(shares[::-1]):
        right.text(share, i, f" {share:.0f} %", va="center", fontsize=9)
    right.set_xlim(0, 115)
    right.set_title("share of what EnvPool steps without learning", loc="left", fontsize=10)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=9)
    figure.savefig(RESULTS / "speed.png", dpi=130)


def parts(rounds, stamp):
    """Milliseconds of each part of an update of 2048 rows, HalfCheetah's sizes, on one thread."""
    import torch

    from lemniscate.algos import ppo
    from lemniscate.data.rollout import epoch_minibatches
    from lemniscate.maths import gae, means
    from lemniscate.optim.compiled import Compiler
    from lemniscate.system.world import ALONE

    torch.set_num_threads(1)
    config, device = ppo.Config(**SHARED), torch.device("cpu")
    spec, rollout = random_rollout(16)
    reward, no = rollout.reward, rollout.terminated

    def milliseconds(function, times):
        function()
        started = time.perf_counter()
        for _ in range(times):
            function()
        return 1e3 * (time.perf_counter() - started) / times

    for how in ("eager", "compiled"):
        state = ppo.init(config, spec, device)
        if how == "compiled":
            state.prepare(ALONE, Compiler())
        state.optimizer.learning_rate = 3e-4
        networks, noise = state.networks, state.policy.draw_noise((16,), state.rng.action)
        batch = ppo.advantages(config, networks, rollout)
        minibatches = epoch_minibatches(torch.arange(2048), 2048, 64, state.rng.minibatch)
        with torch.no_grad():
            act = milliseconds(lambda: networks.policy.act(rollout.obs[0], noise), 500)  # noqa: B023
        rows = batch, minibatches, batch.advantage[minibatches]
        epoch = milliseconds(lambda: means(state.learn(config, state, *rows)), 3 * rounds)  # noqa: B023
        row = {
            "what": "parts",
            "how": how,
            "policy step, 16 rows": act,
            "values, log-probs and GAE, 2048 rows": milliseconds(
                lambda: ppo.advantages(config, networks, rollout),  # noqa: B023
                20,
            ),
            "of which GAE": milliseconds(lambda: gae(reward, reward, reward, no, no), 20),
            "gradient step, 64 rows": epoch / 32,
        }
        append("speed", row | stamp)
        for name, value in list(row.items())[2:]:
            print(f"| {name} | {how} | {value:.3f} ms |")


def startup(rounds, stamp):
    """Seconds from the command to the first line of metrics."""
    cache = tempfile.mkdtemp()
    for name in ("eager", "compiled, cold", *["compiled, warm"] * rounds):
        environment = {"TORCHINDUCTOR_CACHE_DIR": cache}
        with tempfile.TemporaryDirectory() as scratch:
            folder, started = Path(scratch) / "run", time.monotonic()
            fields = {"preset": "paper", "compile": "off" if name == "eager" else "on", **SHARED}
            process = train(folder, ENVS[0], wait=False, environment=environment, **fields)
            while not lines(folder):
                if process.poll() is not None:
                    raise SystemExit(process.stderr.read())
                time.sleep(0.02)
            seconds = time.monotonic() - started
            process.terminate()
            process.wait()
        append("speed", {"what": "startup", "how": name, "seconds": seconds} | stamp)
        print(f"| {name} | {seconds:.1f} s |")
    shutil.rmtree(cache)


def trust(rounds, stamp):
    """Steps per second of TRPO, each at its best threads and the peer's best vectors, which the first round finds."""

    def ours(size, count):
        with tempfile.TemporaryDirectory() as scratch:
            folder, fields = Path(scratch) / "run", {"num_envs": 16, "num_steps": 128, "compile": "on", **size}
            train(folder, ENVS[0], algorithm="trpo", preset="default", total_steps=60_000, threads=count, **fields)
            return harmonic_mean(line["time/steps_per_second"] for line in lines(folder)[3:])

    best = {}
    for _ in range(rounds):
        for name, size in TRUST.items():
            programs = {(OURS, n): partial(ours, size, n) for n in (1, 2)}
            for kind, n in product(("dummy", "subproc"), (1, 2)):
                programs["sb3-contrib", kind, n] = partial(python, PEER_TRPO, 20_000, kind, n, *size.values())
            tried = {way: program() for way, program in programs.items() if way in best.get(name, programs)}
            best[name] = [max((way for way in tried if way[0] == who), key=tried.get) for who in (OURS, "sb3-contrib")]
            row = {way[0]: tried[way] for way in best[name]}
            say(f"TRPO, {ENVS[0]}, settings of {name}:", {who: round(speed) for who, speed in row.items()}, best[name])
            append("speed", {"what": "trust", "env": name, "steps_per_second": row, "ways": best[name]} | stamp)
    print("| TRPO, HalfCheetah-v5, settings of | lemniscate | sb3-contrib | lemniscate is |")
    print("|---|---|---|---|")
    for name in TRUST:
        speeds = measured("trust", name)
        ratio = median(row[OURS] / row["sb3-contrib"] for row in speeds)
        mine, other = (median(row[who] for row in speeds) for who in (OURS, "sb3-contrib"))
        print(f"| {name} | {mine:,.0f} steps/s | {other:,.0f} steps/s | {ratio:.1f} × |")


def replay(rounds, stamp):
    """Steps per second of DDPG, in turns of 500 steps, each at the number of threads that was the quicker at first."""
    turns = 10
    programs = {
        (name, threads): (REPLAY, json.dumps(DDPG | fields | {"threads": threads}))
        for (name, fields), threads in product(WAYS.items(), (1, 2))
    }
    programs |= {way: (PEER_REPLAY, *map(str, way)) for way in product(("sb3", "sbx"), (1, 2))}
    with ExitStack() as stack:
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "bufsize": 1, "text": True}
        processes = {
            way: stack.enter_context(subprocess.Popen([sys.executable, "-c", *program], **pipes))
            for way, program in programs.items()
        }
        take_turns(processes, 3)  # they import, compile, and fill a first batch
        tried = take_turns(processes, 4)
        best = dict(min((way for way in tried if way[0] == name), key=tried.get) for name in (*WAYS, "sb3", "sbx"))
        for _ in range(rounds):
            spent = take_turns({way: processes[way] for way in best.items()}, turns)
            row = {name: 500 * turns / seconds for (name, _), seconds in spent.items()}
            say("DDPG, Hopper-v5", {name: round(speed) for name, speed in row.items()}, best)
            append("speed", {"what": "replay", "steps_per_second": row, "threads": best} | stamp)
    replay_summary()


def take_turns(processes, turns):
    """Seconds that each took in so many turns; one has its turn while all the others wait."""
    spent = dict.fromkeys(processes, 0.0)
    for _ in range(turns):
        for name, process in processes.items():
            started = time.perf_counter()
            process.stdin.write("\n")
            if not process.stdout.readline():
                raise SystemExit(f"{name} ended before its turn was over.")
            spent[name] += time.perf_counter() - started
    return spent


def replay_summary():
    """The table of docs/speed.md of it: medians, and the medians of ratios within a round."""
    speeds = measured("replay")
    print("| DDPG, Hopper-v5 | steps/s | × sb3 | × sbx |")
    print("|---|---|---|---|")
    for name in speeds[0]:
        times = [f"{median(row[name] / row[peer] for row in speeds):.2f}" for peer in ("sb3", "sbx")]
        print(f"| {name} | {median(row[name] for row in speeds):,.0f} | {' | '.join(times)} |")


def pace(rounds, stamp):
    """Minutes of a million steps, without the first lines: those compile, or act at random."""
    for _ in range(rounds):
        spent = {}
        for algorithm, steps in PACE.items():
            with tempfile.TemporaryDirectory() as scratch:
                folder = Path(scratch) / "run"
                train(
                    folder,
                    "HalfCheetah-v5",
                    algorithm=algorithm,
                    total_steps=steps,
                    checkpoint_every=steps,
                    compile="on",
                )
                learning = [line for line in lines(folder) if any(name.startswith("losses/") for name in line)][3:]
                speed = harmonic_mean(line["time/steps_per_second"] for line in learning)
                spent[algorithm] = 1e6 / speed / 60
                say(algorithm, f"{spent[algorithm]:.1f} min for a million steps")
        append("speed", {"what": "pace", "minutes": spent} | stamp)
    table = [row["minutes"] for row in rows("speed") if row["what"] == "pace" and row["commit"] == stamp["commit"]]
    print("| " + " | ".join(name.upper() for name in PACE) + " |")
    print("|" + "--:|" * len(PACE))
    print("| " + " | ".join(f"{median(row[name] for row in table):.1f} min" for name in PACE) + " |")


def lander(rounds, stamp):
    """Seconds to a mean return of 250, both judged every 50,000 steps by 100 episodes, for 1,000,000 steps at most."""
    for seed in range(1, rounds + 1):
        with tempfile.TemporaryDirectory() as scratch:
            folder, started = Path(scratch) / "run", time.monotonic()
            judge = {"evaluate_every": 50_000, "evaluate_episodes": 100, "seed": seed}
            process = train(folder, "LunarLander-v3", wait=False, **judge)
            while (
                process.poll() is None and max((x.get("evaluation/return", 0) for x in lines(folder)), default=0) < 250
            ):
                time.sleep(0.1)
            mine, ended = time.monotonic() - started, process.poll()
            if ended is not None:
                raise SystemExit(process.stderr.read() if ended else f"Seed {seed} ends below 250.")
            steps = lines(folder)[-1]["step"]
            say(f"lemniscate, seed {seed}: {mine:.0f} s, {steps:,} steps")
            process.terminate()
            process.wait()
        started = time.monotonic()
        their_steps = python(PEER_LANDER, seed)
        theirs = time.monotonic() - started
        row = {
            "what": "lander",
            "seed": seed,
            "lemniscate": mine,
            "steps": steps,
            "sb3": theirs,
            "sb3_steps": their_steps,
        }
        append("speed", row | stamp)
        late = "not in " if their_steps >= 1_000_000 else ""
        print(
            f"| seed {seed} | {mine:.0f} s, {steps:,} steps | {late}{theirs:.0f} s, {their_steps:,.0f} steps |",
            flush=True,
        )


MEASURES = {
    "throughput": throughput,
    "parts": parts,
    "startup": startup,
    "trust": trust,
    "replay": replay,
    "pace": pace,
    "lander": lander,
}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("measures", nargs="*", metavar="MEASURE", help=", ".join(MEASURES))
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--envs", nargs="+", choices=ENVS, default=ENVS, help="of throughput")
    parser.add_argument("--table", action="store_true", help="run nothing")
    given = parser.parse_args()
    stamp = provenance()
    wrong = set(given.measures) - set(MEASURES)
    if wrong:
        parser.error(f"there is no measure {', '.join(wrong)}; there is {', '.join(MEASURES)}")
    for name in [] if given.table else given.measures or MEASURES:
        MEASURES[name](given.rounds, stamp, *([given.envs] if name == "throughput" else []))
    if all(measured("throughput", env) for env in ENVS):
        summary()
        draw()


if __name__ == "__main__":
    main()
