# ruff: noqa: E402  (JAX is imported after crazyflow's variable of the environment is set)
"""The race through gates: the presets over seeds on unseen tracks, crazyflow's own controller beside them, pictures.

.venv/bin/python benchmarks/race.py train --levels 0 2 --seeds 1 2 3 4 5
.venv/bin/python benchmarks/race.py train --algorithm shac,ppo --levels 0     SHAC, and PPO from there
.venv/bin/python benchmarks/race.py train --algorithm ppo,ppo --levels 2      PPO, and PPO from there, careful
.venv/bin/python benchmarks/race.py controller
.venv/bin/python benchmarks/race.py table
.venv/bin/python benchmarks/race.py levels          docs/images/gates_levels.png
"""

import argparse
import tempfile
from collections import defaultdict
from pathlib import Path

import numpy as np
from common import append, provenance, rows
from matplotlib.figure import Figure

import lemniscate as lem
from lemniscate.drones.crazyflow import _import, make_drones

_import()  # before JAX

import jax
import jax.numpy as jnp
from scipy.interpolate import CubicSpline

from lemniscate.drones import gates
from lemniscate.drones.drones import Drones

PRESETS = {0: ("gates", "gates-finish"), 2: ("gates-moved", "gates-moved-finish")}
"""of each level: the first, and that of an algorithm that goes on from there"""
NAMES = ("success", "lap_seconds", "gates_passed", "crashed")


def train(algorithm: str, level: int, seed: int) -> None:
    """Train the presets of a level, and race a hundred times on tracks that training has not seen."""
    with tempfile.TemporaryDirectory() as scratch:
        seconds, steps, before = 0.0, 0, {}
        names = algorithm.split(",")
        for name, preset in zip(names, PRESETS[level][: len(names)], strict=True):
            fields = {"preset": preset, "seed": seed, "run": f"{scratch}/{preset}", "progress": False, **before}
            run = lem.train(name, "DroneGates-v0", **fields)
            seconds, steps, before = seconds + run.seconds, steps + run.policy.step, {"warm_start": fields["run"]}
        found = lem.evaluate(run.policy, episodes=100, seed=1_000 + seed)
    row = {"algorithm": algorithm, "level": level, "seed": seed, "seconds": seconds, "steps": steps}
    append("race", row | {name: found.measures.get(name) for name in NAMES} | provenance())
    print(row, found.measures, flush=True)


class OnBoard(gates.DroneGates):
    """The race, flown by crazyflow's controller of states: an action is a position, a velocity, an acceleration."""

    controls = ("state",)

    def _apply_action(self, action: jax.Array) -> None:
        upright = jnp.broadcast_to(jnp.array((0, 0, 0, 1, 0, 0, 0), jnp.float32), (len(action), 7))
        self.sim.state_control(jnp.concatenate([action, upright], axis=1)[:, None])


WAY = np.array([
    (-1.3, 0.7, 0.4), (-0.3, 0.5, 0.65), (0.5, 0.25, 0.7), (0.85, -0.05, 0.75), (1.35, 0.0, 0.9), (1.45, 0.45, 1.15),
    (1.05, 0.75, 1.2), (0.7, 1.05, 1.2), (0.3, 0.9, 1.15), (-0.1, 0.4, 1.0), (-0.55, -0.1, 0.75), (-1.0, -0.25, 0.7),
    (-1.3, -0.5, 0.8), (-1.2, -0.9, 1.0), (-0.6, -1.0, 1.15), (-0.25, -0.8, 1.2), (0.0, -0.75, 1.2), (0.4, -0.75, 1.2),
])  # fmt: skip
"""points of a way through the course's four gates, past its obstacles, set by hand, m"""


def spline(start: np.ndarray, pace: float) -> CubicSpline:
    """A curve over time from a start along the way, at a pace in m/s."""
    points = np.concatenate([start[None], WAY])
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return CubicSpline(np.cumsum([0, *np.maximum(lengths / pace, 0.1)]), points, bc_type="clamped")


