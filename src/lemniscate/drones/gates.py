# pyright: reportAttributeAccessIssue=false, reportIncompatibleMethodOverride=false, reportArgumentType=false
"""A race through gates: the course of the laboratory that crazyflow comes from, as one more of crazyflow's tasks.

Geometry, rules and levels are those of its racing course (learnsyslab/lsy_drone_racing). What a policy observes and is
rewarded for is ours, after Song et al. 2021 (arXiv:2103.08624) and Kaufmann et al. 2023 (Swift, Nature 620).
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
from crazyflow.control import Control
from crazyflow.envs.drone_env import DroneEnv
from crazyflow.sim import Sim
from crazyflow.sim.pipeline import append_fn, replace_fn
from crazyflow.utils import leaf_replace
from scipy.spatial.transform import Rotation

from lemniscate.errors import UserError, shown
from lemniscate.system.files import at_home

OPENING, FRAME = 0.40, 0.72
"""side of the square opening of a gate, and of its frame outside, m"""
PASSED = 0.45
"""side of the square about the centre within which a gate is passed, m"""
THICKNESS, STAND = 0.02, 0.10
"""of a frame; side of the square stand below it, m"""
OBSTACLE = np.array(((-0.015, -0.015, -1.5), (0.015, 0.015, 0.0)), np.float32)
"""lower and upper corner of an obstacle, a post, about its top, m"""
BODY = np.array((0.07, 0.07, 0.02), np.float32)
"""half of the sides of the box that touches, m; crazyflow's collision box"""
BODY_CENTRE = np.array((0.0, 0.0, 0.02), np.float32)
SEEN_FROM = 0.7
"""the horizontal distance from which on the true place of a gate or an obstacle is known, m"""
AT_START = 0.02
"""the horizontal distance from its start within which a drone may touch the ground, m"""
ACTION_NOISE, FORCE = 0.001, 0.1
"""standard deviation of the noise of actions (rad, N); the most of the random force, an axis, N"""
CAREFUL = 1.5
"""m/s that cost nothing while the true place of the next gate is not known"""
SPREAD = {
    "mass": 0.005,
    "inertia": 1e-6,
    "start": ((-0.1, -0.1, 0.0), (0.1, 0.1, 0.02)),
    "attitude": 0.1,
    "gate": (0.15, 0.15, 0.1, 0.05, 0.1, 0.2),
    "obstacle": (0.15, 0.15, 0.05),
}
"""the most by which a level changes what it draws: kg, kg m², m, rad; of gates x, y, z (m), roll, pitch, yaw (rad)"""
BODY_RATES = (10.0, 10.0, 6.0)
"""the most that can be commanded with `control="body_rate"`, rad/s"""
SPEED_AHEAD = 4.0
"""the most m/s of an episode that begins on its way: as fast as races get to a gate, so that they learn to go on"""
CANDIDATES = 64
"""places of which the first that fits is taken, where a track is drawn"""
APART = {
    "border": 0.5,
    "start": 1.0,
    "gates": 1.0,
    "obstacle_gate": 0.8,
    "obstacles": 0.3,
    "corridor": 0.5,
    "yaw": 0.75,
}
"""distances between what is drawn (m), and the most that a gate's yaw differs from the way to it (rad)"""


@dataclass(frozen=True)
class Track:
    """A course: gates [G, 6] (x, y, z, roll, pitch, yaw), obstacles [M, 3] (their tops), start [3], room [2, 3].

    `order` [K] are the gates in the order in which they are flown, from 0; `reverse` [K] those flown from +x to −x.
    """

    gates: np.ndarray
    obstacles: np.ndarray
    order: np.ndarray
    reverse: np.ndarray
    start: np.ndarray
    room: np.ndarray

    @property
    def stand(self) -> float:
        """The height of the stands, by which the highest gate reaches the floor wherever a level moves it, m."""
        return float(self.gates[:, 2].max()) - FRAME / 2 + SPREAD["gate"][2]


