"""Sweeps: each run ends in the same bits as alone, whatever happens to the others.

Where processes are stopped, killed or counted they are real ones; else the runs are trained in this one.
"""

import contextlib
import io
import json
import os
import shutil
import signal
import subprocess
import time

import numpy as np
import pytest
import torch
from filelock import FileLock

import lemniscate as lem
from forks import command
from lemniscate.cli import main
from lemniscate.run import checkpoint, places
from lemniscate.run.directory import is_finished
from lemniscate.run.metrics import read_metrics
from lemniscate.sweeps import sweep
from lemniscate.system.files import read_json, write_json
from tuning.here import in_this_process

SEEDS = ["--seeds", "1-2"]
ENV = "environments:Copy-box-v0"
SHARED = {"num_envs": 4, "total_steps": 5_200, "hidden": (16,), "compile": "off"}
FLAGS = ["--num-envs", "4", "--total-steps", "5_200", "--hidden", "16", "--compile", "off"]
SMALL = [
    "--num-envs",
    "4",
    "--num-steps",
    "8",
    "--epochs",
    "4",
    "--hidden",
    "16",
    "--minibatch-size",
    "16",
    "--compile",
    "off",
]


def final_hash(run):
    last = run / "checkpoints" / f"step-{checkpoint.list_steps(run / 'checkpoints')[-1]}"
    return json.loads((last / "manifest.json").read_text())["sha256"]


@pytest.fixture(scope="module", autouse=True)
def _few_episodes():
    """A final return takes seconds over 100 episodes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lemniscate.api.results.FINAL_EPISODES", 10)
        yield


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A sweep of PPO and DDPG with a callback, and its lines on standard error."""
    path = tmp_path_factory.mktemp("sweeps") / "both"
    with contextlib.redirect_stderr(io.StringIO()) as said, in_this_process():
        options = ["--env", ENV, "--seeds", "1-2", "--run", str(path), "--callbacks", "environments:tell"]
        code = main(["train", "ppo,ddpg", *options, *FLAGS])
    assert code == 0, said.getvalue()
    return path, said.getvalue()


def test_a_sweep_is_a_run_for_each_algorithm_and_seed(trained):
    path, _ = trained
    record = json.loads((path / "sweep.json").read_text())
    assert record["seeds"] == [1, 2]
    assert list(record["configs"]) == ["ppo", "ddpg"]
    assert record["configs"]["ddpg"]["total_steps"] == 5_200
    runs = {file.parent.name: json.loads(file.read_text()) for file in path.glob("*/config.json")}
    assert set(runs) == {"ppo-1", "ppo-2", "ddpg-1", "ddpg-2"}
    assert runs["ddpg-2"]["algorithm"] == "ddpg"
    assert runs["ddpg-2"]["config"]["seed"] == 2


def test_every_run_of_a_sweep_calls_the_callbacks(trained):
    path, _ = trained
    for run in ("ppo-1", "ppo-2", "ddpg-1", "ddpg-2"):
        assert "called at " in (path / run / places.LOG).read_text()


@pytest.mark.parametrize(("algorithm", "seed"), [("ppo", 2), ("ddpg", 1)])
@pytest.mark.one_in(2)
def test_each_run_of_a_sweep_ends_in_the_bits_of_a_run_alone(trained, tmp_path, algorithm, seed):
    path, _ = trained
    alone = lem.train(algorithm, ENV, seed=seed, run=tmp_path / "alone", progress=False, **SHARED)
    assert final_hash(alone.path) == final_hash(path / f"{algorithm}-{seed}")


def test_at_the_end_there_is_one_table_and_one_picture(trained):
    path, said = trained
    assert "4 of 4 runs to train" in said
    assert "ppo-1: done, final return " in said
    table = said[said.index(f"{ENV}:") :].splitlines()
    assert [line.split()[0] for line in table[1:4]] == ["seeds", "PPO", "DDPG"]
    assert f"{path}/plots/comparison.png" in table
    assert (path / "plots" / "comparison.png").stat().st_size > 20_000


