"""Statistics of batches and of streams."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

Moments = tuple[Tensor, Tensor, Tensor]
"""mean, population variance and count of rows"""


def require_alike(**tensors: object) -> None:
    """Raise `ValueError` unless all have one shape, numbers left out: [B, 1] less [B] would be [B, B], and no error."""
    name, first = "", None
    for other, tensor in tensors.items():
        if isinstance(tensor, int | float) or getattr(tensor, "ndim", 1) == 0:
            continue
        if not isinstance(tensor, Tensor):
            raise ValueError(f"{other} must be a Tensor, not {type(tensor).__name__}.")
        if first is None:
            name, first = other, tensor
        elif first.shape != tensor.shape:
            shapes = f"{name} has the shape {list(first.shape)}, and {other} {list(tensor.shape)}"
            raise ValueError(f"{shapes}; they must be the same.")


def moments(rows: Tensor) -> Moments:
    """The moments over the last dimension of rows [..., B]; those of no rows are zero."""
    count = rows.new_tensor(rows.shape[-1])
    if not rows.shape[-1]:
        return rows.sum(-1), rows.sum(-1), count
    return rows.mean(-1), rows.var(-1, correction=0), count


def means(rows: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """The mean of each quantity over the rows in which it is."""
    columns: dict[str, list[Tensor]] = {}
    found: dict[str, Tensor] = {}
    for row in rows:
        for name, value in row.items():
            columns.setdefault(name, []).append(value)
    for name, column in columns.items():
        found[name] = torch.stack(list(map(torch.as_tensor, column))).mean()
    return found


def standardize(x: Float[Tensor, "*K B"]) -> Float[Tensor, "*K B"]:
    """(x − mean) / (std + 1e-8) over the last dimension, with the unbiased std; a constant batch becomes zeros."""
    mean, var, count = moments(x)
    std = (var * (count / (count - 1).clamp(min=1))).sqrt()
    return (x - mean[..., None]) / (std[..., None] + 1e-8)


def explained_variance(prediction: Tensor, target: Tensor) -> Tensor:
    """1 − Var[target − prediction] / Var[target], over [B]: 1 is perfect, 0 no better than the mean, below 0 worse.

    Not finite where the target is constant. Raises `ValueError` for other shapes.
    """
    require_alike(prediction=prediction, target=target)
    return 1 - moments(target - prediction)[1] / moments(target)[1]


def explained_by(features: Tensor, targets: Tensor, beside: Tensor) -> Tensor:
    """The share of the targets' variance that a regression on `features` explains beyond one on `beside`, less chance.

    The adjusted coefficient of partial determination, 1 − (RSS₁ / (B − p₁)) / (RSS₀ / (B − p₀)): about 0, and sometimes
    below, for features that have nothing to do with the targets.

    Args:
        features: [B, F], float64.
        targets: [B, K].
        beside: [B, G]; G may be 0.

    Returns:
        [K]; 0 where `beside` leaves nothing to explain, NaN where there are no more rows than columns.
    """
    base_dof = len(targets) - beside.shape[1] - 1
    full_dof = base_dof - features.shape[1]
    if full_dof <= 0:
        return targets.new_full(targets.shape[1:], torch.nan)
    if (targets == targets[:1]).all():  # a constant reward is common
        return torch.zeros_like(targets[0])
    x, y, gram = _normal(torch.cat([beside, features], dim=-1), targets)
    base_rss, full_rss = (_residual(x[:, :n], y, gram[:n, :n]) for n in (beside.shape[1], len(gram)))
    share = 1 - (full_rss / full_dof) / (base_rss / base_dof)
    return torch.where(base_rss > 1e-9 * targets.square().sum(0), share, 0.0)


def explained_by_each(features: Tensor, targets: Tensor) -> Tensor:
    """What `explained_by` says of each column of `features` [B, F] beside all the others, of one inverse: [F, K].

    Without column i the sum of squares is larger by β_i² / (XᵀX)⁻¹_ii, where β is the solution with all of them.
    """
    full_dof = len(targets) - features.shape[1] - 1
    if full_dof <= 0:
        return targets.new_full((features.shape[1], targets.shape[1]), torch.nan)
    x, y, gram = _normal(features, targets)
    inverse = torch.linalg.inv(gram)
    slopes = inverse @ (x.T @ y)
    full_rss = (y - x @ slopes).square().sum(0)
    base_rss = full_rss + slopes.square() / inverse.diagonal()[:, None]
    share = 1 - (full_rss / full_dof) / (base_rss / (full_dof + 1))
    return torch.where(base_rss > 1e-9 * targets.square().sum(0), share, 0.0)


def _residual(x: Tensor, y: Tensor, gram: Tensor) -> Tensor:
    """The sum of squares [K] that a line in columns x [B, F] of mean 0 leaves of targets y [B, K]; xᵀx is `gram`."""
    return (y - x @ torch.linalg.solve(gram, x.T @ y)).square().sum(0)


def _normal(columns: Tensor, targets: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Columns x of mean 0 and length 1, targets y of mean 0, and xᵀx, which has an inverse."""
    x, y = columns - columns.mean(0), targets - targets.mean(0)
    x = x / (x.square().sum(0).sqrt() + 1e-12)
    ridge = 1e-9 * torch.eye(x.shape[1], dtype=x.dtype, device=x.device)  # columns may be multiples of each other
    return x, y, x.T @ x + ridge


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


def clip_fraction(log_ratio: Tensor, clip: float | Tensor) -> Tensor:
    """The share of ratios outside [1−ε, 1+ε]."""
    return ((log_ratio.exp() - 1).abs() > clip).float().mean()


def ratio_statistics(log_ratio: Tensor, clip: float | Tensor) -> dict[str, Tensor]:
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
