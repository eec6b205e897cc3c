"""Ray: a run as a job of several workers, sets and searches as tasks; whatever is killed, the bits are the same.

Everything but the bad input runs with `make test-cluster`, which installs Ray.
"""

import os
import random
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from functools import partial
from importlib.util import find_spec
from shutil import copytree

import psutil
import pytest

import lemniscate as lem
from cluster.worlds import outcome, words
from lemniscate.cli import main
from run.test_run import final_hashes

RAY = find_spec("ray") is not None
with_ray = [pytest.mark.cluster, pytest.mark.skipif(not RAY, reason="Ray is not installed: make test-cluster")]
TASK, WORKER = "ray::Task", "ray::RayTrainWorker"
RUN = {"total_steps": 10_240, "checkpoint_every": 1_280}
"""eight planned checkpoints, one every two or three seconds"""


def start(*arguments, cwd, **environment):
    """Start a command in a process of its own, in which Ray has not been imported."""
    paths = os.pathsep.join(filter(None, sys.path))
    return subprocess.Popen(
        [sys.executable, "-m", "lemniscate", *map(str, arguments)],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": paths, **environment},
        stderr=subprocess.PIPE,
        text=True,
    )


def finish(process, timeout=600):
    """Wait for its end; what it said. Fails unless it exits with 0."""
    said = process.communicate(timeout=timeout)[1]
    assert process.returncode == 0, said
    assert "Traceback" not in said, said
    return said


def below(process, title):
    """The processes of Ray with this title that a process has begun, directly or not."""
    found = []
    for child in psutil.Process(process.pid).children(recursive=True):
        try:
            if child.cmdline()[:1] and child.cmdline()[0].startswith(title):
                found.append(child)
        except psutil.NoSuchProcess:
            pass
    return found


def checkpoints(path):
    """The names of the checkpoints in a job's storage."""
    return {file.name for file in (path / "ray" / "job").glob("checkpoint_*")}


def new_checkpoints(path, seen):
    """The names of those that have not been seen."""
    return checkpoints(path) - seen


def wait_for(process, condition, seconds=120):
    """Wait until `condition()` holds; returns what it is, or None if the process has ended before."""
    deadline = time.monotonic() + seconds
    while process.poll() is None:
        if found := condition():
            return found
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return None


def whole(kind, folder):
    """The outcome of a run of one process that nobody disturbs, and its seconds."""
    began = time.monotonic()
    finish(start(*words(kind, **RUN), "--run", "whole", cwd=folder))
    return outcome(folder / "whole"), time.monotonic() - began


def check_kills(folder, kind, kills, kill, options=(), **environment):
    """Train until so many kills have hit; each run ends in the same bits. Returns runs, kills, seconds lost by each."""
    expected, _ = whole(kind, folder)
    command = [*words(kind, **RUN), "--cluster", "ray", "--workers", "2", *options]
    began = time.monotonic()
    finish(start(*command, "--run", "calm", cwd=folder, **environment))
    calm = time.monotonic() - began
    assert outcome(folder / "calm") == expected
    killed = runs = 0
    lost = []
    while killed < kills:
        path, before = folder / f"killed-{runs}", killed
        began, seen, wanted = time.monotonic(), set(), min(3, kills - killed)
        process = start(*command, "--run", path, cwd=folder, **environment)
        while killed - before < wanted and wait_for(process, partial(new_checkpoints, path, seen)):
            time.sleep(random.uniform(0, 2))
            seen |= checkpoints(path)
            killed += kill(process)
        said = finish(process)
        assert outcome(path) == expected, said
        if killed > before:
            lost.append((time.monotonic() - began - calm) / (killed - before))
        runs += 1
        print(f"{kind}: run {runs}, {killed} kills, {lost[-1:]} s lost by each", flush=True)
    return runs, killed, lost


def kill_worker(process):
    """Kill one of the workers of a job, if there is one."""
    workers = below(process, WORKER)
    if workers:
        random.choice(workers).kill()
    return bool(workers)


