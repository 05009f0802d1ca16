"""Models of COLMAP: cameras, lenses, pictures of another size, and what is refused."""

import re
import shutil
import struct
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from bench.cameras import pixel_grid, project
from bench.errors import Unavailable
from bench.scenes import colmap
from bench.scenes.assemble import Box
from bench.scenes.images import Fisheye, RadialTangential
from tests.bench.scenes.conftest import picture, pose
from tests.common import assert_near, refusal

pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is an extra")

PINHOLE = (9.0, 8.0, 4.5, 2.5)
POINTS = np.random.default_rng(0).uniform((-1, -2, -3), (1, 2, 3), (400, 3))


@pytest.fixture
def folder(tmp_path) -> Callable[..., Path]:
    """A capture of ten pictures of 8 x 6, with the camera and a model of the kind asked for."""

    def make(model="PINHOLE", params=PINHOLE, kind="binary"):
        root, found = tmp_path / kind, pycolmap.Reconstruction()
        for folder in ("images", "sparse/0"):
            (root / folder).mkdir(parents=True)
        camera = pycolmap.Camera(camera_id=1, model=model, width=8, height=6, params=params)
        found.add_camera_with_trivial_rig(camera)
        for number in range(10):
            name = f"{number:03}.png"
            Image.fromarray(picture(number, channels=3)).save(root / "images" / name)
            opencv = np.array(pose(number))[:3] * (1, -1, -1, 1)
            image = pycolmap.Image(image_id=number + 1, camera_id=1, name=name)
            found.add_image_with_trivial_frame(image, pycolmap.Rigid3d(opencv).inverse())
        for point in POINTS:
            found.add_point3D(point, pycolmap.Track(), np.zeros(3, np.uint8))
        getattr(found, f"write_{kind}")(root / "sparse/0")
        return root

    return make


def test_cameras_see_the_points_where_colmap_does(folder, log):
    root = folder()
    scene = colmap.load(root, log=log)
    found = pycolmap.Reconstruction(root / "sparse/0")
    assert list(scene.splits["test"].names) == ["000.png", "008.png"]
    assert len(scene.splits["train"]) == 8
    split = scene.splits["train"]
    for name, camera in zip(split.names, split.cameras, strict=True):
        image = found.find_image_with_name(name)
        points = (torch.from_numpy(POINTS) - scene.origin) / scene.unit_length
        pixels, depth = project(camera, points.float())
        seen = image.camera.img_from_cam(image.cam_from_world() * POINTS, check_cheirality=False)
        ahead = depth > 0
        torch.testing.assert_close(
            pixels[ahead], torch.from_numpy(seen).float()[ahead], rtol=1e-4, atol=1e-3
        )


def test_the_box_is_that_of_the_points_without_outliers_and_of_a_ply_the_same(folder, log):
    root = folder()
    model, scene = root / "sparse/0", colmap.load(root, space="box", log=log)
    box = pycolmap.Reconstruction(model).compute_bounding_box(colmap.STRAY, 1 - colmap.STRAY)
    expected = Box(torch.tensor(box.min), torch.tensor(box.max)).grown()
    assert scene.unit_length == expected.side
    assert torch.equal(scene.bounds, expected.place_of(expected))
    pycolmap.Reconstruction(model).export_PLY(model / "points3D.ply")
    (model / "points3D.bin").unlink()
    again = colmap.load(root, space="box", log=log)
    assert again.unit_length == pytest.approx(scene.unit_length, rel=1e-6)


def test_smaller_pictures_have_smaller_cameras(folder, log):
    root = folder()
    (root / "images_2").mkdir()
    for number in range(10):
        Image.fromarray(picture(number, 4, 3, 3)).save(root / f"images_2/{number:03}.png")
    full, half = (colmap.load(root, images=name, log=log) for name in ("images", "images_2"))
    first, second = (scene.splits["test"].cameras[0] for scene in (full, half))
    assert (second.width, second.height) == (4, 3)
    assert (second.fx, second.cy) == (first.fx / 2, first.cy / 2)


