"""`preflight`: the margins of a policy, with one thing at a time other than in training."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch

from lemniscate.api.policy import Trained, TrainedPolicy, load, path_of
from lemniscate.envs import probe as probes
from lemniscate.envs import registry
from lemniscate.errors import UserError, export_line
from lemniscate.exporting.compiled import HostPolicy, host_compiler
from lemniscate.exporting.deployed import (
    Act,
    act_with,
    carried,
    difference_units,
    for_policy,
    input_size,
    memory_size,
)
from lemniscate.exporting.export import MANIFEST, commit
from lemniscate.margins.presentation import FAILS, FALLS_SHORT, draw, rows, sentences, smoothness_sentence
from lemniscate.margins.record import AxisMargins, margins_of, smoothness, worst_accepted
from lemniscate.margins.vector_probe import VectorProbe
from lemniscate.report.compare import table
from lemniscate.run.config import Natural, Range, checked
from lemniscate.run.directory import read_config
from lemniscate.run.environments import env_arguments
from lemniscate.run.evaluate import EVALUATION
from lemniscate.run.seeding import derive, torch_defaults
from lemniscate.system.console import say
from lemniscate.system.files import DamagedFileError, read_json, write_json
from lemniscate.system.machine import version

FORMAT = 1
Starts = Annotated[int, Range(4, 1000)]


@dataclass(frozen=True)
class Preflight:
    """The findings of a pre-flight.

    Attributes:
        step: of the policy.
        episodes: E, from as many starts, the same at every point; `seed` is theirs.
        compiled: the exported C acted.
        alive_means: the condition of an episode that counts as alive.
        nominal_return: mean return in the environment as it is.
        smoothness: of the actions in the environment as it is, where the time between them is known: `action_rate`,
            `fast_share`, `saturated_share`, as `lemniscate.margins.record.smoothness` measures them.
        sentences: for people.
        env_kwargs: arguments that were nominal here, though not in training.
    """

    env_id: str
    step: int
    episodes: int
    seed: int
    compiled: bool
    alive_means: str
    nominal_return: float
    axes: tuple[AxisMargins, ...]
    smoothness: dict[str, float] | None
    sentences: tuple[str, ...]
    env_kwargs: dict[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """One object of JSON; a margin is the deviation from the nominal value, on each side that was tried."""
        own = {name: value for name, value in vars(self).items() if name not in ("axes", "sentences")}
        axes = {one.axis.name: one.to_json() for one in self.axes}
        origin = {"lemniscate": version(), "commit": commit()}
        return {"preflight": FORMAT, **own, "axes": axes, "sentences": list(self.sentences), **origin}


@torch_defaults(grad=False)
def preflight(
    run: Trained,
    compiled: bool = False,
    episodes: int = 64,
    seed: int = 0,
    env_kwargs: Mapping[str, Any] | None = None,
    trust: bool = False,
) -> Preflight:
    """Let a policy act while one thing after the other differs from training, and find how much it bears.

    Drones are flown with late, lost and irregular actions, with late, noisy and biased observations, with other masses,
    inertias, motors and dynamics, in wind and from wider starts; conditions that training has drawn are nominal
    otherwise. Other environments have late and lost actions, noisy observations and, where MuJoCo simulates them, other
    masses and frictions. A margin ends where fewer than 95 % are alive: have not crashed; in environments that are no
    drones, have a return that is at most a tenth of the nominal mean below what 95 % of the nominal episodes reach.

    Writes `preflight.json` and `plots/preflight.png` into the run; a table and sentences go to standard error.

    Args:
        run: the directory of a run, or what `train` returned.
        compiled: let the exported C act, `policy.c` in the run's `export`.
        episodes: from as many starts at each point, which are the same at all.
        seed: of the starts.
        env_kwargs: arguments of the environment that are to be nominal here; of conditions that are ranges there is no
            axis.
        trust: as in `load`.

    Raises:
        UserError: no run; numbers out of range; an environment that cannot be made, is another now, or has no axis;
            with `compiled`, no export of this policy or no compiler. Nothing is written then.
    """
    episodes, seed = checked("episodes", episodes, Starts), checked("seed", seed, Natural)
    given = checked("env_kwargs", env_kwargs, dict | None) or {}
    folder = path_of(run)
    read_config(folder)
    policy = load(run, trust=trust)
    act = _compiled(policy, folder) if compiled else None
    probe = _probe(policy, episodes, given)
    # several threads wait for each other longer than a small network takes, if simulators run too
    torch.set_num_threads(1)
    nominal, flown = probe.fly(partial(_begin, policy, act), derive(seed, EVALUATION, 0))
    least = None if probe.ends_by_failure else worst_accepted(nominal)
    axes = tuple(margins_of(axis, flown[axis.name], least) for axis in probe.axes)
    said, smooth = [*sentences(axes, FAILS if least is None else FALLS_SHORT)], None
    if probe.period is not None and nominal.actions is not None:
        smooth = smoothness(nominal.actions, probe.period)
        said.append(smoothness_sentence(smooth))
    alive_means = "no crash" if least is None else f"a return of at least {least:.6g}"
    result = Preflight(
        env_id=policy.spec.env_id,
        step=policy.step,
        episodes=episodes,
        seed=seed,
        compiled=compiled,
        alive_means=alive_means,
        nominal_return=float(nominal.returns.mean()),
        axes=axes,
        smoothness=smooth,
        sentences=tuple(said),
        env_kwargs=given,
    )
    for line in [*table(rows(axes)), *said]:
        say(line)
    acting = f"{result.env_id}: {'the exported C' if compiled else 'the policy'} of step {result.step:,}"
    try:
        title = f"{acting}, {episodes} starts a point, alive is {alive_means}"
        draw(axes, title, folder / "plots" / "preflight.png")
        write_json(folder / "preflight.json", result.to_json())
    except OSError as error:
        raise UserError(f"{folder} cannot be written: {error.strerror or error}.") from error
    return result


def _compiled(policy: TrainedPolicy, run: Path) -> Act:
    """The C of a run's `export`, compiled on this machine.

    Raises:
        UserError: no export, a damaged one, or one of another step; no compiler, or one that refuses.
    """
    compiler, folder = host_compiler(), run / "export"
    if compiler is None:
        raise UserError("There is no C compiler here (cc, gcc, clang or CC), which --compiled needs.")
    try:
        manifest = read_json(folder / MANIFEST)
        step, digests = manifest["step"], manifest["files"]
        files = {name: (folder / name).read_text("utf-8") for name in ("policy.c", "policy.h")}
        if any(sha256(text.encode()).hexdigest() != digests[name] for name, text in files.items()):
            raise UserError(f"{folder} has been changed since it was written: {export_line(run)}")
    except (DamagedFileError, OSError, KeyError, TypeError, UnicodeDecodeError):
        raise UserError(f"There is no whole export of {run}: {export_line(run)}") from None
    if step != policy.step:
        raise UserError(f"{folder} is of step {step:,}, the policy of step {policy.step:,}: {export_line(run)}")
    act = HostPolicy(files, compiler).act
    inputs = input_size(policy.spec) + memory_size(policy)
    rows = np.random.default_rng(0).standard_normal((64, inputs)).astype(np.float32)
    true = act_with(policy)(rows)
    apart = (np.abs(act(rows) - true) / difference_units(policy.spec.action, true)).max(1)
    if np.quantile(apart, 0.9) > 1e-2:  # products in bfloat16 round a few rows the other way
        raise UserError(f"{folder} is of another policy: {export_line(run)}")
    return act


def _begin(policy: TrainedPolicy, act: Act | None) -> probes.Act:
    """The policy, or its C where `act` is that, at the beginning of episodes."""
    if not act and not memory_size(policy):
        return lambda obs: policy.module(obs).mode()
    acts = carried(act or act_with(policy), memory_size(policy))
    return lambda obs: for_policy(acts(obs.numpy()), policy.spec.action)


def _probe(policy: TrainedPolicy, episodes: int, given: Mapping[str, Any]) -> probes.Probe:
    """The environment. Raises `UserError` where it is another than in training, or has no axis."""
    arguments = env_arguments(policy.config)
    backend = arguments["backend"] or registry.backend_for(arguments["env"], arguments["wrappers"])
    own = registry.backend_class(backend)
    probe: probes.Probe | None = own.probe(arguments["env"], episodes, policy.config.env_kwargs, given)
    if probe is None:
        arguments["kwargs"] |= given
        probe = VectorProbe(starts=episodes, **arguments)
        if not (probe.axes and probe.spec.fits(policy.spec)):
            probe.close()
    if not probe.spec.fits(policy.spec):
        raise UserError(f"{policy.spec.env_id} has other spaces here than in training.")
    if not probe.axes:
        raise UserError(
            f"{policy.spec.env_id} has nothing that could be changed: masked actions, no numbers to observe."
        )
    return probe
