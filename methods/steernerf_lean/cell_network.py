"""The network of the lean 2D renderer, on cells, after ConvNeXt (Liu et al. 2022)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from methods.engines.network import Network
from methods.steernerf_lean.cell_inputs import Layout
from methods.steernerf_lean.kernels.depthwise import TAPS, depthwise

LEAK = 0.1
"""Slope of the activations below 0. With plain ReLU, units die on the sparse inputs and never
recover."""


class CellNetwork(Network):
    """A trunk of depthwise 3 x 3 convolutions and matrix products, with one head for each output.

    Args:
        layout: layout of the input rows.
        width: channels of the trunk.
        blocks: residual blocks of the trunk.
    """

    varying = True  # cells
    quantum = 512

    def __init__(self, layout: Layout, width: int, blocks: int) -> None:
        super().__init__()
        self.enter = _Linear(layout.width, width)
        self.trunk = nn.ModuleList(_Block(width) for _ in range(blocks))
        self.leave = _Linear(width, layout.scale**2 * (3 + layout.history))
        self.error = _Linear(width, 1)
        self.read = _Linear(width, 3 * (layout.channels + 1))
        for layer in (self.leave, self.error, self.read):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, rows: Tensor, neighbours: Tensor) -> tuple[Tensor, ...]:
        """Corrections and logits of the shares [N, (3 + layout.history) s^2]; estimated error
        [N, 1], the log of the mean squared error; matrices [N, 3 (K + 1)]: of cells with the `rows`
        [N, layout.width] and the `neighbours` [N, 9]."""
        hidden = self.enter(rows).to(rows)
        for block in self.trunk:
            hidden = block(hidden, neighbours, self.backend)
        hidden = functional.leaky_relu(hidden, LEAK)
        return self.leave(hidden), self.error(hidden), self.read(hidden)

    def products(self, *inputs: Tensor) -> int:
        """Every matrix, and the taps of every channel, count once per cell."""
        return len(inputs[0]) * sum(x.numel() for x in self.parameters() if x.dim() > 1)


class _Linear(nn.Linear):
    def forward(self, x: Tensor) -> Tensor:
        """x W^T + b of `x` [N, C].

        Without gradient it is computed as a 1 x 1 convolution: torch hands products of float32 to
        MKL, but convolutions to oneDNN, which is twice as fast on non-Intel processors.
        """
        if torch.is_grad_enabled() or torch.jit.is_tracing() or not len(x):
            return super().forward(x)
        picture = x[None, :, None].permute(0, 3, 1, 2)  # [1, C, N, 1], channels last in memory
        return functional.conv2d(picture, self.weight[:, :, None, None], self.bias)[0, :, :, 0].T


class _Block(nn.Module):
    """x + W2 act(W1 (x convolved channel by channel))."""

    def __init__(self, width: int, growth: int = 2) -> None:
        super().__init__()
        self.spread = nn.Parameter(torch.randn(TAPS, width) / 3)
        self.grow = _Linear(width, growth * width)
        self.shrink = _Linear(growth * width, width)
        with torch.no_grad():
            self.shrink.weight.mul_(0.1)

    def forward(self, x: Tensor, neighbours: Tensor, backend: str) -> Tensor:
        """`x` [N, width] of cells with `neighbours` [N, 9]."""
        mixed = depthwise(x, neighbours, self.spread, backend=backend)
        grown = functional.leaky_relu(self.grow(mixed), LEAK, inplace=not torch.is_grad_enabled())
        return x + self.shrink(grown)
