"""Small networks with Triton: a program multiplies a tile of samples of one network.

Samples are sorted by network, and a network's tiles start at its first sample, so its last tile may
be partly empty. The host knows only an upper bound on the number of tiles; so it need not wait, and
surplus programs return at once. A whole network is one kernel that keeps hidden channels in
registers.

Products are in float32, not TF32. For the gradient of the weights, a program takes one network and
sums over its samples tile by tile, without atomics, so that results are repeatable.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from methods.kernels.gpu import check_types, launch
from methods.kilonerf.kernels.grouped_mlp import HIDDEN, Networks
from methods.kilonerf.kernels.grouped_mlp.reference import order

__all__ = ["colours", "densities", "encode_frequencies", "grouped_linear", "locate", "order"]

ROWS = 64
"""Samples per tile."""

BLOCK = 512
"""Numbers per program in kernels without products, 4 per lane."""

LEAST, MOST = 16, 64
"""Inputs or outputs that are multiplied together: the least that Triton's product accepts, and the
most that fit into registers."""


def locate(positions: Tensor, cubes: Tensor, corner: Tensor, side: Tensor) -> tuple[Tensor, Tensor]:
    """See `methods.kilonerf.kernels.grouped_mlp.locate`."""
    check_types(torch.float32, positions=positions, corner=corner, side=side)
    check_types(torch.int16, cubes=cubes)
    count = len(positions)
    networks = torch.empty(count, dtype=torch.int16, device=positions.device)
    local = positions.new_empty(count, 3)
    given = (x.detach().contiguous() for x in (positions, cubes, corner, side))
    grid = (triton.cdiv(count, BLOCK),)
    launch(_locate, grid, *given, networks, local, count, *cubes.shape, BLOCK=BLOCK)
    return networks, local


def encode_frequencies(inputs: Tensor, frequencies: int) -> Tensor:
    """See `methods.kilonerf.kernels.grouped_mlp.encode_frequencies`."""
    check_types(torch.float32, inputs=inputs)
    if inputs.requires_grad:
        raise ValueError("backend 'gpu' gives no gradient for inputs: use backend='reference'")
    out = inputs.new_empty(len(inputs), 3 + 6 * frequencies)
    grid, given = (triton.cdiv(out.numel(), BLOCK),), (inputs.contiguous(), out, out.numel())
    launch(_encode, grid, *given, CHANNELS=out.shape[1], BLOCK=BLOCK)
    return out


def grouped_linear(
    inputs: Tensor, weights: Tensor, biases: Tensor, offsets: Tensor, relu: bool
) -> Tensor:
    """See `methods.kilonerf.kernels.grouped_mlp.grouped_linear`."""
    check_types(torch.float32, inputs=inputs, weights=weights, biases=biases)
    return _Linear.apply(inputs, weights, biases, offsets.contiguous(), relu)


def densities(positions: Tensor, numbers: Tensor, networks: Networks) -> tuple[Tensor, Tensor]:
    """See `methods.kilonerf.kernels.grouped_mlp.densities`."""
    check_types(torch.float32, positions=positions)
    layers, frequencies = _layers(networks, "in", "mid", "density"), networks.frequencies
    raw = positions.new_zeros(len(positions))
    geometry = positions.new_zeros(len(positions), HIDDEN + 1)
    geometry[:, HIDDEN] = numbers
    place, tiles = _sorted(numbers, networks.count)
    given = positions.detach().contiguous(), place, tiles, *layers, raw, geometry
    sizes = {"FREQUENCIES": frequencies, "ANGLES": _padded(3 * frequencies), "HIDDEN": HIDDEN}
    launch(_densities, (len(tiles),), *given, **sizes, ROWS=ROWS)
    return raw, geometry


def colours(geometry: Tensor, encoded: Tensor, networks: Networks) -> Tensor:
    """See `methods.kilonerf.kernels.grouped_mlp.colours`."""
    check_types(torch.float32, geometry=geometry, encoded=encoded)
    layers, seen = _layers(networks, "feature", "direction", "colour"), encoded.shape[1]
    out = geometry.new_zeros(len(geometry), 3)
    place, tiles = _sorted(geometry[:, HIDDEN].int(), networks.count)
    given = (x.detach().contiguous() for x in (geometry, encoded))
    sizes = {"SEEN": seen, "PADDED": _padded(seen), "HIDDEN": HIDDEN, "COLOURS": LEAST}
    launch(_colours, (len(tiles),), *given, place, tiles, *layers, out, **sizes, ROWS=ROWS)
    return out


def _layers(networks: Networks, *names: str) -> list[Tensor]:
    """Weights and biases of some layers."""
    parts = [part for name in names for part in networks.layer(name)]
    for part in parts:
        check_types(torch.float32, networks=part)
    return [part.detach().contiguous() for part in parts]


def _padded(size: int) -> int:
    """How many inputs or outputs are multiplied together for a layer with `size` of them."""
    return max(triton.next_power_of_2(size), LEAST)


def _sorted(numbers: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Samples by network, those without one first, and their `_tiles`."""
    networks, place = numbers.int().sort(stable=True)
    each = torch.arange(count + 1, dtype=torch.int32, device=numbers.device)
    return place, _tiles(torch.searchsorted(networks, each), len(numbers))


