"""Trained policies, for those who have NumPy and an environment of their own; `load` and `save`."""

import re
import sys
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lemniscate import algos
from lemniscate.envs.conversion import normalized_action, physical_action, scale_of
from lemniscate.envs.returned import as_array, kind_of
from lemniscate.envs.spaces import read_mask, read_observation
from lemniscate.errors import UserError, prefix_errors, shown
from lemniscate.hub import repository as hub
from lemniscate.maths import mean_and_std
from lemniscate.nn.memory import Recall
from lemniscate.nn.policies import Policy
from lemniscate.run import checkpoint
from lemniscate.run.config import RunConfig, checked
from lemniscate.run.directory import difference, find_checkpoint, require_no_file_of_a_run
from lemniscate.run.seeding import generator, torch_defaults
from lemniscate.spec import Box, Discrete, MultiDiscrete, Spec
from lemniscate.system.files import at_home, parsing

FILES = (".pt", ".pth", ".zip", ".pkl", ".pickle", ".safetensors", ".onnx", ".bin")
"""endings of the files that other libraries keep policies in"""


@dataclass(frozen=True)
class ActionDistribution:
    """The distribution of actions at one observation or at each of B; a field is None where the actions have none.

    Attributes:
        probabilities: of a Discrete [n] or [B, n]; of a MultiDiscrete one such array for each component; of a
            MultiBinary those of 1, in the shape of the action.
        mean: of a Box, in the environment's units and shape: of a Gaussian before it is clipped to the bounds; of one
            that tanh squashes, after that (`act` takes the squashed mean instead).
        std: standard deviation, in the same units; 0 of a deterministic policy.
    """

    probabilities: np.ndarray | tuple[np.ndarray, ...] | None = None
    mean: np.ndarray | None = None
    std: np.ndarray | None = None


