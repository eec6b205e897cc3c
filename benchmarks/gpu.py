"""What lemniscate does on a CUDA device, in six minutes at most: one table, and a row of benchmarks/results/gpu.jsonl.

    .venv/bin/python benchmarks/gpu.py                         on the first GPU
    .venv/bin/python benchmarks/gpu.py --parts resume drones   some of it
    .venv/bin/python benchmarks/gpu.py --device cpu --quick    every part in miniature, where there is no GPU

    agreement   every algorithm begins, collects, learns, and is restored; its metrics beside the CPU's, from the same
                random numbers
    resume      runs that are killed and resumed: the bits in which their last checkpoint differs from that of a run
                that was left alone
    drones      the presets of `make fly` and of the course with 64, 1,024 and 4,096 drones; JAX's arrays in torch
    speed       PPO's steps per second by the number of environments, which cost nothing here
    graphs      PPO's gradient step: plain, as the library compiles it, compiled with CUDA graphs, and captured

Each part is a process of its own with its own limit of time; where it fails or is late, the table says so and goes on.
The drones need `pip install 'jax[cuda12]'`.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from common import append, provenance
from torch.overrides import TorchFunctionMode

ROOT = Path(__file__).parents[1]
TESTS = ROOT / "tests"

FIGURE_EIGHT = "DroneFigureEightTrajectory-v0"
DRONES = [("figure-eight", 64), ("course", 1024), ("figure-eight", 1024), ("figure-eight", 4096)]
DRONES += [("course", 4096), ("course", 64)]
"""(preset, number of drones); the first ones are the ones to know if time runs out"""
LIMIT = 1e-3
"""of the relative distance between metrics of two devices: float32 and another order of sums, over four updates"""


def row(what: str, found: str, ok: bool | None = None) -> dict[str, Any]:
    """A line of the table; `ok` where there is something to be right or wrong."""
    return {"what": what, "found": found, "ok": ok}


class NumbersOfTheCPU(TorchFunctionMode):
    """Draws the random numbers of `pretend_device.Generator` on the CPU, and moves them to its device.

    The generators of two devices give different numbers from the same seed.
    """

    def __torch_function__(self, func: Callable, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        kwargs = dict(kwargs or {})
        if kwargs.get("generator") is None:
            return func(*args, **kwargs)
        kwargs.pop("device", None)
        return func(*args, **kwargs).to(kwargs["generator"].device)


@contextmanager
def numbers_of_the_cpu() -> Iterator[None]:
    """Inside, every generator that is made draws as on the CPU."""
    from pretend_device import Generator

    with mock.patch.object(torch, "Generator", Generator), NumbersOfTheCPU():
        yield


def agreement(device: torch.device, quick: bool) -> Iterator[dict[str, Any]]:
    """The cases of tests/test_devices.py on both devices."""
    import lemniscate as lem
    from test_devices import CASES, train_twice

    lem.set_seeds(0)
    for case in list(CASES)[:: 8 if quick else 1]:
        with tempfile.TemporaryDirectory() as folder, numbers_of_the_cpu():
            try:
                there = train_twice(case, device, Path(folder) / "there")
                here = train_twice(case, torch.device("cpu"), Path(folder) / "here")
            except (RuntimeError, TypeError, AssertionError) as error:  # the other cases are to be seen, too
                yield row(case, f"{type(error).__name__}: {str(error)[:120]}", ok=False)
                continue
        pairs = [(mine[name], other[name]) for mine, other in zip(there, here, strict=True) for name in other]
        apart = max(abs(a - b) / (abs(b) + 0.1) for a, b in pairs)
        yield row(case, f"{apart:.1e} from the CPU's metrics", ok=apart <= LIMIT)


def resume(device: torch.device, quick: bool) -> Iterator[dict[str, Any]]:
    """A run of PPO and one of SAC, killed after their first checkpoint."""
    steps = {"ppo": 2_048, "sac": 400} if quick else {"ppo": 40_960, "sac": 6_000}
    for algorithm, total in steps.items():
        with tempfile.TemporaryDirectory() as folder:
            whole, killed = Path(folder) / "whole", Path(folder) / "killed"
            command = ["train", algorithm, "--env", "Pendulum-v1", "--device", str(device), "--compile", "off"]
            command += ["--total-steps", str(total), "--checkpoint-every", str(total // 4), "--num-envs", "4"]
            command += ["--learning-starts", "100"] if algorithm == "sac" else ["--num-steps", "64"]
            command += ["--hidden", "8"] if quick else []
            lemniscate(*command, "--run", str(whole)).wait()
            begun = lemniscate(*command, "--run", str(killed))
            while begun.poll() is None and not list(killed.glob("checkpoints/step-*/*.safetensors")):
                time.sleep(0.01)
            begun.kill()
            was_killed = begun.wait() == -signal.SIGKILL
            lemniscate("resume", str(killed)).wait()
            bits = differing_bits(last_tensors(whole), last_tensors(killed))
        when = "killed and resumed" if was_killed else "over before it could be killed"
        yield row(algorithm, f"{when}: {bits:,} bits differ", ok=bits == 0 and was_killed)


def lemniscate(*words: str) -> subprocess.Popen:
    """A command of the library, in a process of its own."""
    return subprocess.Popen([sys.executable, "-m", "lemniscate", *words], stderr=subprocess.DEVNULL)


def last_tensors(run: Path) -> bytes:
    """The parameters, moments and generators of a run's last checkpoint."""
    return max(run.glob("checkpoints/step-*/*.safetensors"), key=lambda file: int(file.parent.name[5:])).read_bytes()


