"""Gaussians as PLY: both ways, in the data set's coordinates, and files that are no good."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.lib.recfunctions import repack_fields
from plyfile import PlyData, PlyElement

from bench.types import Scene, SteerbenchError
from methods.gaussians import ply
from methods.gaussians.model import Gaussians
from methods.kernels.shade import shade


@pytest.fixture
def moved_scene(tiny_scene: Scene) -> Scene:
    """The unit cube is [-1, 2] x [-2, 1] x [5, 8] of the data set."""
    return replace(tiny_scene, origin=torch.tensor([-1.0, -2.0, 5.0]), unit_length=3.0)


def some(count: int = 50, degree: int = 3) -> Gaussians:
    generator = torch.Generator().manual_seed(0)

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator)

    harmonics = torch.randn(count, (degree + 1) ** 2, 3, generator=generator)
    return Gaussians(
        rand(count, 3),
        rand(count, 3) - 5,
        torch.randn(count, 4, generator=generator),
        4 * rand(count) - 2,
        harmonics[:, :1],
        harmonics[:, 1:],
    )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_what_is_written_is_read_and_holds_the_coordinates_of_the_data_set(
    degree, moved_scene, tmp_path
):
    path = tmp_path / "a.ply"
    given = some(degree=degree)
    ply.write(given, moved_scene, path)
    found = ply.read(path, moved_scene)
    for name, value in given.named_parameters():
        # A product and a sum in float32, of numbers below 8.
        torch.testing.assert_close(getattr(found, name), value, rtol=0, atol=8 * 2.0**-22)
    vertex, means = PlyData.read(path)["vertex"][0], given.means[0].tolist()
    assert vertex["x"] == pytest.approx(-1 + 3 * means[0])
    assert vertex["z"] == pytest.approx(5 + 3 * means[2])
    assert vertex["scale_1"] == pytest.approx(given.log_scales[0, 1].item() + math.log(3))


def test_harmonics_of_a_file_have_the_condon_shortley_phase(moved_scene, tmp_path):
    """Colours by the polynomials of degree 2 as the release of 3D Gaussians has them."""
    path = tmp_path / "a.ply"
    given = some(1, degree=2)
    ply.write(given, moved_scene, path)
    vertex = PlyData.read(path)["vertex"][0]
    x, y, z = 0.36, 0.48, 0.8
    basis = [
        0.28209479177387814,
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * z * z - x * x - y * y),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (x * x - y * y),
    ]
    harmonics = torch.cat((given.base, given.view), dim=1)
    ours = shade(harmonics, torch.tensor([[x, y, z]]))[0].tolist()
    for channel in range(3):
        names = [f"f_dc_{channel}", *(f"f_rest_{8 * channel + k}" for k in range(8))]
        theirs = sum(b * float(vertex[name]) for b, name in zip(basis, names, strict=True))
        assert theirs == pytest.approx(ours[channel], abs=1e-5)


def vertices_of(scene: Scene, path: Path, **changes: float) -> np.ndarray:
    """Those of a good file of 50 Gaussians, but for the properties in `changes` of the first."""
    ply.write(some(), scene, path)
    vertices = PlyData.read(path, mmap=False)["vertex"].data
    for name, value in changes.items():
        vertices[name][0] = value
    return vertices


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"x": math.nan}, "1 of 50 Gaussians are not finite"),
        ({"scale_0": math.inf}, "1 of 50 Gaussians are not finite"),
        (dict.fromkeys(ply.ROTATION, 0.0), "1 of 50 Gaussians have a rotation of zeros"),
        (["x", "y", "z"], "there is no f_dc_0, f_dc_1"),
        ([*ply.NEEDED, *(f"f_rest_{k}" for k in range(44))], "got 44"),
        (slice(0), "it has none"),
    ],
)
def test_bad_vertices_are_refused(changes, complaint, tiny_scene, tmp_path):
    path = tmp_path / "a.ply"
    if isinstance(changes, dict):
        vertices = vertices_of(tiny_scene, path, **changes)
    else:
        vertices = repack_fields(vertices_of(tiny_scene, path)[changes])
    PlyData([PlyElement.describe(vertices, "vertex")]).write(path)
    with pytest.raises(SteerbenchError, match=complaint):
        ply.read(path, tiny_scene)


def test_a_missing_or_damaged_file_and_one_of_another_place_are_refused(tiny_scene, tmp_path):
    path = tmp_path / "a.ply"
    with pytest.raises(SteerbenchError, match="there is none"):
        ply.read(path, tiny_scene)
    ply.write(some(), tiny_scene, path)
    with pytest.raises(SteerbenchError, match="none of 50 Gaussians lies inside the scene"):
        ply.read(path, replace(tiny_scene, origin=torch.full((3,), 100.0)))
    for content in (path.read_bytes()[:-100], b"\x89PNG\r\n\x1a\n"):
        path.write_bytes(content)
        with pytest.raises(SteerbenchError, match="could not read one"):
            ply.read(path, tiny_scene)
