"""Several processes of one run: the same bits for any number of them; those that die, hang or fail are named."""

import logging
import os
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from hosts import hosts
from torch.distributed.elastic.multiprocessing.errors import ChildFailedError, ProcessFailure

import lemniscate as lem
from cluster.worlds import KINDS, SHARDS, finish, free_port, outcome, ranks, train, wait_for, words
from forks import command
from lemniscate.api.options import CAUGHT, _undone
from lemniscate.errors import RankError, UserError
from lemniscate.run.stopping import Stopped
from lemniscate.system.world import World

ALWAYS = ("ppo",)
"""the kinds that are trained in every run of the suite"""


def kinds(always):
    return [kind if kind in always else pytest.param(kind, marks=pytest.mark.cluster) for kind in KINDS]


@pytest.mark.parametrize("kind", kinds(ALWAYS))
def test_any_number_of_processes_gives_the_same_bits(tmp_path, kind):
    for size in (1, 2, 4):
        train(size, *words(kind), "--run", tmp_path / str(size))
    expected = outcome(tmp_path / "1")
    assert outcome(tmp_path / "2") == expected
    assert outcome(tmp_path / "4") == expected
    assert expected[1][-1]["step"] >= 640


@pytest.mark.cluster
@pytest.mark.parametrize("kind", ["ppo", "sac"])
def test_eight_shards_too(tmp_path, kind):
    for size in (1, 2, 4):
        train(size, *words(kind, shards=8), "--run", tmp_path / str(size))
    expected = outcome(tmp_path / "1")
    assert outcome(tmp_path / "2") == expected
    assert outcome(tmp_path / "4") == expected


def check_kills(folder, kind, kills, rng):
    """Kill a rank of four, go on with two, kill one of these, go on with one; returns how many runs it took."""
    began = time.monotonic()
    train(4, *words(kind), "--run", folder / "whole")
    seconds, expected, killed, runs = time.monotonic() - began, outcome(folder / "whole"), 0, 0
    while killed < kills:
        path, runs = folder / f"killed-{runs}", runs + 1
        for size in (4, 2, 1):
            begun = (path / "config.json").exists()
            given = ["resume", path] if begun else [*words(kind), "--run", path]
            processes = ranks(size, *given) if size > 1 else [command(*given)]
            if size > 1:
                time.sleep(rng.uniform(0.3, 1) * seconds)
                rng.choice(processes).kill()
            codes, said = finish(processes)
            assert size > 1 or codes == [0], said
            assert "Traceback" not in said
            killed += -9 in codes
        assert outcome(path) == expected
    return runs


@pytest.mark.parametrize(
    ("kind", "kills"),
    [pytest.param(kind, kills, marks=pytest.mark.cluster) for kind, kills in (("ppo", 1), ("ppo", 15), ("sac", 15))],
)
def test_a_killed_rank_costs_nothing_and_the_run_goes_on_with_fewer(tmp_path, kind, kills):
    seed = random.SystemRandom().randrange(10**6)
    runs = check_kills(tmp_path, kind, kills, random.Random(seed))
    print(f"{kind}: {runs} runs, {kills} ranks killed, 0 differ (seed {seed})")


ENDLESS = [*words("ppo", total_steps=10**7, checkpoint_every=512), "--run"]
NAN = """
import lemniscate.envs.envpool as module
step = module.EnvpoolBackend.step
def broken(self, action):
    given = step(self, action)
    if RANK == 1 and self.num_envs == 4:
        given.reward[2] = float("nan")
    return given
module.EnvpoolBackend.step = broken
"""
DRIFT = """
import lemniscate.nn.normalizer as module
update = module.RunningNorm.update
def local(self, obs, valid=None):
    update(self, obs, valid)
    if RANK == 1:
        self.mean += 1e-9
module.RunningNorm.update = local
"""
SIGNALLED = """
import pickle, signal
dumps, updates = pickle.dumps, iter(range(3))
def signalled(said, *args, **kwargs):
    if RANK == 0 and said == (False, 0) and next(updates, None) == 2:
        os.kill(os.getpid(), signal.SIGTERM)
    return dumps(said, *args, **kwargs)
pickle.dumps = signalled
"""
HANG = """
import lemniscate.envs.envpool as module, time
step = module.EnvpoolBackend.step
def hanging(self, action):
    while RANK == 1 and os.path.exists(os.environ["HANG"]):
        {}
    return step(self, action)
module.EnvpoolBackend.step = hanging
"""


