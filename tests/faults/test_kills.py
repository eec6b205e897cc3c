"""SIGKILL at random times: a run that is killed and resumed ends as one that was not, whatever was going on."""

import random
import time
from importlib.util import find_spec

import pytest

from conftest import tiny_fields, tiny_off_policy
from faults.runs import often, trials
from lemniscate.run import checkpoint
from run.test_run import OFF_POLICY, ON_POLICY, final_hashes, history, words_for

SMALL = {"num_envs": 4, "num_steps": 8, "hidden": (32,), "evaluate_episodes": 2, "compile": "off"}
FIELDS = {
    # kind of run: algorithm, environment, fields; without "total_steps" it takes 1,600
    "ppo": ("ppo", "CartPole-v1", {"epochs": 4, "minibatch_size": 16}),
    "ppo-sync": ("ppo", "CartPole-v1", {"backend": "gymnasium", "minibatch_size": 16}),
    "ppo-async": ("ppo", "CartPole-v1", {"backend": "gymnasium-async", "minibatch_size": 16}),
    "ppo-evaluated": ("ppo", "CartPole-v1", {"evaluate_every": 96, "minibatch_size": 16, "total_steps": 960}),
    "ppo-recorded": ("ppo", "CartPole-v1", {"video_every": 320, "minibatch_size": 16, "total_steps": 960}),
    "ppo-compiled": ("ppo", "CartPole-v1", {"compile": "on", "minibatch_size": 16}),
    "reinforce": ("reinforce", "CartPole-v1", ON_POLICY["reinforce"]),
    "a2c": ("a2c", "CartPole-v1", ON_POLICY["a2c"] | {"total_steps": 3_200}),
    "trpo": ("trpo", "CartPole-v1", ON_POLICY["trpo"] | {"total_steps": 640}),
    "trpo-sync": ("trpo", "Pendulum-v1", ON_POLICY["trpo"] | {"backend": "gymnasium", "total_steps": 640}),
    "reppo": ("reppo", "Pendulum-v1", ON_POLICY["reppo"]),
    "pqn": ("pqn", "CartPole-v1", ON_POLICY["pqn"]),
    "ddpg": ("ddpg", "Pendulum-v1", OFF_POLICY["ddpg"]),
    "ddpg-sync": ("ddpg", "Pendulum-v1", OFF_POLICY["ddpg-pink"] | {"backend": "gymnasium"}),
    "ddpg-compiled": ("ddpg", "Pendulum-v1", OFF_POLICY["ddpg"] | {"compile": "on"}),
    "td3": ("td3", "Pendulum-v1", OFF_POLICY["td3"]),
    "td3-async": ("td3", "Pendulum-v1", OFF_POLICY["td3"] | {"backend": "gymnasium-async"}),
    "sac": ("sac", "Pendulum-v1", OFF_POLICY["sac"]),
    "sac-bins": ("sac", "Pendulum-v1", OFF_POLICY["sac-bins"] | {"unit_weights": True}),
    "sac-compiled": ("sac", "Pendulum-v1", OFF_POLICY["sac"] | {"compile": "on"}),
    "drone": ("ppo", "DroneFigureEightTrajectory-v0", {"num_envs": 64, "num_steps": 16, "total_steps": 64 * 16 * 60}),
}
KINDS = [*FIELDS, "sweep"]
COSTLY = {"ppo-compiled": 12, "ddpg-compiled": 12, "sac-compiled": 12, "ppo-recorded": 12, "drone": 12, "sweep": 12}
"""how many processes are killed, where it is not 26"""


def words(kind, **changes):
    """The command that trains a run of this kind, with some fields changed, less its directory."""
    if kind == "sweep":
        fields = {"num_envs": 8, "num_steps": 32, "total_steps": 6_400, "checkpoint_every": 512, "hidden": (16,)}
        given = ["train", "a2c,ppo", "--env", "toy:Countdown-v0", "--seeds", "1", "--compile", "off"]
    else:
        algorithm, env, chosen = FIELDS[kind]
        small = tiny_off_policy(compile="off", log_every=16) if algorithm in OFF_POLICY else SMALL
        fields = {**small, "total_steps": 1_600, **chosen, **changes}
        fields.setdefault("checkpoint_every", fields["total_steps"] // 10)
        given = ["train", algorithm, "--env", env]
    return [*given, *(word for name, value in fields.items() for word in words_for(name, value)), "--run"]


def runs_in(path):
    """The run itself, or each of a sweep's."""
    return sorted({path for path in (path, *path.glob("*")) if (path / "checkpoints").exists()})


def points(folder):
    """All scalars that TensorBoard shows of the runs below `folder`, less what the wall clock decides."""
    from tensorboard.backend.event_processing.event_multiplexer import EventMultiplexer

    runs = EventMultiplexer(size_guidance={"scalars": 0}).AddRunsFromDirectory(str(folder)).Reload()
    return {
        (name, tag): [(event.step, event.value) for event in runs.Scalars(name, tag)]
        for name, tags in runs.Runs().items()
        for tag in tags["scalars"]
        if not tag.startswith("time/")
    }


def outcome(path):
    """All of a finished run that must not differ."""
    videos = {video.name: video.read_bytes() for video in path.rglob("videos/*")}
    runs = {str(run.relative_to(path)): (final_hashes(run), history(run)) for run in runs_in(path)}
    return runs, points(path), videos


def check_kills(trials, folder, kind, wanted, names=("whole", "again"), each=4, **changes):
    """Kill `wanted` processes, up to `each` of each run, which then is left alone; returns how many runs it took."""
    for name in names:
        began = time.monotonic()
        code, said = trials.run("", *words(kind, **changes), folder / name)
        assert code == 0, said
        seconds = time.monotonic() - began
    expected = outcome(folder / "whole")
    assert all(outcome(folder / name) == expected for name in names)
    assert len(checkpoint.list_steps(runs_in(folder / "whole")[0] / "checkpoints")) == 3
    seed = random.SystemRandom().randrange(10**6)
    rng, killed, runs = random.Random(seed), 0, 0
    while killed < wanted:
        path, runs, told = folder / f"killed-{runs}", runs + 1, []
        for kill in (*[True] * each, False):
            begun = any(path.glob("*.json"))
            after = rng.uniform(0, 0.5 * seconds) if kill else None
            code, said = trials.run("", *(["resume", path] if begun else [*words(kind, **changes), path]), after=after)
            assert code == 0 or (kill and code == -9), said
            killed += code == -9
            told.append(said)
        assert outcome(path) == expected, "\n".join([f"kill times from seed {seed}", *told])
    return runs


@pytest.mark.parametrize("kind", [pytest.param(kind, marks=pytest.mark.faults) for kind in KINDS])
def test_killed_at_random_times_a_run_ends_in_the_same_bits(trials, tmp_path, kind):
    if kind == "drone" and find_spec("crazyflow") is None:
        pytest.skip("without crazyflow")
    wanted = often(COSTLY.get(kind, 26))
    runs = check_kills(trials, tmp_path, kind, wanted)
    print(f"{kind}: {runs} runs killed {wanted} times, 0 differ")


@pytest.mark.parametrize("kind", ["ddpg-sync", pytest.param("ppo-async", marks=pytest.mark.faults)])
def test_killed_now_and_then_a_run_ends_in_the_same_bits(trials, tmp_path, kind):
    check_kills(trials, tmp_path, kind, wanted=1, names=("whole",), each=1, total_steps=640)
