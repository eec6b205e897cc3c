"""Runs of several processes, each forked from one that has imported what takes seconds."""

import socket
import time
from functools import cache

from conftest import tiny_off_policy
from forks import Forks, command
from run.test_run import OFF_POLICY, final_hashes, history, words_for

SHARDS = 4
SMALL = {"num_envs": 8, "num_steps": 8, "hidden": (32,), "evaluate_episodes": 2, "compile": "off", "shards": SHARDS}
KINDS = {
    # kind of run: algorithm, environment, fields; without "total_steps" it takes 1,600
    "ppo-toy": ("ppo", "toy:Matching-v0", {"minibatch_size": 16, "evaluate_every": 512}),
    "ppo": ("ppo", "CartPole-v1", {"epochs": 3, "minibatch_size": 16, "evaluate_every": 512}),
    "ppo-gru": (
        "ppo",
        "CartPole-v1",
        {"network": "gru", "sequence_length": 4, "minibatch_size": 32, "evaluate_every": 512},
    ),
    "ppo-sync": ("ppo", "CartPole-v1", {"backend": "gymnasium", "minibatch_size": 16}),
    "ppo-async": ("ppo", "CartPole-v1", {"backend": "gymnasium-async", "minibatch_size": 16}),
    "ppo-cheetah": ("ppo", "HalfCheetah-v5", {"minibatch_size": 32, "evaluate_every": 800}),
    "ppo-curriculum": (
        "ppo",
        "environments:Graded",
        {"curriculum": "environments:harder", "backend": "gymnasium", "minibatch_size": 16, "evaluate_every": 512},
    ),
    "ppo-compiled": ("ppo", "CartPole-v1", {"compile": "on", "minibatch_size": 16}),
    "reinforce": ("reinforce", "Pendulum-v1", {"critic_minibatch_size": 16}),
    "a2c": ("a2c", "CartPole-v1", {}),
    "trpo": ("trpo", "HalfCheetah-v5", {"critic_minibatch_size": 16, "total_steps": 640}),
    "reppo": ("reppo", "Pendulum-v1", {"minibatch_size": 16, "epochs": 3}),
    "ddpg": ("ddpg", "Pendulum-v1", OFF_POLICY["ddpg"]),
    "td3": ("td3", "HalfCheetah-v5", OFF_POLICY["td3"]),
    "sac": ("sac", "Pendulum-v1", OFF_POLICY["sac"] | {"evaluate_every": 800}),
    "sac-bins": ("sac", "Pendulum-v1", OFF_POLICY["sac-bins"]),
    "sac-compiled": ("sac", "Pendulum-v1", OFF_POLICY["sac"] | {"compile": "on"}),
    "drone": ("ppo", "DroneFigureEightTrajectory-v0", {"num_envs": 64, "total_steps": 4096, "minibatch_size": 64}),
}


def words(kind, **fields):
    """The command that trains a run of this kind, less its directory."""
    algorithm, env, chosen = KINDS[kind]
    small = {**tiny_off_policy(), "num_envs": 8, "log_every": 16, "batch_size": 32, "shards": SHARDS, "compile": "off"}
    given = {**(small if algorithm in OFF_POLICY else SMALL), "total_steps": 1_600, **chosen, **fields}
    given.setdefault("checkpoint_every", given["total_steps"] // 5)
    return [
        "train",
        algorithm,
        "--env",
        env,
        *(word for name, value in given.items() for word in words_for(name, value)),
    ]


def free_port():
    """A port of this machine that nobody listens on."""
    with socket.socket() as listener:
        listener.bind(("localhost", 0))
        return listener.getsockname()[1]


@cache
def forks():
    """A process with everything imported, in which torch says nothing of connections that end."""
    return Forks(TORCH_CPP_LOG_LEVEL="ERROR")


def ranks(size, *arguments, before="", patience=None):
    """Start a command in `size` processes that make one world; `before` are statements, in which RANK is a number."""
    shared = {"WORLD_SIZE": str(size), "LOCAL_WORLD_SIZE": str(size), "MASTER_ADDR": "localhost"}
    shared |= {"MASTER_PORT": str(free_port())} | ({"LEMNISCATE_PATIENCE": str(patience)} if patience else {})
    started = []
    for rank in range(size):
        own = {**shared, "RANK": str(rank), "LOCAL_RANK": str(rank)}
        lines = f"import os\nos.environ.update({own!r})\nRANK = {rank}\n{before}"
        started.append(command(*arguments, before=lines, server=forks()))
    return started


def finish(processes, timeout=300.0):
    """Wait for all; (exit codes, everything said)."""
    said = ["".join(process.communicate(timeout)) for process in processes]
    return [process.returncode for process in processes], "\n".join(said)


def train(size, *arguments, **options):
    """Run a command to its end, in one process or in several. Fails unless all exit with 0."""
    processes = ranks(size, *arguments, **options) if size > 1 else [command(*arguments)]
    codes, said = finish(processes)
    assert not any(codes), said
    return said


def outcome(path):
    """All of a finished run that must not differ: hashes of the checkpoint, and the metrics."""
    return final_hashes(path), history(path)


def wait_for(path, seconds=60.0):
    """Wait until a file has something in it."""
    deadline = time.monotonic() + seconds
    while not (path.exists() and path.stat().st_size):
        assert time.monotonic() < deadline, f"{path} is still empty"
        time.sleep(0.02)