def differing_bits(one: bytes, other: bytes) -> int:
    """The number of bits in which two files differ; all of the longer one if their lengths do."""
    if len(one) != len(other):
        return 8 * max(len(one), len(other))
    a, b = (np.frombuffer(data, np.uint8) for data in (one, other))
    return int(np.unpackbits(a ^ b).sum())


def drones(device: torch.device, quick: bool) -> Iterator[dict[str, Any]]:
    """Whole trainings, and flights from unseen starts."""
    import lemniscate as lem

    yield zero_copy(device)
    few = {"num_steps": 16, "minibatch_size": 32, "hidden": (8,), "total_steps": 128, "compile": "off"}
    for preset, count in [("course", 4)] if quick else DRONES:
        settings = {"num_envs": count, "device": str(device), **(few if quick else {})}
        config = lem.config_for("ppo", FIGURE_EIGHT, preset=preset, **settings)
        with tempfile.TemporaryDirectory() as folder:
            run = lem.train(config, run=Path(folder) / "run", progress=False)
        scores = lem.evaluate(run.policy, episodes=2 if quick else 64, seed=0)
        speed = run.policy.step / run.seconds
        error = f"{scores.mean_return:.1f} return, {scores.measures['rmse_after_1s_mm']:.2f} mm after 1 s"
        yield row(f"{preset}, {count:,} drones", f"{run.seconds:.1f} s, {speed:,.0f} steps/s; {error}")


def zero_copy(device: torch.device) -> dict[str, Any]:
    """Whether an array of JAX and the tensor made of it are one piece of memory, and the other way round."""
    import jax

    from lemniscate.drones.crazyflow import jax_device

    array = jax.device_put(jax.numpy.ones((64, 64)), jax.devices(jax_device(device))[0])
    tensor = torch.from_dlpack(array)
    back = jax.dlpack.from_dlpack(tensor)
    addresses = {array.unsafe_buffer_pointer(), tensor.data_ptr(), back.unsafe_buffer_pointer()}
    on_it = tensor.device.type == device.type
    return row(
        "JAX to torch and back", f"{len(addresses) - 1} copies, on {tensor.device}", len(addresses) == 1 and on_it
    )