class TrainedPolicy:
    """A policy from a run or a checkpoint: NumPy in, NumPy out."""

    path: Path | None = None
    """the run or the checkpoint that it came from"""

    def __init__(self, networks: Any, spec: Spec, config: RunConfig, step: int, path: Path | None = None) -> None:
        self.networks = networks.eval()
        self.spec, self.config, self.step, self.path = spec, config, step, path
        self.reset()  # makes `_recall` now: what changes when it acts is taken for a policy with a memory

    @cached_property
    def _recall(self) -> Recall | None:
        """The memory of the episodes that `act` plays, for a policy that has one."""
        if not self.module.memory:
            return None
        if self.spec.privileged:  # what the critic remembers depends on numbers that no observation has
            return Recall(replace(self.module.memory, privileged=0), self.module.remember)
        return Recall(self.networks.memory, self.networks.remember)

    @cached_property
    def _noise(self) -> torch.Generator:
        return generator(self.config.seed, torch.device("cpu"), 4)

    @property
    def module(self) -> Policy:
        """The policy itself, a function of torch tensors."""
        return self.networks.policy

    @property
    def is_masked(self) -> bool:
        """Whether its environment says at each step which actions are valid."""
        return self.spec.action.mask_size > 0

    @torch_defaults(grad=False)
    def act(self, obs: Any, deterministic: bool = True, action_mask: Any = None) -> np.ndarray:
        """The action at one raw observation, or at each of a batch; ready for `env.step`.

        A policy with a memory remembers the observation, so each is to be given once, in order; `reset` at the end of
        an episode.

        Args:
            obs: as the environment returns it: an array, a number, or a dictionary or tuple of these; or the flat
                observation [O] or [B, O].
            deterministic: the mode of the distribution; otherwise a sample.
            action_mask: `info["action_mask"]`, for one observation or a batch [B, n], where the environment gives one;
                by default that in a Dict observation, or else all are valid.

        Returns:
            In the environment's own units and shape, [A] or [B, A] for Box; a scalar array or [B] for Discrete.

        Raises:
            UserError: an observation or a mask of another shape, or that is not finite; a mask where the environment
                of training gave none; another B, of a policy with a memory, without `reset`.
        """
        flat, batched = self._read(obs, action_mask)
        distribution = self.module(flat)
        if checked("deterministic", deterministic, bool):
            action = distribution.mode()
        else:
            action = distribution.sample(self.module.draw_noise((len(flat),), self._noise))
        if self._recall:
            self._recall.advance(flat)
        physical = physical_action(action.numpy(), self.spec.action)
        return physical if batched else physical[0]

    def reset(self, done: Any = None) -> None:
        """Forget what a policy with a memory remembers: at the end of an episode, before the next observation.

        Args:
            done: of a batch, whose episodes are over, [B] bool; by default all are.

        Raises:
            UserError: `done` of another shape.
        """
        if self._recall:
            flags = None if done is None else as_array(done)
            if flags is not None and not (flags.dtype.kind in "biuf" and ((flags == 0) | (flags == 1)).all()):
                raise UserError(f"done must be True or False for each episode of the batch, not {kind_of(done)}.")
            self._recall.reset(None if flags is None else torch.from_numpy(flags.astype(bool)))

    @torch_defaults(grad=False)
    def distribution(self, obs: Any, action_mask: Any = None) -> ActionDistribution:
        """The distribution of the actions at one raw observation, or at each of a batch; takes and raises as `act`."""
        (flat, batched), kind = self._read(obs, action_mask), self.spec.action
        found: Any = self.module(flat)
        rows = partial(_rows, batched=batched)
        if isinstance(kind, MultiDiscrete):
            return ActionDistribution(tuple(rows(part.probabilities) for part in found.parts))
        if not isinstance(kind, Box):
            return ActionDistribution(rows(found.probabilities, getattr(kind, "shape", None)))
        mean, std = mean_and_std(found)
        _, _, middle, half = map(torch.from_numpy, scale_of(kind))
        return ActionDistribution(mean=rows(middle + half * mean, kind.shape), std=rows(half * std, kind.shape))

    @torch_defaults(grad=False)
    def value(self, obs: Any) -> np.ndarray:
        """V(s) of one raw observation, a scalar array, or of each of a batch, [B]; takes and raises as `act`.

        It is the discounted return that the policy expects, in units of the scaled reward where the run has
        `scale_rewards`; of a policy that acts by Q(s, ·), the largest of these. Raises `UserError` for an algorithm
        that learns no V(s), or one of privileged numbers too.
        """
        flat, batched = self._read_for("value", obs)
        return _rows(self.networks.value(flat), batched=batched)

    @torch_defaults(grad=False)
    def q_value(self, obs: Any, action: Any) -> np.ndarray:
        """Q(s, a) of one raw observation and action, a scalar array, or of each of a batch, [B]; raises as `value`.

        The return is that of `value`, of several critics the smallest; of SAC and REPPO with the entropy that is
        rewarded on the way. Actions are as `act` returns them; what is outside of a Box's bounds is clipped.
        """
        flat, batched = self._read_for("q", obs)
        kind: Any = self.spec.action
        given, several = as_array(action), (len(flat),) * batched
        shape = () if isinstance(kind, Discrete) else (kind.size,) if kind.shape is None else kind.shape
        kinds, what = ("iu", "whole") if isinstance(kind, Discrete) else ("biuf", "finite")
        if given.shape != several + shape or given.dtype.kind not in kinds or not np.isfinite(given).all():
            said = f"action must be {what} numbers of the shape {several + shape}, not {kind_of(action)}"
            raise UserError(f"{said}: as act returns it.")
        own = torch.from_numpy(normalized_action(given.reshape(len(flat), *shape), kind))
        if isinstance(kind, Discrete) and ((own < 0) | (own >= kind.n)).any():
            raise UserError(f"action must be from {kind.start} to below {kind.start + kind.n}, not {shown(action)}.")
        return _rows(self.networks.q(flat, own if isinstance(kind, Discrete) else own.clamp(-1, 1)), batched=batched)

    def _read(self, obs: Any, action_mask: Any = None) -> tuple[Tensor, bool]:
        """The flat observations [B, O], with the mask where there is one, and whether they are a batch."""
        flat, batched = read_observation(self.spec, obs)
        if action_mask is not None and not self.is_masked:
            raise UserError(f"{self.spec.env_id} has no action mask, so this policy cannot follow one.")
        if self.is_masked:
            mask = read_mask(action_mask, self.spec, flat)
            flat = np.concatenate([flat, mask.astype(flat.dtype)], axis=-1)
        rows = torch.from_numpy(np.array(flat, order="C"))  # the caller's may be read-only, or run backwards
        return self._recall.rows(rows) if self._recall else rows, batched

    def _read_for(self, critic: str, obs: Any) -> tuple[Tensor, bool]:
        """The observations of `_read` for a critic, "value" or "q". Raises `UserError` where none has been learned."""
        verbs = {"value": "policy.value(obs)", "q": "policy.q_value(obs, action)"}
        own = getattr(self.config, "baseline", None)  # REINFORCE's, which may have learned another
        here = [name for name in verbs if hasattr(self.networks, name) and own in (None, name)]
        if critic not in here:
            there = f"; it has {verbs[here[0]]}" if here else ""
            raise UserError(f"This policy of {algorithm_of(self)} has learned no {verbs[critic]}{there}.")
        if numbers := self.spec.privileged:
            raise UserError(f"{verbs[critic]} takes {numbers} privileged numbers, which no observation has.")
        return self._read(obs)


