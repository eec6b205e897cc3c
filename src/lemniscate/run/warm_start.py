"""Warm start: networks that another run has trained are the beginning of this one."""

from collections.abc import Callable
from pathlib import Path

from torch import Tensor, nn

from lemniscate.errors import UserError
from lemniscate.run import checkpoint
from lemniscate.run.config import RunConfig
from lemniscate.run.directory import find_checkpoint
from lemniscate.spec import Spec

FUNCTION = ("network", "activation")
"""fields of a Config that change what networks of the same shapes compute"""

SHAPE = ("hidden", "normalize_observations")
"""fields of a Config that a policy of other shapes may come from"""


def load_networks(networks: nn.Module, config: RunConfig, spec: Spec, locate: Callable[[str], Path] = Path) -> str:
    """Load the networks of the run or checkpoint `config.warm_start` into `networks`, as many as fit.

    All of them if they have the same names and shapes; else the policy, with its normalizer, if it has. `locate` finds
    the directory that `config.warm_start` names: a run knows no address but a path.

    Returns:
        A sentence on what was loaded.

    Raises:
        UserError: no such checkpoint; other spaces; a policy of other shapes.
    """
    source = find_checkpoint(locate(str(config.warm_start)))
    name = f"{config.warm_start} at step {source.numbers['step']:,}"
    their_spec = checkpoint.spec_from_json(source.record["spec"])
    if not their_spec.fits(spec):
        raise UserError(
            f"warm_start: {name} was trained on {their_spec.env_id}, whose observation or action spaces differ from"
            f" those of {spec.env_id}."
        )
    theirs, mine = source.record["config"], config.to_json()
    shared = [field for field in (*FUNCTION, *SHAPE) if field in theirs and field in mine]
    differing = [field for field in shared if theirs[field] != mine[field]]
    settings = [f"{field} is {theirs[field]!r} there and {mine[field]!r} here" for field in differing]
    if set(differing) & set(FUNCTION):
        raise UserError(f"warm_start: {name} does not fit: {settings[0]}.")
    found, own = source.tensors_of("networks"), networks.state_dict()
    if not difference(found, own) and theirs.get("value_range") == mine.get("value_range"):  # else a Q says another
        networks.load_state_dict(found)
        return f"Warm start: all networks of {name}."
    policy, own_policy = _policy(found), _policy(own)
    if differs := difference(policy, own_policy):
        raise UserError(f"warm_start: the policy of {name} does not fit: {[*settings, differs][0]}.")
    networks.load_state_dict(policy, strict=False)
    return f"Warm start: the policy of {name}; the other networks are new."


def _policy(networks: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: tensor for name, tensor in networks.items() if name.startswith("policy.")}


def difference(theirs: dict[str, Tensor], mine: dict[str, Tensor]) -> str:
    """The first parameter that is missing on one side or has another shape; empty if there is none."""
    for name in [*mine, *theirs]:
        there, here = (list(side[name].shape) if name in side else "missing" for side in (theirs, mine))
        if there != here:
            return f"{name} is {there} there and {here} here"
    return ""
