"""Absurd numbers: one sentence each, or a run that begins; no traceback, no crash, no memory, nothing left behind."""

import itertools
import math
from collections import Counter

import pytest
from hypothesis import HealthCheck, Phase, given, seed, settings

import lemniscate as lem
from faults.absurd import (
    VALUES,
    Accepted,
    answer,
    by_fields,
    by_words,
    drawn,
    env_of,
    in_own_process,
    numeric_fields,
    systematic,
)
from lemniscate.algos import ALGORITHMS, find
from lemniscate.errors import UserError

TOTAL, PER_PROCESS = 20_000, 1_000


def stop(obs):
    raise Accepted


def verbs(folder):
    """The other numbers that Python's verbs take, with every value; what is taken stops where it would begin."""
    (folder / "there").mkdir(exist_ok=True)
    (folder / "there" / "file").touch()
    for value in VALUES:
        yield lem.evaluate, (stop, "CartPole-v1"), {"episodes": value}
        yield lem.evaluate, (stop, "CartPole-v1"), {"seed": value}
        yield lem.watch, (stop, "CartPole-v1"), {"episodes": value, "video": folder / "film.gif"}
        yield lem.watch, (stop, "CartPole-v1"), {"seed": value, "video": folder / "film.gif"}
        yield lem.set_seeds, (value,), {}
        yield lem.make_vec, ("Countdown-v0", value), {}
        yield lem.train_sweep, ("ppo", "Countdown-v0", value), {"run": folder / "there", "num_envs": 2}
        yield lem.config_for, (value, "CartPole-v1"), {}
        yield lem.config_for, ("ppo", value), {}
        yield lem.config_for, ("ppo", "CartPole-v1", value), {}
        yield lem.train, ("ppo", "CartPole-v1"), {"track": value, "run": folder / "there"}
        yield lem.train, ("ppo", "CartPole-v1"), {"callbacks": [value], "run": folder / "there"}
        yield lem.train, ("ppo", "CartPole-v1"), {"env_kwargs": {"x": value}, "run": folder / "there"}
    for seeds in ("1-1000000000000", "1-" + "9" * 5_000, range(10**12), itertools.count(), "5-1", "nan", "1-1001"):
        yield lem.train_sweep, ("ppo", "Countdown-v0", seeds), {"run": folder / "there"}


def counted(cases):
    """The answers of these cases, in processes of 2 GB."""
    total = Counter()
    for chunk in chunks(cases):

        def work(counts, chunk=chunk):
            for case in chunk:
                try:
                    counts[answer(*case)] += 1
                except BaseException:
                    print(f"{case[0].__name__} {case[1:]!s:.300}")
                    raise

        total += in_own_process(work)
    return total


def chunks(cases):
    while chunk := list(itertools.islice(cases, PER_PROCESS)):
        yield chunk