def read_track(file: str | Path | None = None) -> Track:
    """A track from a file as `gates.toml`, which is taken by default, or from its text. Raises `UserError` for none."""
    given = Path(__file__).with_name("gates.toml") if file is None else file
    text = given if isinstance(given, str) and "\n" in given else text_of_track(given)
    name = "The file" if text == given else given
    try:
        table = tomllib.loads(text)
        _table(table, "it", ("name", "order", "start", "room", "gates", "obstacles"))
        room = _table(table["room"], "room", ("low", "high"))
        low, high, start = (_three(room["low"], "low"), _three(room["high"], "high"), _three(table["start"], "start"))
        gates = _rows(table["gates"], "gates", ("roll", "pitch", "yaw"))
        obstacles, order = _rows(table.get("obstacles", []), "obstacles", ()), table["order"]
        if not (low < high).all() or any(((place < low) | (place > high)).any() for place in (start, *gates[:, :3])):
            raise ValueError("room must reach from low to high, in metres, with the start and all gates between")
        if (np.abs(gates[:, 3:]) > 6.3).any():
            raise ValueError("roll, pitch and yaw are radians, at most 2 π")
    except (KeyError, ValueError, OverflowError) as error:
        what = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
        raise UserError(f"{name} is no track: {what}; lemniscate/drones/gates.toml is an example.") from error
    right = isinstance(order, list) and all(type(gate) is int and 0 < abs(gate) <= len(gates) for gate in order)
    if not right or not order:
        raise UserError(
            f"{name}: order names gates from 1 to {len(gates)}, with a minus if in reverse, not {shown(order)}."
        )
    flown = np.array(order)
    return Track(gates, obstacles, np.abs(flown) - 1, flown < 0, start, np.stack([low, high]))


def text_of_track(file: object) -> str:
    """The text of a track's file, with a line break at its end. Raises `UserError` where it cannot be read."""
    if not isinstance(file, str | Path):
        raise UserError(f"track of DroneGates-v0 must be the path of a file, not {shown(file)}.")
    if not str(file):
        raise UserError("'' is no track: name a file, or leave track out.")
    try:
        return at_home(file).read_text("utf-8-sig") + "\n"
    except (OSError, ValueError) as error:
        raise UserError(f"{file} is no track: {error}; one looks as lemniscate/drones/gates.toml does.") from error


def _table(given: Any, name: str, known: tuple[str, ...]) -> dict[str, Any]:
    """A table of a file as it is. Raises `ValueError` for anything else, and for a key that is not `known`."""
    if not isinstance(given, dict):
        raise ValueError(f"{name} must be a table, not {shown(given)}")
    if strange := [key for key in given if key not in known]:
        raise ValueError(f"{name} has {strange[0]!r}, and may have {', '.join(known)}")
    return given


def _three(given: Any, name: str) -> np.ndarray:
    """Three numbers. Raises `ValueError` for anything else."""
    if not isinstance(given, list) or [type(x) in (int, float) and math.isfinite(x) for x in given] != [True] * 3:
        raise ValueError(f"{name} must be three numbers, not {shown(given)}")
    return np.array(given, np.float32)


def _rows(given: Any, name: str, angles: tuple[str, ...]) -> np.ndarray:
    """The positions and angles of tables, [M, 3 or 6]. Raises `ValueError` for other tables."""
    if not isinstance(given, list):
        raise ValueError(f"{name} are tables, each below [[{name}]], not {shown(given)}")
    rows = []
    for number, one in enumerate(given, 1):
        row = _table(one, f"{name} {number}", ("name", "position", *angles))
        turned = _three([row.get(angle, 0.0) for angle in angles] or [0, 0, 0], f"what turns {name} {number}")
        rows.append([*_three(row["position"], f"position of {name} {number}"), *turned[: len(angles)]])
    return np.array(rows, np.float32).reshape(-1, 3 + len(angles))


def out_of(matrix: jax.Array, vector: Any) -> jax.Array:
    """Vectors [..., 3] of a frame in the world's; a sum and not a product of matrices, which XLA would not fuse."""
    return (matrix * vector[..., None, :]).sum(-1)


def to_frame(matrix: jax.Array, vector: Any) -> jax.Array:
    """Vectors [..., 3] of the world in a frame."""
    return (matrix * vector[..., :, None]).sum(-2)


def passes(before: jax.Array, now: jax.Array) -> jax.Array:
    """Whether a step passes a gate, given where it began and ended in the gate's frame, [..., 3] each.

    The line between both cuts the gate's plane from −x to +x within `PASSED` / 2 of the centre in y and in z.
    """
    share = -before[..., :1] / jnp.where(now[..., :1] == before[..., :1], 1.0, now[..., :1] - before[..., :1])
    cut = before[..., 1:] + share * (now[..., 1:] - before[..., 1:])
    return (before[..., 0] < 0) & (now[..., 0] >= 0) & (jnp.abs(cut) < PASSED / 2).all(-1)


