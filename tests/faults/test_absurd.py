"""Absurd numbers: one sentence each, or a run that begins; no traceback, no crash, no memory, nothing left behind."""

import itertools
import json
import math
from collections import Counter

import pytest

import lemniscate as lem
from faults.absurd import base, by_fields, by_words, env_of, numeric_fields, systematic, verbs
from faults.runs import often
from forks import Forks
from lemniscate.algos import ALGORITHMS, find
from lemniscate.errors import UserError

TOTAL, PER_PROCESS = often(20_000), 1_000


@pytest.fixture(scope="module")
def processes():
    """A process that has the cases, from which those that answer them are forked."""
    forks = Forks("import faults.absurd")
    yield forks
    forks.close()


@pytest.mark.parametrize("total", [pytest.param(TOTAL, marks=pytest.mark.faults), 150])
def test_every_absurd_number_gets_one_sentence_or_a_run(tmp_path, processes, total):
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "file").touch()

    def counted(what, cases, every=1):
        """The answers of all these cases, in processes of 2 GB."""
        total = Counter()
        for first in range(0, cases, PER_PROCESS * every):
            program = f"count({what!r}, {str(tmp_path)!r}, {first}, {min(cases, first + PER_PROCESS * every)}, {every})"
            process = processes.start(f"from faults.absurd import count; {program}", tmp_path)
            said, errors = process.communicate()
            assert process.returncode == 0, (process.returncode, program, said, errors)
            total += Counter(json.loads(said.splitlines()[-1]))
        return total

    every_field, every_verb = (1, 1) if total == TOTAL else (197, 61)
    counts = counted("systematic", sum(1 for _ in systematic()), every_field)
    counts += counted("verbs", sum(1 for _ in verbs(tmp_path)), every_verb)
    counts += counted("random", total - counts.total())
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
        ("--clip 1e300", r"clip must be a number above 0, and at most 1e\+38, or a schedule 'FIRST>LAST' of two such numbers, not 1e\+300"),
        ("--evaluate-episodes 1e12", "evaluate_episodes must be a whole number from 1 to 1,000,000"),
        ("--threads 100000", "threads must be a whole number from 1 to 256"),
        ("--num-envs 1e6 --backend gymnasium-async", "1,000,000 × CartPole-v1 in the gymnasium-async backend take at"),
    ],
)  # fmt: skip
def test_numbers_that_crashed_once_are_answered(words, said):
    with pytest.raises(UserError, match=said):
        by_words("ppo", *words.split())


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
    small |= {
        "num_envs": 2,
        "hidden": (8,),
        "total_steps": 48,
        "evaluate_episodes": 1,
        "backend": base(algorithm)["backend"],
    }
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
