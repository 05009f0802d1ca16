"""Dense layers for students that are networks, and the encoding of their inputs."""

import math
from abc import abstractmethod

import torch
from torch import Tensor, nn
from torch.nn import functional

from bench.types import TwoTensors
from methods.instant_ngp.field import FieldPrecision
from methods.kernels import multiplies_bf16
from methods.kernels.types import joined
from methods.students.fields import StudentField

DIRECTION_FREQUENCIES = 4  # of NeRF, and of what follows it
DIRECTION_CHANNELS = 3 + 2 * 3 * DIRECTION_FREQUENCIES

CHUNK = 1 << 14  # samples that go through a network together: 16 MiB of activations


def positional(
    values: Tensor, frequencies: int, *, identity: bool = True, scale: float = math.pi
) -> Tensor:
    """Sines and cosines of `values` [S, C], at frequencies 2^0 to 2^(F - 1) times `scale`, the
    lowest first: [S, C (2 F + identity)]. Mildenhall et al. (2020), Eq. 4; the release has no pi
    (`scale` 1) and puts the values themselves in front (`identity`)."""
    angles = scale * values
    sine, cosine = angles.sin(), angles.cos()
    parts = [values] if identity else []
    for _ in range(frequencies):
        parts += [sine, cosine]
        # Double-angle formulas cost less than sin and cos. Errors double as the angle does;
        # with 1 - 2 sin^2 for the cosine they would grow faster.
        sine, cosine = 2 * sine * cosine, (cosine - sine) * (cosine + sine)
    return torch.cat(parts, dim=-1)


def encode_directions(directions: Tensor) -> Tensor:
    """The encoding [R, 27] of ray `directions` [R, 3], made unit vectors."""
    return positional(functional.normalize(directions, dim=-1), DIRECTION_FREQUENCIES)


class Dense(nn.Linear):
    """A dense layer: `inputs` [S, I] times weights, plus biases, [S, O].

    With precision "bf16" products are of bfloat16 with float32 accumulation, and results are
    bfloat16, if the device has such products; otherwise everything is float32. Parameters stay
    float32.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        precision: FieldPrecision,
        generator: torch.Generator | None,
    ) -> None:
        super().__init__(inputs, outputs)
        self.precision = precision
        bound = math.sqrt(6 / (inputs + outputs))  # Glorot and Bengio (2010), Eq. 16
        with torch.no_grad():
            self.weight.uniform_(-bound, bound, generator=generator)
            self.bias.zero_()

    def forward(self, inputs: Tensor) -> Tensor:
        return self.forward_with(inputs, self.weight, self.bias)

    def forward_with(self, inputs: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """Do the same with `weight` [O, I] and `bias` [O] in place of its own."""
        half = self.precision == "bf16" and multiplies_bf16(self.weight.device.type)
        dtype = torch.bfloat16 if half else self.weight.dtype
        return functional.linear(inputs.to(dtype), weight.to(dtype), bias.to(dtype))


class NetworkField(StudentField):
    """A field that is one large network of dense layers."""

    round_samples = 2  # a sample costs half a million products

    @abstractmethod
    def density_together(self, positions: Tensor) -> TwoTensors:
        """Density [S], and the output of the trunk as the geometry, of a few samples."""

    @abstractmethod
    def colours_together(self, geometry: Tensor, encoded: Tensor) -> Tensor:
        """Colours [S, 3] of a few samples."""

    def density(self, positions: Tensor) -> TwoTensors:
        parts = [self.density_together(part) for part in positions.split(CHUNK)]
        sigma, geometry = joined(parts)
        return sigma, geometry

    def features(self, geometry: Tensor, encoded: Tensor) -> Tensor:
        pairs = zip(geometry.split(CHUNK), encoded.split(CHUNK), strict=True)
        return torch.cat([self.colours_together(*pair) for pair in pairs])

    def sizes(self) -> dict[str, int]:
        return {"network": sum(x.numel() * x.element_size() for x in self.parameters())}


def density_of(raw: Tensor) -> Tensor:
    """ReLU of a density network's output; where the result is 0, a loss can still raise it. With
    the gradient of plain ReLU, a network that once gives 0 everywhere, as it may after its first
    steps among mostly empty samples, stays at 0 forever."""
    return _RisingRelu.apply(raw)


class _RisingRelu(torch.autograd.Function):
    @staticmethod
    def forward(ctx, raw):
        ctx.save_for_backward(raw)
        return raw.relu()

    @staticmethod
    def backward(ctx, grad):
        (raw,) = ctx.saved_tensors
        return torch.where(raw > 0, grad, grad.clamp(max=0))


def products(*layers: nn.Module) -> int:
    """Multiplications per sample in all dense layers inside `layers`."""
    dense = (part for layer in layers for part in layer.modules() if isinstance(part, Dense))
    return sum(part.weight.numel() for part in dense)