def way_left(place: jax.Array) -> jax.Array:
    """The length of the way from a place in a gate's frame [..., 3] to its centre, in metres.

    In front of the gate it is straight, and what is aside of the gate's axis counts double; behind it, it goes around
    the frame on the nearest side and in front of it.
    """
    straight = jnp.linalg.norm(place * np.array((1, 2, 2), np.float32), axis=-1)
    far, front = FRAME / 2 + 0.15, 0.3
    sides = jnp.array([(0, far, 0), (0, -far, 0), (0, 0, far), (0, 0, -far)], jnp.float32)
    around = jnp.linalg.norm(place[..., None, :] - sides, axis=-1).min(-1) + math.hypot(2 * far, front) + front
    return jnp.where(place[..., 0] < 0, straight, around)


def touches(centre: jax.Array, turned: jax.Array, low: np.ndarray, high: np.ndarray) -> jax.Array:
    """Whether a drone at `centre` [..., 3], turned by [..., 3, 3], touches a box from `low` to `high`, in its frame.

    Two boxes are apart if and only if they are so along an edge of one, or across an edge of each: Gottschalk et al.
    1996 (OBBTree), section 5.
    """
    way, half = centre - (low + high) / 2, (high - low) / 2
    size = jnp.abs(turned) + 1e-5  # across parallel edges there is no direction: it must not look like one with a gap
    along_box = jnp.abs(way) - half - (size * BODY).sum(-1)
    along_body = jnp.abs(to_frame(turned, way)) - BODY - (size * half[..., None]).sum(-2)

    roll_rows, roll_columns = partial(jnp.roll, axis=-2), partial(jnp.roll, axis=-1)

    way, half = way[..., None], half[..., None]
    across = jnp.abs(roll_rows(way, -1) * roll_rows(turned, -2) - roll_rows(way, -2) * roll_rows(turned, -1))
    across -= roll_rows(half, -1) * roll_rows(size, -2) + roll_rows(half, -2) * roll_rows(size, -1)
    across -= roll_columns(BODY, -1) * roll_columns(size, -2) + roll_columns(BODY, -2) * roll_columns(size, -1)
    return (jnp.maximum(along_box, along_body).max(-1) < 0) & (across.max((-1, -2)) < 0)


def _boxes(stand: float) -> tuple[np.ndarray, np.ndarray]:
    """The boxes [5, 3] of a gate in its own frame, lower and upper corners: four beams, and a stand of that height."""
    inner, outer, thick, half = OPENING / 2, FRAME / 2, THICKNESS / 2, STAND / 2
    boxes = [
        ((-thick, -outer, inner), (thick, outer, outer)),
        ((-thick, -outer, -outer), (thick, outer, -inner)),
        ((-thick, inner, -outer), (thick, outer, outer)),
        ((-thick, -outer, -outer), (thick, -inner, outer)),
        ((-half, -half, -outer - stand), (half, half, -outer)),
    ]
    low, high = np.array(boxes, np.float32).swapaxes(0, 1)
    return low, high


