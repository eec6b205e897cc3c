# pyright: reportAttributeAccessIssue=false, reportIncompatibleMethodOverride=false, reportArgumentType=false
"""A race through gates: the course of the laboratory that crazyflow comes from, as one more of crazyflow's tasks.

Geometry, rules and levels are those of its racing course (learnsyslab/lsy_drone_racing). What a policy observes and is
rewarded for is ours, after Song et al. 2021 (arXiv:2103.08624) and Kaufmann et al. 2023 (Swift, Nature 620).
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping
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
from gymnasium.vector.utils import batch_space
from scipy.spatial.transform import Rotation

from lemniscate.errors import UserError, shown

OPENING, FRAME = 0.40, 0.72
"""side of the square opening of a gate, and of its frame outside, m"""
PASSED = 0.45
"""side of the square about the centre within which a gate is passed, m"""
THICKNESS, STAND, OBSTACLE, OBSTACLE_HEIGHT = 0.02, 0.10, 0.03, 1.5
"""of a frame; of the square stand below it; of the obstacles, m"""
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
    """A track from a file as `gates.toml`, which is taken by default. Raises `UserError` for one that is none."""
    path = Path(file) if file else Path(__file__).with_name("gates.toml")
    try:
        table = tomllib.loads(path.read_text("utf-8"))
        gates = [
            [*gate["position"], *(gate.get(name, 0.0) for name in ("roll", "pitch", "yaw"))] for gate in table["gates"]
        ]
        obstacles = [obstacle["position"] for obstacle in table.get("obstacles", [])]
        order, room = np.array(table["order"], int), [table["room"]["low"], table["room"]["high"]]
        arrays = [np.array(rows, np.float32) for rows in (gates, obstacles or np.zeros((0, 3)), table["start"], room)]
        gates, obstacles, start, room = (
            a.reshape(shape) for a, shape in zip(arrays, ((-1, 6), (-1, 3), (3,), (2, 3)), strict=True)
        )
    except (OSError, tomllib.TOMLDecodeError, KeyError, TypeError, ValueError) as error:
        what = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise UserError(f"{path} is no track: {what}; one looks as lemniscate/drones/gates.toml does.") from error
    if not len(order) or (np.abs(order) > len(gates)).any() or (order == 0).any():
        raise UserError(
            f"{path}: order names gates from 1 to {len(gates)}, in reverse with a minus, not {order.tolist()}."
        )
    return Track(gates, obstacles, np.abs(order) - 1, order < 0, start, room)


def standing(gates: np.ndarray, obstacles: np.ndarray, stand: float) -> np.ndarray:
    """The boxes [N, B, 15] of a `Scene`, of tracks with gates [N, G, 6] and obstacles [N, M, 3]."""
    low, high = _boxes(stand)
    frames = Rotation.from_euler("xyz", gates[..., 3:]).as_matrix()[:, :, None]
    centre = gates[:, :, None, :3] + (frames * ((low + high) / 2)[:, None, :]).sum(-1)
    parts = [
        centre,
        np.broadcast_to((high - low) / 2, centre.shape),
        np.broadcast_to(frames.reshape(*frames.shape[:3], 9), (*centre.shape[:3], 9)),
    ]
    boxes = np.concatenate(parts, axis=-1).reshape(len(gates), -1, 15)
    half = np.array((OBSTACLE / 2, OBSTACLE / 2, OBSTACLE_HEIGHT / 2), np.float32)
    own = [
        obstacles - half * (0, 0, 1),
        np.broadcast_to(half, obstacles.shape),
        np.broadcast_to(np.eye(3).ravel(), (*obstacles.shape[:2], 9)),
    ]
    return np.concatenate([boxes, np.concatenate(own, axis=-1)], axis=1)


def out_of(matrix: jax.Array, vector: Any) -> jax.Array:
    """Vectors [..., 3] of a frame in the world's; a sum and not a product of matrices, which XLA would not fuse."""
    return (matrix * vector[..., None, :]).sum(-1)