def _rows(values: Tensor, shape: tuple[int, ...] | None = None, *, batched: bool) -> np.ndarray:
    """Values [B, …] as an array, each in this shape if one is given; the only one if they are no batch."""
    array = values.numpy() if shape is None else values.numpy().reshape(-1, *shape)
    return array if batched else array[0]


@dataclass(frozen=True)
class TrainedRun:
    """The result of `train` and `resume`: the run directory, the final policy, the seconds of the training loop."""

    path: Path
    policy: TrainedPolicy
    seconds: float


Trained = str | Path | TrainedRun | TrainedPolicy
"""what has a policy: the path of a run or a checkpoint, or an address on the Hub; what `train` returned; the policy"""


def path_of(run: object) -> Path:
    """The directory of a run: of its path, of what `train` returned, or of a policy from `train` or `load`.

    Raises:
        UserError: anything else; a policy on the Hub.
    """
    path = getattr(run, "path", run)
    if not isinstance(path, str | PathLike) or not str(path):
        raise UserError(f"A run is a directory, such as 'runs/lander', or what train returned, not {shown(run)}.")
    if re.match(r"(?!hf:)[A-Za-z][\w+.-]+:/", str(path)):
        raise UserError(f"{path} is an address, and a run is a directory of this machine: leave out the scheme.")
    if Path(path).parts[:1] == (hub.SCHEME,):
        address = hub.read_address(path)
        raise UserError(f"{address} is on the Hub, and no run directory: it can be loaded, evaluated and watched.")
    return at_home(path)


@torch_defaults()
def load(run: Trained, *, checkpoint: str | int | None = None, trust: bool = False) -> TrainedPolicy:
    """The policy of a run (its newest whole checkpoint), of one checkpoint or on the Hub. No file is executed.

    What `train` returned has its policy already, and a policy is returned as it is, unless a `checkpoint` is named.

    Args:
        run: its directory or a checkpoint's; `hf://user/name` or `hf://user/name@revision`, which is downloaded; what
            `train` returned; a policy.
        checkpoint: of a run, "best" (see `keep_best`) or the step of one that is kept.
        trust: import the code that a downloaded policy names as `module:name`.

    Raises:
        UserError: neither a run nor a checkpoint, or a run without a whole one or that one; a damaged one; networks
            of the user's own that have other parameters now; an address without a policy, a Hub that refuses or cannot
            be reached; a downloaded policy that names code of its own, without `trust`.
    """
    if checkpoint is None and isinstance(run, TrainedRun | TrainedPolicy):
        return run.policy if isinstance(run, TrainedRun) else run
    if isinstance(run, TrainedRun | TrainedPolicy) or not hub.is_address(run):
        path = path_of(run)
        require_no_file_of_a_run(path)
        if path.is_file():
            raise UserError(
                f"{path} is a file, and a policy of lemniscate is a folder. lem.evaluate('{path}', env=…) plays weights"
                " of torch (.pt, .pth); the policy of another library is to be loaded with that library."
            )
        return _read(find_checkpoint(path, checkpoint), path)
    address = hub.read_address(run)
    if checkpoint is not None:
        raise UserError(f"{address} is one checkpoint: none of it can be chosen.")
    path = hub.download(address)
    with prefix_errors(str(address)):
        found = find_checkpoint(path)
        with parsing(found.path):
            hub.require_trusted(own_code(found), trust=trust)
        return _read(found, path)