class DroneGates(DroneEnv):
    """Fly through all gates of a track in their order, as fast as possible.

    An episode ends when the last gate is passed, when the drone touches a gate, an obstacle or the ground, leaves the
    room, or after 30 s. Between a control step's action and the drone there is noise of σ `ACTION_NOISE`; on the drone
    acts a force that is drawn anew 500 times a second, up to `FORCE` an axis.

    Levels: 0 always the same; 1 mass, inertia and start are drawn; 2 gates and obstacles too, and their true place is
    known once the drone has been within `SEEN_FROM` of them, the track's before; 3 the whole track is drawn.

    Observed after the drone's state: `gates` 15, of the next two gates the way from the drone to the centre (m) and
    the direction in which it is flown, then the drone's place in the frame of the next (m); `obstacles` 4, the way to
    the two nearest, x and y (m); `last_action` 4; `race` 3: the share of gates that is left, and whether the true place
    of the next two is known. But for the place, all is along the world's axes, as an attitude is commanded.

    The reward of a step is 3 for each metre of the way to the next gate's centre (`way_left`), 3 for a gate, −`crash`
    for a crash; less 0.05, 0.0005 |ω|² (rad²/s²), 0.01 for the squared change of the action and, while at levels 2 and
    3 the true place of the next gate is not known, 0.2 for the square of what is above `CAREFUL` of the speed.

    Args:
        level: 0, 1, 2 or 3.
        track: a file as `gates.toml`; the laboratory's course by default.
        control: of what an action is: "attitude" (roll, pitch, yaw) or "body_rate", beside the thrust of all rotors.
        crash: the cost of a crash; the larger, the slower and surer a policy flies.
        num_envs: N.
        max_episode_time: s.
        dynamics: crazyflow's; body rates need first_principles.
        drone: crazyflow's.
        freq: control steps in a second.
        device: of JAX.

    Raises:
        UserError: a level, a control, a track or a cost that is none.
    """

    controls: tuple[str, ...] = ("attitude", "body_rate")
    own_parameters = ("mass", "J", "J_inv")
    """crazyflow's parameters of which each drone has its own"""

    def __init__(
        self,
        level: int = 0,
        track: str | None = None,
        control: str = "attitude",
        crash: float = 6.0,
        *,
        num_envs: int = 1,
        max_episode_time: float = 30.0,
        dynamics: str = "first_principles",
        drone: str = "cf21B_500",
        freq: int = 50,
        device: str = "cpu",
    ) -> None:
        if level not in (0, 1, 2, 3) or isinstance(level, bool):
            raise UserError(f"level of DroneGates-v0 must be 0, 1, 2 or 3, not {shown(level)}.")
        if control not in self.controls:
            raise UserError(f"control of DroneGates-v0 must be attitude or body_rate, not {shown(control)}.")
        if control == "body_rate" and dynamics != "first_principles":
            raise UserError(f"control body_rate needs the dynamics first_principles, not {dynamics}.")
        if isinstance(crash, bool) or not isinstance(crash, int | float) or not 0 <= crash < math.inf:
            raise UserError(
                f"crash of DroneGates-v0 must be a number from 0 on, what a crash costs, not {shown(crash)}."
            )
        self.level, self.track, self.crash = level, read_track(track), float(crash)
        shared = {"num_envs": num_envs, "max_episode_time": max_episode_time, "drone": drone, "freq": freq}
        super().__init__(dynamics=dynamics, device=device, reset_randomization=_as_it_is, **shared)
        if control != "attitude":
            self._take_control(control, num_envs, device)
        integrate = self.sim.step_pipeline["integration"]
        replace_fn(self.sim.step_pipeline, lambda data: integrate_pushed(data, integrate), name="integration")
        self.sim.build_step_fn()
        params = self.sim.data.params
        self._nominal = np.asarray(params.mass), np.diagonal(np.asarray(params.J))
        observed = {"gates": 15, "obstacles": 4, "last_action": 4, "race": 3}
        parts = {name: gym.spaces.Box(-np.inf, np.inf, (size,)) for name, size in observed.items()}
        self.single_observation_space = gym.spaces.Dict({**self.single_observation_space.spaces, **parts})
        self._key = jax.random.key(0)
        start, gates, obstacles = self._course()
        vars(self).update(self._fresh(start[:, :3], (gates, obstacles), (gates, obstacles)))

    def _take_control(self, control: str, num_envs: int, device: str) -> None:
        """Simulate another control than that of attitudes; body rates without the terms that level the drone."""
        shared = {"drone": self.sim.drone, "device": device, "dynamics": self.sim.dynamics}
        sim = Sim(n_worlds=num_envs, control=Control(control), **shared)
        if (rates := sim.data.controls.body_rate) is not None:
            own = rates.replace(params={**rates.params, **{name: 0 * rates.params[name] for name in ("kR", "ki_m")}})
            sim.data = sim.data.replace(controls=sim.data.controls.replace(body_rate=own))
            sim.build_default_data()
            low, high = (np.array(bound) for bound in (self.single_action_space.low, self.single_action_space.high))
            low[:3], high[:3] = -np.array(BODY_RATES), BODY_RATES
            self.single_action_space = gym.spaces.Box(low, high)
        append_fn(sim.reset_pipeline, _as_it_is, name="reset_randomization")
        sim.build_reset_fn()
        self.sim = sim

    def _course(self) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Starts [N, 4] (x, y, z, yaw), gates [N, G, 6] and obstacles [N, M, 3] as the track has them."""
        parts = np.append(self.track.start, 0.0), self.track.gates, self.track.obstacles
        start, gates, obstacles = (jnp.tile(part, (self.num_envs, *[1] * part.ndim)) for part in parts)
        return start, gates, obstacles

    def _fresh(self, start: jax.Array, true: Sequence[jax.Array], expected: Sequence[jax.Array]) -> dict[str, Any]:
        """The arrays beside the simulator's state, at the start [N, 3] of a race: they are its state too.

        `true` are the gates and obstacles, `expected` what is known of them before they are seen.
        """
        n = self.num_envs
        return {
            "_gates": true[0],
            "_expected_gates": expected[0],
            "_obstacles": true[1],
            "_expected_obstacles": expected[1],
            "_gates_seen": jnp.zeros(true[0].shape[:2], bool),
            "_obstacles_seen": jnp.zeros(true[1].shape[:2], bool),
            "starts_around": start,
            "_start": start,  # where the drone itself has begun
            "_before": start,  # where it was a step ago
            "_target": jnp.zeros(n, jnp.int32),  # the number of gates that are passed
            "_whole": jnp.ones(n, bool),  # whether the race began at the start
            "_crashed": jnp.zeros(n, bool),
            "_gain": jnp.zeros(n),  # the reward of the step
            "_last_action": jnp.zeros((n, 4)),
        }

    # --- an episode's beginning -------------------------------------------------------------------------------------

    def _reset(self, mask: jax.Array) -> None:
        self.sim.reset(mask=mask)
        self._key, own, layout = jax.random.split(self._key, 3)
        start, *expected = self._layout(layout)
        n, counts = self.num_envs, (3, 3, 1, 3, 6 * len(self.track.gates), 3 * len(self.track.obstacles))
        drawn = jax.random.uniform(own, (n, sum(counts)), minval=-1.0, maxval=1.0)
        places, turns, mass, inertia, gates, obstacles = jnp.split(drawn, np.cumsum(counts)[:-1], axis=1)
        varied, moved = float(self.level >= 1), float(self.level >= 2)
        gates = expected[0] + moved * gates.reshape(n, -1, 6) * np.array(SPREAD["gate"])
        obstacles = expected[1] + moved * obstacles.reshape(n, -1, 3) * np.array(SPREAD["obstacle"])
        low, high = np.array(SPREAD["start"])
        pos = start[:, :3] + varied * (low + (places + 1) / 2 * (high - low))
        rpy = (varied * SPREAD["attitude"] * turns).at[:, 2].add(start[:, 3])
        nominal_mass, nominal_inertia = self._nominal
        mass = nominal_mass + varied * SPREAD["mass"] * mass[:, None]
        inertia = nominal_inertia + varied * SPREAD["inertia"] * inertia
        inertia = np.eye(3) * inertia[:, None, :, None]
        inverse = np.eye(3) / jnp.where(np.eye(3) > 0, inertia, 1)
        quat, data = Rotation.from_euler("xyz", rpy).as_quat(), self.sim.data
        states = leaf_replace(data.states, mask, pos=pos[:, None], quat=quat[:, None])
        params = leaf_replace(data.params, mask, mass=mass, J=inertia, J_inv=inverse)
        self.sim.data = data.replace(states=states, params=params)
        for name, value in self._fresh(start[:, :3], (gates, obstacles), expected).items():
            setattr(self, name, jnp.where(mask.reshape(-1, *[1] * (value.ndim - 1)), value, getattr(self, name)))

    def _layout(self, key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """The course of the level: the same for all, or at level 3 drawn."""
        track, n, course = self.track, self.num_envs, self._course()
        if self.level < 3:
            return course
        low, high = track.room[0, :2] + APART["border"], track.room[1, :2] - APART["border"]
        key, own, turn = jax.random.split(key, 3)
        at = jax.random.uniform(own, (n, 2), minval=low, maxval=high)
        yaw = jax.random.uniform(turn, (n, 1), minval=-math.pi / 2, maxval=math.pi / 2)
        start = jnp.concatenate([at, jnp.full((n, 1), track.start[2]), yaw], axis=1)
        yaws, obstacles, ways = list[jax.Array](), list[jax.Array](), list[tuple[jax.Array, jax.Array]]()

        def choose(key: jax.Array, from_gates: float, from_obstacles: float, wished: Callable) -> jax.Array:
            """The first place with room that is wished for, else the first with room, else that with the most room."""
            places = jax.random.uniform(key, (n, CANDIDATES, 2), minval=low, maxval=high)
            apart = [APART["start"]] + [from_gates] * len(ways) + [from_obstacles] * len(obstacles)
            others = zip([start[:, :2], *(gate for _, gate in ways), *obstacles], apart, strict=True)
            room = jnp.stack([jnp.linalg.norm(places - one[:, None], axis=-1) - least for one, least in others]).min(0)
            score = jnp.where(room > 0, 1.0 + wished(places), jnp.minimum(room, 0.0))
            return jnp.take_along_axis(places, score.argmax(1)[:, None, None], axis=1)[:, 0]

        def off_the_ways(places: jax.Array) -> Any:
            return jnp.stack([~_in_corridor(places, *way) for way in ways]).all(0) if ways else True

        for i in range(max(len(track.gates), len(track.obstacles))):
            key, one, two, three = jax.random.split(key, 4)
            if i < len(track.gates):
                place = choose(one, APART["gates"], APART["obstacle_gate"], off_the_ways)
                turn = jax.random.uniform(two, (n,), minval=-APART["yaw"], maxval=APART["yaw"])
                back = math.pi * bool(track.reverse[track.order == i][:1].any())  # it is flown through from +x
                yaws.append(jnp.arctan2(*(place - at).T[::-1]) + turn + back)
                ways.append((at, place))
                at = place
            if i < len(track.obstacles):
                on_the_way = partial(_in_corridor, start=ways[-1][0], end=ways[-1][1])
                obstacles.append(choose(three, APART["obstacle_gate"], APART["obstacles"], on_the_way))
        _, poses, tops = course
        poses = poses.at[..., :2].set(jnp.stack([gate for _, gate in ways], 1)).at[..., 3:5].set(0.0)
        poses = poses.at[..., 5].set(jnp.stack(yaws, 1))
        return start, poses, tops.at[..., :2].set(jnp.stack(obstacles, 1)) if obstacles else tops

    def begin(self, mask: jax.Array, ahead: jax.Array) -> None:
        """Let the masked drones begin where they are; those `ahead` on their way, behind a gate that they have passed.

        Ahead, what stands there differs from the track by a random share of what the level says, so that there is
        something to learn before the hardest races can be won.
        """
        self._key, which, where, hurried, fast, easier = jax.random.split(self._key, 6)
        n, count, data = self.num_envs, len(self.track.order), self.sim.data
        share = jnp.sqrt(jax.random.uniform(easier, (n, 1, 1)))
        for true, expected in (("_gates", self._expected_gates), ("_obstacles", self._expected_obstacles)):
            given = getattr(self, true)
            setattr(self, true, jnp.where(ahead[:, None, None], expected + share * (given - expected), given))
        target = jax.random.randint(which, (n,), 1, count) if count > 1 else jnp.zeros(n, jnp.int32)
        place, turned = self._frame(jnp.maximum(target - 1, 0), self._gates)
        pos = place + out_of(turned, jnp.array((0.25, 0.0, 0.0)) + _uniform(where, (n, 3), (0.1, 0.12, 0.12)))
        speed = jax.random.uniform(hurried, (n, 1), maxval=SPEED_AHEAD)
        vel = speed * turned[:, :, 0] + 0.5 * jax.random.normal(fast, (n, 3))
        states = leaf_replace(data.states, ahead, pos=pos[:, None], vel=vel[:, None])
        self.sim.data = data.replace(states=states)
        self._target = jnp.where(ahead, target, self._target)
        self._whole = jnp.where(mask, ~ahead, self._whole)
        self._start = jnp.where(mask[:, None], states.pos[:, 0], self._start)
        self._before = jnp.where(mask[:, None], states.pos[:, 0], self._before)
        self._look()

    # --- a step -----------------------------------------------------------------------------------------------------

    def _apply_action(self, action: jax.Array) -> None:
        noise = jax.random.normal(jax.random.fold_in(self._key, 1), action.shape)  # one for all of a control step
        noisy = jnp.clip(action, self.single_action_space.low, self.single_action_space.high) + ACTION_NOISE * noise
        send = self.sim.attitude_control if self.sim.control == Control.attitude else self.sim.body_rate_control
        send(noisy[:, None])

    def advance(self, action: jax.Array) -> None:
        """Take note of what a step with an action [N, 4] in [-1, 1] has brought: contacts, gates, what is seen."""
        states = self.sim.data.states
        self._key = jax.random.split(self._key, 1)[0]
        pos = states.pos[:, 0]
        self._crashed = self._touches(pos, Rotation.from_quat(states.quat[:, 0]).as_matrix()) | self._leaves(pos)
        place, turned = self._frame(self._target, self._gates)
        before, now = (to_frame(turned, at - place) for at in (self._before, pos))
        passed = passes(before, now) & ~self._crashed
        progress = way_left(before) - jnp.where(passed, -jnp.linalg.norm(now, axis=-1), way_left(now))
        self._target = self._target + passed
        self._before = pos
        self._look()
        rates = jnp.square(states.ang_vel[:, 0]).sum(-1)
        hurry = jnp.maximum(jnp.linalg.norm(states.vel[:, 0], axis=-1) - CAREFUL, 0.0)
        hurry = jnp.where(self._sees_next(0) | (self.level < 2), 0.0, hurry)
        change = jnp.square(action - self._last_action).sum(-1)
        self._gain = 3 * progress + 3.0 * passed - self.crash * self._crashed - 0.05 - 0.0005 * rates - 0.01 * change
        self._gain -= 0.2 * jnp.square(hurry)
        self._last_action = action

    def _look(self) -> None:
        """Know the true place of what is near."""
        here = self.sim.data.states.pos[:, :, :2]
        near = [jnp.linalg.norm(of[..., :2] - here, axis=-1) < SEEN_FROM for of in (self._gates, self._obstacles)]
        self._gates_seen, self._obstacles_seen = self._gates_seen | near[0], self._obstacles_seen | near[1]

    def _number(self, target: jax.Array) -> jax.Array:
        """Which gates are number `target` in the order, [N]; the last where there are no more."""
        return jnp.asarray(self.track.order)[jnp.clip(target, 0, len(self.track.order) - 1)]

    def _sees_next(self, ahead: int) -> jax.Array:
        """Whether the true place of the gate so many after the next is known, [N]."""
        return jnp.take_along_axis(self._gates_seen, self._number(self._target + ahead)[:, None], axis=1)[:, 0]

    def _frame(self, target: jax.Array, gates: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Centre [N, 3] and attitude [N, 3, 3] of the gates number `target` in the order, x in flight's direction."""
        pose = jnp.take_along_axis(gates, self._number(target)[:, None, None], axis=1)[:, 0]
        reverse = jnp.asarray(self.track.reverse)[jnp.clip(target, 0, len(self.track.order) - 1)]
        turn = jnp.where(reverse, -1.0, 1.0)
        flip = jnp.stack([turn, turn, jnp.ones_like(turn)], axis=-1)
        return pose[:, :3], Rotation.from_euler("xyz", pose[:, 3:]).as_matrix() * flip[:, None]

    def _leaves(self, pos: jax.Array) -> jax.Array:
        low, high = self.track.room
        grounded = pos[:, 2] < 0
        away = (jnp.abs(pos[:, :2] - self._start[:, :2]) > AT_START).any(-1)
        sinks = (low[2] > 0) & (pos[:, 2] < low[2])
        return (pos[:, :2] < low[:2]).any(-1) | (pos > high).any(-1) | (grounded & away) | sinks

    def _touches(self, pos: jax.Array, turned: jax.Array) -> jax.Array:
        """Whether the drone's box touches a gate's frame or stand, or an obstacle."""
        centre = pos + out_of(turned, BODY_CENTRE)
        frames = Rotation.from_euler("xyz", self._gates[..., 3:]).as_matrix()
        local = to_frame(frames, centre[:, None] - self._gates[..., :3])
        own = (frames[..., None] * turned[:, None, :, None]).sum(-3)
        gates = touches(local[:, :, None], own[:, :, None], *_boxes(self.track.stand))
        obstacles = touches(centre[:, None] - self._obstacles, turned[:, None], *OBSTACLE)
        return gates.any((1, 2)) | obstacles.any(1)

    def obs(self) -> dict[str, jax.Array]:
        """The drone's state, then `gates`, `obstacles`, `last_action` and `race`."""
        parts = super().obs()
        pos, n = parts["pos"], self.num_envs
        known = jnp.where(self._gates_seen[..., None], self._gates, self._expected_gates)
        ahead = [self._frame(self._target + i, known) for i in (0, 1)]
        seen = [part for at, frame in ahead for part in (at - pos, frame[..., 0])]
        parts["gates"] = jnp.concatenate([*seen, to_frame(ahead[0][1], pos - ahead[0][0])], axis=1)
        obstacles = jnp.where(self._obstacles_seen[..., None], self._obstacles, self._expected_obstacles)
        far = jnp.full((n, 2, 2), 5.0)  # where there are fewer than two
        way = jnp.concatenate([obstacles[..., :2] - pos[:, None, :2], far], axis=1)
        distance = jnp.linalg.norm(way, axis=-1)
        first = distance.argmin(1)
        second = jnp.where(jnp.arange(distance.shape[1]) == first[:, None], jnp.inf, distance).argmin(1)
        way = jnp.take_along_axis(way, jnp.stack([first, second], axis=1)[..., None], axis=1)
        parts["obstacles"] = way.reshape(n, -1)
        parts["last_action"] = self._last_action
        seen = [self._sees_next(ahead)[:, None] for ahead in (0, 1)]
        left = 1 - self._target[:, None] / len(self.track.order)
        parts["race"] = jnp.concatenate([left, *seen], axis=1).astype(jnp.float32)
        return parts

    def truth(self) -> jax.Array:
        """The privileged numbers [N, 6]: the ways from the believed to the true places of the next two gates, m."""
        true = [self._frame(self._target + i, self._gates)[0] for i in (0, 1)]
        known = jnp.where(self._gates_seen[..., None], self._gates, self._expected_gates)
        return jnp.concatenate([at - self._frame(self._target + i, known)[0] for i, at in enumerate(true)], axis=1)

    def reward(self) -> jax.Array:
        """The reward of the step that `advance` took note of, [N]."""
        return self._gain

    def terminated(self) -> jax.Array:
        """Whether the drone has crashed or finished, [N]."""
        return self._crashed | self._finished

    @property
    def _finished(self) -> jax.Array:
        return self._target >= len(self.track.order)

    def boxes(self, arrays: Mapping[str, jax.Array]) -> np.ndarray:
        """The boxes [N, B, 15] of a `Scene`, of races in the state of these arrays."""
        gates, obstacles = np.asarray(arrays["_gates"]), np.asarray(arrays["_obstacles"])
        turned = Rotation.from_euler("xyz", gates[..., 3:]).as_matrix()[:, :, None]
        level = np.broadcast_to(np.eye(3), (*obstacles.shape[:2], 1, 3, 3))
        standing = (gates, turned, _boxes(self.track.stand)), (obstacles, level, OBSTACLE[:, None])
        boxes = list[np.ndarray]()
        for at, frames, (low, high) in standing:
            centre = at[:, :, None, :3] + (frames * ((low + high) / 2)[:, None]).sum(-1)
            parts = centre, (high - low) / 2, frames.reshape(*frames.shape[:3], 9)
            each = [np.broadcast_to(part, (*centre.shape[:3], part.shape[-1])) for part in parts]
            boxes.append(np.concatenate(each, axis=-1).reshape(len(gates), -1, 15))
        return np.concatenate(boxes, axis=1)

    def measures(self) -> dict[str, jax.Array]:
        """`gates_passed`, `success`, `crashed` and `lap_seconds` of races that end here; of others not a number.

        A race that began on its way has none of them, and one that is not finished no `lap_seconds`.
        """
        ends = self._whole & (self.terminated() | self.truncated())
        parts = {"gates_passed": self._target, "success": self._finished, "crashed": self._crashed}
        found = {name: jnp.where(ends, value.astype(jnp.float32), jnp.nan) for name, value in parts.items()}
        return found | {"lap_seconds": jnp.where(ends & self._finished, self.sim.time[:, 0], jnp.nan)}


