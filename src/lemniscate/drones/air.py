"""The disturbances of a flight: late actions, wind, noisy observations, as the conditions of `vehicle` say."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from lemniscate.drones.vehicle import CONDITIONS, NOISE, STATE_SIZE, Ranges

GUST_SECONDS = 0.5
"""time constant of gusts"""

Acting = Callable[[Any], Any]
"""a function of the substep to the commands [N, 4] that act in it"""


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

    @property
    def delay(self) -> tuple[float, float]:
        """Seconds from an observation to its action's effect, the least and the most."""
        late = [self.ranges.get(name, (0.0, 0.0)) for name in ("action_delay", "observation_delay")]
        jitter = self._most("jitter") / self.frequency
        return sum(least for least, _ in late), sum(most for _, most in late) + jitter

    def empty(self, key: jax.Array) -> dict[str, Any]:
        """The air before the first episode."""
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
            steps = self._most("observation_delay") * self.frequency + 0.5 / self.substeps  # as `steps_behind` rounds
            air |= {"states": jnp.zeros((n, math.floor(steps + 1e-6) + 1, STATE_SIZE)), "bias": jnp.zeros((n, 12))}
        if self.is_blurred or self.history:
            air["seen"] = jnp.zeros((n, STATE_SIZE))
        if self.history:
            air["past"] = jnp.zeros((n, self.history, STATE_SIZE + actions))
        return air

    def _most(self, name: str) -> float:
        return self.ranges.get(name, (0.0, 0.0))[1]

    def draw(self, air: dict[str, Any], mask: jax.Array) -> dict[str, Any]:
        """The conditions of the episodes that begin, `mask` [N]."""
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
            air["wind"] = jnp.where(mask[:, None], self._condition(air, "wind")[:, None] * level, air["wind"])
            air["gust"] = jnp.where(mask[:, None], self._condition(air, "gusts")[:, None] * first, air["gust"])
        if self.is_blurred:
            bias = self._condition(air, "observation_bias")[:, None] * jax.random.normal(keys[2], (self.num_envs, 12))
            air["bias"] = jnp.where(mask[:, None], bias, air["bias"])
        return air

    def _condition(self, air: dict[str, Any], name: str) -> jax.Array:
        """The value of a condition, [N]."""
        return air["drawn"][name] if name in self.ranges else jnp.full(self.num_envs, CONDITIONS[name].nominal)

    def begin(self, air: dict[str, Any], mask: jax.Array, state: jax.Array) -> dict[str, Any]:
        """Buffers of the episodes that begin in these states [N, 13], as if the drone had hovered there before."""
        begins, air = mask[:, None, None], dict(air)
        if self.is_late:
            air["commands"] = jnp.where(begins, self.hover, air["commands"])
        if self.is_blurred:
            air["states"] = jnp.where(begins, state[:, None], air["states"])
        air = self._measure(air, state, mask[:, None])
        if self.history:
            action = jnp.broadcast_to(self._hover_action, (self.num_envs, self._hover_action.size))
            first = jnp.concatenate([air["seen"], action], axis=-1)[:, None]
            air["past"] = jnp.where(begins, first, air["past"])
        return air

    def send(self, air: dict[str, Any], command: jax.Array, bounds: tuple[Any, Any]) -> tuple[dict[str, Any], Any]:
        """Take up commands [N, 4]; returns a function of the substep, from 0, to those that act in it."""
        if "thrust_curve" in self.ranges:
            command = _through_curve(command, air["drawn"]["thrust_curve"], *bounds)
        if not self.is_late:
            return air, lambda substep: command
        key, loss, jitter = jax.random.split(air["key"], 3)
        lost = jax.random.uniform(loss, (self.num_envs,)) < self._condition(air, "lost_actions")
        commands = _push(air["commands"], jnp.where(lost[:, None], air["commands"][:, 0], command))
        periods = self._condition(air, "action_delay") * self.frequency
        periods = periods + self._condition(air, "jitter") * jax.random.uniform(jitter, (self.num_envs,))
        delay = jnp.round(periods * self.substeps).astype(jnp.int32)

        def acting(substep: jax.Array) -> jax.Array:
            age = -(-(delay - substep) // self.substeps)  # the youngest that has arrived
            age = jnp.clip(age, 0, commands.shape[1] - 1)
            return jnp.take_along_axis(commands, age[:, None, None], axis=1)[:, 0]

        return {**air, "key": key, "commands": commands}, acting

    def force(self, air: dict[str, Any]) -> tuple[dict[str, Any], jax.Array]:
        """The force of wind and gusts in a control step, [N, 3] newtons; a gust is an Ornstein-Uhlenbeck process."""
        key, own = jax.random.split(air["key"])
        keep = math.exp(-1 / (self.frequency * GUST_SECONDS))
        noise = math.sqrt(1 - keep**2) * jax.random.normal(own, (self.num_envs, 3))
        gust = keep * air["gust"] + self._condition(air, "gusts")[:, None] * noise
        return {**air, "key": key, "gust": gust}, air["wind"] + gust

    def steps_behind(self, air: dict[str, Any]) -> tuple[jax.Array, jax.Array]:
        """The delay of observations as control steps and substeps, [N] each."""
        behind = self._condition(air, "observation_delay") * self.frequency * self.substeps
        return jnp.divmod(jnp.round(behind).astype(jnp.int32), self.substeps)

    def observe(self, air: dict[str, Any], state: jax.Array, action: jax.Array) -> dict[str, Any]:
        """The observation after a step, caught in `state` [N, 13] as many substeps before its end as it is late."""
        air = dict(air)
        if self.is_blurred:
            air["states"] = _push(air["states"], state)
        if self.history:
            air["past"] = _push(air["past"], jnp.concatenate([air["seen"], action], axis=-1))
        return self._measure(air, state)

    def truth(self, air: dict[str, Any]) -> jax.Array:
        """The conditions and the force on each drone, of which a vehicle knows nothing, [N, …].

        Each condition drawn by its place in its range, from -1 to 1; and the force of the wind and the gust, 1 where
        it is the most that there is on average.
        """
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
        states, actions = air["past"][..., :STATE_SIZE], air["past"][..., STATE_SIZE:]
        return jnp.concatenate([states - air["seen"][:, None], actions], axis=-1)

    def _measure(self, air: dict[str, Any], state: jax.Array, mask: Any = True) -> dict[str, Any]:
        """See the masked drones, whose states are [N, 13]: late, biased and noisy."""
        if "seen" not in air:
            return air
        if self.is_blurred:
            key, own = jax.random.split(air["key"])
            age, _ = self.steps_behind(air)
            state = jnp.take_along_axis(air["states"], age[:, None, None], axis=1)[:, 0]
            noise = self._condition(air, "observation_noise")[:, None] * jax.random.normal(own, (self.num_envs, 12))
            air, state = {**air, "key": key}, disturb(state, air["bias"] + noise)
        return {**air, "seen": jnp.where(mask, state, air["seen"])}


def disturb(state: jax.Array, noise: jax.Array) -> jax.Array:
    """States [N, 13] with noise [N, 12] added, in multiples of `NOISE`; that of the attitude is a small rotation."""
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
    return jnp.concatenate([newest[:, None], buffer[:, :-1]], axis=1)