@pytest.mark.parametrize(
    ("how", "sentence"),
    [
        ("kill", "Rank 1 on .* does not answer any more"),
        pytest.param("stop", "Rank 1 on .* does not answer any more", marks=pytest.mark.cluster),
        pytest.param("hang", "Rank 1 on .* has made no step for 4 s", marks=pytest.mark.cluster),
        pytest.param("hang in C", "Rank 1 on .* (does not answer|has made no step)", marks=pytest.mark.cluster),
    ],
)
def test_a_rank_that_is_gone_is_named_and_all_end(tmp_path, how, sentence):
    flag = tmp_path / "hang"
    waits = "pass" if how == "hang" else "sum(range(10**12))"
    before = f"os.environ['HANG'] = {str(flag)!r}\n" + (HANG.format(waits) if "hang" in how else "")
    in_peace = ("--checkpoint-every", 10**6, "--evaluate-every", 0)  # who saves or evaluates may be silent for 30 s
    processes = ranks(2, *ENDLESS, tmp_path / "r", *in_peace, before=before, patience=4)
    wait_for(tmp_path / "r" / "metrics.jsonl")
    time.sleep(1)
    began = time.monotonic()
    if how == "kill":
        processes[1].kill()
    elif how == "stop":
        processes[1].send_signal(signal.SIGSTOP)
    else:
        flag.touch()
    codes, said = finish(processes)
    assert time.monotonic() - began < 10, said
    assert codes[0] == 1, said
    assert "Traceback" not in said
    assert re.search(sentence, said), said


def test_a_nan_in_one_rank_is_named_with_its_environment(tmp_path):
    codes, said = finish(ranks(2, *ENDLESS, tmp_path / "r", before=NAN))
    assert codes == [1, 1], said
    assert "Rank 1 on " in said
    assert "The reward of environment 6 is nan" in said  # the third of the second four
    assert said.count("Rank ") == 1, said
    assert "Traceback" not in said


def test_statistics_that_drift_apart_are_named(tmp_path):
    given = [*words("ppo", normalize_observations=True), "--run", tmp_path / "r"]
    codes, said = finish(ranks(2, *given, before=DRIFT))
    assert codes == [1, 1], said
    assert "The networks of rank 1 on " in said
    assert "differ from those of rank 0" in said
    assert said.count("differ from") == 1, said


@pytest.mark.parametrize("rank", [0, pytest.param(1, marks=pytest.mark.cluster)])
def test_sigterm_to_one_rank_saves_once_and_stops_all(tmp_path, rank):
    processes = ranks(2, *ENDLESS, tmp_path / "r")
    wait_for(tmp_path / "r" / "metrics.jsonl")
    processes[rank].terminate()
    codes, said = finish(processes, 30)
    assert codes == [143, 143], said
    assert said.count("is saved. Go on with: lemniscate resume") == 1, said
    assert lem.load(tmp_path / "r").step == max(lem.load(tmp_path / "r").step, 1)


def test_sigterm_while_the_ranks_agree_is_not_lost(tmp_path):
    codes, said = finish(ranks(2, *ENDLESS, tmp_path / "r", before=SIGNALLED), 30)
    assert codes == [143, 143], said
    assert said.count("is saved. Go on with: lemniscate resume") == 1, said


@pytest.mark.parametrize(
    ("size", "given", "sentence"),
    [
        (3, ["--shards", "4"], "3 processes cannot share 4 shards equally: 4 can be shared by 1, 2, 4."),
        (2, ["--shards", "8", "--num-envs", "12"], "shards 8 does not divide num_envs 12."),
        (2, ["--shards", "8", "--minibatch-size", "20"], "shards 8 does not divide minibatch_size 20."),
    ],
)
def test_what_cannot_be_shared_equally_is_refused_in_one_sentence(tmp_path, size, given, sentence):
    codes, said = finish(ranks(size, *words("ppo"), *given, "--run", tmp_path / "r"))
    assert set(codes) <= {1, 2}, said
    assert codes[0] == 2
    assert said.strip().splitlines()[-1] == sentence
    assert said.count("shards") == sentence.count("shards")
    assert not (tmp_path / "r").exists()


def test_a_run_of_one_shard_cannot_go_on_with_two_processes(tmp_path):
    train(1, *words("ppo", shards=1, total_steps=640), "--run", tmp_path / "r", "--checkpoint-every", "320")
    with pytest.raises(UserError, match="2 processes cannot share 1 shards equally"):
        World(1, 0, 2).divide(1)