def _as_it_is(data: Any, _: Any, mask: jax.Array | None = None) -> Any:
    return data


def integrate_pushed(data: Any, integrate: Any) -> Any:
    """A step of the simulator with a random force of up to `FORCE` an axis on each drone besides the one there is."""
    key, own = jax.random.split(data.core.rng_key)
    force = data.states.force
    pushed = force + jax.random.uniform(own, force.shape, minval=-FORCE, maxval=FORCE)
    data = data.replace(states=data.states.replace(force=pushed), core=data.core.replace(rng_key=key))
    data = integrate(data)
    return data.replace(states=data.states.replace(force=force))


def _uniform(key: jax.Array, shape: tuple[int, ...], most: Any) -> jax.Array:
    return jnp.asarray(most) * jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)


def _in_corridor(places: jax.Array, start: jax.Array, end: jax.Array) -> jax.Array:
    """Whether places [N, C, 2] are within the corridor from `start` to `end`, [N, 2] each."""
    way, off = (end - start)[:, None], places - start[:, None]
    along = (off * way).sum(-1) / jnp.maximum((way * way).sum(-1), 1e-8)
    aside = jnp.linalg.norm(off - along[..., None] * way, axis=-1)
    return (along >= 0) & (along <= 1) & (aside < APART["corridor"])


gym.register(id="DroneGates-v0", vector_entry_point=DroneGates)