def test_the_sweep_is_plotted_again_without_playing(trained, monkeypatch):
    path, _ = trained
    monkeypatch.setattr(lem.api.results, "evaluate", None)
    assert {picture.parent for picture in lem.plot(path)} == {path / "plots"}


def test_what_needs_one_run_says_so_of_a_sweep(trained, capsys):
    path, _ = trained
    for verb in ("evaluate", "watch"):
        assert main([verb, str(path)]) == 2
        said = f"{path} is a sweep: name one of its runs, such as {path / 'ddpg-1'}.\n"
        assert capsys.readouterr().err == said
    with pytest.raises(lem.UserError, match="is a sweep"):
        lem.resume(path)
    assert main(["resume", str(path), "--total-steps", "99"]) == 2
    assert f"--total-steps is for one run, and {path} is a set of them" in capsys.readouterr().err


@pytest.mark.long
def test_resuming_a_sweep_goes_on_begins_and_leaves_alone(trained, tmp_path, capsys):
    path, _ = trained
    copy = shutil.copytree(path, tmp_path / "copy")
    shutil.rmtree(copy / "ddpg-2")
    for step in checkpoint.list_steps(copy / "ppo-2" / "checkpoints")[-2:]:
        shutil.rmtree(copy / "ppo-2" / "checkpoints" / f"step-{step}")
    untouched = {file: file.stat().st_mtime_ns for name in ("ppo-1", "ddpg-1") for file in (copy / name).rglob("*")}
    with in_this_process():
        assert main(["resume", str(copy)]) == 0
    assert "2 of 4 runs to train" in capsys.readouterr().err
    for name in ("ppo-2", "ddpg-2"):
        assert final_hash(copy / name) == final_hash(path / name)
    assert {file: file.stat().st_mtime_ns for file in untouched} == untouched


@pytest.mark.long
def test_a_finished_sweep_is_resumed_in_no_time(trained, capsys, monkeypatch):
    path, _ = trained
    monkeypatch.setattr(subprocess, "Popen", None)
    assert main(["resume", str(path)]) == 0
    assert "0 of 4 runs to train" in capsys.readouterr().err


def test_a_run_whose_last_checkpoint_is_damaged_is_not_finished(trained, tmp_path):
    run = shutil.copytree(trained[0] / "ppo-1", tmp_path / "run")
    assert is_finished(run)
    state = run / "checkpoints" / f"step-{checkpoint.list_steps(run / 'checkpoints')[-1]}" / "state.json"
    state.write_bytes(state.read_bytes()[:-1])
    assert not is_finished(run)


def test_two_processes_do_not_train_one_sweep(trained):
    path, _ = trained
    with FileLock(path / ".lock"), pytest.raises(lem.UserError, match="being trained by another process"):
        lem.resume_sweep(path)


def test_the_policy_is_played_anew_when_there_is_a_newer_checkpoint(trained, tmp_path, capsys):
    run = shutil.copytree(trained[0] / "ppo-1", tmp_path / "run")
    known = read_json(run / "final.json")
    assert lem.api.results.final_return(run) == known["mean_return"]
    assert capsys.readouterr().err == ""
    newest = run / "checkpoints" / f"step-{known['step']}"
    newest.rename(newest.with_name(f"step-{known['step'] + 1}"))
    write_json(run / "final.json", known | {"mean_return": 7.0})
    assert lem.api.results.final_return(run) == known["mean_return"]
    assert "Evaluating" in capsys.readouterr().err


ONE_CORE = "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})"
"""a sweep trains its runs one after the other"""


