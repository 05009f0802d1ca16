"""The kernels of the GPU where their cases say nothing: on a GPU, else in Triton's interpreter."""

from __future__ import annotations

import importlib
import inspect
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

from bench.cameras import place_camera
from bench.case import U32, largest_error
from bench.types import Camera, Rays
from methods.checks import kernels
from methods.gaussians.kernels.blending import blend
from methods.gaussians.kernels.projection import Ellipses, project_gaussians
from methods.gaussians.kernels.ssim import ssim
from methods.kernels import availability, corner_gather
from methods.kernels.adam import AdamState, hash_adam_, sparse_adam_
from methods.kernels.composite import composite, visible, weights
from methods.kernels.encode import HashGrid, SampleGradients, encode
from methods.kernels.encode.reference import corners
from methods.kernels.march import extents, march
from methods.kernels.types import Intervals, Occupancy
from methods.kernels.voxel_shading import shade_voxels
from methods.kernels.voxel_walk import Voxels, walk
from methods.kilonerf.kernels.grouped_mlp import grouped_linear
from methods.steernerf.kernels.splat import gather

pytestmark = pytest.mark.skipif(
    bool(availability()["gpu"]), reason="Triton has no build for this platform"
)
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
POSE = torch.tensor([[1.0, 0.0, 0.0, 0.5], [0.0, 1.0, 0.0, 0.5], [0.0, 0.0, 1.0, -1.0]])
FRONT = Camera(POSE, 20.0, 20.0, 10.0, 9.0, 20, 18)
"""It looks at the unit cube, which fills the picture."""


def test_a_table_of_half_precision_gives_features_of_its_type() -> None:
    torch.manual_seed(0)
    grid = HashGrid(levels=4, log2_table=10, n_min=4, n_max=40)
    positions = torch.rand(57, 3, device=DEVICE)
    for dtype in (torch.float16, torch.bfloat16):
        table = torch.randn(grid.entries, 2, device=DEVICE).to(dtype).requires_grad_()
        exact = table.detach().double().requires_grad_()
        features = encode(positions, table, grid, backend="gpu")
        right = encode(positions.double(), exact, grid, backend="reference")
        # Fractions as in the cases of `encode`, at sizes up to that of the table, and one rounding.
        size = table.detach().abs().max().item()
        unit = torch.finfo(dtype).eps
        tolerance = size * (3 * 2 * 2 * U32 * grid.n_max + 11 * U32 + unit)
        assert features.dtype == dtype
        assert (features - right).abs().max() <= tolerance
        features.sum().backward()
        right.sum().backward()
        assert table.grad is not None
        assert exact.grad is not None
        most = exact.grad.abs().max().item()  # an entry's gradient is a sum of weights
        assert (table.grad - exact.grad).abs().max() <= most * unit + 57 * 6 * U32 * grid.n_max


def test_what_is_marched_has_the_extent_that_was_told() -> None:
    generator = torch.Generator().manual_seed(0)
    cells = torch.rand(16, 16, 16, generator=generator) < 0.2
    origins = torch.rand(40, 3, generator=generator) * 3 - 1
    rays = Rays(origins.to(DEVICE), (0.5 - origins).to(DEVICE))
    occupancy = Occupancy(cells.to(DEVICE))
    found = extents(rays, occupancy, 0.02, 30, backend="gpu")
    counts = march(rays, occupancy, 0.02, backend="reference").offsets.diff().split(30)
    assert [(x.total, x.longest) for x in found] == [(int(c.sum()), int(c.max())) for c in counts]
    first = Rays(rays.origins[:30], rays.directions[:30])
    samples = march(first, occupancy, 0.02, extent=found[0], backend="gpu")
    assert torch.equal(samples.offsets.diff(), counts[0])