def _read(found: checkpoint.Checkpoint, path: Path) -> TrainedPolicy:
    """The policy of a checkpoint, which was named by `path`; raises as `load`."""
    with parsing(found.path):
        name, fields, step = found.record["algorithm"], found.record["config"], found.numbers["step"]
        spec = checkpoint.spec_from_json(found.record["spec"])
        has_own_code = bool(own_code(found))
    config = algos.find(name).Config.from_json(fields)
    with nullcontext() if has_own_code else parsing(found.path):  # what the user's own code raises is not damage
        networks = config.networks(spec)
    tensors = found.tensors_of("networks")
    if differs := difference(tensors, networks.state_dict()):
        raise UserError(f"{path} does not fit its networks: {differs}.")
    networks.load_state_dict(tensors)
    return TrainedPolicy(networks, spec, config, step, path)


def own_code(found: checkpoint.Checkpoint) -> list[str]:
    """The names of the code that a checkpoint needs and that is not lemniscate's: algorithm, environment, networks."""
    name = found.record["algorithm"]
    return [*([] if name in algos.ALGORITHMS else [str(name)]), *hub.own_code(found.record["config"])]


def save(policy: Any, path: str | Path) -> Path:
    """Store a policy for `load`: weights, normalizer, Config and Spec, as a checkpoint without pickle.

    Args:
        policy: from `load`, or what `train` returned. It may begin another run (`warm_start=path`), but not resume
            its own: a run's checkpoints also hold optimizers and random generators.
        path: a new directory, or a policy stored before, or a link to one, which is replaced.

    Raises:
        UserError: something else is at `path`, it has the ending of a file, or it cannot be written.
    """
    path, policy = path_of(path), getattr(policy, "policy", policy)
    if not isinstance(policy, TrainedPolicy):
        raise UserError(f"What can be stored is a policy, from load or train, not a {type(policy).__name__}.")
    if path.suffix in FILES:
        raise UserError(
            f"{path} is the name of a file, and a policy is stored as a folder, weights, normalizer and settings:"
            f" lem.save(policy, {str(path.with_suffix(''))!r}). Its weights alone:"
            f" torch.save(policy.networks.state_dict(), {path.name!r})."
        )
    stored = False  # what a run has saved is not to be replaced
    with suppress(UserError):
        stored = checkpoint.read(path).record.get("stored", False)
    if path.is_symlink() and not path.exists():
        raise UserError(f"{path} is a link that leads nowhere; choose another path.")
    if path.exists() and not stored:
        raise UserError(f"{path} exists already, and is not a stored policy; choose another path.")
    if others := sorted({file.name for file in path.glob("[!.]*")} - {*checkpoint.FILES, checkpoint.MANIFEST}):
        raise UserError(f"{path} holds {others[0]} beside a stored policy, which would be lost; choose another path.")
    record = {"algorithm": algorithm_of(policy), "config": policy.config.to_json()}
    record |= {"spec": checkpoint.spec_to_json(policy.spec), "planned": False, "stored": True}
    try:
        checkpoint.write_fields(path.resolve(), {"networks": policy.networks, "step": policy.step}, record)
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error}.") from error
    return path


def algorithm_of(policy: TrainedPolicy) -> str:
    """The name of the algorithm that trained a policy."""
    return algos.name_of(sys.modules[type(policy.config).__module__])