def into(matrix: jax.Array, vector: Any) -> jax.Array:
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
    along_body = jnp.abs(into(turned, way)) - BODY - (size * half[..., None]).sum(-2)

    def next_row(of: Any, count: int) -> Any:
        return jnp.roll(of, -count, axis=-2)

    def next_column(of: Any, count: int) -> Any:
        return jnp.roll(of, -count, axis=-1)

    way, half = way[..., None], half[..., None]
    across = jnp.abs(next_row(way, 1) * next_row(turned, 2) - next_row(way, 2) * next_row(turned, 1))
    across -= next_row(half, 1) * next_row(size, 2) + next_row(half, 2) * next_row(size, 1)
    across -= next_column(BODY, 1) * next_column(size, 2) + next_column(BODY, 2) * next_column(size, 1)
    return (jnp.maximum(along_box, along_body).max(-1) < 0) & (across.max((-1, -2)) < 0)


def _boxes(stand: float) -> tuple[np.ndarray, np.ndarray]:
    """The boxes [5, 3] of a gate in its own frame, lower and upper corners: four beams, and a stand of that height."""
    inner, outer, thick, half = OPENING / 2, FRAME / 2, THICKNESS / 2, STAND / 2
    low = [(-thick, -outer, inner), (-thick, -outer, -outer), (-thick, inner, -outer), (-thick, -outer, -outer)]
    high = [(thick, outer, outer), (thick, outer, -inner), (thick, outer, outer), (thick, -inner, outer)]
    corners = [*low, (-half, -half, -outer - stand)], [*high, (half, half, -outer)]
    return np.array(corners[0], np.float32), np.array(corners[1], np.float32)


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

    The reward of a step is 3 for each metre of the way to the next gate's centre (`way_left`), 3 for a gate, −6 for a
    crash; less 0.05, 0.0005 |ω|² (rad²/s²), 0.01 for the squared change of the action and, while at levels 2 and 3 the
    true place of the next gate is not known, 0.2 for the square of what is above `CAREFUL` of the speed.

    Args:
        level: 0, 1, 2 or 3.
        track: a file as `gates.toml`; the laboratory's course by default.
        control: of what an action is: "attitude" (roll, pitch, yaw) or "body_rate", beside the thrust of all rotors.
        num_envs: N.
        max_episode_time: s.
        dynamics: crazyflow's; body rates need first_principles.
        drone: crazyflow's.
        freq: control steps in a second.
        device: of JAX.

    Raises:
        UserError: a level, a control or a track that is none.
    """

    controls: tuple[str, ...] = ("attitude", "body_rate")

    def __init__(
        self,
        level: int = 0,
        track: str | None = None,
        control: str = "attitude",
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
        self.level, self.track = level, read_track(track)
        shared = {"num_envs": num_envs, "max_episode_time": max_episode_time, "drone": drone, "freq": freq}
        super().__init__(dynamics=dynamics, device=device, reset_randomization=_as_it_is, **shared)
        if control != "attitude":
            self._take_control(control, num_envs, device)
        integrate = self.sim.step_pipeline["integration"]
        replace_fn(self.sim.step_pipeline, lambda data: integrate_pushed(data, integrate), name="integration")
        self.sim.build_step_fn()
        self._own_parameters()
        observed = {"gates": 15, "obstacles": 4, "last_action": 4, "race": 3}
        parts = {name: gym.spaces.Box(-np.inf, np.inf, (size,)) for name, size in observed.items()}
        self.single_observation_space = gym.spaces.Dict({**self.single_observation_space.spaces, **parts})
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._empty(num_envs)

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
            self.action_space = batch_space(self.single_action_space, num_envs)
        append_fn(sim.reset_pipeline, _as_it_is, name="reset_randomization")
        sim.build_reset_fn()
        self.sim = sim

    own_parameters = ("mass", "J", "J_inv")
    """crazyflow's parameters of which each drone has its own"""

    def _own_parameters(self) -> None:
        params = self.sim.data.params
        each = {name: getattr(params, name) for name in self.own_parameters}
        each = {name: jnp.tile(value, (self.num_envs, 1, *[1] * value.ndim)) for name, value in each.items()}
        self._nominal = {name: np.asarray(getattr(params, name)) for name in ("mass", "J")}
        self.sim.data = self.sim.data.replace(params=params.replace(**each))
        self.sim.build_default_data()

    def _empty(self, n: int) -> None:
        """Set the arrays beside the simulator's state; each is a part of the state of the race."""
        track = self.track
        self._key = jax.random.key(0)
        self._gates = jnp.tile(track.gates, (n, 1, 1))
        """the true gates [N, G, 6], and below what is known of them before they are seen"""
        self._expected_gates = self._gates
        self._obstacles = jnp.tile(track.obstacles, (n, 1, 1))
        self._expected_obstacles = self._obstacles
        self._gates_seen = jnp.zeros((n, len(track.gates)), bool)
        self._obstacles_seen = jnp.zeros((n, len(track.obstacles)), bool)
        self.starts_around = self._start = jnp.tile(track.start, (n, 1))
        """the start of the track, and where the drone has begun"""
        self._target = jnp.zeros(n, jnp.int32)
        """the number of gates that are passed"""
        self._whole = jnp.ones(n, bool)
        """whether the race began at the start"""
        self._before = jnp.zeros((n, 3))
        self._crashed = jnp.zeros(n, bool)
        self._gain = jnp.zeros(n)
        """the reward of the step"""
        self._last_action = jnp.zeros((n, 4))

    # --- an episode's beginning -------------------------------------------------------------------------------------

    def _reset(self, mask: jax.Array | None = None, options: Mapping[str, Any] | None = None) -> None:
        mask = jnp.ones(self.num_envs, bool) if mask is None else mask
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
        mass = self._nominal["mass"] + varied * SPREAD["mass"] * mass[:, None]
        inertia = np.diagonal(self._nominal["J"]) + varied * SPREAD["inertia"] * inertia
        inertia = np.eye(3) * inertia[:, None, :, None]
        data, begins = self.sim.data, mask[:, None]
        states = data.states.replace(
            pos=jnp.where(begins[..., None], pos[:, None], data.states.pos),
            quat=jnp.where(begins[..., None], Rotation.from_euler("xyz", rpy).as_quat()[:, None], data.states.quat),
        )
        inverse = np.eye(3) / jnp.where(np.eye(3) > 0, inertia, 1)
        old, new = data.params, {"mass": mass, "J": inertia, "J_inv": inverse}
        chosen = {
            name: jnp.where(mask.reshape(-1, *[1] * (value.ndim - 1)), value, getattr(old, name))
            for name, value in new.items()
        }
        self.sim.data = data.replace(states=states, params=old.replace(**chosen))
        fresh = {
            "_gates": gates, "_expected_gates": expected[0],
            "_obstacles": obstacles, "_expected_obstacles": expected[1],
            "starts_around": start[:, :3], "_target": jnp.zeros(n, jnp.int32), "_crashed": jnp.zeros(n, bool),
            "_gates_seen": jnp.zeros_like(self._gates_seen), "_obstacles_seen": jnp.zeros_like(self._obstacles_seen),
            "_last_action": jnp.zeros((n, 4)), "_gain": jnp.zeros(n),
        }  # fmt: skip
        for name, value in fresh.items():
            old = getattr(self, name)
            setattr(self, name, jnp.where(mask.reshape(-1, *[1] * (old.ndim - 1)), value, old))

    def _layout(self, key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Starts [N, 4] (x, y, z, yaw), gates and obstacles of the level: the same for all, or at level 3 drawn."""
        track, n = self.track, self.num_envs
        if self.level < 3:
            first = jnp.tile(np.append(track.start, 0.0), (n, 1))
            return first, jnp.tile(track.gates, (n, 1, 1)), jnp.tile(track.obstacles, (n, 1, 1))
        low, high = track.room[0, :2] + APART["border"], track.room[1, :2] - APART["border"]
        key, own, turn = jax.random.split(key, 3)
        at = jax.random.uniform(own, (n, 2), minval=low, maxval=high)
        yaw = jax.random.uniform(turn, (n, 1), minval=-math.pi / 2, maxval=math.pi / 2)
        start = jnp.concatenate([at, jnp.full((n, 1), track.start[2]), yaw], axis=1)
        gates, yaws, obstacles = list[jax.Array](), list[jax.Array](), list[jax.Array]()
        ways = list[tuple[jax.Array, jax.Array]]()

        def choose(key: jax.Array, from_gates: float, from_obstacles: float, wished: Callable) -> jax.Array:
            """The first place with room that is wished for, else the first with room, else that with the most room."""
            places = jax.random.uniform(key, (n, CANDIDATES, 2), minval=low, maxval=high)
            apart = [APART["start"]] + [from_gates] * len(gates) + [from_obstacles] * len(obstacles)
            others = zip([start[:, :2], *gates, *obstacles], apart, strict=True)
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
                yaws.append(jnp.arctan2(*(place - at).T[::-1]) + turn)
                ways.append((at, place))
                gates.append(place)
                at = place
            if i < len(track.obstacles):
                on_the_way = partial(_in_corridor, start=ways[-1][0], end=ways[-1][1])
                obstacles.append(choose(three, APART["obstacle_gate"], APART["obstacles"], on_the_way))
        poses, tops = (jnp.tile(part, (n, 1, 1)) for part in (track.gates, track.obstacles))
        poses = poses.at[..., :2].set(jnp.stack(gates, 1)).at[..., 3:5].set(0.0).at[..., 5].set(jnp.stack(yaws, 1))
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
        pos = jnp.where(ahead[:, None], pos, data.states.pos[:, 0])
        vel = jnp.where(ahead[:, None], vel, data.states.vel[:, 0])
        self.sim.data = data.replace(states=data.states.replace(pos=pos[:, None], vel=vel[:, None]))
        self._target = jnp.where(ahead, target, self._target)
        self._whole = jnp.where(mask, ~ahead, self._whole)
        self._start = jnp.where(mask[:, None], pos, self._start)
        self._before = jnp.where(mask[:, None], pos, self._before)
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
        before, now = (into(turned, at - place) for at in (self._before, pos))
        passed = passes(before, now) & ~self._crashed
        progress = way_left(before) - jnp.where(passed, -jnp.linalg.norm(now, axis=-1), way_left(now))
        self._target = self._target + passed
        self._before = pos
        self._look()
        rates = jnp.square(states.ang_vel[:, 0]).sum(-1)
        hurry = jnp.maximum(jnp.linalg.norm(states.vel[:, 0], axis=-1) - CAREFUL, 0.0)
        hurry = jnp.where(self._sees_next(0) | (self.level < 2), 0.0, hurry)
        change = jnp.square(action - self._last_action).sum(-1)
        self._gain = 3 * progress + 3.0 * passed - 6.0 * self._crashed - 0.05 - 0.0005 * rates - 0.01 * change
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
        return (pos[:, :2] < low[:2]).any(-1) | (pos > high).any(-1) | (grounded & away)

    def _touches(self, pos: jax.Array, turned: jax.Array) -> jax.Array:
        """Whether the drone's box touches a gate's frame or stand, or an obstacle."""
        centre = pos + out_of(turned, BODY_CENTRE)
        frames, half = (
            Rotation.from_euler("xyz", self._gates[..., 3:]).as_matrix(),
            np.array((OBSTACLE / 2, OBSTACLE / 2, OBSTACLE_HEIGHT / 2), np.float32),
        )
        local = into(frames, centre[:, None] - self._gates[..., :3])
        own = (frames[..., None] * turned[:, None, :, None]).sum(-3)
        gates = touches(local[:, :, None], own[:, :, None], *_boxes(self.track.stand))
        obstacles = touches(centre[:, None] - self._obstacles + half * (0, 0, 1), turned[:, None], -half, half)
        return gates.any((1, 2)) | obstacles.any(1)

    def obs(self) -> dict[str, jax.Array]:
        """The drone's state, then `gates`, `obstacles`, `last_action` and `race`."""
        parts = super().obs()
        pos, n = parts["pos"], self.num_envs
        known = jnp.where(self._gates_seen[..., None], self._gates, self._expected_gates)
        ahead = [self._frame(self._target + i, known) for i in (0, 1)]
        seen = [part for at, frame in ahead for part in (at - pos, frame[..., 0])]
        parts["gates"] = jnp.concatenate([*seen, into(ahead[0][1], pos - ahead[0][0])], axis=1)
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

    truth_size = 6

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
        return standing(np.asarray(arrays["_gates"]), np.asarray(arrays["_obstacles"]), self.track.stand)

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
