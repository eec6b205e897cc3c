"""Absurd numbers for every numeric field and verb, what a run does with them before its first update, and the answers.

A process of its own counts the answers: `count("systematic", "folder", 0, 1000, 1)` is the program of a fork.
"""

import itertools
import json
import math
import resource
import signal
from collections import Counter
from pathlib import Path

import numpy as np
import psutil
import torch
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

import lemniscate as lem
from lemniscate.algos import ALGORITHMS, find
from lemniscate.api import training
from lemniscate.cli import parse
from lemniscate.envs import registry
from lemniscate.errors import UserError
from lemniscate.run.config import _hints_of
from lemniscate.run.environments import device_for, evaluation_env, make_envs, require_memory
from lemniscate.run.fields import kinds_of

MEMORY, SECONDS = 2 * 10**9, 5
"""bytes that the cases of one process may take, and processor time of one case"""

VALUES = (
    *(0, -1, 1, 2, 10**6, 10**9, 10**12, 10**18, 2**63, 10**400, -(10**400), 10**5000, 0.5, 1e-300, 5e-324, 1e38),
    *(3.5e38, 1e300, -1e300, math.nan, math.inf, -math.inf, True, False, None, "", "x", "10**9", b"x", {}, object()),
    *((), (0,), (10**9,), (10**5, 10**5), (math.nan,), (10**400,), [1] * 2_000, 1j, np.float64("nan"), np.array([])),
    *(np.int64(2**63 - 1), np.uint64(2**64 - 1), torch.tensor(math.inf), torch.tensor([10**9, 1]), torch.zeros(0)),
)
WORDS = (
    "10**9",
    "1e400",
    "1" + "0" * 400,
    "9" * 5_000,
    "nan",
    "-inf",
    "1e-400",
    "1_000_000_000_000",
    "０",
    "1,2,,3",
    "",
)

numbers = st.one_of(
    st.integers(-3, 300),
    st.integers(),
    st.floats(),
    st.floats(0, 1),
    st.sampled_from([10**exponent for exponent in range(4, 20)]),
    st.sampled_from([value for value in VALUES[:24] if not isinstance(value, int) or abs(value) <= 10**400]),
)
texts = st.one_of(numbers.map(str), st.sampled_from(WORDS))


def numeric_fields(algorithm):
    """The names of the fields that hold a number, or several."""
    hints = _hints_of(find(algorithm).Config)

    def is_numeric(hint):
        kinds = kinds_of(hint)
        return bool({int, float} & kinds.keys()) or (tuple in kinds and is_numeric(kinds[tuple][0]))

    return [name for name, hint in hints.items() if is_numeric(hint)]


def base(algorithm):
    """Fields of a run that is made in a moment."""
    fields = {"num_envs": 2, "hidden": (8,), "evaluate_episodes": 1, "total_steps": 10**5}
    fields["backend"] = "own_simulator:Glide" if find(algorithm).Config.differentiates else "gymnasium"
    small = {
        "num_steps": 8,
        "minibatch_size": 16,
        "critic_minibatch_size": 16,
        "critic_hidden": (8,),
        "buffer_size": 1_000,
    }
    return {**fields, **{name: value for name, value in small.items() if name in find(algorithm).Config.names()}}


def env_of(algorithm):
    if find(algorithm).Config.differentiates:
        return "Glide-v0"
    return "Pendulum-v1" if algorithm in ("ddpg", "td3", "sac") else "CartPole-v1"


def begin(algorithm, config):
    """Do what a run does before its first update; of what is large and allowed, all but the making."""
    device = device_for(config.device)
    registry.require_room(config.env, config.num_envs, config.backend)
    env = evaluation_env(config, 1)
    env.close()
    require_memory(config, env.spec, device)
    widths = (*config.hidden, *(getattr(config, "critic_hidden", None) or ()))
    if config.num_envs <= 16 and max(widths, default=0) <= 500 and sum(config.memory_bytes(env.spec).values()) < 10**8:
        envs = make_envs(config)
        find(algorithm).init(config, env.spec, device)
        for made in envs:
            made.close()


def by_fields(algorithm, **fields):
    """From Python."""
    begin(algorithm, training.config_for(algorithm, env_of(algorithm), **{**base(algorithm), **fields}))


def by_words(algorithm, *words):
    """From the command line."""
    given = parse(["train", algorithm, "--env", env_of(algorithm), *words])
    by_fields(algorithm, **given.fields)


def systematic():
    """(function, its arguments) for every numeric field of every algorithm with every value."""
    for algorithm in ALGORITHMS:
        for name in numeric_fields(algorithm):
            yield from ((by_fields, (algorithm,), {name: value}) for value in VALUES)
            yield from ((by_words, (algorithm, f"--{name.replace('_', '-')}={word}"), {}) for word in WORDS)


class Accepted(Exception):
    """What stops a case that would go on for long."""


def stop(obs):
    """A policy that stops the case where it would begin."""
    raise Accepted


def verbs(folder):
    """The other numbers that Python's verbs take, with every value; what is taken stops where it would begin."""
    for value in VALUES:
        yield lem.evaluate, (stop, "CartPole-v1"), {"episodes": value}
        yield lem.evaluate, (stop, "CartPole-v1"), {"seed": value}
        yield lem.watch, (stop, "CartPole-v1"), {"episodes": value, "video": folder / "video.gif"}
        yield lem.watch, (stop, "CartPole-v1"), {"seed": value, "video": folder / "video.gif"}
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


@st.composite
def drawn(draw):
    """The same at random, several fields at once."""
    algorithm = draw(st.sampled_from(ALGORITHMS if isinstance(ALGORITHMS, tuple) else list(ALGORITHMS)))
    names = draw(st.lists(st.sampled_from(numeric_fields(algorithm)), min_size=1, max_size=6, unique=True))
    if draw(st.booleans()):
        several = st.lists(numbers, max_size=3)
        return by_fields, (algorithm,), {name: draw(several if "hidden" in name else numbers) for name in names}
    return by_words, (algorithm, *(f"--{name.replace('_', '-')}={draw(texts)}" for name in names)), {}


def answer(function, args, fields):
    """Whether a case is taken or refused. Raises whatever is neither, an answer that is not one sentence included."""
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        function(*args, **fields)
    except Accepted:
        return "taken"
    except UserError as error:
        said = str(error)
        assert said.strip(), "no sentence"
        assert "\n" not in said, said
        assert len(said) < 700, said
        return "refused"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    return "taken"


def randomly(first, cases):
    """Answers of `cases` random cases, from the seed `first` on."""
    counts = Counter()

    @seed(first)
    @settings(
        max_examples=cases,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(drawn())
    def check(case):
        counts[answer(*case)] += 1

    check()
    return counts


def count(what, folder, first, last, every):
    """Print the answers of the cases `first`, `first + every`, … below `last`, with at most 2 GB more than there was."""
    most = psutil.Process().memory_info().vms + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    if what == "random":
        counts = randomly(first, last - first)
    else:
        counts = Counter()
        for case in itertools.islice(systematic() if what == "systematic" else verbs(Path(folder)), first, last, every):
            try:
                counts[answer(*case)] += 1
            except BaseException:
                print(f"{case[0].__name__} {case[1:]!s:.300}")
                raise
    resident = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    assert resident < MEMORY, f"{resident:,} bytes"
    print(json.dumps(counts))