def randomly(count, number):
    """The answers of `count` random cases."""

    def work(counts):
        @seed(number)
        @settings(
            max_examples=count,
            database=None,
            deadline=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        @given(drawn())
        def check(case):
            counts[answer(*case)] += 1

        check()

    return in_own_process(work)


@pytest.mark.parametrize("total", [pytest.param(TOTAL, marks=pytest.mark.faults), 150])
def test_every_absurd_number_gets_one_sentence_or_a_run(tmp_path, monkeypatch, total):
    monkeypatch.chdir(tmp_path)
    every = 1 if total == TOTAL else 197
    counts = counted(itertools.islice(systematic(), 0, None, every))
    counts += counted(itertools.islice(verbs(tmp_path), 0, None, 1 if total == TOTAL else 61))
    for number in itertools.count():
        left = total - counts.total()
        if left <= 0:
            break
        counts += randomly(min(left, PER_PROCESS), number)
    assert counts["taken"] > total / 20
    assert {path.name for path in tmp_path.rglob("*")} == {"there", "file"}
    print(
        f"{counts.total():,} configurations: {counts['refused']:,} sentences, {counts['taken']:,} taken, 0 tracebacks,"
    )
    print("0 crashes, memory below 2 GB, no answer after more than 5 s, nothing left behind")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--num-envs 1000000000", "num_envs must be a whole number from 1 to 1,000,000, not 1000000000"),
        ("--num-steps 1e12", r"This run takes at least [\d,]+ MB, of which .* are for num_steps 1000000000000; .*choose num_steps at most \d"),
        ("--hidden 1000000000", "hidden must be a whole number from 1 to 1,000,000"),
        ("--hidden 100000 100000", r"at least [\d,]+ MB, of which [\d,]+ MB are for hidden .* choose a smaller hidden"),
        (f"--total-steps 1{'0' * 400}", r"at least 1, and at most 1e\+15, not a number of 401 digits"),
        ("--clip 1e300", r"clip must be a number above 0, and at most 1e\+38, not 1e\+300"),
        ("--evaluate-episodes 1e12", "evaluate_episodes must be a whole number from 1 to 1,000,000"),
        ("--threads 100000", "threads must be a whole number from 1 to 1,024"),
        ("--num-envs 1e6 --backend gymnasium-async", "1,000,000 × CartPole-v1 in the gymnasium-async backend take at"),
    ],
)  # fmt: skip
def test_numbers_that_crashed_once_are_answered(words, said):
    with pytest.raises(UserError, match=said):
        by_words("ppo", *words.split())


def test_threads_are_bounded_by_the_machine():
    with pytest.raises(UserError, match=r"threads is 1,024, and this machine has \d+ processors: choose at most"):
        by_fields("ppo", threads=1024)


def test_off_policy_memory_is_estimated_before_it_is_taken():
    for fields, said in (
        (
            {"buffer_size": 10**12, "total_steps": 10**12},
            "for buffer_size 1000000000000; .* choose buffer_size at most",
        ),
        ({"num_updates": 10**12}, "for num_updates 1000000000000; .* choose num_updates at most"),
        ({"log_every": 10**13}, "for log_every 10000000000000; .* choose log_every at most"),
    ):
        with pytest.raises(UserError, match=said):
            by_fields("sac", **fields)


def extremes(algorithm):
    """Each field of real numbers at the ends of what it takes."""
    config = find(algorithm).Config
    for name in numeric_fields(algorithm):
        for value in (1e38, 1e30, 5e-324, 0.0, 1.0):
            if isinstance(getattr(config(), name), float | None):
                yield name, value


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("every", [pytest.param(1, marks=pytest.mark.faults), 31])
def test_extreme_numbers_that_are_taken_are_trained_with(tmp_path, algorithm, every):
    counts, said = Counter(), []
    off_policy = {"learning_starts": 16, "log_every": 16, "batch_size": 8, "critic_hidden": (8,)}
    on_policy = {"num_steps": 8, "hidden": (8,)} | {
        name: 8 for name in ("minibatch_size", "critic_minibatch_size") if name in find(algorithm).Config.names()
    }
    small = off_policy if algorithm in ("ddpg", "td3", "sac") else on_policy
    small |= {"num_envs": 2, "hidden": (8,), "total_steps": 48, "evaluate_episodes": 1, "backend": "gymnasium"}
    for number, (name, value) in enumerate(itertools.islice(extremes(algorithm), 0, None, every)):
        run = tmp_path / str(number)
        try:
            trained = lem.train(algorithm, env_of(algorithm), run=run, progress=False, **{**small, name: value})
        except UserError:
            counts["refused"] += 1
            assert not run.exists()
        except lem.NonFiniteError as error:
            counts["stopped"] += 1
            said.append(str(error))
        else:
            counts["finished"] += 1
            tensors = trained.policy.networks.state_dict().values()
            assert all(math.isfinite(tensor.double().abs().max()) for tensor in tensors if tensor.numel())
    assert all("step" in sentence for sentence in said), said
    print(f"{algorithm}: {dict(counts)}, 0 tracebacks")