@pytest.mark.slow
def test_told_to_be_deterministic_it_adds_up_in_an_order_that_repeats() -> None:
    """In another order than the atomics', so that only the last bits may differ from theirs."""
    torch.manual_seed(0)
    grid = HashGrid(levels=2, log2_table=6, n_min=4, n_max=20)
    positions = torch.rand(4000, 3, device=DEVICE)
    table = torch.zeros(grid.entries, 2, device=DEVICE, requires_grad=True)
    weights_of_rows = torch.rand(4000, grid.channels, device=DEVICE)
    values = torch.rand(3, 5, device=DEVICE, requires_grad=True)
    index = torch.randint(-1, 3, (4000,), dtype=torch.int32, device=DEVICE)
    rows = torch.rand(4000, 5, device=DEVICE)
    corners = torch.arange(16, dtype=torch.int32, device=DEVICE).view(2, 8)
    features = torch.rand(16, 5, device=DEVICE, requires_grad=True)
    of_corners = torch.rand(4000, 8, device=DEVICE)
    harmonics = torch.rand(2, 4, 3, device=DEVICE, requires_grad=True)
    up = torch.tensor([[0.0, 0.0, 1.0]], device=DEVICE)
    voxel, ray = index.clamp(0, 1), torch.zeros_like(index)

    def gradients() -> tuple[Tensor, ...]:
        loss = (encode(positions, table, grid, backend="gpu") * weights_of_rows).sum()
        loss = loss + (gather(values, index, backend="gpu") * rows).sum()
        at_corners = corner_gather.gather(features, corners, voxel, of_corners, backend="gpu")
        colours = shade_voxels(harmonics, voxel, ray, up, backend="gpu")
        loss = loss + (at_corners * rows).sum() + (colours * rows[:, :3]).sum()
        return torch.autograd.grad(loss, (table, values, features, harmonics))

    free = gradients()
    torch.use_deterministic_algorithms(True)
    try:
        first, second = gradients(), gradients()
    finally:
        torch.use_deterministic_algorithms(False)
    assert largest_error(first, second) == 0
    # At most 4,000 terms below 1: 2 n roundings of a sum of n, as independent errors.
    assert 0 < largest_error(first, free) <= 6 * 4000**0.5 * 4000 * U32


def test_what_is_not_a_number_shows_and_what_is_behind_it_does_not() -> None:
    sigma = torch.tensor([1.0, torch.nan, 1.0, torch.inf, 1.0], device=DEVICE)
    delta = torch.full_like(sigma, 0.5)
    offsets = torch.tensor([0, 1, 3, 5], device=DEVICE)
    ones = torch.ones(5, 1, device=DEVICE)
    pixels = composite(sigma, ones, Intervals(ones[:, 0], delta, offsets), backend="gpu")
    thin = -torch.expm1(torch.tensor(-0.5)).item()
    assert pixels.alpha[0].item() == pytest.approx(thin, abs=4 * U32)
    assert pixels.alpha[1].isnan()
    assert pixels.alpha[2] == 1  # opaque: what is behind has no weight


def test_behind_what_is_not_a_number_a_long_ray_has_no_weights() -> None:
    """In the blocks to come neither: 64 samples are one."""
    sigma = torch.full((200,), 0.01, device=DEVICE)
    sigma[10] = torch.nan
    offsets = torch.tensor([0, 200], device=DEVICE)
    intervals = Intervals(sigma, torch.ones_like(sigma), offsets)
    found = weights(sigma, intervals, backend="gpu").cpu()
    assert (found[:10] > 0).all()
    assert found[10].isnan()
    assert not found[11:].any()
    counts, _ = visible(sigma, intervals, backend="gpu")
    assert counts.tolist() == [11]


def test_what_is_not_contiguous_is_read_all_the_same() -> None:
    generator = torch.Generator().manual_seed(0)
    grid = HashGrid(levels=2, log2_table=6, n_min=4, n_max=20)
    positions = torch.rand(3, 50, generator=generator).to(DEVICE).T
    table = torch.rand(2, grid.entries, generator=generator).to(DEVICE).T.requires_grad_()
    gradients = [
        torch.autograd.grad(encode(positions, table, grid, backend=backend).sum(), table)
        for backend in ("gpu", "reference")
    ]
    # As in the cases of `encode backward`, of at most 50 samples.
    fractions = 3 * 2 * U32 * grid.n_max
    assert largest_error(*gradients) <= 6 * 50**0.5 * (fractions + 50 * U32)


def gaussian_gradients(given: list[Tensor]) -> tuple[Tensor, ...]:
    """Those of the sum of a picture of 20 x 18 pixels, by all that Gaussians consist of."""
    means, scales, rotations, opacities, colours = (x.detach().requires_grad_() for x in given)
    ellipses = project_gaussians(
        means, scales, rotations, opacities, place_camera(FRONT, DEVICE), backend="gpu"
    )
    pixels = blend(ellipses, opacities, colours, 20, 18, backend="gpu")
    total = pixels.values.sum() + pixels.alpha.sum()  # its gradients are expanded, not contiguous
    return torch.autograd.grad(total, (means, scales, rotations, opacities, colours))