def _tiles(offsets: Tensor, samples: int) -> Tensor:
    """Network, first sample and end of each tile, [T, 3] int64; surplus tiles are empty.

    A network has at most one tile that is not full.
    """
    count = len(offsets) - 1
    ends = ((offsets.diff() + ROWS - 1) // ROWS).cumsum(dim=0)
    tile = torch.arange(samples // ROWS + count, device=offsets.device)
    network = torch.searchsorted(ends, tile, right=True).clamp(max=count - 1)
    begins = torch.cat((ends.new_zeros(1), ends))[network]
    end = offsets[network + 1]
    first = torch.minimum(offsets[network] + (tile - begins) * ROWS, end)
    return torch.stack((network, first, torch.minimum(first + ROWS, end)), dim=1)


class _Linear(torch.autograd.Function):
    @staticmethod
    def forward(ctx, inputs, weights, biases, offsets, relu):
        inputs, weights, biases = (x.detach().contiguous() for x in (inputs, weights, biases))
        tiles = _tiles(offsets, len(inputs))
        out = inputs.new_empty(len(inputs), weights.shape[2])
        _launch(inputs, weights, biases, tiles, out, relu)
        ctx.save_for_backward(inputs, weights, offsets, tiles, out if relu else None)
        return out

    @staticmethod
    def backward(ctx, grad):
        inputs, weights, offsets, tiles, out = ctx.saved_tensors
        if out is not None:
            grad = torch.where(out <= 0, 0, grad)
        grad, grad_inputs = grad.contiguous(), None
        networks, channels, outputs = weights.shape
        if ctx.needs_input_grad[0]:
            grad_inputs = torch.empty_like(inputs)
            _launch(grad, weights.transpose(1, 2), None, tiles, grad_inputs, relu=False)
        grad_weights, grad_biases = torch.empty_like(weights), grad.new_empty(networks, outputs)
        inner, outer = (min(_padded(size), MOST) for size in (channels, outputs))
        grid = networks, triton.cdiv(channels, inner), triton.cdiv(outputs, outer)
        given = inputs, grad, offsets, grad_weights, grad_biases, channels, outputs
        launch(_correlate, grid, *given, INNER=inner, OUTER=outer, ROWS=ROWS)
        return grad_inputs, grad_weights, grad_biases, None, None


def _launch(
    inputs: Tensor, weights: Tensor, biases: Tensor | None, tiles: Tensor, out: Tensor, relu: bool
) -> None:
    _, channels, outputs = weights.shape
    inner, outer = (min(_padded(size), MOST) for size in (channels, outputs))
    given = inputs, weights, biases, tiles, out, channels, outputs, *weights.stride()[1:]
    sizes = {"INNER": inner, "OUTER": outer, "ROWS": ROWS}
    launch(_multiply, (len(tiles), triton.cdiv(outputs, outer)), *given, RELU=relu, **sizes)


@triton.jit
def _locate(
    positions,
    cubes,
    corner,
    side,
    networks,
    local,
    count,
    x_size,
    y_size,
    z_size,
    BLOCK: tl.constexpr,
):
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    within, cube = inside, tl.zeros([BLOCK], tl.int32)
    length = tl.load(side)
    for axis in tl.static_range(3):
        size = x_size if axis == 0 else (y_size if axis == 1 else z_size)
        place = tl.load(positions + 3 * i + axis, mask=inside, other=0.0)
        scaled = tl.div_rn(place - tl.load(corner + axis), length)
        cell = tl.floor(scaled)
        tl.store(local + 3 * i + axis, 2 * (scaled - cell) - 1, mask=inside)
        within = within & (cell >= 0) & (cell < size)
        cube = cube * size + tl.where(within, cell, 0.0).to(tl.int32)
    found = tl.load(cubes + cube, mask=within, other=-1)
    tl.store(networks + i, found, mask=inside)


@triton.jit
def _encode(inputs, out, total, CHANNELS: tl.constexpr, BLOCK: tl.constexpr):
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < total
    channel = (i % CHANNELS).to(tl.int32)
    x = tl.load(inputs + i // CHANNELS * 3 + channel % 3, mask=inside, other=0.0)
    part = channel // 3 - 1  # -1: x itself; 2 k: the sine of 2^k x; 2 k + 1: its cosine
    angle = _doubled(x, tl.maximum(part, 0) >> 1)
    wave = tl.where((part & 1) == 0, tl.sin(angle), tl.cos(angle))
    tl.store(out + i, tl.where(part < 0, x, wave), mask=inside)


@triton.jit
def _doubled(x, times):
    return x * (tl.full(times.shape, 1, tl.int32) << times).to(tl.float32)


@triton.jit
def _relu(x):
    """ReLU that keeps NaN."""
    return tl.where(x < 0, 0.0, x)


@triton.jit
def _product(x, weights, total):
    return tl.dot(x, weights, total, input_precision="ieee")


@triton.jit
def _rows(table, row, column, there, known, width):
    """Load numbers of `table` with `width` columns; 0 unless row is `there` and column `known`."""
    place = table + row[:, None] * width + column[None, :]
    return tl.load(place, mask=there[:, None] & known[None, :], other=0.0)


@triton.jit
def _tile(tiles, ROWS: tl.constexpr):
    """Network and samples of a tile, the mask of valid samples, and whether there are any."""
    tile = tiles + 3 * tl.program_id(0)
    first, end = tl.load(tile + 1), tl.load(tile + 2)
    row = first + tl.arange(0, ROWS)
    return tl.load(tile), row, row < end, first < end


@triton.jit
def _multiply(
    inputs,
    weights,
    biases,
    tiles,
    out,
    channels,
    outputs,
    step_in,
    step_out,
    RELU: tl.constexpr,
    INNER: tl.constexpr,
    OUTER: tl.constexpr,
    ROWS: tl.constexpr,
):
    network, row, inside, busy = _tile(tiles, ROWS)
    o = tl.program_id(1) * OUTER + tl.arange(0, OUTER)
    there = o < outputs
    if busy:
        total = tl.zeros([ROWS, OUTER], tl.float32)
        for begin in range(0, channels, INNER):
            k = begin + tl.arange(0, INNER)
            x = _rows(inputs, row, k, inside, k < channels, channels)
            place = weights + network * (channels * outputs) + k[:, None] * step_in
            known = (k < channels)[:, None] & there[None, :]
            w = tl.load(place + o[None, :] * step_out, mask=known, other=0.0)
            total = _product(x, w, total)
        if biases is not None:
            total += tl.load(biases + network * outputs + o, mask=there, other=0.0)[None, :]
        if RELU:
            total = _relu(total)
        place = out + row[:, None] * outputs + o[None, :]
        tl.store(place, total, mask=inside[:, None] & there[None, :])


@triton.jit
def _correlate(
    inputs,
    grad,
    offsets,
    grad_weights,
    grad_biases,
    channels,
    outputs,
    INNER: tl.constexpr,
    OUTER: tl.constexpr,
    ROWS: tl.constexpr,
):
    """Gradients of a network's weights and biases: inputs^T grad."""
    network = tl.program_id(0).to(tl.int64)
    first, end = tl.load(offsets + network), tl.load(offsets + network + 1)
    k = tl.program_id(1) * INNER + tl.arange(0, INNER)
    o = tl.program_id(2) * OUTER + tl.arange(0, OUTER)
    known, there = k < channels, o < outputs
    total, of_bias = tl.zeros([INNER, OUTER], tl.float32), tl.zeros([OUTER], tl.float32)
    while first < end:
        row = first + tl.arange(0, ROWS)
        share = _rows(grad, row, o, row < end, there, outputs)
        x = _rows(inputs, row, k, row < end, known, channels)
        total = _product(tl.trans(x), share, total)
        of_bias += tl.sum(share, 0)
        first += ROWS
    place = grad_weights + network * (channels * outputs) + k[:, None] * outputs + o[None, :]
    tl.store(place, total, mask=known[:, None] & there[None, :])
    tl.store(grad_biases + network * outputs + o, of_bias, mask=there & (tl.program_id(1) == 0))


@triton.jit
def _densities(
    positions,
    places,
    tiles,
    in_weights,
    in_biases,
    mid_weights,
    mid_biases,
    density_weights,
    density_biases,
    raw,
    geometry,
    FREQUENCIES: tl.constexpr,
    ANGLES: tl.constexpr,
    HIDDEN: tl.constexpr,
    ROWS: tl.constexpr,
):
    network, row, inside, busy = _tile(tiles, ROWS)
    if busy:
        sample = tl.load(places + row, mask=inside, other=0)
        angle, o = tl.arange(0, ANGLES), tl.arange(0, HIDDEN)
        real, all_of = angle < 3 * FREQUENCIES, o < HIDDEN
        x = _rows(positions, sample, angle % 3, inside, real, 3)
        turned = _doubled(x, (angle // 3)[None, :])
        into = in_weights + network * ((3 + 6 * FREQUENCIES) * HIDDEN)
        sine = 3 + angle + angle // 3 * 3  # the row of a sine; of its cosine, 3 on
        total = tl.zeros([ROWS, HIDDEN], tl.float32)
        total = _product(tl.sin(turned), _rows(into, sine, o, real, all_of, HIDDEN), total)
        total = _product(tl.cos(turned), _rows(into, sine + 3, o, real, all_of, HIDDEN), total)
        for axis in tl.static_range(3):
            place = tl.load(positions + 3 * sample + axis, mask=inside, other=0.0)
            total += place[:, None] * tl.load(into + axis * HIDDEN + o)[None, :]
        hidden = _relu(total + tl.load(in_biases + network * HIDDEN + o)[None, :])
        mid = _rows(mid_weights + network * (HIDDEN * HIDDEN), o, o, all_of, all_of, HIDDEN)
        total = tl.zeros([ROWS, HIDDEN], tl.float32)
        total += tl.load(mid_biases + network * HIDDEN + o)[None, :]
        hidden = _relu(_product(hidden, mid, total))
        last = tl.load(density_weights + network * HIDDEN + o)[None, :]
        density = tl.sum(hidden * last, 1) + tl.load(density_biases + network)
        tl.store(raw + sample, density, mask=inside)
        place = geometry + sample[:, None] * (HIDDEN + 1) + o[None, :]
        tl.store(place, hidden, mask=inside[:, None])


@triton.jit
def _colours(
    geometry,
    encoded,
    places,
    tiles,
    feature_weights,
    feature_biases,
    direction_weights,
    direction_biases,
    colour_weights,
    colour_biases,
    out,
    SEEN: tl.constexpr,
    PADDED: tl.constexpr,
    HIDDEN: tl.constexpr,
    COLOURS: tl.constexpr,
    ROWS: tl.constexpr,
):
    network, row, inside, busy = _tile(tiles, ROWS)
    if busy:
        sample = tl.load(places + row, mask=inside, other=0)
        o, d, c = tl.arange(0, HIDDEN), tl.arange(0, PADDED), tl.arange(0, COLOURS)
        all_of, seen, three = o < HIDDEN, d < SEEN, c < 3
        hidden = _rows(geometry, sample, o, inside, all_of, HIDDEN + 1)
        weights = feature_weights + network * (HIDDEN * HIDDEN)
        total = tl.zeros([ROWS, HIDDEN], tl.float32)
        total += tl.load(feature_biases + network * HIDDEN + o)[None, :]
        feature = _product(hidden, _rows(weights, o, o, all_of, all_of, HIDDEN), total)
        weights = direction_weights + network * ((HIDDEN + SEEN) * HIDDEN)
        total = tl.zeros([ROWS, HIDDEN], tl.float32)
        total += tl.load(direction_biases + network * HIDDEN + o)[None, :]
        total = _product(feature, _rows(weights, o, o, all_of, all_of, HIDDEN), total)
        towards = _rows(encoded, sample, d, inside, seen, SEEN)
        weights = _rows(weights + HIDDEN * HIDDEN, d, o, seen, all_of, HIDDEN)
        hidden = _relu(_product(towards, weights, total))
        weights = _rows(colour_weights + network * (3 * HIDDEN), o, c, all_of, three, 3)
        total = tl.zeros([ROWS, COLOURS], tl.float32)
        total += tl.load(colour_biases + network * 3 + c, mask=three, other=0.0)[None, :]
        shown = tl.sigmoid(_product(hidden, weights, total))
        place = out + sample[:, None] * 3 + c[None, :]
        tl.store(place, shown, mask=inside[:, None] & three[None, :])
