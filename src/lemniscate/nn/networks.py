"""Networks: perceptrons, residual blocks, modules of one's own; and the encoder of images."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn.parameter import is_lazy

from lemniscate.errors import UserError, shown, unknown_name
from lemniscate.maths import tanh
from lemniscate.spec import ObservationPart
from lemniscate.system.named import find_callable

Activation = Literal["tanh", "relu", "elu", "silu"]


class Tanh(nn.Module):
    """`lemniscate.maths.tanh`, any shape to the same shape."""

    forward = staticmethod(tanh)


ACTIVATIONS = {"tanh": Tanh, "relu": nn.ReLU, "elu": nn.ELU, "silu": nn.SiLU}

Matmul = Literal["float32", "bfloat16"]
"""of products between hidden layers; the first and the last are always in float32"""


class Bfloat16Linear(nn.Linear):
    """x Wᵀ + b with both factors and their product rounded to bfloat16, 8 bits each, on the way there and back.

    The sums inside the product are of float32. Parameters and b keep their type, and so does what comes out.
    """

    def forward(self, input: Tensor) -> Tensor:
        """[…, inputs] to […, outputs]."""
        return nn.functional.linear(input.bfloat16(), self.weight.bfloat16()).to(input.dtype) + self.bias


@dataclass(frozen=True)
class Layers:
    """The settings of a network between its inputs and its outputs.

    Args:
        hidden: widths of the hidden layers.
        activation: between the layers.
        kind: a name in `NETWORKS`, gru, or one's own as `module:Class` or `module:Class(key=value, …)`: called with the
            numbers of inputs and outputs it makes a module that takes [B, inputs] to [B, outputs]. Where the class has
            a `memory_size` K, the module takes [B, inputs] and [B, K] to [B, outputs] and the next [B, K].
        matmul: precision of the products between hidden layers.
    """

    hidden: tuple[int, ...] = (64, 64)
    activation: Activation = "tanh"
    kind: str = "mlp"
    matmul: Matmul = "float32"

    def check(self) -> None:
        """Raise `UserError` if no network can have these layers."""
        if self.kind not in (*NETWORKS, "gru") and ":" not in self.kind:
            raise unknown_name("network", self.kind, [*NETWORKS, "gru", "module:Class"])
        if self.kind == "gru" and not self.hidden:
            raise UserError("A gru needs a width, the numbers that it remembers, such as (64, 64).")
        if self.kind == "simba" and len(set(self.hidden)) != 1:
            raise UserError(f"SimBa's blocks have one width, such as (256, 256), not {self.hidden}.")

    def network(self, inputs: int, outputs: int, last_gain: float) -> nn.Module:
        """A new network, […, inputs] to […, outputs]; orthogonal weights, zero biases.

        The last layer has gain `last_gain`: 0.01 for a policy, so that it starts near the centre of its range whatever
        it observes (Andrychowicz et al. 2021, arXiv:2006.05990, section 3.2), 1 for a value; the others have √2,
        SimBa's first one 1.
        """
        if self.remembers:
            raise UserError(f"{self.kind} has a memory, with which a2c, ppo, trpo and reppo learn.")
        if self.kind not in NETWORKS:
            return OwnNetwork(self.kind, inputs, outputs)
        layers, width = NETWORKS[self.kind](self, inputs)
        return nn.Sequential(*layers, orthogonal(nn.Linear(width, outputs), last_gain))

    @cached_property
    def remembers(self) -> bool:
        """Whether a network of these layers has a memory. Raises `UserError` for one of one's own that is not found."""
        if ":" not in self.kind:
            return self.kind == "gru"
        return _memory_size(find_callable(self.kind)) > 0

    @property
    def linear(self) -> type[nn.Linear]:
        """The class of the products between hidden layers."""
        return nn.Linear if self.matmul == "float32" else Bfloat16Linear


def _mlp(layers: Layers, inputs: int, normalized: bool = False) -> tuple[list[nn.Module], int]:
    modules: list[nn.Module] = []
    for i, (before, after) in enumerate(pairwise((inputs, *layers.hidden))):
        modules += [orthogonal((layers.linear if i else nn.Linear)(before, after), 2**0.5)]
        modules += [nn.LayerNorm(after)] if normalized else []
        modules += [ACTIVATIONS[layers.activation]()]
    return modules, layers.hidden[-1] if layers.hidden else inputs