def speed(device: torch.device, quick: bool) -> Iterator[dict[str, Any]]:
    """Iterations of PPO on an environment of noise, which is drawn on the device."""
    from lemniscate.algos import ppo
    from lemniscate.data.rollout import collect

    for count in (4, 8) if quick else (16, 64, 256, 1024, 4096, 16384):
        config, env, state = learner(count, device)
        seconds = {"collect": 0.0, "learn": 0.0}
        for iteration in range(2 if quick else 7):
            began = now(device)
            rollout = collect(env, state.policy, config.num_steps, state.rng.action)
            collected = now(device)
            ppo.update(config, state, rollout)
            if iteration:  # the first one allocates
                seconds["collect"] += collected - began
                seconds["learn"] += now(device) - collected
        steps = count * config.num_steps * (1 if quick else 6)
        parts = ", ".join(f"{name} {1e6 * taken / steps:.2f} µs a step" for name, taken in seconds.items())
        yield row(f"{count:,} environments", f"{steps / sum(seconds.values()):,.0f} steps/s; {parts}")


def learner(count: int, device: torch.device) -> tuple[Any, Any, Any]:
    """The Config, the environments and a new state of PPO; four minibatches in each of four epochs."""
    from lemniscate.algos import ppo
    from lemniscate.envs.vec_env import VecEnv
    from test_devices import Noise

    settings = {"num_steps": 16, "minibatch_size": 4 * count, "epochs": 4, "total_steps": 10**9}
    config = ppo.Config(env="Noise-v0", num_envs=count, desired_kl=None, **settings)
    env = VecEnv(Noise("box", count, device))
    torch.manual_seed(0)
    env.restart(1)
    return config, env, ppo.init(config, env.spec, device)


