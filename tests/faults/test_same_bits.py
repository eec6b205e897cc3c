"""The same seed gives the same bits, whatever else a run does and wherever it runs; what two threads change is printed."""

import json
from functools import partial
from importlib.util import find_spec

import pytest

from conftest import tiny_off_policy
from faults.runs import SHARE
from faults.test_kills import SMALL
from forks import LEMNISCATE, Forks, command
from lemniscate.run import checkpoint
from run.test_run import OFF_POLICY, ON_POLICY, final_hashes, history, words_for

ALGORITHMS = ("reinforce", "a2c", "trpo", "ppo", "reppo", "pqn", "ddpg", "td3", "sac")
DRAWING = """
import sys, types
import matplotlib.pyplot as plt, numpy, random, torch
def draw(step, metrics, policy):
    random.random(), numpy.random.rand(), torch.rand(3)
    plt.plot(list(metrics.values())), plt.savefig("curve.png"), plt.close()
sys.modules["drawing"] = types.ModuleType("drawing")
sys.modules["drawing"].draw = draw
"""
AFFINITY = "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})"
VARIANTS = {
    # what else the run does, or where it runs: words of the command, statements before it
    "again": ([], ""),
    "with evaluations": (["--evaluate-every", "96", "--evaluate-episodes", "3"], ""),
    "with videos": (["--video-every", "320"], ""),
    "with a report and a score": (["--report", "--score"], ""),
    "with a callback that draws numbers and pictures": (["--callbacks", "drawing:draw"], DRAWING),
    "with Weights & Biases": (["--track", "wandb"], "import os; os.environ['WANDB_MODE'] = 'offline'"),
    "with all checkpoints kept": (["--keep-checkpoints", "100"], ""),
    "with global generators used before": ([], "import random, numpy, torch; random.random(), numpy.random.rand(), torch.rand(9)"),
    "on one processor": ([], AFFINITY),
    "as nice as can be": ([], "import os; os.nice(19)"),
}  # fmt: skip
BACKENDS = {"gymnasium": list(VARIANTS), "envpool": ["again", "with evaluations", "on one processor"]}
"""the variants of each; Gymnasium also in processes, EnvPool's threads are as many as the processors that it may use"""


def words(algorithm, backend):
    """The command that trains a run of some hundred steps, less its directory."""
    continuous = "Hopper-v5" if backend == "envpool" else "Pendulum-v1"
    env = continuous if algorithm in (*OFF_POLICY, "reppo") else "CartPole-v1"
    chosen = OFF_POLICY.get(algorithm) or ON_POLICY.get(algorithm, {"minibatch_size": 16})
    small = tiny_off_policy(log_every=16) if algorithm in OFF_POLICY else SMALL
    fields = {**small, **chosen, "compile": "off", "total_steps": 640, "checkpoint_every": 320, "backend": backend}
    return ["train", algorithm, "--env", env, *(w for name, value in fields.items() for w in words_for(name, value))]


def bits(path):
    """What must not differ: all tensors and numbers of the state, and the training lines of the metrics."""
    last = path / "checkpoints" / f"step-{checkpoint.list_steps(path / 'checkpoints')[-1]}"
    numbers = json.loads((last / "state.json").read_text())["numbers"]
    tensors = {name: digest for name, digest in final_hashes(path).items() if name.endswith(".safetensors")}
    lines = [line for line in history(path) if not any(name.startswith("evaluation/") for name in line)]
    return json.dumps([numbers, tensors, lines], sort_keys=True)


def trained(folder, algorithm, backend, name, more=(), before="", server=None):
    """The bits of a run of some hundred steps."""
    path = folder / name.replace(" ", "-")
    process = command(*words(algorithm, backend), *more, "--run", path, before=before, cwd=folder, server=server)
    _, said = process.communicate()
    assert process.returncode == 0, (name, said)
    return bits(path)


@pytest.fixture(scope="module")
def elsewhere():
    """Processes with another hash seed and other numbers of threads in their environment."""
    forks = Forks(LEMNISCATE, PYTHONHASHSEED="7", OMP_NUM_THREADS="2", MKL_NUM_THREADS="2", LANG="C", TZ="Asia/Tokyo")
    yield forks
    forks.close()


@pytest.mark.faults
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_seed_gives_the_same_bits_whatever_else_a_run_does(tmp_path, elsewhere, algorithm, backend):
    run = partial(trained, tmp_path, algorithm, backend)
    expected, compared = run("base"), 0
    for name in BACKENDS[backend]:
        more, before = VARIANTS[name]
        if "wandb" not in more or find_spec("wandb"):
            assert run(name, more, before) == expected, name
            compared += 1
    assert run("elsewhere", server=elsewhere) == expected
    if backend == "gymnasium":
        assert trained(tmp_path, algorithm, "gymnasium-async", "in processes") == expected
        compared += 1
    threads = {
        n: [run(f"{n} threads {again}", ["--threads", n]) for again in (1, 2)] for n in ((2, 4) if SHARE == 1 else (2,))
    }
    assert all(first == again for first, again in threads.values())
    as_one = all(first == expected for first, _ in threads.values())
    print(
        f"{algorithm}, {backend}: {compared + 3} variants, 0 differ; 2 and 4 threads {'as' if as_one else 'not as'} 1"
    )


def test_a_seed_gives_the_same_bits_with_evaluations_and_on_one_processor(tmp_path):
    run = partial(trained, tmp_path, "a2c", "gymnasium")
    expected = run("base")
    assert all(run(name, *VARIANTS[name]) == expected for name in ("with evaluations", "on one processor"))
    assert run("another seed", ["--seed", 2]) != expected