def _simba(layers: Layers, inputs: int) -> tuple[list[nn.Module], int]:
    width = layers.hidden[-1]
    blocks = (Residual(width, layers.linear) for _ in layers.hidden)
    return [orthogonal(nn.Linear(inputs, width), 1.0), *blocks, nn.LayerNorm(width)], width


NETWORKS: dict[str, Callable[[Layers, int], tuple[list[nn.Module], int]]] = {
    "mlp": _mlp,
    "layer_norm": partial(_mlp, normalized=True),
    "simba": _simba,
}
"""The layers before the last one, and the number of their outputs."""


def _memory_size(maker: Callable[..., Any]) -> int:
    """The numbers that modules of a class remember; 0 where it does not say so. Raises `UserError` for no number."""
    size = getattr(getattr(maker, "func", maker), "memory_size", 0)
    if type(size) is not int or size < 0:
        name = getattr(maker, "__name__", maker)
        raise UserError(f"memory_size of {name} is {shown(size)}; in the class it must be a whole number, such as 64.")
    return size


class OwnNetwork(nn.Module):
    """A module of one's own, which `name` makes: it takes rows [B, inputs] to [B, outputs], whatever dimensions lead.

    Raises:
        UserError: it cannot be made, called or saved; nothing in it learns; or what it does in training could not be
            repeated, since it is random or changes its own tensors.
    """

    def __init__(self, name: str, inputs: int, outputs: int) -> None:
        super().__init__()
        self.name, self.writes = name, False
        rows = torch.randn(64, inputs, generator=torch.Generator().manual_seed(0))
        wanted = f"{name}({inputs}, {outputs}) must make a module that takes {self._expected_shapes(inputs, outputs)}"
        try:
            self.module = self._make(inputs, outputs)
            before, given = self._tensors(), rows.clone()
            with torch.enable_grad():
                out = self._call(given)
                if isinstance(out, Tensor) and out.requires_grad:  # fails where forward has overwritten what it needs
                    torch.autograd.grad(out.sum(), [x for x in self.parameters() if x.requires_grad], allow_unused=True)
            self.writes = not _equal(given, rows)
            with torch.no_grad():  # last, so that nothing that the module keeps has a graph, which could not be copied
                again, acting = self._call(rows), self._call_to_act(rows)
            changed = [key for key, tensor in self._tensors().items() if not _equal(before.get(key, tensor), tensor)]
            lost = [key for key, tensor in self.state_dict().items() if not tensor.isfinite().all()]
        except UserError:
            raise
        except Exception as error:
            raise UserError(f"{wanted}: {type(error).__name__}: {error}") from error
        if not isinstance(out, Tensor) or (*out.shape, out.dtype) != (len(rows), outputs, torch.float32):
            what = f"{list(out.shape)} of {out.dtype}" if isinstance(out, Tensor) else f"a {type(out).__name__}"
            raise UserError(f"{wanted}, in float32; it takes [{len(rows)}, {inputs}] to {what}.")
        if changed:
            how = f"changes {changed[0].removeprefix('module.')} in forward, which no other process would repeat"
            raise UserError(f"{name} {how}; take LayerNorm in the place of batch normalization.")
        self._require_repeated(out, again, acting)
        self._require_learned(out, lost)
        self._require_rows(out, rows)
        self._require_saved(out, rows)

    def _make(self, inputs: int, outputs: int) -> Any:
        """A new module. Raises `UserError` for one that is made already, or says too late that it has a memory."""
        maker = find_callable(self.name)
        if isinstance(maker, nn.Module):
            kind = type(maker).__name__
            raise UserError(f"network is a {kind} that is made already: give its class, of which each network is one.")
        module = maker(inputs, outputs)
        if not isinstance(module, nn.Module):
            raise UserError(f"network must make a torch module, and {self.name} makes {shown(module)}.")
        if getattr(module, "memory_size", 0) and not _memory_size(maker):
            raise UserError(f"{self.name} sets its memory_size too late; it must stand in the class: memory_size = 64.")
        return module

    def _require_repeated(self, out: Tensor, again: Tensor, acting: Any) -> None:
        """Raise `UserError` where the same rows have other outputs, in a second call or out of training."""
        if not _equal(out, again):
            how = "is random: two calls with the same rows differ, and so would old and new probabilities"
            raise UserError(f"{self.name} {how}; leave out its dropout, and what it keeps, or changes in its input.")
        if not isinstance(acting, Tensor) or not _equal(out, acting):
            how = "has other outputs after eval(), in which policies act, than in training"
            raise UserError(f"{self.name} {how}: they must not depend on self.training.")

    def _require_learned(self, out: Tensor, lost: list[str]) -> None:
        """Raise `UserError` for numbers that are not finite, and where nothing of float32 would be learned."""
        if lost:
            raise UserError(f"{self.name} has a number in {lost[0].removeprefix('module.')} that is not finite.")
        types = {str(parameter.dtype) for parameter in self.parameters() if parameter.requires_grad}
        if types == {"torch.float32"} and not out.requires_grad:
            raise UserError(f"{self.name} has outputs that do not depend on its parameters: no detach, and no no_grad.")
        if types != {"torch.float32"}:
            kinds = f"parameters of {', '.join(sorted(types))}" if types else "no parameter to learn"
            raise UserError(f"{self.name} has {kinds}; it must have some of torch.float32 that its outputs depend on.")

    def _require_rows(self, out: Tensor, rows: Tensor) -> None:
        """Raise `UserError` where a row [1, inputs] does not stay a row, or where its output depends on the others."""
        if not out.isfinite().all():
            raise UserError(f"{self.name} has outputs that are not finite, of inputs of ordinary size.")
        try:
            with torch.no_grad():
                alone, turned = self._call(rows[:1]), self._call(rows.flip(0))
        except ValueError as error:  # of batch normalization, by the statistics of the rows themselves
            raise UserError(
                f"{self.name} cannot take one row: {error}; LayerNorm takes the place of batch normalization."
            ) from error
        if alone.shape != (1, out.shape[1]) and alone.shape != out.shape:
            shapes = f"[1, {rows.shape[1]}], to {list(alone.shape)}; it must be [1, {out.shape[1]}]"
            raise UserError(f"{self.name} takes one row, {shapes}.")
        if not all(torch.allclose(out[: len(x)], x, rtol=1e-3, atol=1e-4) for x in (alone, turned.flip(0))):
            raise UserError(
                f"{self.name} has an output at one row that depends on the other rows: it takes them for one sequence,"
                " or normalizes over them, as batch normalization does; LayerNorm does not."
            )

    def _require_saved(self, out: Tensor, rows: Tensor) -> None:
        """Raise `UserError` where another module with the same state_dict has other outputs at rows [B, inputs]."""
        module = self.module
        try:
            with torch.random.fork_rng([]), torch.no_grad():
                self.module = self._make(rows.shape[-1], out.shape[-1])
                self._call(rows)  # where its layers find out their sizes
                self.module.load_state_dict(module.state_dict())
                again, self.module = self._call(rows), module
        except Exception as error:
            raise UserError(
                f"{self.name} cannot be made again, to be loaded: {type(error).__name__}: {error}"
            ) from error
        if not _equal(out, again):
            raise UserError(
                f"{self.name} has numbers that its state_dict has not, so that they would be neither learned nor saved:"
                " layers must be attributes or in an nn.ModuleList, and tensors given to register_buffer."
            )

    def _expected_shapes(self, inputs: int, outputs: int) -> str:
        """The shapes that the module is to take and return, in words."""
        return f"[B, {inputs}] to [B, {outputs}]"

    def _call(self, rows: Tensor) -> Tensor:
        """The outputs at rows [B, inputs] for the checks above."""
        return self.module(rows.clone() if self.writes else rows)

    def _call_to_act(self, rows: Tensor) -> Tensor:
        """The outputs while the module is not in training."""
        modes = [(module, module.training) for module in self.module.modules()]
        try:
            self.module.eval()
            return self._call(rows)
        finally:
            for module, mode in modes:
                module.training = mode

    def forward(self, x: Tensor) -> Tensor:
        """[…, inputs] to […, outputs]."""
        rows = x.reshape(-1, x.shape[-1]) if x.dim() != 2 else x
        out = self.module(rows.clone() if self.writes else rows)
        return out.reshape(*x.shape[:-1], out.shape[-1]) if x.dim() != 2 else out

    def _tensors(self) -> dict[str, Tensor]:
        """Copies of all parameters and buffers, but of those that get their shape in the first call."""
        named = (*self.named_parameters(), *self.named_buffers())
        return {name: tensor.detach().clone() for name, tensor in named if not is_lazy(tensor)}


