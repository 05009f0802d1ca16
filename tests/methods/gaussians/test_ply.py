"""Gaussians as PLY: both ways, in the data set's coordinates; files of others, and no good ones."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.lib.recfunctions import append_fields, repack_fields
from plyfile import PlyData, PlyElement

from bench.types import NullProbe, Scene
from methods.gaussians import ply
from methods.gaussians.model import Gaussians, rounded
from methods.kernels.shade import shade
from tests.common import assert_near, refusal, seeded
from tests.methods.kernels.test_spherical import with_phase

NEEDED = (*ply.POSITION, *ply.BASE, "opacity", *ply.SCALE, *ply.ROTATION)


def some(count: int = 50, degree: int = 3) -> Gaussians:
    generator = seeded(0)

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
    degree, tiny_scene, tmp_path
):
    """The unit cube is [-1, 2] x [-2, 1] x [5, 8] of the data set."""
    scene = replace(tiny_scene, origin=torch.tensor([-1.0, -2.0, 5.0]))
    path, given = tmp_path / "a.ply", some(degree=degree)
    ply.write(given, scene, path)
    found = ply.read(path, scene, print)
    # A product and a sum in float32, of numbers below 8.
    assert_near(found.state_dict(), given.state_dict(), atol=8 * 2.0**-22)
    vertex, means = PlyData.read(path)["vertex"][0], given.means[0].tolist()
    assert vertex["x"] == pytest.approx(-1 + 3 * means[0])
    assert vertex["z"] == pytest.approx(5 + 3 * means[2])
    assert vertex["scale_1"] == pytest.approx(given.log_scales[0, 1].item() + math.log(3))


def test_positions_far_from_the_origin_keep_their_digits(moved_scene, tmp_path):
    far = torch.tensor([500_000.0, 5_000_000.0, 0.0], dtype=torch.float64)
    scene, given = replace(moved_scene, origin=far), some()
    ply.write(given, scene, tmp_path / "a.ply")
    assert PlyData.read(tmp_path / "a.ply")["vertex"]["y"].max() > 5e6
    found = ply.read(tmp_path / "a.ply", scene, print)
    assert_near(found.means, given.means, atol=1e-6)  # float32: 0.2


def test_harmonics_of_a_file_have_the_condon_shortley_phase(moved_scene, tmp_path):
    """As the polynomials in the release of 3D Gaussians have it."""
    path, given = tmp_path / "a.ply", some(1, degree=2)
    ply.write(given, moved_scene, path)
    vertex, towards = PlyData.read(path)["vertex"][0], torch.tensor([[0.36, 0.48, 0.8]])
    (basis,) = with_phase(towards, 3)
    ours = shade(torch.cat((given.base, given.view), dim=1), towards)[0].tolist()
    for channel in range(3):
        names = [f"f_dc_{channel}", *(f"f_rest_{8 * channel + k}" for k in range(8))]
        assert basis @ [float(vertex[name]) for name in names] == pytest.approx(
            ours[channel], abs=1e-5
        )


def vertices_of(scene: Scene, path: Path, **changes: float) -> np.ndarray:
    """Those of a good file of 50 Gaussians, but for the properties in `changes` of the first."""
    ply.write(some(), scene, path)
    vertices = PlyData.read(path, mmap=False)["vertex"].data
    for name, value in changes.items():
        vertices[name][0] = value
    return vertices


def read_again(vertices: np.ndarray, path: Path, scene: Scene, **how: Any) -> tuple[Gaussians, str]:
    """The Gaussians of a file that is written otherwise, and what is said of it."""
    PlyData([PlyElement.describe(vertices, "vertex")], **how).write(path)
    said: list[str] = []
    return ply.read(path, scene, said.append), "; ".join(said)


@pytest.mark.parametrize(
    ("how", "kind"), [({"text": True}, "f4"), ({"byte_order": ">"}, "f4"), ({}, "f8")]
)
def test_text_the_other_byte_order_and_doubles_are_read_alike(how, kind, tiny_scene, tmp_path):
    vertices = vertices_of(tiny_scene, tmp_path / "a.ply")
    other = vertices.astype([(name, kind) for name in vertices.dtype.names])
    found, said = read_again(other, tmp_path / "b.ply", tiny_scene, **how)
    assert said == ""
    plain = ply.read(tmp_path / "a.ply", tiny_scene, print).state_dict()
    torch.testing.assert_close(found.state_dict(), plain, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    "changes", [{"x": math.nan}, {"scale_0": math.inf}, dict.fromkeys(ply.ROTATION, 0.0)]
)
def test_gaussians_that_cannot_be_drawn_are_left_out_and_counted(changes, tiny_scene, tmp_path):
    path = tmp_path / "a.ply"
    found, said = read_again(vertices_of(tiny_scene, path, **changes), path, tiny_scene)
    assert "1 of 50 Gaussians are left out" in said
    torch.testing.assert_close(found.means, some().means[1:])


@pytest.mark.parametrize(
    ("name", "infinite", "finite"),
    [("opacity", math.inf, 30), ("opacity", -math.inf, -30), ("scale_1", -math.inf, -40)],
)
def test_an_infinite_opacity_or_no_thickness_is_drawn(name, infinite, finite, tiny_scene, tmp_path):
    path, pictures = tmp_path / "a.ply", []
    for value in (infinite, finite):
        vertices = vertices_of(tiny_scene, path, **{name: value})
        found, _ = read_again(vertices, path, tiny_scene)
        assert all(x.isfinite().all() for x in rounded(found).parameters())
        camera = tiny_scene.splits["test"].cameras[0]
        pictures.append(found.render(camera, 1e-4, NullProbe()).values)
    torch.testing.assert_close(*pictures)


def test_the_filter_of_mip_splatting_is_fused_and_what_is_not_read_or_drawn_named(
    tiny_scene, tmp_path
):
    path, given, more = tmp_path / "a.ply", some(), ["filter_3D", "motion_0"]
    plain = vertices_of(tiny_scene, path)
    vertices = append_fields(plain, more, [np.full(50, 0.03)] * 2, usemask=False)
    found, said = read_again(vertices, path, tiny_scene, comments=["SplatRenderMode: mip"])
    assert "trained with antialiasing, as a comment in it says; drawn without" in said
    assert "filter_3D is fused" in said
    assert "not read: motion_0" in said
    scales = (given.log_scales.exp().square() + (0.03 / tiny_scene.unit_length) ** 2).sqrt()
    torch.testing.assert_close(found.log_scales.exp(), scales)
    share = (given.log_scales.exp() / scales).prod(dim=1)
    torch.testing.assert_close(found.opacities, given.opacities * share)


def test_surfels_of_2dgs_are_flat(tiny_scene, tmp_path):
    vertices = vertices_of(tiny_scene, tmp_path / "a.ply")
    flat = repack_fields(vertices[[name for name in vertices.dtype.names if name != "scale_2"]])
    found, said = read_again(flat, tmp_path / "b.ply", tiny_scene)
    assert "2DGS" in said
    assert (found.log_scales[:, 2] == -math.inf).all()


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        (["x", "y", "z"], "there is no f_dc_0, .*, but x, y, z"),
        ([*NEEDED, *(f"f_rest_{k}" for k in range(44))], "got 44"),
        (slice(0), "it has none"),
    ],
)
def test_files_without_gaussians_are_refused(changes, complaint, tiny_scene, tmp_path):
    path = tmp_path / "a.ply"
    vertices = repack_fields(vertices_of(tiny_scene, path)[changes])
    with refusal(complaint):
        read_again(vertices, path, tiny_scene)


@pytest.mark.parametrize("name", ["a.spz", "a.compressed.ply"])
def test_packed_files_are_named_with_what_converts_them(name, tiny_scene, tmp_path):
    vertices = np.zeros(1, [("packed_position", "u4")])
    with refusal(f"splat-transform {name} a-plain.ply"):
        read_again(vertices, tmp_path / name, tiny_scene)


def test_a_missing_or_damaged_file_and_one_of_another_place_are_refused(tiny_scene, tmp_path):
    path = tmp_path / "a.ply"
    with refusal("expected a PLY file of 3D Gaussians, got no"):
        ply.read(path, tiny_scene, print)
    ply.write(some(), tiny_scene, path)
    with refusal("none of 50 Gaussians lies inside the scene"):
        ply.read(path, replace(tiny_scene, origin=torch.full((3,), 100.0)), print)
    for content in (path.read_bytes()[:-100], b"\x89PNG\r\n\x1a\n"):
        path.write_bytes(content)
        with refusal("could not read one"):
            ply.read(path, tiny_scene, print)
