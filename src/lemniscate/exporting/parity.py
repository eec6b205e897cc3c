"""`parity.json`: how far the exported policies are from the policy itself, where they act, and what they cost."""

import platform
import timeit
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from torch import Tensor

from lemniscate.api.policy import TrainedPolicy
from lemniscate.envs.backend import Interface
from lemniscate.errors import UserError, is_installed, missing_extra
from lemniscate.exporting import compiled
from lemniscate.exporting.compiled import CORE, EMULATOR, TARGET_COMPILER, HostPolicy
from lemniscate.exporting.deployed import Act, act_with, carried, difference_units, for_policy, input_size, memory_size
from lemniscate.exporting.onnx_model import onnx_act
from lemniscate.exporting.translation import Program
from lemniscate.maths import Deterministic
from lemniscate.nn.normalizer import NormByPart, RunningNorm
from lemniscate.run.environments import evaluation_env
from lemniscate.run.evaluate import play_episodes
from lemniscate.spec import Action, Box

ENVIRONMENTS, ROWS, TESTS = 16, 10_000, 64
"""environments side by side; observations at least; the number of them that the self-test has"""
EDGES = 8
"""further observations of the self-test, for the clips"""
TOLERANCE, BFLOAT16_TOLERANCE = 1e-5, 0.05
"""of `difference_units`; with bfloat16 a sum in another order is sometimes rounded the other way, to the next number"""
INSTRUCTIONS = 10**9
"""the most instructions that a simulation of the target executes, in some ten seconds"""


@dataclass(frozen=True)
class Flights:
    """What was seen: rows [T, N, O] float32, and whether each begins an episode, [T, N]."""

    obs: np.ndarray
    begins: np.ndarray

    def actions(self, act: Act, memory: int) -> np.ndarray:
        """The actions at all rows in their order, [T · N, A], of a policy that carries its own memory, of K numbers."""
        acts = carried(act, memory)
        return np.concatenate([acts(*step) for step in zip(self.obs, self.begins, strict=True)])

    def rows(self, act: Act, memory: int) -> np.ndarray:
        """Each row with what `act` remembers there, [T · N, O + K]."""
        seen = list[np.ndarray]()

        def watched(rows: np.ndarray) -> np.ndarray:
            seen.append(rows)
            return act(rows)

        self.actions(watched, memory)
        return np.concatenate(seen)