@pytest.mark.parametrize("kind", [pytest.param(kind, marks=with_ray) for kind in ("ppo", "sac")])
def test_a_killed_worker_is_replaced_and_costs_no_bit(tmp_path, kind):
    kills = int(os.environ.get("KILLS", 2))
    runs, killed, lost = check_kills(tmp_path, kind, kills, kill_worker)
    print(f"{kind}: {runs} jobs, {killed} workers killed, 0 differ; {max(lost):.0f} s lost by a kill at most")
    assert max(lost) < 30 + 10


@contextmanager
def cluster_of(nodes):
    """A cluster of several nodes on this machine, each with one core, besides that of whoever begins a job."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    try:
        for _ in range(nodes):
            cluster.add_node(num_cpus=1)
        cluster.wait_for_nodes()
        yield cluster
    finally:
        cluster.shutdown()


def node_with(cluster, title):
    """A node, not the first one, on which a process with this title runs."""
    for node in random.sample(cluster.list_all_nodes()[1:], len(cluster.list_all_nodes()) - 1):
        raylet = node.all_processes["raylet"][0].process
        if below(raylet, title):
            return node
    return None


@pytest.mark.parametrize("kind", [pytest.param("ppo", marks=with_ray)])
def test_a_killed_node_costs_no_bit_and_a_job_goes_on_with_fewer(tmp_path, kind):
    kills = int(os.environ.get("KILLS", 2))
    with cluster_of(2) as cluster:

        def kill_node(_):
            node = node_with(cluster, WORKER)
            if node is None:
                return False
            if random.random() < 0.5:  # else there are fewer for the rest of the run
                cluster.add_node(num_cpus=1)
            if len(cluster.list_all_nodes()) < 3:
                cluster.add_node(num_cpus=1)
            cluster.remove_node(node, allow_graceful=False)
            return True

        runs, killed, lost = check_kills(tmp_path, kind, kills, kill_node, RAY_ADDRESS=cluster.address)
    print(f"{kind}: {runs} jobs, {killed} nodes killed, 0 differ; {max(lost):.0f} s lost by a kill at most")


@pytest.mark.parametrize("signum", [pytest.param(s, marks=with_ray) for s in (signal.SIGINT, signal.SIGTERM)])
def test_a_job_that_is_stopped_goes_on_from_its_storage(tmp_path, signum):
    expected, _ = whole("ppo", tmp_path)
    path = tmp_path / "job"
    process = start(*words("ppo", **RUN), "--cluster", "ray", "--workers", "2", "--run", path, cwd=tmp_path)
    assert wait_for(process, lambda: len(checkpoints(path)) > 0)
    process.send_signal(signum)
    said = process.communicate(timeout=60)[1]
    assert process.returncode == 128 + signum, said
    assert f"lemniscate resume {path} --cluster ray --workers 2" in said
    finish(start("resume", path, "--cluster", "ray", "--workers", "2", cwd=tmp_path))
    assert outcome(path) == expected


@pytest.mark.parametrize("kill", [pytest.param(kill, marks=with_ray) for kill in (False, True)])
def test_the_runs_of_a_sweep_are_tasks_that_end_in_the_same_bits(tmp_path, kill):
    shared = [*words("ppo", **RUN), "--seeds", "1-2"]
    finish(start(*shared, "--run", "here", cwd=tmp_path))
    process = start(*shared, "--run", "there", "--cluster", "ray", cwd=tmp_path)
    for _ in range(3 * kill):
        tasks = wait_for(process, lambda: below(process, TASK))
        time.sleep(random.uniform(2, 6))
        random.choice(tasks).kill()
    said = finish(process)
    assert "2 of 2 runs to train, 2 at a time" in said
    for run in ("ppo-1", "ppo-2"):
        assert outcome(tmp_path / "there" / run) == outcome(tmp_path / "here" / run)
    assert (tmp_path / "there" / "plots" / "comparison.png").exists()


@pytest.mark.parametrize("verb", [pytest.param(verb, marks=with_ray) for verb in ("train", "tune")])
def test_a_set_that_is_stopped_saves_itself_and_goes_on_there_or_here(tmp_path, verb):
    if verb == "train":
        own = [*words("ppo", **RUN)[1:], "--seeds", "1-2"]
    else:  # which chooses its checkpoints itself
        own = ["ppo", "--env", "CartPole-v1", "--total-steps", RUN["total_steps"], "--compile", "off"]
        own += ["--search", "gamma=.9:.99", "--trials", "2", "--seeds", "101"]
    process = start(verb, *own, "--run", "set", "--cluster", "ray", cwd=tmp_path)
    assert wait_for(process, lambda: [*tmp_path.glob("set/**/step-*")])
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=60)[1]
    assert process.returncode == 130, said
    assert "Go on with: lemniscate resume set" in said
    again = copytree(tmp_path / "set", tmp_path / "copy")
    finish(start("resume", "set", "--cluster", "ray", cwd=tmp_path))
    finish(start("resume", again, cwd=tmp_path))
    for run in sorted(file.parent.relative_to(tmp_path / "set") for file in tmp_path.glob("set/**/config.json")):
        assert final_hashes(tmp_path / "set" / run) == final_hashes(again / run)


@pytest.mark.parametrize("kind", [pytest.param("nan", marks=with_ray)])
def test_what_would_fail_again_is_told_once(tmp_path, kind):
    (tmp_path / "broken.py").write_text(
        "import gymnasium as gym\n"
        "class Env(gym.Env):\n"
        "    observation_space = gym.spaces.Box(-1, 1, (2,))\n"
        "    action_space = gym.spaces.Discrete(2)\n"
        "    def reset(self, *, seed=None, options=None):\n"
        "        super().reset(seed=seed)\n"
        "        return self.observation_space.sample(), {}\n"
        "    def step(self, action):\n"
        "        return self.observation_space.sample(), float('nan'), False, False, {}\n"
    )
    small = ["--num-envs", "4", "--num-steps", "8", "--minibatch-size", "16", "--total-steps", "640"]
    process = start(
        *["train", "ppo", "--env", "broken:Env", *small, "--cluster", "ray", "--workers", "2", "--run", "run"],
        cwd=tmp_path,
        PYTHONPATH=os.pathsep.join([str(tmp_path), *filter(None, sys.path)]),
    )
    said = process.communicate(timeout=120)[1]
    assert process.returncode == 1, said
    assert "reward" in said.splitlines()[-1]
    assert "Traceback" not in said


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--cluster", "spark"], "cluster must be ray or ray=ADDRESS, not 'spark'."),
        (["--cluster", "ray", "--workers", "0"], "workers must be a whole number from 1 to 4,096, not 0."),
        (["--cluster", "ray", "--workers", "two"], "workers must be a whole number from 1 to 4,096, not 'two'."),
        (["--workers", "2"], "workers are of a cluster: add --cluster ray; on this machine, --processes."),
        (["--storage", "here"], "storage is of a cluster"),
    ],
)
@pytest.mark.parametrize("several", [[], ["--seeds", "1-2"]])
def test_what_is_no_cluster_has_its_sentence_and_leaves_nothing(tmp_path, options, sentence, several, capsys):
    if several and "--storage" in options:
        pytest.skip("a set has none")
    path = tmp_path / "run"
    assert main(["train", "ppo", "--env", "CartPole-v1", *several, "--run", str(path), *options]) == 2
    assert sentence in capsys.readouterr().err
    assert not path.exists()


def test_without_ray_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(lem.UserError, match="ray is not installed; it comes with the extra ray"):
        lem.train("ppo", "CartPole-v1", run=tmp_path / "run", cluster="ray")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("address", [pytest.param("127.0.0.1:1", marks=with_ray)])
@pytest.mark.parametrize("several", [[], ["--seeds", "1-2"]])
def test_an_address_at_which_nobody_answers_has_its_sentence(tmp_path, address, several):
    process = start(*words("ppo"), *several, "--cluster", f"ray={address}", "--run", "run", cwd=tmp_path)
    said = process.communicate(timeout=120)[1]
    assert process.returncode == 2, said
    assert f"No Ray cluster answers at {address}" in said
    assert not [*tmp_path.iterdir()]
