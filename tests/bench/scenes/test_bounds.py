"""Boxes: a visual hull never cuts what is seen, and the unit cube is filled."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.scenes import assemble
from bench.scenes.analytic import picture, pose_on_sphere, train_poses
from bench.scenes.assemble import Box, cube, hull_box
from bench.scenes.raytrace import Part, Solids
from bench.scenes.solids import Ellipsoid
from bench.scenes.textures import plain
from bench.types import Camera

SIZE = 32


def camera(pose) -> Camera:
    return Camera(pose.float(), 45.0, 45.0, SIZE / 2, SIZE / 2, SIZE, SIZE)


def pictures_of(model: Solids, poses: list) -> tuple[list[Camera], list[torch.Tensor]]:
    cameras = [camera(pose) for pose in poses]
    return cameras, [picture(model, c) for c in cameras]


@given(
    st.tuples(*[st.floats(-0.6, 0.6)] * 3),
    st.tuples(*[st.floats(0.05, 0.5)] * 3),
    st.integers(0, 1000),
)
@settings(max_examples=15)
def test_no_point_of_the_surface_is_outside_the_hull(centre, radii, seed) -> None:
    model = Solids([Part(Ellipsoid(radii), plain((1.0, 0.0, 0.0)), centre)])
    box = hull_box(*pictures_of(model, train_poses(8, seed)), cube(1.5))
    assert box is not None
    # The surface's outermost points are its centre +- its semi-axes.
    middle, reach = torch.tensor(centre).double(), torch.tensor(radii).double()
    assert (box.lower <= middle - reach).all()
    assert (box.upper >= middle + reach).all()


def test_the_hull_of_many_views_is_tight() -> None:
    model = Solids([Part(Ellipsoid((0.3, 0.3, 0.3)), plain((1.0, 0.0, 0.0)))])
    poses = train_poses(24, 0) + [pose_on_sphere(k, -0.4) for k in range(6)]
    box = hull_box(*pictures_of(model, poses), cube(1.5))
    # A pixel is 4 / 45 wide there; the hull has up to 2 of them and a cell of 3 / 64 more.
    slack = 2 * 4 / 45 + 2 * 3 / 64
    assert box is not None
    assert (box.upper - box.lower).max() <= (0.6 + 2 * slack) * 1.05


def test_blocks_drop_no_cell_that_would_be_kept(monkeypatch) -> None:
    model = Solids([Part(Ellipsoid((0.2, 0.5, 0.1)), plain((1.0, 0.0, 0.0)), (0.3, -0.2, 0.1))])
    views = pictures_of(model, train_poses(20, 3))
    box = hull_box(*views, cube(1.5))
    monkeypatch.setattr(assemble, "GLANCES", 0)
    cell_by_cell = hull_box(*views, cube(1.5))
    assert box is not None
    assert cell_by_cell is not None
    assert torch.equal(box.lower, cell_by_cell.lower)
    assert torch.equal(box.upper, cell_by_cell.upper)


def test_cells_that_leave_the_picture_are_kept() -> None:
    # One view sees only the middle of space: what it does not see, it cannot rule out.
    narrow = Camera(pose_on_sphere(0.0, 0.0).float(), 400.0, 400.0, 16, 16, SIZE, SIZE)
    nothing = torch.zeros(SIZE, SIZE, 4, dtype=torch.uint8)
    box = hull_box([narrow], [nothing], cube(1.5))
    assert box is not None
    assert (box.lower <= -1.5).all()
    assert (box.upper >= 1.5).all()
    # A camera inside the space rules nothing out behind it.
    inside = Camera(torch.eye(4)[:3], 16.0, 16.0, 16, 16, SIZE, SIZE)
    box = hull_box([inside], [nothing], cube(1.5))
    assert box is not None
    assert box.lower[2] <= -1.5


@pytest.mark.parametrize("alpha", [0, 255])
def test_no_hull_without_a_mask(alpha) -> None:
    cameras = [camera(pose) for pose in train_poses(40, 0)]
    image = torch.full((SIZE, SIZE, 4), alpha, dtype=torch.uint8)
    assert hull_box(cameras, [image] * 40, cube(1.2)) is None
    assert hull_box(cameras, [image[..., :3]] * 40, cube(1.2)) is None


def test_the_unit_cube_is_filled_and_the_origin_undoes_it() -> None:
    box = Box(torch.tensor([1.0, 2, 3]).double(), torch.tensor([3.0, 6, 4]).double())
    assert box.side == 4
    inside = box.in_unit_cube()
    assert inside.tolist() == [[0.25, 0, 0.375], [0.75, 1, 0.625]]
    assert (box.origin + box.side * inside[0].double()).tolist() == [1, 2, 3]
