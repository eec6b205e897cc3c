"""The conditions of a drone's flight: how the vehicle and the air differ from the simulator's own.

A condition is a number, or a range [low, high] from which one is drawn for every episode of every drone. All of them
together are what is called domain randomization (Tobin et al. 2017, arXiv:1703.06907).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from lemniscate.errors import UserError, shown

if TYPE_CHECKING:
    import jax

STATE_SIZE = 13
"""position 3 (m), quaternion 4 (xyzw), velocity 3 (m/s), angular velocity 3 (rad/s)"""
NOISE = {"pos": 0.002, "attitude": math.radians(0.5), "vel": 0.03, "ang_vel": 0.05}
"""standard deviations: of a motion-capture system (m, rad), of velocities estimated from it (m/s), of a gyroscope
(rad/s)"""
GUST_SECONDS = 0.5
"""time constant of gusts"""


@dataclass(frozen=True)
class Condition:
    """The value of a condition in the simulator as it is, the limits of what can be asked for, and its meaning."""

    nominal: float
    low: float
    high: float
    meaning: str


CONDITIONS = {
    "mass": Condition(1, 0.2, 3, "factor of the mass"),
    "inertia": Condition(1, 0.1, 10, "factor of the moments of inertia: angular accelerations are divided by it"),
    "motor_gain": Condition(1, 0.2, 3, "factor of the thrust that a command gives"),
    "motor_time": Condition(1, 0.05, 20, "factor of the time in which rotors follow; so_rpy has no such time"),
    "thrust_curve": Condition(0, -0.2, 0.2, "what half of the thrust range gives more, as a share of the range"),
    "action_delay": Condition(0, 0, 0.2, "seconds until an action reaches the drone, in steps of 2 ms"),
    "observation_delay": Condition(0, 0, 0.2, "seconds since an observation was true, in steps of 2 ms"),
    "jitter": Condition(0, 0, 1, "most of a further delay of each action by itself, in control periods"),
    "lost_actions": Condition(0, 0, 0.9, "probability that an action is lost, and the one before it goes on"),
    "observation_noise": Condition(0, 0, 20, "normal noise of each observation, in multiples of NOISE"),
    "observation_bias": Condition(0, 0, 20, "the same, but drawn once an episode"),
    "wind": Condition(0, 0, 1, "newtons of a constant force from any horizontal direction"),
    "gusts": Condition(0, 0, 1, "standard deviation of a force that changes within half a second, newtons an axis"),
    "start_spread": Condition(1, 0, 3, "factor of how far from its middle, and how fast, a flight begins"),
    "rotors": Condition(0, 0, 1, "rotor speed at the beginning, as a share of that of hovering; so_rpy has no rotors"),
}

Ranges = Mapping[str, tuple[float, float]]


def read_ranges(kwargs: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """The ranges of the conditions among the arguments of an environment, without those that change nothing.

    Raises:
        UserError: a value that is neither a number nor a range, or outside what a drone could fly with.
    """
    ranges = {name: _range(name, kwargs[name]) for name in CONDITIONS if name in kwargs}
    return {name: ends for name, ends in ranges.items() if ends != (CONDITIONS[name].nominal,) * 2}


def _range(name: str, value: Any) -> tuple[float, float]:
    ends = list(value) if isinstance(value, list | tuple) else [value, value]
    numbers = all(isinstance(end, int | float) and not isinstance(end, bool) for end in ends)
    if len(ends) != 2 or not numbers:
        raise UserError(f"{name} must be a number or a range [low, high], not {shown(value)}.")
    condition, (low, high) = CONDITIONS[name], map(float, ends)
    if low > high:
        raise UserError(f"{name} is a range upside down: {low:g} is above {high:g}.")
    if not condition.low <= low <= high <= condition.high:
        limits = f"from {condition.low:g} to {condition.high:g}"
        raise UserError(f"{name} must be {limits} ({condition.meaning}), not {shown(value)}.")
    return low, high


def parameter_factors(dynamics: str, drawn: Mapping[str, jax.Array]) -> dict[str, jax.Array]:
    """The factors [N] of crazyflow's parameters, by their names, that the conditions drawn mean in these dynamics."""
    factors: dict[str, jax.Array] = {}
    first_principles = dynamics == "first_principles"
    if "mass" in drawn:
        factors["mass"] = drawn["mass"]
    if "inertia" in drawn:
        factors |= {"J": drawn["inertia"], "J_inv": 1 / drawn["inertia"]}
        if not first_principles:  # whose attitude is a fitted second-order system
            factors |= dict.fromkeys(("rpy_coef", "rpy_rates_coef", "cmd_rpy_coef"), 1 / drawn["inertia"])
    if "motor_gain" in drawn:
        names = ("rpm2thrust", "rpm2torque") if first_principles else ("cmd_f_coef", "acc_coef")
        factors |= dict.fromkeys(names, drawn["motor_gain"])
    if "motor_time" in drawn and dynamics != "so_rpy":
        factors["rotor_dyn_coef" if first_principles else "thrust_dyn_coef"] = 1 / drawn["motor_time"]
    return factors