@pytest.mark.faults
def test_runs_end_with_the_sweep_that_is_killed_and_it_goes_on(tmp_path):
    path = tmp_path / "killed"
    process = command(
        "train",
        "ppo",
        "--env",
        "toy:Countdown-v0",
        "--seeds",
        "1",
        "--run",
        path,
        "--total-steps",
        "1e6",
        "--compile",
        "off",
        before=ONE_CORE,
    )
    while len(read_metrics(path / "ppo-1")) < 2:
        assert process.poll() is None, process.communicate()
        time.sleep(0.005)
    process.kill()
    process.communicate()
    with FileLock(path / "ppo-1" / ".lock", timeout=2):
        pass


@pytest.mark.faults
def test_ctrl_c_stops_every_run_and_the_sweep_goes_on_to_the_same_bits(tmp_path):
    path = tmp_path / "stopped"
    fields = [*SMALL, "--total-steps", "3_200", "--checkpoint-every", "512"]
    process = command(
        "train", "ppo", "--env", "toy:Countdown-v0", "--seeds", "1,2", "--run", path, *fields, before=ONE_CORE
    )
    while len(read_metrics(path / "ppo-1")) < 20:
        assert process.poll() is None, process.communicate()
        time.sleep(0.005)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does, to all who belong to it
    said = process.communicate()[1]
    assert process.returncode == 130
    assert f"Stopped; the runs that had begun are saved. Go on with: lemniscate resume {path}" in said
    assert "ppo-1: stopped at step" in said
    assert "Traceback" not in said
    with FileLock(path / "ppo-1" / ".lock", timeout=0):  # nobody trains any more
        assert lem.load(path / "ppo-1").step == read_metrics(path / "ppo-1")[-1]["step"] < 3_200
    assert not (path / "ppo-2" / "metrics.jsonl").exists()
    process = command("resume", path, before=ONE_CORE)
    assert "1 at a time" in process.communicate()[1]
    assert process.returncode == 0
    config = json.loads((path / "ppo-2" / "config.json").read_text())["config"]
    for seed in (1, 2):
        fields = {name: tuple(x) if isinstance(x, list) else x for name, x in config.items()} | {"seed": seed}
        alone = lem.train("ppo", run=tmp_path / f"{seed}", progress=False, **fields)
        assert final_hash(path / f"ppo-{seed}") == final_hash(alone.path)