def some_gaussians() -> list[Tensor]:
    """Means, scales, rotations, opacities and colours, each transposed in memory."""
    generator = torch.Generator().manual_seed(0)
    means, scales, rotations, colours = (
        torch.rand(size, 12, generator=generator).to(DEVICE).T for size in (3, 3, 4, 3)
    )
    opacities = torch.rand(12, 2, generator=generator).to(DEVICE)[:, 0]
    return [means, 0.2 * scales, rotations, opacities, colours]


def test_gaussians_that_are_not_contiguous_are_the_same() -> None:
    given = some_gaussians()
    assert not any(x.is_contiguous() for x in given)
    found = gaussian_gradients(given)
    assert all(grad.count_nonzero() for grad in found)
    assert largest_error(found, gaussian_gradients([x.contiguous() for x in given])) == 0


def test_gradients_of_gaussians_repeat_to_the_last_bit() -> None:
    """Nothing has to be told to be deterministic."""
    given = some_gaussians()
    assert largest_error(gaussian_gradients(given), gaussian_gradients(given)) == 0


@pytest.mark.parametrize("far", [-1e30, -1e3, 1e3, 1e30])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_gaussian_far_outside_of_the_picture_is_not_in_it(axis: int, far: float) -> None:
    centres = torch.full((1, 2), 8.0, device=DEVICE)
    centres[0, axis] = far
    ones = torch.ones(1, 3, device=DEVICE)
    ellipses = Ellipses(centres, ones, ones[:, 0], torch.full_like(centres, 4.0))
    assert not blend(ellipses, ones[:, 0], ones, 17, 33, backend="gpu").alpha.any()


def scattered(x: Tensor) -> Tensor:
    """The same numbers, with the last axis outermost in memory."""
    axes = tuple(reversed(range(x.dim())))
    return x.permute(axes).contiguous().permute(axes)


def ssim_of(picture: Tensor, target: Tensor, grad: Tensor) -> tuple[Tensor, ...]:
    found = ssim(picture.requires_grad_(), target, backend="gpu")
    return found, *torch.autograd.grad(found, picture, grad)


def linear_of(x: Tensor, weights: Tensor, biases: Tensor, grad: Tensor) -> tuple[Tensor, ...]:
    offsets = torch.tensor([0, 3, 7], device=DEVICE)
    given = x.requires_grad_(), weights.requires_grad_(), biases.requires_grad_()
    out = grouped_linear(*given, offsets, relu=True, backend="gpu")
    return out, *torch.autograd.grad(out, given, grad)


def corner_features_of(
    table: Tensor, corners: Tensor, weights: Tensor, grad: Tensor, buffer: Tensor
) -> tuple[Tensor, ...]:
    """Of voxels that share no corner: a sum has one term, in every order."""
    given = table.requires_grad_(), corners.int(), torch.tensor([1, 0], device=DEVICE).int()
    out = corner_gather.gather(*given, weights, grad_buffer=buffer, backend="gpu")
    out.backward(grad)
    return out, buffer


def colours_of(
    harmonics: Tensor, directions: Tensor, grad: Tensor, buffer: Tensor
) -> tuple[Tensor, ...]:
    """Of voxels that are seen once."""
    voxel, ray = (torch.tensor(x, device=DEVICE).int() for x in ([2, 0, 1], [1, 0, 1]))
    out = shade_voxels(harmonics, voxel, ray, directions, grad_buffer=buffer, backend="gpu")
    out.backward(grad)
    return out, buffer


def crossed_by(origins: Tensor, directions: Tensor, cells: Tensor) -> tuple[Tensor, ...]:
    voxels = Voxels((8 * cells).long().unique(dim=0), 8)
    found = walk(Rays(origins - 1, directions + 0.5), voxels, limit=2, backend="gpu")
    assert len(found)
    return found.t, found.delta, found.voxel