@pytest.mark.parametrize(
    ("images", "place"),
    [
        ("images", "masks/{}.png"),
        ("images", "masks/{}"),  # NAME.jpg.png may also be NAME.png
        ("images_2", "masks_2/{}.png"),
    ],
)
def test_masks_lie_beside_the_pictures(folder, log, images, place):
    root, black = folder(), np.uint8(np.arange(48).reshape(6, 8) % 3)
    (root / "images").rename(root / images)
    file = root / place.format("008.png")
    file.parent.mkdir()
    Image.fromarray(black).save(file)
    scene = colmap.load(root, images=images, log=log)
    assert scene.splits["test"].mask(0) is None is scene.splits["train"].mask(0)
    assert torch.equal(scene.splits["test"].mask(1), torch.from_numpy(black > 0))
    assert not colmap.load(root, images=images, masks=None, log=log).splits["test"].masks
    file.rename(file.with_name("frame_8.png"))
    log.messages.clear()
    colmap.load(root, images=images, log=log)
    assert "no picture has its mask there" in log.messages[0]
    Image.fromarray(black[::2, ::2]).save(file)
    with refusal(r"008\.png.*: expected 8 x 6 pixels, got 4 x 3"):
        colmap.load(root, images=images, log=log)
    with refusal(r"scene\.masks: .* got no 'none' in"):
        colmap.load(root, images=images, masks="none", log=log)


LENSES = {
    "SIMPLE_RADIAL": (9.0, 4.0, 3.0, 0.05),
    "OPENCV": (9.0, 8.0, 4.0, 3.0, 0.05, -0.02, 0.001, 0.002),
    "FULL_OPENCV": (9.0, 8.0, 4.0, 3.0, 0.05, -0.02, 0.001, 0.002, 0.01, 0.02, 0.01, 0.01),
    "OPENCV_FISHEYE": (9.0, 8.0, 4.0, 3.0, 0.05, -0.02, 0.01, 0.002),
    "FOV": (9.0, 8.0, 4.0, 3.0, 0.3),
}
GRID = (pixel_grid(8, 6).double() - torch.tensor([4.0, 3.0])) / torch.tensor([9.0, 8.0])


@pytest.mark.parametrize(
    ("model", "ours"),
    [
        ("OPENCV", RadialTangential((*LENSES["OPENCV"][4:], 0.0))),
        ("FULL_OPENCV", RadialTangential(LENSES["FULL_OPENCV"][4:])),
        ("OPENCV_FISHEYE", Fisheye(LENSES["OPENCV_FISHEYE"][4:])),
    ],
)
def test_our_lenses_are_those_of_colmap(model, ours):
    theirs = colmap.ColmapLens(model, LENSES[model])
    assert_near(ours(GRID), theirs(GRID), atol=1e-9)


@pytest.mark.parametrize("model", LENSES)
def test_pictures_of_every_lens_are_of_a_pinhole_of_the_same_focal_length(model, folder, log):
    plain = colmap.load(folder(kind="text"), log=log)
    bent = colmap.load(folder(model, LENSES[model]), log=log)
    first, second = (scene.splits["test"].images[0] for scene in (plain, bent))
    assert first.shape != second.shape or not torch.equal(first, second)
    camera = bent.splits["test"].cameras[0]
    assert (camera.height, camera.width) == second.shape[:2]
    assert camera.fx == pytest.approx(9.0)


def test_what_does_not_fit_is_named(folder, log):
    with refusal(r"\.png: expected a camera model with a focal"):
        colmap.load(folder("EQUIRECTANGULAR", (8.0, 6.0), "text"), log=log)
    root = folder()
    with refusal(r"expected cameras.bin or cameras.txt in sparse/1"):
        colmap.load(root, model="sparse/1", log=log)
    Image.fromarray(picture(5, 9, 9, 3)).save(root / "images/005.png")
    with refusal(r"005.png: expected a picture of 8 x 6 .* got 9 x 9"):
        colmap.load(root, log=log)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_damaged_list_is_an_error_that_names_it(folder, log, name):
    path = folder() / f"sparse/0/{name}.bin"
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with refusal(rf"{name}.bin: expected a whole list, got a damaged"):
        colmap.load(path.parents[2], space="box", log=log)


