"""Statistics of batches, of their shards, and of streams."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

Moments = tuple[Tensor, Tensor, Tensor]
"""mean, population variance and count of rows"""


class Shards:
    """The S shards that a batch is divided into. `lemniscate.system.world.World` has those of several processes.

    Whatever is computed of a shard has the same shapes wherever it is computed, and what the shards say is merged in
    their order. So no result depends on which process holds which shard.

    Args:
        count: S.
    """

    def __init__(self, count: int = 1) -> None:
        self.count = count
        self.held = range(count)
        """the numbers of those that this process holds"""

    def gather(self, mine: Tensor) -> Tensor:
        """The values of all shards, [S, …], from those of the shards held here, [held, …]."""
        return mine

    def to_first(self, mine: Tensor) -> Tensor:
        """The same, where the process that holds the first shard writes it; others may get only their own."""
        return mine

    def mean(self, values: Sequence[Tensor], rows: Sequence[int]) -> Tensor:
        """The mean over all rows, from that over the rows of each shard held, and the number of these."""
        if self.count == 1:
            return values[0]
        weights = self.gather(torch.tensor(rows, device=values[0].device)).to(values[0])
        return torch.tensordot(weights / weights.sum(), self.gather(torch.stack(list(values))), dims=1)

    def moments(self, parts: Sequence[Tensor]) -> Moments:
        """The moments over the last dimension of all shards' rows, from the rows [..., B] of each shard held here."""
        mine = [_moments(part) for part in parts]
        if self.count == 1:
            return mine[0]
        mean, var, count = self.gather(torch.stack([torch.stack(torch.broadcast_tensors(*m)) for m in mine])).unbind(1)
        rows = count.sum(0).clamp(min=1)  # of nothing, too
        middle = (mean * count).sum(0) / rows
        return middle, ((var + (mean - middle).square()) * count).sum(0) / rows, rows

    def standardize(self, parts: Sequence[Tensor]) -> list[Tensor]:
        """`standardize` with the moments of all shards, for the rows [..., B] of each shard held."""
        mean, var, count = self.moments(parts)
        std = (var * (count / (count - 1).clamp(min=1))).sqrt()
        return [(part - mean[..., None]) / (std[..., None] + 1e-8) for part in parts]


ONE_SHARD = Shards()
"""all rows, in this process"""


def _moments(rows: Tensor) -> Moments:
    count = rows.new_tensor(rows.shape[-1])
    if not rows.shape[-1]:
        return rows.sum(-1), rows.sum(-1), count
    return rows.mean(-1), rows.var(-1, correction=0), count


def means(rows: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """The mean of each quantity over the rows in which it is."""
    names = dict.fromkeys(name for row in rows for name in row)
    columns = {name: [row[name] for row in rows if name in row] for name in names}
    return {name: torch.stack(column).mean() if len(column) > 1 else column[0] for name, column in columns.items()}


def standardize(x: Float[Tensor, "*K B"], shards: Shards = ONE_SHARD) -> Float[Tensor, "*K B"]:
    """(x − mean) / (std + 1e-8), with the unbiased std; a constant batch becomes zeros, and so does a single row.

    The rows are in the last dimension, an equal part of each shard held; the moments are those of all shards.
    """
    return torch.cat(shards.standardize(x.chunk(len(shards.held), -1)), -1)


def explained_variance(prediction: Tensor, target: Tensor, rows: Sequence[Tensor], shards: Shards) -> Tensor:
    """1 − Var[target − prediction] / Var[target]: 1 is perfect, 0 no better than the mean, below 0 worse.

    Over `rows`, the indices of each shard held. Not finite where the target is constant.
    """
    error, known = ([x[chosen] for chosen in rows] for x in (target - prediction, target))
    return 1 - shards.moments(error)[1] / shards.moments(known)[1]


def kl_k1(log_ratio: Tensor) -> Tensor:
    """The estimate E_old[−log r] of KL(π_old ‖ π): unbiased, of high variance, sometimes negative.

    Schulman 2020, "Approximating KL Divergence" (joschu.net/blog/kl-approx.html), k1.
    """
    return -log_ratio.mean()


def kl_k3(log_ratio: Tensor) -> Tensor:
    """The estimate E_old[(r − 1) − log r] of KL(π_old ‖ π): unbiased, of low variance, never negative.

    Schulman 2020, "Approximating KL Divergence" (joschu.net/blog/kl-approx.html), k3.
    """
    return (log_ratio.exp() - 1 - log_ratio).mean()


def clip_fraction(log_ratio: Tensor, clip: float) -> Tensor:
    """The share of ratios outside [1−ε, 1+ε]."""
    return ((log_ratio.exp() - 1).abs() > clip).float().mean()


def ratio_statistics(log_ratio: Tensor, clip: float) -> dict[str, Tensor]:
    """The distance that a policy has moved: the two KL estimates and the clip fraction, by their usual names."""
    return {
        "approx_kl": kl_k3(log_ratio),
        "old_approx_kl": kl_k1(log_ratio),
        "clip_fraction": clip_fraction(log_ratio, clip),
    }


def merge_moments(
    mean_a: Tensor, var_a: Tensor, count_a: Tensor, mean_b: Tensor, var_b: Tensor, count_b: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Mean, population variance and count of the union of two samples.

    Chan, Golub & LeVeque 1983, eq. 2.1: exact, whatever the sizes.
    """
    count = (count_a + count_b).clamp(min=1)  # of nothing and nothing, too
    delta = mean_b - mean_a
    mean = mean_a + delta * (count_b / count)
    scatter = var_a * count_a + var_b * count_b + delta.square() * (count_a * count_b / count)
    return mean, scatter / count, count
