"""Many small networks, each for the samples of its own cell (Reiser et al. 2021, Section 3).

Samples are sorted by network, so that the weights of one network stay in the cache while its
samples are computed. All networks have the layers of KiloNeRF (Figure 2):

hidden = relu(mid(relu(in(encoding of the position)))), density = density(hidden),
colour = sigmoid(colour(relu(direction(feature(hidden), encoding of the direction))))

`feature` is not followed by a ReLU. The density has no activation here.
"""

from collections.abc import Mapping
from types import ModuleType

import torch
from torch import Tensor

from bench.types import TwoTensors, check_shape
from methods.kernels.dispatch import implementation

HIDDEN = 32  # outputs of every layer except density and colour

POSITION_FREQUENCIES, DIRECTION_FREQUENCIES = 10, 4

SHAPES = {
    "in": (3 + 6 * POSITION_FREQUENCIES, HIDDEN),
    "mid": (HIDDEN, HIDDEN),
    "density": (HIDDEN, 1),
    "feature": (HIDDEN, HIDDEN),
    "direction": (HIDDEN + 3 + 6 * DIRECTION_FREQUENCIES, HIDDEN),
    "colour": (HIDDEN, 3),
}
"""Inputs and outputs of a layer: 6,212 parameters a network."""

Networks = Mapping[str, TwoTensors]
"""Weights [N, I, O], from I inputs to O outputs, and biases [N, O] of each layer of N networks."""


def locate(
    positions: Tensor, cubes: Tensor, corner: Tensor, side: Tensor, *, backend: str = "auto"
) -> TwoTensors:
    """The networks [S] int16 of `positions` [S, 3], -1 for none, and where these are in the cubes
    of their networks [S, 3], -1 to 1 along each axis. No gradient. `cubes` [X, Y, Z] int16 are the
    networks of a grid of cubes of a `side` [], -1 for none; the first one has the lower `corner`
    [3]."""
    check_shape("positions", positions, None, 3)
    check_shape("cubes", cubes, None, None, None)
    check_shape("corner", corner, 3)
    kernel = implementation(__name__, backend, positions.device)
    return kernel.locate(positions, cubes, corner, side)


def order(networks: Tensor, count: int, *, backend: str = "auto") -> TwoTensors:
    """Sort samples by their `networks` [S], integers below `count`, which is not checked, negative
    for none; within a network they keep their order. Returns the samples [M] int64 that have a
    network, and offsets [N + 1] int64: network n owns offsets[n] to offsets[n + 1] of them."""
    check_shape("networks", networks, None)
    return implementation(__name__, backend, networks.device).order(networks, count)


def encode_frequencies(inputs: Tensor, frequencies: int, *, backend: str = "auto") -> Tensor:
    """Positional encoding [S, 3 + 6 F] of `inputs` [S, 3]: x, sin x, cos x, sin 2x, cos 2x, ...

    Angles are 2^k x for k = 0 to F - 1, without the factor pi of Mildenhall et al. 2020, Eq. 4, as
    in their release and that of KiloNeRF. Differentiable with backend="reference" only; with
    backend="cpu" an input beyond +-16 loses digits.
    """
    check_shape("inputs", inputs, None, 3)
    return implementation(__name__, backend, inputs.device).encode_frequencies(inputs, frequencies)


def grouped_linear(
    inputs: Tensor,
    weights: Tensor,
    biases: Tensor,
    offsets: Tensor,
    *,
    relu: bool = False,
    backend: str = "auto",
) -> Tensor:
    """A linear layer [S, O], with a `relu` or without, on `inputs` [S, I] sorted by network.
    Differentiable in inputs, `weights` [N, I, O] and `biases` [N, O]; `offsets` [N + 1] are those
    of `order`. Not checked."""
    check_shape("weights", weights, None, None, None)
    networks, channels, outputs = weights.shape
    check_shape("inputs", inputs, None, channels)
    check_shape("biases", biases, networks, outputs)
    check_shape("offsets", offsets, networks + 1)
    kernel = implementation(__name__, backend, inputs.device)
    return kernel.grouped_linear(inputs, weights, biases, offsets, relu)


def densities(
    positions: Tensor, numbers: Tensor, networks: Networks, *, backend: str = "auto"
) -> TwoTensors:
    """Densities [S] before their activation, and the input [S, 33] of `colours`, of samples at
    `positions` [S, 3] in the cubes of their networks, by their `numbers` [S] as for `order`.
    `colours` takes the hidden channels, then the number, which is exact in float32. Densities and
    hidden channels are 0 where a sample has no network. Differentiable in the networks."""
    check_shape("positions", positions, None, 3)
    check_shape("numbers", numbers, len(positions))
    kernel = implementation(__name__, backend, positions.device)
    if _in_one_pass(kernel, networks):
        return kernel.densities(positions, numbers, networks)
    place, offsets = order(numbers, len(networks["in"][0]), backend=backend)
    x = encode_frequencies(positions[place], POSITION_FREQUENCIES, backend=backend)
    for name in ("in", "mid"):
        x = grouped_linear(x, *networks[name], offsets, relu=True, backend=backend)
    raw = grouped_linear(x, *networks["density"], offsets, backend=backend)
    hidden = _back(x, place, len(positions))
    geometry = torch.cat((hidden, numbers[:, None].to(hidden.dtype)), dim=1)
    return _back(raw, place, len(positions)).squeeze(1), geometry


def colours(
    geometry: Tensor, encoded: Tensor, networks: Networks, *, backend: str = "auto"
) -> Tensor:
    """Colours [S, 3] in (0, 1) of samples with the `geometry` [S, 33] of `densities` in `encoded`
    directions [S, 27]; 0 where a sample has no network. Differentiable in the hidden channels and
    the networks."""
    check_shape("geometry", geometry, None, HIDDEN + 1)
    check_shape("encoded", encoded, len(geometry), SHAPES["direction"][0] - HIDDEN)
    kernel = implementation(__name__, backend, geometry.device)
    if _in_one_pass(kernel, networks, geometry):
        return kernel.colours(geometry, encoded, networks)
    numbers, count = geometry[:, HIDDEN].detach().int(), len(networks["feature"][0])
    place, offsets = order(numbers, count, backend=backend)
    hidden = geometry[place, :HIDDEN]
    feature = grouped_linear(hidden, *networks["feature"], offsets, backend=backend)
    x = torch.cat((feature, encoded[place]), dim=1)
    x = grouped_linear(x, *networks["direction"], offsets, relu=True, backend=backend)
    x = grouped_linear(x, *networks["colour"], offsets, backend=backend)
    return _back(x.sigmoid(), place, len(geometry))


def _in_one_pass(kernel: ModuleType, networks: Networks, *inputs: Tensor) -> bool:
    """Whether nobody asks for gradients, and the backend has all layers in one loop."""
    tensors = (*inputs, *(tensor for layer in networks.values() for tensor in layer))
    learned = any(tensor.requires_grad for tensor in tensors)
    return hasattr(kernel, "densities") and not (learned and torch.is_grad_enabled())


def _back(values: Tensor, place: Tensor, count: int) -> Tensor:
    """Scatter rows back to their original places among `count` rows; zeros elsewhere."""
    return values.new_zeros(count, values.shape[1]).index_copy(0, place, values)