def torchrun(*words, on=(), **environment):
    """Start `torchrun … -m -- lemniscate …` in a process of its own; `on` is the beginning of the command."""
    paths = os.pathsep.join(filter(None, sys.path))
    return subprocess.Popen(
        [*on, sys.executable, "-m", "torch.distributed.run", *map(str, words)],
        env={**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1", **environment},
        stderr=subprocess.PIPE,
        text=True,
    )


def ends_well(*processes):
    """Wait for all; fails unless all exit with 0."""
    said = [process.communicate(timeout=300)[1] for process in processes]
    assert [process.returncode for process in processes] == [0] * len(processes), said
    assert "Traceback" not in "".join(said), said


@pytest.mark.cluster
def test_torchrun_on_one_machine_gives_the_bits_of_one_process(tmp_path):
    train(1, *words("ppo"), "--run", tmp_path / "one")
    port = ["--master-port", free_port()]
    ends_well(
        torchrun("--nproc-per-node", 2, *port, "-m", "--", "lemniscate", *words("ppo"), "--run", tmp_path / "two")
    )
    assert outcome(tmp_path / "two") == outcome(tmp_path / "one")


@pytest.mark.cluster
@pytest.mark.skipif(os.geteuid() != 0 or not Path("/dev/net/tun").exists(), reason="only root makes simulated hosts")
@pytest.mark.parametrize("kind", ["ppo", "sac"])
def test_torchrun_on_two_hosts_gives_the_bits_of_one_process(tmp_path, kind):
    """The line of docs/scale.md on two machines that share a network alone: no shared memory, a disk on the first."""
    train(1, *words(kind), "--run", tmp_path / "one")
    meet = ["--nnodes", 2, "--nproc-per-node", 2, "--rdzv-backend", "c10d", "--rdzv-endpoint", "10.77.0.1:29500"]
    with hosts(2, 0.0005) as commands:
        processes = []
        for i, there in enumerate(commands):
            name = [
                "--local-addr",
                f"10.77.0.{i + 1}",
                "--rdzv-conf",
                f"is_host={i == 0}",
            ]  # no names are resolved here
            own = [*meet, *name, "-m", "--", "lemniscate", *words(kind), "--run"]
            path = tmp_path / ("two" if i == 0 else "not-there")
            processes.append(torchrun(*own, path, on=there, GLOO_SOCKET_IFNAME=f"lem{i}"))
        ends_well(*processes)
    assert outcome(tmp_path / "two") == outcome(tmp_path / "one")
    assert not (tmp_path / "not-there").exists()


@pytest.mark.cluster
def test_processes_launches_them_and_leaves_none(tmp_path):
    given = [*words("ppo"), "--run"]
    train(1, *given, tmp_path / "one")
    said = train(1, *given, tmp_path / "two", "--processes", 2)
    assert "Everything is in" in said
    assert outcome(tmp_path / "two") == outcome(tmp_path / "one")
    launcher = command(*ENDLESS, tmp_path / "endless", "--processes", 2)
    wait_for(tmp_path / "endless" / "metrics.jsonl")
    launcher.kill()
    deadline = time.monotonic() + 2
    while any(str(tmp_path / "endless") in (p.info["cmdline"] or ()) for p in psutil.process_iter(["cmdline"])):
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.parametrize(
    ("codes", "error", "said"),
    [
        ({1: -9, 0: 143}, RankError, "Process 1 of the run was killed"),
        ({1: 143, 0: -9}, Stopped, "^$"),
        ({0: -9, 1: -9}, RankError, "All processes of the run were killed"),
        ({0: 1}, RankError, "^$"),
    ],
)
def test_a_process_that_is_killed_is_named_and_is_no_stop(tmp_path, monkeypatch, codes, error, said):
    """`codes` are the exit codes by rank, in the order in which the processes failed."""

    def launch(*_):
        failures = {rank: ProcessFailure(rank, 1, code, "") for rank, code in codes.items()}
        for when, failure in enumerate(failures.values()):
            failure.timestamp = when
        raise ChildFailedError("lemniscate", failures)

    monkeypatch.setattr("torch.distributed.launcher.api.elastic_launch", lambda *_: launch)
    with pytest.raises(error, match=said):
        lem.train("ppo", "CartPole-v1", run=tmp_path / "run", processes=2, progress=False)


def test_what_the_launcher_changes_is_undone(monkeypatch):
    monkeypatch.setenv("KEPT", "as it was")
    handlers, disabled = [signal.getsignal(each) for each in CAUGHT], logging.root.manager.disable
    with _undone():
        for each in CAUGHT:
            signal.signal(each, lambda *_: None)
        os.environ |= {"KEPT": "changed", "NEW": "here"}
        logging.disable(logging.CRITICAL)
    assert [signal.getsignal(each) for each in CAUGHT] == handlers
    assert (os.environ["KEPT"], "NEW" in os.environ) == ("as it was", False)
    assert logging.root.manager.disable == disabled


def test_without_shards_every_process_has_one(tmp_path):
    given = [*words("a2c"), "--shards", "1", "--run"]
    train(2, *given, tmp_path / "two")
    train(1, *words("a2c"), "--shards", "2", "--run", tmp_path / "one")
    assert outcome(tmp_path / "two") == outcome(tmp_path / "one")
    assert SHARDS == 4