@pytest.mark.parametrize(
    ("compute", "shapes"),
    [
        (ssim_of, [(4, 5, 3), (4, 5, 3), ()]),
        (linear_of, [(7, 5), (2, 5, 3), (2, 3), (7, 3)]),
        (corner_features_of, [(16, 5), (2, 8), (2, 8), (2, 5), (16, 5)]),
        (colours_of, [(3, 4, 3), (2, 3), (3, 3), (3, 4, 3)]),
        (crossed_by, [(6, 3), (6, 3), (300, 3)]),
    ],
)
def test_where_numbers_lie_in_memory_changes_nothing(
    compute: Callable[..., tuple[Tensor, ...]], shapes: list[tuple[int, ...]]
) -> None:
    generator = torch.Generator().manual_seed(0)
    given = [torch.rand(shape, generator=generator).to(DEVICE) for shape in shapes]
    if compute is corner_features_of:
        given[1] = torch.arange(16.0, device=DEVICE).view(2, 8)
    there = [scattered(x) for x in given]
    right = compute(*(x.clone() for x in given))
    assert all(torch.equal(x, y) for x, y in zip(compute(*there), right, strict=True))


def test_a_thin_haze_keeps_its_light_to_the_last_digits() -> None:
    """1 - exp(-tau) of a tau far below 1, which a difference of float32 numbers does not have."""
    sigma = torch.logspace(-30, 0, 61, device=DEVICE)
    offsets = torch.arange(62, device=DEVICE)
    intervals = Intervals(sigma, torch.full_like(sigma, 0.25), offsets)
    found = weights(sigma, intervals, backend="gpu").double().cpu()
    exact = -torch.expm1(-(0.25 * sigma.double())).cpu()
    # The series has twelve operations; 1 - exp is off by itself and 2 ulp of an exp below 1.
    assert ((found - exact).abs() / exact).max() <= (12 + 3 / 0.06) * U32


@pytest.mark.slow
@pytest.mark.skipif(platform.system() != "Linux", reason="Triton brings its assembler for Linux")
def test_every_kernel_compiles_for_a_gpu_that_is_not_here(tmp_path: Path) -> None:
    environment = {name: text for name, text in os.environ.items() if name != "TRITON_INTERPRET"}
    done = subprocess.run(
        [sys.executable, "-P", Path(__file__).with_name("compiled.py")],
        env=environment | {"TRITON_CACHE_DIR": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    compiled = set(done.stdout.splitlines())
    written = {
        f"{kernel}.gpu {name}"
        for kernel in kernels("gpu")
        for name in re.findall(
            r"(?:launch|_move|_weights|_filled)\(\s*(_\w+)",
            inspect.getsource(importlib.import_module(f"{kernel}.gpu")),
        )
    }
    assert written <= compiled


def test_types_that_it_does_not_serve_are_refused() -> None:
    grid = HashGrid(levels=1, log2_table=3, n_min=2, n_max=2)
    positions = torch.rand(2, 3, dtype=torch.float64, device=DEVICE)
    with pytest.raises(ValueError, match="expects positions of float32"):
        encode(positions, torch.rand(grid.entries, 2, device=DEVICE), grid, backend="gpu")


def test_gaussians_of_another_type_are_refused() -> None:
    means, scales, rotations, opacities, colours = (x.double() for x in some_gaussians())
    with pytest.raises(ValueError, match="expects means of float32"):
        project_gaussians(means, scales, rotations, opacities, FRONT, backend="gpu")
    ellipses = Ellipses(means[:, :2], scales, opacities, means[:, :2])
    with pytest.raises(ValueError, match="expects centres of float32"):
        blend(ellipses, opacities, colours, 4, 4, backend="gpu")


def test_the_first_step_moves_the_corners_of_a_sample_by_the_rate() -> None:
    grid = HashGrid(levels=2, log2_table=10, n_min=4, n_max=20)
    position = torch.full((1, 3), 0.3, device=DEVICE)
    table, gradients = torch.zeros(grid.entries, 2, device=DEVICE), SampleGradients()
    gradients.add(position, torch.ones(1, grid.channels, device=DEVICE))
    hash_adam_(table, gradients, grid, AdamState.like(table), 0.1, backend="gpu")
    want = torch.zeros_like(table)
    for level in range(grid.levels):
        want[corners(position, grid, level)[0]] = -0.1
    torch.testing.assert_close(table, want, rtol=16 * U32, atol=0)


def test_a_table_that_cannot_be_changed_in_place_is_refused() -> None:
    table = torch.zeros(2, 5, device=DEVICE).T
    with pytest.raises(ValueError, match="expects table to be contiguous"):
        sparse_adam_(table, table, AdamState.like(table), 0.1, backend="gpu")