KEYPOINTS = "\n1 2 3 4.5 5.5 -1 7 8 9 10 11 12\n"
CHANGES: dict[str, Callable[[str], str]] = {
    "no end": lambda text: text.rstrip("\n"),
    "one line": lambda text: re.sub(r"\n+", "\n", text),
    "three lines": lambda text: text.replace("\n\n", "\n\n\n"),
    "keypoints": lambda text: text.replace("\n\n", KEYPOINTS),
    "windows": lambda text: "\ufeff" + text.replace("\n", "\r\n"),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_every_image_of_a_text_is_read_by_its_whole_name(folder, log, change):
    binary, root = colmap.load(folder(), log=log), folder(kind="text")
    for path in (root / "images").iterdir():
        path.rename(path.with_name(f"my  photo ({path.stem}).png"))
    images, cameras = (root / f"sparse/0/{name}.txt" for name in ("images", "cameras"))
    text = re.sub(r"(\d+)\.png", r"my  photo (\1).png", images.read_text())
    images.write_bytes(change(text).encode())
    cameras.write_text(cameras.read_text() + "9 NONE that no picture uses\n")
    scene = colmap.load(root, log=log)
    for split, of in scene.splits.items():
        other = binary.splits[split]
        assert of.names == [f"my  photo ({name[:-4]}).png" for name in other.names]
        poses = [torch.stack([camera.c2w for camera in part.cameras]) for part in (of, other)]
        torch.testing.assert_close(*poses)
    assert log.messages == []


IMAGE, CAMERA = "3 1 0 0 0 0 0 0 002.png", "expected CAMERA_ID MODEL"


@pytest.mark.parametrize(
    ("name", "pattern", "new", "message"),
    [
        ("images", r"^3 .*", IMAGE, "line 9: expected IMAGE_ID QW .* got '3 1 0"),
        ("images", r"1 002.png", "7 002.png", "line 9: 002.png: .* CAMERA_ID 7 without an entry"),
        (
            "images",
            r"^3 .* (?=1 002.png)",
            "3 0 0 0 0 0 0 0 ",
            "line 9: 002.png: length of its quaternion",
        ),
        ("images", r"^3 \S+", "3 nan", "line 9: 002.png: expected a finite number, got nan"),
        ("cameras", r"PINHOLE", "PINHOLES", f"line 4: {CAMERA} .* got 1 PINHOLES"),
        ("cameras", r" \S+$", "", f"line 4: {CAMERA} .* got 1 PINHOLE 8 6 9"),
        ("points3D", r"^7 .*", "7 0.5 x 1", r"line \d+: expected POINT3D_ID .* '7 0.5 x 1'"),
    ],
)
def test_a_bad_entry_of_a_text_is_named(folder, log, name, pattern, new, message):
    path = folder(kind="text") / f"sparse/0/{name}.txt"
    path.write_text(re.sub(pattern, new, path.read_text(), flags=re.MULTILINE))
    with refusal(f"{name}.txt: {message}"):
        colmap.load(path.parents[2], space="box", log=log)


def test_only_what_is_needed_of_a_binary_model_must_be_right(folder, log):
    root = folder()
    wanted, model = colmap.load(root, space="box", log=log), root / "sparse/0"
    cameras = (model / "cameras.bin").read_bytes()
    bad = struct.pack("<IiQQ4d", 9, 1, 0, 0, *[float("nan")] * 4)
    (model / "cameras.bin").write_bytes(struct.pack("<Q", 2) + cameras[8:] + bad)
    track = [struct.pack("<Q3d3BdQ2I", 1, *p, 0, 0, 0, 0, 1, 1, 77) for p in POINTS]
    (model / "points3D.bin").write_bytes(struct.pack("<Q", len(POINTS)) + b"".join(track))
    scene = colmap.load(root, space="box", log=log)
    assert scene.unit_length == wanted.unit_length
    assert scene.splits["test"].names == wanted.splits["test"].names


@pytest.mark.parametrize("content", ["", None])
def test_without_points_the_box_must_be_given(folder, log, content):
    root = folder(kind="text")
    path = root / "sparse/0/points3D.txt"
    path.unlink() if content is None else path.write_text(content)
    with refusal(r"expected points3D.* or scene\.bounds"):
        colmap.load(root, space="box", log=log)
    scene = colmap.load(root, bounds=[[-2, -2, -2], [2, 2, 2]], space="box", log=log)
    assert scene.unit_length == 4


@pytest.mark.parametrize("unregistered", [False, True])
def test_pictures_of_other_names_are_paired_in_order(folder, log, unregistered):
    root = folder()
    full, small = root / "images", root / "images_8"
    small.mkdir()
    if unregistered:
        (full / "000a.png").touch()
    for place, path in enumerate(sorted(full.iterdir())):
        shutil.copy(path, small / f"image{place:02}.jpg")
    if not unregistered:
        shutil.rmtree(full)
    scene = colmap.load(root, images="images_8", log=log)
    assert scene.splits["test"].names == ["000.png", "008.png"]
    assert np.array_equal(scene.splits["test"].images[1], picture(8, channels=3))
    assert "image00.jpg for 000.png" in log.messages[0]
    (small / "image.jpg").touch()
    with refusal(r"10 of 10 not there: no '000.png' in .*images_8;"):
        colmap.load(root, images="images_8", log=log)


def test_without_pycolmap_it_says_what_to_install(folder, log, monkeypatch):
    root = folder()
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with refusal(r"pip install .*\[colmap\]", Unavailable):
        colmap.load(root, log=log)
