"""The messages between the processes of a run after every update."""

from socket import gethostname
from zlib import crc32

import torch

from lemniscate.envs.episodes import Episodes
from lemniscate.errors import RankError
from lemniscate.run.state import TrainState
from lemniscate.system.world import World


def episodes_of_all(world: World, state: TrainState, episodes: Episodes) -> Episodes:
    """The episodes of all processes. Raises `RankError` where the networks of one are not those of the first."""
    said = world.each((fingerprint(state), episodes, gethostname()))
    for rank, (theirs, _, host) in enumerate(said):
        if theirs != said[0][0]:
            sentence = f"The networks of rank {rank} on {host} differ from those of rank 0 on {said[0][2]}"
            raise RankError(f"{sentence} after the update that ends at step {state.step:,}." if world.is_first else "")
    return Episodes.merged([part for _, part, _ in said])


def fingerprint(state: TrainState) -> int:
    """A checksum of the networks, the same in every process of a run."""
    checksum = 0
    for values in state.networks.state_dict().values():
        checksum = crc32(values.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy(), checksum)
    return checksum