@pytest.mark.long
def test_runs_that_fail_are_named_and_the_others_are_trained_side_by_side(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(places, "at_once", lambda threads: 2)
    most = []
    ended = places.Processes.ended
    monkeypatch.setattr(places.Processes, "ended", lambda here: most.append(len(here.running)) or ended(here))
    with pytest.raises(lem.SweepError) as told:
        lem.train_sweep(["ppo"], "environments:Fragile", range(1, 4), run=tmp_path / "s", num_envs=2, total_steps=2_000)
    assert max(most) == 2
    first, nan, killed, again = str(told.value).splitlines()
    assert first == "2 of 3 runs could not go on; log.txt in each says more."
    assert nan.startswith("ppo-2: The reward of environment 0 is nan in the step after 0. Training stopped;")
    assert killed == "ppo-3: Killed, as the system does where memory has run out."
    assert again == f"Try them again with: lemniscate resume {tmp_path / 's'}"
    assert lem.load(tmp_path / "s" / "ppo-1").step >= 2_000
    said = capsys.readouterr().err
    assert f"{tmp_path / 's'} has no metrics yet of ppo-2" in said
    assert "PPO      1" in said
    assert "One seed says nothing" in said


def test_the_command_ends_in_1_if_a_run_has_failed(monkeypatch, capsys):
    def fails(*_, **__):
        raise lem.SweepError("1 of 2 runs could not go on.\nppo-2: why.")

    monkeypatch.setattr(sweep, "train_sweep", fails)
    assert main(["train", "ppo", "--env", "CartPole-v1", "--seeds", "1-2"]) == 1
    assert capsys.readouterr().err == "1 of 2 runs could not go on.\nppo-2: why.\n"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["ppo,ddpg", "--env", "Pendulum-v1", "--clip", "0.1", *SEEDS], "ddpg: There is no field '--clip'"),
        (
            ["ppo,ddpg", "--env", "Pendulum-v1", "--gamma", "2", *SEEDS],
            "ppo: gamma must be a number from 0 to 1, not 2.",
        ),
        (["ppo,ddpg", "--env", "Pendulum-v1", "--total-steps", "900", *SEEDS], "ddpg: learning_starts must be below"),
        (["ppo,ddpg", "--env", "CartPole-v1", *SEEDS], "ddpg: CartPole-v1 has Discrete actions"),
        (["ppo,saac", "--env", "Pendulum-v1", *SEEDS], "There is no algorithm 'saac': did you mean sac"),
        (["ppo,ddpg", "--preset", "course", *SEEDS], "These presets are for different environments"),
        (["ppo,ddpg", "--env", "Pendulum-v1"], "over several seeds: add --seeds 1-5."),
        (["ppo", "--seeds", "1-2"], "ppo: Which environment?"),
        (["ppo", "--env", "CartPole-v1", "--seeds", "5-1"], "seeds must be numbers such as 1-5 or 1,3,7, not '5-1'."),
        (["ppo", "--env", "CartPole-v1", "--seeds", "1,x"], "seeds must be numbers such as 1-5 or 1,3,7, not '1,x'."),
        (["ppo", "--env", "CartPole-v1", "--seeds", "1-2", "--seed", "3"], "--seeds 1-5, not --seed."),
        (["ppo", "--env", "CartPole-v1", "--seeds", "1-2", "--track", "x"], "There is no tracker 'x'"),
    ],
)
def test_a_mistake_is_one_sentence_before_anything_starts(tmp_path, capsys, arguments, said):
    assert main(["train", *arguments, "--run", str(tmp_path / "set")]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert len(err.strip().splitlines()) == 1
    assert not (tmp_path / "set").exists()


def test_seeds_are_given_as_ranges_and_lists():
    assert sweep.seeds_of("1-3") == [1, 2, 3]
    assert sweep.seeds_of("7,1-2, 7") == [7, 1, 2]
    assert sweep.seeds_of(range(2)) == [0, 1]
    assert sweep.seeds_of(5) == [5]
    assert sweep.seeds_of(np.arange(1, 4)) == sweep.seeds_of(list(np.arange(1, 4))) == [1, 2, 3]
    assert sweep.seeds_of([torch.tensor(7), np.int64(8)]) == [7, 8]


@pytest.mark.parametrize(("cores", "threads", "runs"), [(8, 1, 8), (8, 3, 2), (2, 4, 1)])
def test_as_many_runs_at_once_as_cores_serve(monkeypatch, cores, threads, runs):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    assert places.at_once(threads) == runs


def test_a_run_that_has_lost_its_config_gets_it_from_the_sweep(trained, tmp_path):
    path = tmp_path / "both"
    shutil.copytree(trained[0], path)
    before = final_hash(path / "ppo-1")
    (path / "ppo-1" / "config.json").unlink()
    (path / "ppo-2" / "config.json").write_text("{")
    with in_this_process():
        assert main(["resume", str(path)]) == 0
    assert read_json(path / "ppo-1" / "config.json")["config"]["seed"] == 1
    assert read_json(path / "ppo-2" / "config.json")["config"]["seed"] == 2
    assert final_hash(path / "ppo-1") == before


def test_a_run_that_a_callback_stopped_is_not_said_to_be_done(tmp_path, capsys):
    stop = ["--callbacks", "lemniscate.api.callbacks:StopAt(steps=64)", "--run", str(tmp_path / "sweep")]
    with in_this_process():
        main(["train", "ppo", "--env", ENV, "--seeds", "1", "--total-steps", "640", *SMALL, *stop])
    said = capsys.readouterr().err
    assert f"ppo-1: stopped by a callback at step 64; go on with: lemniscate resume {tmp_path / 'sweep'}" in said