def controller(level: int, pace: float, races: int = 100) -> None:
    """Race along a spline through the track as it is before a level moves it."""
    env = OnBoard(level, control="state", num_envs=races)
    drones = Drones(env, {})
    state, _, _ = drones.reset(drones.init(jax.random.key(1_000)), jnp.ones(races, bool), jnp.array(False))
    curves = [spline(start, pace) for start in np.asarray(state[1]["_start"])]

    @jax.jit
    def step(state, goal):
        with drones._at(state):
            env._apply_action(goal)
            env.sim.step(env.n_substeps)
            env.advance(jnp.zeros((races, 4)))
            return (*drones._take(), state[2]), env.terminated(), env.measures()

    going, passed, laps = np.ones(races, bool), np.zeros(races), list[float]()
    for number in range(drones.episode_steps):
        times = [min((number + 1) / 50, curve.x[-1]) for curve in curves]
        goal = np.array([[*c(t), *c(t, 1), *c(t, 2)] for c, t in zip(curves, times, strict=True)], np.float32)
        state, terminated, measures = step(state, goal)
        ended = going & np.asarray(terminated)
        passed = np.where(going, np.asarray(measures["gates_passed"]), passed)
        laps += list(np.asarray(measures["lap_seconds"])[ended & (passed == 4)])
        going &= ~ended
        if not going.any():
            break
    mean = np.mean(laps) if laps else np.nan
    print(f"level {level}, {pace} m/s: {len(laps) / races:.0%} in {mean:.2f} s, {passed.mean():.2f} gates", flush=True)


def table() -> None:
    """Means over seeds, and the worst seed."""
    by_level = defaultdict(dict)
    for row in rows("race"):
        by_level[row.get("algorithm", "ppo"), row["level"]][row["seed"]] = row
    for (algorithm, level), seeds in sorted(by_level.items()):
        success, laps = ([row[name] for row in seeds.values()] for name in ("success", "lap_seconds"))
        seconds = np.mean([row["seconds"] for row in seeds.values()])
        laps = [lap for lap in laps if lap is not None]
        reached = f"{np.mean(success):.1%} | {min(success):.0%} | {np.mean(laps):.2f}"
        print(f"| {algorithm} | {level} | {len(seeds)} | {reached} | {seconds:.0f} |")


def levels(file: Path) -> None:
    """Histograms of what the levels draw, over 2,048 races each."""
    figure = Figure(figsize=(9, 6), layout="constrained")
    ranges = {
        "mass / g": (37, 50),
        "start x / m": (-2.2, 2.2),
        "gate 1 x / m": (-2.3, 2.3),
        "gate 1 yaw / rad": (-4, 4),
    }
    axes = figure.subplots(4, len(ranges), sharex="col")
    for level in range(4):
        drones = make_drones("DroneGates-v0", 2_048, "cpu", {"level": level}, None, {})
        (data, arrays, _), *_ = drones.reset(drones.init(jax.random.key(0)), jnp.ones(2_048, bool), jnp.array(False))
        gate = arrays["_gates"][:, 0]
        drawn = (1e3 * data.params.mass.ravel(), data.states.pos[:, 0, 0], gate[:, 0], gate[:, 5])
        for axis, (name, ends), values in zip(axes[level], ranges.items(), drawn, strict=True):
            axis.hist(np.asarray(values), bins=80, range=ends, color="#1f5fa8")
            axis.set(xlim=ends, yticks=[], xlabel=name if level == 3 else "")
            axis.spines[["top", "right", "left"]].set_visible(False)
        axes[level, 0].set_ylabel(f"level {level}")
    figure.savefig(file, dpi=110)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["train", "controller", "table", "levels"])
    parser.add_argument("--levels", nargs="+", type=int, default=[0, 2])
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3, 4, 5])
    parser.add_argument("--algorithm", default="ppo")
    given = parser.parse_args()
    if given.what == "train" and (others := set(given.levels) - set(PRESETS)):
        parser.error(f"level {min(others)} has no presets; levels {' and '.join(map(str, PRESETS))} have")
    for level in given.levels if given.what in ("train", "controller") else ():
        for seed in given.seeds if given.what == "train" else ():
            train(given.algorithm, level, seed)
        for pace in (0.5, 1.0, 1.5) if given.what == "controller" else ():
            controller(level, pace)
    if given.what == "table":
        table()
    if given.what == "levels":
        levels(Path(__file__).parents[1] / "docs/images/gates_levels.png")
