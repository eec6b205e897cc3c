"""Actions on their way into an environment: noise that is correlated in time, and the gradient that comes back."""

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor


def ornstein_uhlenbeck(normal: Float[Tensor, "*S L"], time: float) -> Float[Tensor, "*S L"]:
    """Sequences of an Ornstein–Uhlenbeck process, exact for any step: Uhlenbeck & Ornstein 1930; Gillespie 1996.

        x_0 = ε_0,    x_{t+1} = φ x_t + √(1 − φ²) ε_{t+1},    φ = exp(−1 / time)

    Every x_t is standard normal, and x_t and x_{t+k} correlate by φᵏ. In the form that the DDPG paper (Lillicrap et al.
    2016, arXiv:1509.02971, section 3) takes it from, dx = −θ x dt + σ dW, this is time = 1 / (θ dt) and a stationary
    standard deviation of σ / √(2θ), divided out.

    Args:
        normal: ε, standard normal.
        time: steps in which the correlation falls to 1/e, positive.
    """
    phi = math.exp(-1 / time)
    x = normal * math.sqrt(1 - phi * phi)
    x[..., 0] = normal[..., 0]
    reach = 1  # x_t = Σ_{k < reach} φᵏ x_{t−k} of what it was; so twice as far at each turn
    while reach < x.shape[-1]:
        x = torch.cat([x[..., :reach], x[..., reach:] + phi**reach * x[..., :-reach]], dim=-1)
        reach *= 2
    return x


def coloured(normal: Float[Tensor, "*S L"], exponent: float) -> Float[Tensor, "*S L"]:
    """Sequences whose power falls as f^(−β): Timmer & König 1995, *On generating power law noise*.

    Each frequency k / L gets an amplitude and a phase that are Gaussian, of standard deviation s_k = max(k, 1)^(−β/2)
    before the whole is scaled; then back to time by an inverse Fourier transform. Exponent 0 is white noise, 1 is pink
    (Eberhard et al. 2023, *Pink noise is all you need*), 2 is red.

    Args:
        normal: standard normal; L even.
        exponent: β.

    Returns:
        Standard normal at every step, correlated along L.
    """
    length = normal.shape[-1]
    half = length // 2
    scale = torch.arange(half + 1, dtype=normal.dtype, device=normal.device).clamp(min=1) ** (-exponent / 2)
    ends = torch.full_like(scale, 2)
    ends[0] = ends[-1] = 1  # frequencies 0 and ½ have no phase, and so one number of normal instead of two
    scale = scale * length / (2 * ends * scale.square()).sum().sqrt()
    real, imaginary = normal[..., : half + 1].clone(), torch.zeros_like(normal[..., : half + 1])
    imaginary[..., 1:half] = normal[..., half + 1 :]
    real[..., 0] *= math.sqrt(2)
    real[..., -1] *= math.sqrt(2)
    return torch.fft.irfft(torch.complex(real, imaginary) * scale, n=length)


def uniform(normal: Float[Tensor, "*S"]) -> Float[Tensor, "*S"]:
    """2 Φ(x) − 1: standard normal numbers to uniform ones in [-1, 1], whose order and dependence stay."""
    return torch.erf(normal / math.sqrt(2))


def clip_inward(action: Float[Tensor, "N A"], max_ratio: float) -> Float[Tensor, "N A"]:
    """Actions clipped to [-1, 1], whose gradient g [N, A], of a loss to descend, is made fit for a chain of steps.

        g ← 0 where the action is out of range and −g leads further out; a gradient that leads back is kept
        gᵢ ← gᵢ min(1, k · median ‖gⱼ‖ / ‖gᵢ‖) for each environment i, the median over those j with a gradient

    Hausknecht & Stone 2016, arXiv:1511.04143, call the first zeroing gradients; the limit is our choice.

    Args:
        action: of N environments.
        max_ratio: k; infinite for no limit.
    """
    return _ClipInward.apply(action, max_ratio)


class _ClipInward(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, action: Tensor, max_ratio: float) -> Tensor:
        ctx.save_for_backward(action)
        ctx.max_ratio = max_ratio
        return action.clamp(-1, 1)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        (action,), (gradient,) = ctx.saved_tensors, gradients
        outward = ((action > 1) & (gradient < 0)) | ((action < -1) & (gradient > 0))
        gradient = gradient.masked_fill(outward, 0)
        norm = gradient.norm(dim=-1, keepdim=True)
        usual = norm.masked_fill(norm == 0, torch.nan).nanmedian()
        scale = ctx.max_ratio * usual / norm
        return gradient * torch.fmin(scale, torch.ones_like(scale)), None  # fmin: 1 where no environment has a gradient