def fly(policy: TrainedPolicy, act: Act, rows: int = ROWS, seed: int = 0) -> tuple[Flights, Interface]:
    """Let `act` act in the environment of a policy's training until it has seen `rows` observations.

    Returns:
        The observations, and the meaning of the environment's numbers.

    Raises:
        UserError: the environment cannot be made, or has other spaces now.
    """
    env = evaluation_env(policy.config, ENVIRONMENTS)
    size, seen, begun = input_size(policy.spec), list[np.ndarray](), [np.ones(env.num_envs, bool)]
    stride = max(1, env.num_envs // ENVIRONMENTS)  # of many, all would be seen in the same few steps
    acts = carried(act, memory_size(policy))

    def driver(obs: Tensor) -> Deterministic:
        given = np.ascontiguousarray(obs[:, :size].numpy())  # without what is privileged
        return Deterministic(for_policy(acts(given, begun[-1]), policy.spec.action))

    try:
        if not env.spec.fits(policy.spec):
            raise UserError(f"{policy.spec.env_id} has other spaces here than in training.")
        for obs, _, step, _ in play_episodes(driver, env, episodes=10**9, seed=seed):
            seen.append(obs[::stride, :size].numpy().copy())
            if sum(map(len, seen)) >= rows:
                break
            begun.append((step.terminated | step.truncated | ~step.valid).numpy())
        return Flights(np.stack(seen), np.stack(begun)[:, ::stride]), env.backend.interface
    finally:
        env.close()


def self_tests(policy: TrainedPolicy, obs: np.ndarray) -> np.ndarray:
    """The rows of the self-test, [S, O + K]: `TESTS` from all over the flights, then `EDGES` for the clips.

    Each of the latter is a real one with one number far outside of what was seen, so that a forgotten clip shows. There
    are none where nothing is clipped. With discrete actions, observations at which rounding could decide are left out.
    """
    obs = obs if isinstance(policy.spec.action, Box) else obs[_clear(policy, obs)]
    real = obs[np.linspace(0, len(obs) - 1, TESTS).round().astype(int)]
    normalizer, action = policy.module.normalizer, policy.spec.action
    size = policy.spec.observation_size
    if isinstance(normalizer, NormByPart) and memory_size(policy):
        normalizer = normalizer.parts[0]
    if isinstance(normalizer, RunningNorm):
        mean, std = normalizer.mean.numpy(), normalizer.var.numpy() ** 0.5
        far = 3 * normalizer.clip * (std + 1e-4)
    elif isinstance(action, Box) and np.isfinite([*action.low, *action.high]).all():
        mean, far = obs[:, :size].mean(0), 10 * np.abs(obs[:, :size]).max(0) + 1
    else:
        return real
    edges = real[:: TESTS // EDGES].copy()
    for row, column in enumerate(np.linspace(0, size - 1, EDGES).round().astype(int)):
        edges[row, column] = (mean + (-1) ** row * far)[column]
    edges = edges if isinstance(action, Box) else edges[_clear(policy, edges)]
    return np.concatenate([real, edges]).astype(np.float32)


def _clear(policy: TrainedPolicy, obs: np.ndarray) -> np.ndarray:
    """[R], whether a slightly different observation has the same action; all where that holds for none."""
    act, memory = act_with(policy), memory_size(policy)
    same = [act(obs * np.float32(factor)) == act(obs) for factor in (0.99999, 1.00001)]
    clear = np.logical_and(*same)[:, : same[0].shape[1] - memory].all(1)
    return clear if clear.any() else ~clear


def parity(
    program: Program,
    action: Action,
    act: Act,
    flights: Flights,
    files: Mapping[str, str],
    model: bytes | None,
    host: HostPolicy | str,
) -> dict[str, Any]:
    """The record; `missing` has a sentence for everything that could not be compared.

    Compared with `act`, the policy itself with its kind of actions, at the observations of `flights`: `model`, which is
    `policy.onnx`, and the C in `files`, which is compiled here as `host`; else that is the sentence on why not. Of a
    policy with a memory, each carries its own through the flights too, `over_episodes`.
    """
    obs = flights.rows(act, program.memory_size)
    true, tolerance = act(obs), BFLOAT16_TOLERANCE if program.is_rounded else TOLERANCE
    units = difference_units(action, true)
    compared_with = partial(compare, units=units, tolerance=tolerance)
    costs: dict[str, float | None] = {"c": None, "onnxruntime": None, "torch": nanoseconds(lambda: act(obs[:1]))}
    record: dict[str, Any] = {"observations": len(obs), "tolerance": tolerance, "difference_units": units.tolist()}
    record |= {"onnx": None, "c_host": None}

    def carries(copy: Act) -> dict[str, Any]:
        if not program.memory:
            return {}
        own, its = (flights.actions(each, program.memory_size) for each in (act, copy))
        return {"over_episodes": compare(its, own, units[: own.shape[1]], tolerance)["max_difference"]}

    left_out = {"onnx": "policy.onnx is left out", "onnxruntime": "policy.onnx is not compared"}
    missing = [f"{missing_extra(name, 'export')}; {what}." for name, what in left_out.items() if not is_installed(name)]
    if model is not None and is_installed("onnxruntime"):
        run, version = onnx_act(model)
        record["onnx"] = {**compared_with(run(obs), true), **carries(run), "onnxruntime": version}
        costs["onnxruntime"] = nanoseconds(lambda: run(obs[:1]))
    if isinstance(host, str):
        missing.append(host)
    else:
        compared = compared_with(host.act(obs), true)
        record["c_host"] = {**compared, **carries(host.act), "self_test": host.self_test(), "compiler": host.compiler}
        costs["c"] = nanoseconds(lambda: host.act(obs)) / len(obs)
    record["c_cortex_m4f"], said = _run_on_target(program, files, obs, true, compared_with)
    record["multiplications"] = program.multiplications
    record["ns_per_action"] = {name: cost and round(cost) for name, cost in costs.items()}
    record["ns_are"] = "C in a loop in C, the others called from Python with one observation, all on one core"
    return {**record, "machine": platform.machine(), "missing": missing + said}


def nanoseconds(call: Callable[[], object], calls: int = 20) -> float:
    """The time of a call: the least of several, since anything else on the machine only adds to it."""
    return 1e9 * min(timeit.repeat(call, number=1, repeat=calls))


def compare(actions: np.ndarray, true: np.ndarray, units: np.ndarray, tolerance: float) -> dict[str, Any]:
    """The largest difference of actions [R, A] from the true ones, as a share of `units` [A] and in their own unit."""
    difference = np.abs(actions.astype(np.float64) - true)
    largest, shares = float(difference.max()), difference / units
    return {
        "observations": len(actions),
        "max_difference": float(shares.max()),
        "max_abs_difference": largest,
        "above_tolerance": int((shares.max(1) > tolerance).sum()),
    }


def _run_on_target(
    program: Program, files: Mapping[str, str], obs: np.ndarray, true: np.ndarray, compared_with: Callable[..., Any]
) -> tuple[dict[str, Any] | None, list[str]]:
    """The figures of a Cortex-M4F, and a sentence for what is not installed."""
    absent = compiled.missing_target_tools()
    if TARGET_COMPILER in absent:
        return None, [
            f"{TARGET_COMPILER} is not installed: nothing is measured on the target"
            " (Debian: gcc-arm-none-eabi and libnewlib-arm-none-eabi)."
        ]
    command = " ".join((TARGET_COMPILER, *CORE))
    try:
        record: dict[str, Any] = {**compiled.target_sizes(files), "compiled_with": command}
    except UserError as error:
        return None, [f"Nothing is measured on the target: {error}"]
    if absent:
        missing = f"{EMULATOR} is not installed: policy.c is not run on the target (Debian: qemu-system-arm)."
        return record, [missing]
    rows = min(len(obs), max(64, INSTRUCTIONS // (8 * program.multiplications + 10_000)))
    try:
        actions, self_test, instructions = compiled.simulate(files, obs[:rows], true.shape[1])
    except UserError as error:
        return record, [f"policy.c is not run on the target: {error}"]
    record |= compared_with(actions, true[: len(actions)])
    return {**record, "self_test": self_test, "instructions_per_call": instructions}, []


def sentences(record: Mapping[str, Any]) -> list[str]:
    """The record as sentences for a person."""
    names = {"onnx": "ONNX", "c_host": "C", "c_cortex_m4f": "C on the simulated Cortex-M4F"}
    compared = {name: record[key] for key, name in names.items() if (record[key] or {}).get("observations")}
    said, share = list[str](), "" if set(record["difference_units"]) == {1.0} else " of an action's size"
    for name, each in compared.items():
        largest = each["max_difference"]
        distance = f"differs from the policy by at most {largest:.1e}{share}" if largest else "is exact"
        said.append(f"{name} {distance} at {each['observations']:,} observations.")
        if "over_episodes" in each:
            said.append(f"With a memory of its own over whole episodes, {name} differs by {each['over_episodes']:.1e}.")
    if sizes := record["c_cortex_m4f"]:
        instructions = sizes.get("instructions_per_call")
        said.append(
            f"On a Cortex-M4F: {sizes['flash_bytes']:,} bytes of flash, {sizes['ram_bytes']:,} of RAM"
            + (f", {instructions:,} instructions a call." if instructions else ".")
        )
    for name, each in compared.items():
        if each["above_tolerance"]:
            above = f"At {each['above_tolerance']:,} of these observations"
            said.append(f"{above} {name} differs by more than {record['tolerance']:g}{share}, the tolerance.")
    return [*said, *record["missing"]]
