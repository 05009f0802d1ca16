"""Corner features: integrals against dense sampling, an even medium, input that is refused."""

from __future__ import annotations

import pytest
import torch

from methods.kernels.corner_gather import gather, integral, trilinear

BACKENDS = ("reference", "cpu")


def segments(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    ends = torch.rand(2, count, 3, generator=torch.Generator().manual_seed(0))
    return ends[0], ends[1]


@pytest.mark.parametrize("backend", BACKENDS)
def test_an_integral_is_the_mean_of_many_points(backend: str) -> None:
    entry, leave = segments(50)
    count = 500
    share = (torch.arange(count) + 0.5) / count
    places = entry[:, None] + share[:, None] * (leave - entry)[:, None]
    points = trilinear(places.reshape(-1, 3), backend=backend).view(50, count, 8)
    # The midpoint rule is off by f'' / (24 n^2), and f'' of a product of three is 6 at most; a mean
    # of n rounded numbers of at most 1 by n u, were they not summed in pairs.
    tolerance = 6 / (24 * count**2) + 32 * 2.0**-24
    want = points.double().mean(dim=1).float()
    torch.testing.assert_close(
        integral(entry, leave, backend=backend), want, rtol=0, atol=tolerance
    )


@pytest.mark.parametrize("backend", BACKENDS)
def test_features_that_are_the_same_everywhere_stay_so(backend: str) -> None:
    table = torch.tensor([[3.0, -1.0]]).repeat(20, 1)
    corners = torch.arange(16, dtype=torch.int32).view(2, 8)
    entry, leave = segments(30)
    voxel = torch.arange(30, dtype=torch.int32) % 2
    weights = integral(entry, leave, backend=backend)
    found = gather(table, corners, voxel, weights, backend=backend)
    torch.testing.assert_close(found, table[:30].new_tensor([[3.0, -1.0]]).expand(30, 2))


def test_weights_have_a_gradient_by_the_reference_only() -> None:
    generator = torch.Generator().manual_seed(0)
    table = torch.rand(8, 3, generator=generator)
    corners = torch.arange(8, dtype=torch.int32)[None]
    voxel = torch.zeros(1, dtype=torch.int32)
    weights = torch.full((1, 8), 0.125, requires_grad=True)
    gather(table, corners, voxel, weights, backend="reference").sum().backward()
    torch.testing.assert_close(weights.grad, table.sum(dim=1)[None])
    with pytest.raises(ValueError, match="no gradient for weights"):
        gather(table, corners, voxel, weights, backend="cpu")


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"voxel": torch.tensor([2], dtype=torch.int32)}, "rows of the 2 voxels"),
        ({"voxel": torch.tensor([-1], dtype=torch.int32)}, "rows of the 2 voxels"),
        ({"voxel": torch.tensor([0])}, "int32"),
        ({"weights": torch.zeros(2, 8)}, "weights"),
        ({"weights": torch.zeros(1, 8, dtype=torch.float64)}, "float32"),
        ({"grad_buffer": torch.zeros(3, 3)}, "grad_buffer"),
    ],
)
def test_wrong_input_is_refused(changed: dict[str, torch.Tensor], message: str) -> None:
    given = {
        "table": torch.zeros(16, 3),
        "corners": torch.arange(16, dtype=torch.int32).view(2, 8),
        "voxel": torch.zeros(1, dtype=torch.int32),
        "weights": torch.zeros(1, 8),
    }
    with pytest.raises(ValueError, match=message):
        gather(**given | changed, backend="cpu")