def now(device: torch.device) -> float:
    """The time at which the device has done what it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def graphs(device: torch.device, quick: bool) -> Iterator[dict[str, Any]]:
    """Four gradient steps of PPO on 256 rows each, again and again."""
    repeats = 3 if quick else 100
    options = {"triton.cudagraphs": True, "triton.cudagraph_support_input_mutation": True}
    ways = {"plain": plain, "compiled": lambda state: compiled(state, quick)}
    if device.type == "cuda":
        ways["compiled, CUDA graphs"] = lambda state: compiled(state, quick, **options)
        ways["captured in a CUDA graph"] = captured
    expected = None
    for name, prepare in ways.items():
        try:
            state, arguments = gradient_steps(device)
            learn = prepare(state)
            for _ in range(3):
                learn(*arguments)
            vector = state.optimizer.vector.clone()
            expected = vector if expected is None else expected
            began = now(device)
            for _ in range(repeats):
                learn(*arguments)
            each = (now(device) - began) / repeats / len(arguments[3])
        except Exception as error:  # whatever a compiler raises is a finding
            yield row(name, f"{type(error).__name__}: {str(error)[:120]}", ok=False)
            continue
        apart = (vector - expected).abs().max().item()
        yield row(name, f"{1e3 * each:.3f} ms a gradient step; parameters {apart:.1e} apart", ok=apart <= LIMIT)


def gradient_steps(device: torch.device) -> tuple[Any, tuple]:
    """A new state of PPO, and the arguments with which its `update` calls `learn`."""
    from lemniscate.algos import ppo
    from lemniscate.data.rollout import collect

    config, env, state = learner(64, device)
    rollout = collect(env, state.policy, config.num_steps, state.rng.action)
    calls: list[tuple] = []
    state.learn = lambda *arguments: calls.append(arguments) or ppo.learn(*arguments)
    ppo.update(config, state, rollout)
    return state, calls[0]


def plain(state: Any) -> Callable:
    """`learn` as it stands in the file."""
    from lemniscate.algos import ppo

    return ppo.learn


def compiled(state: Any, quick: bool, **options: bool) -> Callable:
    """`learn` as a compiled run calls it, with more options of the compiler; in miniature, traced but not compiled."""
    from lemniscate.algos import ppo
    from lemniscate.optim.compiled import Compiler, Learner

    compile_it = torch.compile

    def patched(function: Callable, **given: Any) -> Callable:
        given["options"] = given["options"] | options
        return compile_it(function, backend="eager") if quick else compile_it(function, **given)

    steps = Learner(ppo.learn, state.optimizers(), Compiler())

    def call(*arguments: Any) -> Any:
        with mock.patch.object(torch, "compile", patched):  # a program is made at its first call
            if options:
                torch.compiler.cudagraph_mark_step_begin()
            return steps(*arguments)

    return call


def captured(state: Any) -> Callable:
    """`learn`, recorded once as a graph of kernels; its arguments are those of the recording."""
    from lemniscate.algos import ppo

    graph = torch.cuda.CUDAGraph()
    recorded = False

    def call(*arguments: Any) -> None:
        nonlocal recorded
        if recorded:
            graph.replay()
            return
        # One call that counts, on a side stream as torch asks for; recording runs nothing.
        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            ppo.learn(*arguments)
        torch.cuda.current_stream().wait_stream(side)
        with torch.cuda.graph(graph):
            ppo.learn(*arguments)
        recorded = True

    return call


PARTS: dict[str, tuple[Callable[[torch.device, bool], Iterator[dict[str, Any]]], float]] = {
    "agreement": (agreement, 60),
    "resume": (resume, 70),
    "drones": (drones, 110),
    "speed": (speed, 40),
    "graphs": (graphs, 75),
}
"""the parts and their limits in seconds, which add up to less than six minutes"""


def run_part(name: str, device: str, quick: bool, limit: float) -> list[dict[str, Any]]:
    """The rows of a part that is run in a process of its own; what was found before an error or the limit is kept."""
    command = [sys.executable, __file__, "--part", name, "--device", device, *(["--quick"] if quick else [])]
    paths = os.pathsep.join(filter(None, [str(TESTS), os.environ.get("PYTHONPATH")]))
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": paths},
        start_new_session=True,
    )  # fmt: skip
    late = threading.Event()

    def end() -> None:
        late.set()
        os.killpg(process.pid, signal.SIGKILL)  # the runs that it has started, too

    timer = threading.Timer(limit, end)
    timer.start()
    said, errors = process.communicate()
    timer.cancel()
    found = [json.loads(line) for line in said.splitlines() if line.startswith('{"what"')]
    if late.is_set():
        found.append(row("the rest", f"not done within {limit:.0f} s"))
    elif process.returncode:
        found.append(row("the rest", (errors.strip().splitlines() or ["failed"])[-1][:160], ok=False))
    return found


def table(results: dict[str, list[dict[str, Any]]]) -> str:
    """The rows of all parts, in columns."""
    marks = {True: "✓", False: "✗", None: " "}
    lines = [(name, r) for name, found in results.items() for r in found]
    width = max((len(r["what"]) for _, r in lines), default=0)
    return "\n".join(f"{name:<11}{marks[r['ok']]} {r['what']:<{width}}  {r['found']}" for name, r in lines)


def main(words: list[str] | None = None) -> None:
    """Run the parts, print the table, keep the row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda:0", help="cuda:N or cpu")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--quick", action="store_true", help="in miniature; no row is kept")
    parser.add_argument("--part", choices=PARTS, help=argparse.SUPPRESS)
    given = parser.parse_args(words)
    if given.device.startswith("cuda") and not torch.cuda.is_available():
        print("torch sees no CUDA device here, so there is nothing to measure; --device cpu --quick tries the script.")
        return
    if given.part:
        for found in PARTS[given.part][0](torch.device(given.device), given.quick):
            print(json.dumps(found), flush=True)
        return
    results = {}
    for name in given.parts:
        print(f"{name} …", file=sys.stderr, flush=True)
        limit = 600 if given.quick else PARTS[name][1]  # a busy CPU may be slow
        results[name] = run_part(name, given.device, given.quick, limit)
    print(table(results))
    if not given.quick:
        is_gpu = given.device.startswith("cuda")
        hardware = torch.cuda.get_device_name(given.device) if is_gpu else "CPU"
        append("gpu", {"device": hardware, "results": results, **provenance()})


if __name__ == "__main__":
    main()
