"""Warm start: networks that another run has trained are the beginning of this one."""

from collections.abc import Callable
from pathlib import Path

from torch import Tensor, nn

from lemniscate.errors import UserError
from lemniscate.run import checkpoint
from lemniscate.run.config import RunConfig
from lemniscate.run.directory import find_checkpoint
from lemniscate.spec import Spec

FUNCTION = ("network", "activation", "normalize_observations")
"""fields of a Config that change what networks of the same shapes compute"""


def load_networks(networks: nn.Module, config: RunConfig, spec: Spec, locate: Callable[[str], Path] = Path) -> str:
    """Load the networks of the run or checkpoint `config.warm_start` into `networks`, as much as fits.

    The tensors of equal names and shapes are taken over, the others stay new: another head, other observations, other
    critics. A normalizer is taken over whole or not at all. `locate` finds the directory that `config.warm_start`
    names: a run knows no address but a path.

    Returns:
        A sentence on what was loaded.

    Raises:
        UserError: no such checkpoint; networks of another function; no layer of the policy fits.
    """
    source = find_checkpoint(locate(str(config.warm_start)))
    name = f"{config.warm_start} at step {source.numbers['step']:,}"
    their_spec = checkpoint.spec_from_json(source.record["spec"])
    elsewhere = "" if their_spec.fits(spec) else f"; it was trained on {their_spec.env_id}, with other spaces"
    theirs, ours = source.record["config"], config.to_json()
    shared = [field for field in (*FUNCTION, "hidden") if field in theirs and field in ours]
    differing = [field for field in shared if theirs[field] != ours[field]]
    settings = [f"{field} is {theirs[field]!r} there and {ours[field]!r} here" for field in differing]
    if set(differing) & set(FUNCTION):
        raise UserError(f"warm_start: {name} does not fit: {settings[0]}.")
    found, own = source.tensors_of("networks"), networks.state_dict()
    comparable = theirs.get("value_range") == ours.get("value_range")  # else a Q of these shapes says another
    fits = {
        key: tensor
        for key, tensor in found.items()
        if key in own and tensor.shape == own[key].shape and (comparable or key.startswith("policy."))
    }
    resized = [key.removesuffix("mean") + "count" for key in own if key.endswith(".mean") and key not in fits]
    fits = {key: tensor for key, tensor in fits.items() if key not in resized}
    if not any(key.startswith("policy.") and tensor.ndim > 1 for key, tensor in fits.items()):
        reason = [*settings, difference(found, own)][0]
        raise UserError(f"warm_start: no layer of the policy of {name} fits: {reason}{elsewhere}.")
    networks.load_state_dict(fits, strict=False)
    named = (*networks.named_parameters(), *networks.named_buffers())  # a normalizer that networks share is one
    mine = [key for key, _ in named if key in own]
    new = [key for key in mine if key not in fits]
    if not new:
        return f"Warm start: all networks of {name}{elsewhere}."
    some = ", ".join(new[:3]) + ", …" * (len(new) > 3)
    return f"Warm start: {len(mine) - len(new):,} tensors of {name}; {len(new):,} begin anew, {some}{elsewhere}."


def difference(theirs: dict[str, Tensor], mine: dict[str, Tensor]) -> str:
    """The first parameter that is missing on one side or has another shape; empty if there is none."""
    for name in [*mine, *theirs]:
        there, here = (list(side[name].shape) if name in side else "missing" for side in (theirs, mine))
        if there != here:
            return f"{name} is {there} there and {here} here"
    return ""