def _equal(one: Tensor, other: Tensor) -> bool:
    return torch.equal(one.nan_to_num(), other.nan_to_num())


class Residual(nn.Module):
    """x + W₂ relu(W₁ LN(x)), four times as wide inside: a block of SimBa, Lee et al. 2025, arXiv:2410.09754, eq. 5."""

    def __init__(self, width: int, kind: type[nn.Linear] = nn.Linear) -> None:
        super().__init__()
        inner, outer = kind(width, 4 * width), kind(4 * width, width)
        self.layers = nn.Sequential(
            nn.LayerNorm(width), orthogonal(inner, 2**0.5), nn.ReLU(), orthogonal(outer, 2**0.5)
        )

    def forward(self, x: Tensor) -> Tensor:
        """[…, width] to the same shape."""
        return x + self.layers(x)


def orthogonal(layer: nn.Linear | nn.Conv2d, gain: float) -> nn.Module:
    """The layer with orthogonal weights of this gain, and zero biases."""
    nn.init.orthogonal_(layer.weight, gain)
    assert layer.bias is not None
    nn.init.zeros_(layer.bias)
    return layer


class ImageEncoder(nn.Module):
    """Two convolutions with ReLU, 16 and 32 channels, and layer normalization.

    8 × 8 pixels in steps of 4, then 4 × 4 in steps of 2 (Mnih et al. 2013, arXiv:1312.5602, section 4.1); in images
    with a side below 36 pixels, such as a grid world's, 3 × 3 in steps of 1, then of 2. Without the normalization a
    policy's encoder, which learns from the advantage alone, may end with the same output for every image.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        super().__init__()
        self.shape = height, width, channels = shape
        if min(height, width) < 36:
            first = nn.Conv2d(channels, 16, kernel_size=3, padding=1)
            second = nn.Conv2d(16, 32, kernel_size=3, stride=2, padding=1)
        else:
            first = nn.Conv2d(channels, 16, kernel_size=8, stride=4)
            second = nn.Conv2d(16, 32, kernel_size=4, stride=2)
        convolutions = [orthogonal(first, 2**0.5), nn.ReLU(), orthogonal(second, 2**0.5), nn.ReLU(), nn.Flatten()]
        with torch.no_grad():
            self.size = nn.Sequential(*convolutions)(torch.zeros(1, channels, height, width)).shape[-1]
        """length of what comes out"""
        self.layers = nn.Sequential(*convolutions, nn.LayerNorm(self.size))

    def forward(self, pixels: Tensor) -> Tensor:
        """[…, H · W · C] in [-½, ½] to […, `size`]."""
        images = pixels.reshape(-1, *self.shape).movedim(-1, 1)
        return self.layers(images).reshape(*pixels.shape[:-1], self.size)


class PartsEncoder(nn.Module):
    """The features of several parts of the observation: images by an encoder each, beside numbers as they are."""

    def __init__(self, parts: Sequence[ObservationPart]) -> None:
        super().__init__()
        self._sizes = [part.size for part in parts]
        self.encoders = nn.ModuleList(ImageEncoder(part.shape) if part.image else nn.Identity() for part in parts)
        self.size = sum(getattr(encoder, "size", part.size) for encoder, part in zip(self.encoders, parts, strict=True))
        """length of what comes out"""

    def forward(self, obs: Tensor) -> Tensor:
        """Normalized observations […, O] to […, `size`]."""
        pieces = zip(self.encoders, obs.split(self._sizes, dim=-1), strict=True)
        return torch.cat([encoder(piece) for encoder, piece in pieces], dim=-1)