class Air:
    """The disturbances between a policy and N drones: late actions, wind, noisy observations, a history of both.

    Its state is a dictionary of arrays, of which there are only those that the conditions need; every method returns
    it changed. Where there are no conditions and no history it is empty, and nothing is computed.

    Args:
        ranges: of the conditions.
        history: the number of steps before this one whose observed state and action are observed too, H.
        num_envs: N.
        substeps: of the simulator in a control step.
        frequency: control steps in a second.
        hover: the command [4] that is taken to have gone before the first, and [A] the same as an action.
    """

    def __init__(
        self, ranges: Ranges, history: int, num_envs: int, substeps: int, frequency: float, hover: tuple[Any, Any]
    ) -> None:
        self.ranges, self.history, self.num_envs = ranges, history, num_envs
        self.substeps, self.frequency = substeps, frequency
        self.hover, self._hover_action = hover
        self.is_late = bool({"action_delay", "jitter", "lost_actions"} & set(ranges))
        """actions may come late or not at all"""
        self.is_blurred = bool({"observation_delay", "observation_noise", "observation_bias"} & set(ranges))
        """what is observed is not the state"""
        self.is_windy = bool({"wind", "gusts"} & set(ranges))

    def empty(self, key: jax.Array) -> dict[str, Any]:
        """The air before the first episode."""
        import jax.numpy as jnp

        n, actions = self.num_envs, self.hover.size
        air: dict[str, Any] = {}
        if self.ranges:
            ends = jnp.array(list(self.ranges.values()))  # in the state, so that one program serves other ends too
            air = {"key": key, "ends": ends, "drawn": {name: jnp.zeros(n) for name in self.ranges}}
        if self.is_late:
            longest = self._most("action_delay") * self.frequency + self._most("jitter")
            air["commands"] = jnp.zeros((n, math.ceil(longest - 1e-6) + 1, actions))
        if self.is_windy:
            air |= {"wind": jnp.zeros((n, 3)), "gust": jnp.zeros((n, 3))}
        if self.is_blurred:
            entries = math.floor(self._most("observation_delay") * self.frequency + 1e-6) + 1
            air |= {"states": jnp.zeros((n, entries, STATE_SIZE)), "bias": jnp.zeros((n, 12))}
        if self.is_blurred or self.history:
            air["seen"] = jnp.zeros((n, STATE_SIZE))
        if self.history:
            air["past"] = jnp.zeros((n, self.history, STATE_SIZE + actions))
        return air

    def _most(self, name: str) -> float:
        return self.ranges.get(name, (0.0, 0.0))[1]

    def draw(self, air: dict[str, Any], mask: jax.Array) -> dict[str, Any]:
        """The conditions of the episodes that begin, `mask` [N]."""
        import jax
        import jax.numpy as jnp

        if not self.ranges:
            return air
        air, (key, *keys) = dict(air), jax.random.split(air["key"], 4 + len(self.ranges))
        drawn = {}
        for own, name, (low, high) in zip(keys[3:], self.ranges, air["ends"], strict=True):
            new = jax.random.uniform(own, (self.num_envs,), minval=low, maxval=high)
            drawn[name] = jnp.where(mask, new, air["drawn"][name])
        air |= {"key": key, "drawn": drawn}
        if self.is_windy:
            angle = jax.random.uniform(keys[0], (self.num_envs,), maxval=2 * jnp.pi)
            level = jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)], axis=1)
            first = jax.random.normal(keys[1], (self.num_envs, 3))
            air["wind"] = jnp.where(mask[:, None], self._of(air, "wind")[:, None] * level, air["wind"])
            air["gust"] = jnp.where(mask[:, None], self._of(air, "gusts")[:, None] * first, air["gust"])
        if self.is_blurred:
            bias = self._of(air, "observation_bias")[:, None] * jax.random.normal(keys[2], (self.num_envs, 12))
            air["bias"] = jnp.where(mask[:, None], bias, air["bias"])
        return air

    def _of(self, air: dict[str, Any], name: str) -> jax.Array:
        """The value of a condition, [N]."""
        import jax.numpy as jnp

        return air["drawn"][name] if name in self.ranges else jnp.full(self.num_envs, CONDITIONS[name].nominal)

    def begin(self, air: dict[str, Any], mask: jax.Array, state: jax.Array) -> dict[str, Any]:
        """Buffers of the episodes that begin in these states [N, 13], as if the drone had hovered there before."""
        import jax.numpy as jnp

        begins, air = mask[:, None, None], dict(air)
        if self.is_late:
            air["commands"] = jnp.where(begins, self.hover, air["commands"])
        if self.is_blurred:
            air["states"] = jnp.where(begins, state[:, None], air["states"])
        if "seen" in air:
            air, seen = self._measure(air, state)
            air["seen"] = jnp.where(mask[:, None], seen, air["seen"])
        if self.history:
            action = jnp.broadcast_to(self._hover_action, (self.num_envs, self._hover_action.size))
            first = jnp.concatenate([air["seen"], action], axis=-1)[:, None]
            air["past"] = jnp.where(begins, first, air["past"])
        return air

    def send(self, air: dict[str, Any], command: jax.Array, bounds: tuple[Any, Any]) -> tuple[dict[str, Any], Any]:
        """Take up commands [N, 4]; returns a function of the substep, from 0, to those that act in it."""
        import jax
        import jax.numpy as jnp

        if "thrust_curve" in self.ranges:
            command = _through_curve(command, air["drawn"]["thrust_curve"], *bounds)
        if not self.is_late:
            return air, lambda substep: command
        key, loss, jitter = jax.random.split(air["key"], 3)
        lost = jax.random.uniform(loss, (self.num_envs,)) < self._of(air, "lost_actions")
        commands = _push(air["commands"], jnp.where(lost[:, None], air["commands"][:, 0], command))
        periods = self._of(air, "action_delay") * self.frequency
        periods = periods + self._of(air, "jitter") * jax.random.uniform(jitter, (self.num_envs,))
        delay = jnp.round(periods * self.substeps).astype(jnp.int32)

        def acting(substep: jax.Array) -> jax.Array:
            age = -(-(delay - substep) // self.substeps)  # the youngest that has arrived
            age = jnp.clip(age, 0, commands.shape[1] - 1)
            return jnp.take_along_axis(commands, age[:, None, None], axis=1)[:, 0]

        return {**air, "key": key, "commands": commands}, acting

    def force(self, air: dict[str, Any]) -> tuple[dict[str, Any], jax.Array]:
        """The force of wind and gusts in a control step, [N, 3] newtons; a gust is an Ornstein-Uhlenbeck process."""
        import jax

        key, own = jax.random.split(air["key"])
        keep = math.exp(-1 / (self.frequency * GUST_SECONDS))
        noise = math.sqrt(1 - keep**2) * jax.random.normal(own, (self.num_envs, 3))
        gust = keep * air["gust"] + self._of(air, "gusts")[:, None] * noise
        return {**air, "key": key, "gust": gust}, air["wind"] + gust

    def steps_behind(self, air: dict[str, Any]) -> tuple[jax.Array, jax.Array]:
        """The delay of observations as control steps and substeps, [N] each."""
        import jax.numpy as jnp

        behind = self._of(air, "observation_delay") * self.frequency * self.substeps
        return jnp.divmod(jnp.round(behind).astype(jnp.int32), self.substeps)

    def observe(self, air: dict[str, Any], state: jax.Array, action: jax.Array) -> dict[str, Any]:
        """The observation after a step, caught in `state` [N, 13] as many substeps before its end as it is late."""
        import jax.numpy as jnp

        air = dict(air)
        if self.is_blurred:
            air["states"] = _push(air["states"], state)
        if self.history:
            air["past"] = _push(air["past"], jnp.concatenate([air["seen"], action], axis=-1))
        if "seen" in air:
            air, seen = self._measure(air, state)
            air["seen"] = seen
        return air

    @property
    def truth_size(self) -> int:
        """The length of `truth`."""
        return len(self.ranges) + 3 * self.is_windy

    def truth(self, air: dict[str, Any]) -> jax.Array:
        """The conditions and the force on each drone, of which a vehicle knows nothing, [N, `truth_size`].

        Each condition drawn by its place in its range, from -1 to 1; and the force of the wind and the gust, 1 where
        it is the most that there is on average.
        """
        import jax.numpy as jnp

        if not self.ranges:
            return jnp.zeros((self.num_envs, 0))
        low, high = air["ends"].T
        drawn = jnp.stack([air["drawn"][name] for name in self.ranges], axis=1)
        parts = [jnp.where(high > low, (2 * drawn - low - high) / jnp.where(high > low, high - low, 1), 0.0)]
        if self.is_windy:
            parts.append((air["wind"] + air["gust"]) / (self._most("wind") + self._most("gusts")))
        return jnp.concatenate(parts, axis=1)

    def changes(self, air: dict[str, Any]) -> jax.Array:
        """The history as it is observed, [N, H, 13 + A], the newest first: states less the present one, and actions.

        Differences, since what a small one says of mass and motors would drown in the scale of the states themselves.
        """
        import jax.numpy as jnp

        states, actions = air["past"][..., :STATE_SIZE], air["past"][..., STATE_SIZE:]
        return jnp.concatenate([states - air["seen"][:, None], actions], axis=-1)

    def _measure(self, air: dict[str, Any], state: jax.Array) -> tuple[dict[str, Any], jax.Array]:
        """States [N, 13] as they are measured: late, biased and noisy."""
        import jax
        import jax.numpy as jnp

        if not self.is_blurred:
            return air, state
        key, own = jax.random.split(air["key"])
        age, _ = self.steps_behind(air)
        state = jnp.take_along_axis(air["states"], age[:, None, None], axis=1)[:, 0]
        noise = self._of(air, "observation_noise")[:, None] * jax.random.normal(own, (self.num_envs, 12))
        return {**air, "key": key}, disturb(state, air["bias"] + noise)


def disturb(state: jax.Array, noise: jax.Array) -> jax.Array:
    """States [N, 13] with noise [N, 12] added, in multiples of `NOISE`; that of the attitude is a small rotation."""
    import jax.numpy as jnp

    pos, quat, vel, ang_vel = jnp.split(state, (3, 7, 10), axis=-1)
    dpos, angle, dvel, dang_vel = jnp.split(noise, 4, axis=-1)
    half = 0.5 * NOISE["attitude"] * angle
    imaginary = quat[:, :3] + quat[:, 3:] * half + jnp.cross(quat[:, :3], half)  # quat ⊗ (half, 1)
    real = quat[:, 3:] - (quat[:, :3] * half).sum(-1, keepdims=True)
    turned = jnp.concatenate([imaginary, real], axis=-1)
    turned = turned / jnp.linalg.norm(turned, axis=-1, keepdims=True)
    parts = (pos + NOISE["pos"] * dpos, turned, vel + NOISE["vel"] * dvel, ang_vel + NOISE["ang_vel"] * dang_vel)
    return jnp.concatenate(parts, axis=-1)


def _through_curve(command: jax.Array, bend: jax.Array, low: Any, high: Any) -> jax.Array:
    """Commands [N, 4] whose thrust gives more in the middle of its range, and at its ends what it did."""
    share = (command[:, 3] - low[3]) / (high[3] - low[3])
    return command.at[:, 3].add(4 * bend * share * (1 - share) * (high[3] - low[3]))


def _push(buffer: jax.Array, newest: jax.Array) -> jax.Array:
    """A buffer [N, L, …] with one more entry [N, …] in front, and without its last."""
    import jax.numpy as jnp

    return jnp.concatenate([newest[:, None], buffer[:, :-1]], axis=1)


Acting = Callable[[Any], Any]
"""a function of the substep to the commands [N, 4] that act in it"""
