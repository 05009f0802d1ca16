"""Many small networks, each for the samples of its own cell (Reiser et al. 2021, Section 3).

Samples are sorted by network, so that the weights of one network stay in the cache while its
samples are computed. All networks have the layers of KiloNeRF (Figure 2):

hidden = relu(mid(relu(in(encoding of the position)))), density = density(hidden),
colour = sigmoid(colour(relu(direction(feature(hidden), encoding of the direction))))

`feature` is not followed by a ReLU. The density has no activation here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from bench.types import check_shape
from methods.kernels.dispatch import implementation
from methods.kernels.types import expect

HIDDEN = 32
"""Outputs of every layer except density and colour."""


@dataclass(frozen=True)
class Groups:
    """Samples sorted by network.

    Attributes:
        permutation: [M] int64, the samples that have a network, network by network; within a
            network in the given order.
        offsets: [N + 1] int64, network n owns offsets[n] to offsets[n + 1] of the permutation.
    """

    permutation: Tensor
    offsets: Tensor


@dataclass(frozen=True)
class Networks:
    """N networks with the layers in, mid, density, feature, direction and colour.

    Attributes:
        weights: [N, I, O] for each layer, from I inputs to O outputs.
        biases: [N, O] for each layer.
    """

    weights: Mapping[str, Tensor]
    biases: Mapping[str, Tensor]

    def layer(self, name: str) -> tuple[Tensor, Tensor]:
        """Weights and biases of a layer."""
        return self.weights[name], self.biases[name]

    @property
    def count(self) -> int:
        """N, the number of networks."""
        return len(self.biases["in"])

    @property
    def frequencies(self) -> int:
        """F, frequencies in the encoding of a position: the first layer has 3 + 6 F inputs."""
        return (self.weights["in"].shape[1] - 3) // 6

    @property
    def learning(self) -> bool:
        """Whether gradients are needed."""
        tensors = (*self.weights.values(), *self.biases.values())
        return torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)


def locate(
    positions: Tensor, cubes: Tensor, corner: Tensor, side: Tensor, *, backend: str = "auto"
) -> tuple[Tensor, Tensor]:
    """Find the network of each position, and the local position in its cube. No gradient.

    Returns networks [S] int16, -1 for none, and local positions [S, 3], -1 to 1 along each axis.

    Args:
        positions: [S, 3].
        cubes: [X, Y, Z] int16, the network of each cube of a grid, -1 for none.
        corner: [3] lower corner of the first cube.
        side: [] side of a cube.

    Raises:
        ValueError: wrong shapes; backend "cpu": not float32.
    """
    check_shape("positions", positions, None, 3)
    check_shape("cubes", cubes, None, None, None)
    check_shape("corner", corner, 3)
    return implementation(__name__, backend, positions.device).locate(
        positions, cubes, corner, side
    )


def order(networks: Tensor, count: int, *, backend: str = "auto") -> Groups:
    """Sort samples by their networks.

    Args:
        networks: [S] int16, int32 or int64, the number of each sample's network; negative: none.
        count: N, the number of networks.

    Raises:
        ValueError: wrong shape or type; on a CPU, a network number of N or more.
    """
    check_shape("networks", networks, None)
    expect(not networks.is_floating_point(), "networks", "whole numbers", networks.dtype)
    if len(networks) and networks.device.type == "cpu":  # on a GPU the check would wait
        most = int(networks.max())
        expect(most < count, "networks", f"numbers below {count}, negative ones for none", most)
    return implementation(__name__, backend, networks.device).order(networks, count)


def encode_frequencies(inputs: Tensor, frequencies: int, *, backend: str = "auto") -> Tensor:
    """Positional encoding [S, 3 + 6 F] of `inputs` [S, 3]: x, sin x, cos x, sin 2x, cos 2x, ...

    Angles are 2^k x for k = 0 to F - 1, without the factor pi of Mildenhall et al. 2020, Eq. 4, as
    in their release and that of KiloNeRF. Differentiable with backend="reference" only; with
    backend="cpu" an input beyond +-16 loses digits.

    Raises:
        ValueError: wrong shape, F < 1; backend "cpu": not float32.
    """
    check_shape("inputs", inputs, None, 3)
    expect(frequencies >= 1, "frequencies", "1 or more", frequencies)
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
    """A linear layer [S, O] on samples sorted by network; differentiable in all three tensors.

    Args:
        inputs: [S, I]; network n has rows offsets[n] to offsets[n + 1].
        weights: [N, I, O].
        biases: [N, O].
        offsets: [N + 1] int64 of `Groups`, from 0 to S.
        relu: whether to apply a ReLU to the outputs.

    Raises:
        ValueError: wrong shapes; on a CPU, offsets that do not end at S; backend "cpu":
            not float32.
    """
    check_shape("weights", weights, None, None, None)
    networks, channels, outputs = weights.shape
    check_shape("inputs", inputs, None, channels)
    check_shape("biases", biases, networks, outputs)
    check_shape("offsets", offsets, networks + 1)
    if offsets.device.type == "cpu":
        end, count = int(offsets[-1]), len(inputs)
        expect(end == count, "offsets", f"to end at the {count} inputs", end)
    return implementation(__name__, backend, inputs.device).grouped_linear(
        inputs, weights, biases, offsets, relu
    )


def densities(
    positions: Tensor, numbers: Tensor, networks: Networks, *, backend: str = "auto"
) -> tuple[Tensor, Tensor]:
    """Densities [S] before their activation, and the input [S, 33] of `colours`.

    The latter holds the hidden channels, then the number of the network, which is exact in float32.
    Densities and hidden channels are 0 where a sample has no network. Differentiable in the
    networks.

    Args:
        positions: [S, 3] local to the sample's cube, -1 to 1 along each axis.
        numbers: [S] the network of each sample, as for `order`.

    Raises:
        ValueError: wrong shapes; backend "cpu": not float32.
    """
    check_shape("positions", positions, None, 3)
    check_shape("numbers", numbers, len(positions))
    if networks.learning:
        return composed_densities(positions, numbers, networks, backend)
    return implementation(__name__, backend, positions.device).densities(
        positions, numbers, networks
    )


def colours(
    geometry: Tensor, encoded: Tensor, networks: Networks, *, backend: str = "auto"
) -> Tensor:
    """Colours [S, 3] in (0, 1) of samples; 0 where a sample has no network.

    Differentiable in the hidden channels and the networks.

    Args:
        geometry: [S, 33] from `densities`.
        encoded: [S, D] encoded directions.

    Raises:
        ValueError: wrong shapes; backend "cpu": not float32.
    """
    check_shape("geometry", geometry, None, HIDDEN + 1)
    check_shape("encoded", encoded, len(geometry), networks.weights["direction"].shape[1] - HIDDEN)
    if networks.learning:
        return composed_colours(geometry, encoded, networks, backend)
    return implementation(__name__, backend, geometry.device).colours(geometry, encoded, networks)


def composed_densities(
    positions: Tensor, numbers: Tensor, networks: Networks, backend: str
) -> tuple[Tensor, Tensor]:
    """`densities`, layer by layer."""
    groups = order(numbers, networks.count, backend=backend)
    place, offsets = groups.permutation, groups.offsets
    x = encode_frequencies(positions[place], networks.frequencies, backend=backend)
    for name in ("in", "mid"):
        x = grouped_linear(x, *networks.layer(name), offsets, relu=True, backend=backend)
    raw = grouped_linear(x, *networks.layer("density"), offsets, backend=backend)
    hidden = _back(x, place, len(positions))
    geometry = torch.cat((hidden, numbers[:, None].to(hidden.dtype)), dim=1)
    return _back(raw, place, len(positions)).squeeze(1), geometry


def composed_colours(geometry: Tensor, encoded: Tensor, networks: Networks, backend: str) -> Tensor:
    """`colours`, layer by layer."""
    groups = order(geometry[:, HIDDEN].detach().int(), networks.count, backend=backend)
    place, offsets = groups.permutation, groups.offsets
    hidden = geometry[place, :HIDDEN]
    feature = grouped_linear(hidden, *networks.layer("feature"), offsets, backend=backend)
    x = torch.cat((feature, encoded[place]), dim=1)
    x = grouped_linear(x, *networks.layer("direction"), offsets, relu=True, backend=backend)
    x = grouped_linear(x, *networks.layer("colour"), offsets, backend=backend)
    return _back(x.sigmoid(), place, len(geometry))


def _back(values: Tensor, place: Tensor, count: int) -> Tensor:
    """Scatter rows back to their original places among `count` rows; zeros elsewhere."""
    return values.new_zeros(count, values.shape[1]).index_copy(0, place, values)
