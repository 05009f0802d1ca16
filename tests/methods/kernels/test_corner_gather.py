"""Corner features: weights, gradients beside autograd, input that is refused."""

import pytest
import torch

from methods.kernels.corner_gather import corner_gather
from methods.plenoctree.kernels.voxel_light import shade_voxels
from tests.common import refusal, seeded

RANDOM = seeded(0)
WEIGHTS = torch.rand(9, 8, generator=RANDOM)
VOXEL, RAY = (torch.randint(4, (9,), generator=RANDOM).int() for _ in range(2))
CORNERS = torch.randint(20, (4, 8), generator=RANDOM).int()
DIRECTIONS = torch.nn.functional.normalize(torch.randn(4, 3, generator=RANDOM), dim=1)


def test_weights_have_a_gradient_by_the_reference_only():
    table, weights = torch.arange(80.0).view(20, 4), WEIGHTS.clone().requires_grad_()
    corner_gather(table, CORNERS, VOXEL, weights, backend="reference").sum().backward()
    torch.testing.assert_close(weights.grad, table.sum(dim=1)[CORNERS.long()][VOXEL.long()])
    with refusal("no gradient for weights", ValueError):
        corner_gather(table, CORNERS, VOXEL, weights, backend="cpu")


@pytest.mark.parametrize(
    ("read", "rest", "shape"),
    [
        (corner_gather, (CORNERS, VOXEL, WEIGHTS), (20, 4)),
        (shade_voxels, (VOXEL, RAY, DIRECTIONS), (4, 9, 3)),
    ],
)
def test_a_buffer_gets_the_gradient_whether_or_not_the_table_asks_for_one(
    read, rest, shape, backend
):
    table = torch.rand(shape, generator=seeded(1)).requires_grad_()
    (gradient,) = torch.autograd.grad(read(table, *rest, backend=backend).sum(), table)
    for asked in (False, True):
        buffer, source = torch.ones(shape), table.detach().requires_grad_(asked)
        read(source, *rest, grad_buffer=buffer, backend=backend).sum().backward()
        torch.testing.assert_close(buffer, gradient + 1)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"voxel": VOXEL.where(VOXEL < 3, 4)}, "rows of the 4 voxels"),
        ({"voxel": VOXEL.where(VOXEL > 0, -1)}, "rows of the 4 voxels"),
        ({"voxel": VOXEL.long()}, "int32"),
        ({"weights": WEIGHTS[1:]}, "weights"),
        ({"weights": WEIGHTS.double()}, "float32"),
        ({"grad_buffer": torch.zeros(3, 3)}, "grad_buffer"),
    ],
)
def test_wrong_input_is_refused(changed, message):
    given = {"table": torch.zeros(20, 3), "corners": CORNERS, "voxel": VOXEL, "weights": WEIGHTS}
    with refusal(message, ValueError):
        corner_gather(**given | changed, backend="cpu")
