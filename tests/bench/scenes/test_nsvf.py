"""NSVF's layout: both forms of intrinsics, the split prefixes, and what is refused by name."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from bench.cameras import move_camera
from bench.scenes import nsvf
from tests.bench.scenes.conftest import intrinsics, picture
from tests.common import assert_near, refusal

MATRIX = "9 0 4.5 0\n0 8 2.5 0\n0 0 1 0\n0 0 0 1\n"


@pytest.fixture
def folder(tmp_path) -> Path:
    """Two training, one validation and one test picture of 8 x 6."""
    root = tmp_path / "Truck"
    (root / "rgb").mkdir(parents=True)
    (root / "pose").mkdir()
    (root / "bbox.txt").write_text("-1 -2 -1 1 2 1 0.4\n")
    (root / "intrinsics.txt").write_text(MATRIX)
    for k, name in enumerate(("0_000", "0_001", "1_002", "2_003")):
        Image.fromarray(picture(k, channels=3)).save(root / f"rgb/{name}.png")
        pose = np.eye(4)
        pose[:3, 3] = (k, 0, -5)
        np.savetxt(root / f"pose/{name}.txt", pose)
    return root


def test_prefixes_are_splits_poses_opencv_and_the_box_fills_the_unit_cube(folder, log):
    scene = nsvf.load(folder, log=log)
    names = {split: list(views.names) for split, views in scene.splits.items()}
    assert names == {
        "train": ["rgb/0_000.png", "rgb/0_001.png"],
        "val": ["rgb/1_002.png"],
        "test": ["rgb/2_003.png"],
    }
    assert np.array_equal(scene.splits["test"].images[0].numpy(), picture(3, channels=3))
    camera = move_camera(scene.splits["val"].cameras[0], scene.unit_length, scene.origin)
    expected = torch.tensor([[1.0, 0, 0, 2], [0, 1, 0, 0], [0, 0, 1, -5]])
    assert_near(camera.c2w, expected, atol=2e-6)
    # Sides 2.2, 4.2, 2.2: every side is longer by 5 % of the longest.
    x = 1.1 / 4.2
    bounds = torch.tensor([[0.5 - x, 0, 0.5 - x], [0.5 + x, 1, 0.5 + x]])
    torch.testing.assert_close(scene.bounds, bounds)


def test_folders_may_be_links_and_have_another_case(folder, log):
    digest = nsvf.load(folder, log=log).digest
    (folder / "rgb").rename(folder.parent / "elsewhere")
    (folder / "RGB").symlink_to(folder.parent / "elsewhere")
    (folder / "pose").rename(folder / "Pose")
    assert nsvf.load(folder, log=log).digest == digest


def test_without_2_the_1_are_the_test_split(folder, log):
    (folder / "rgb/2_003.png").unlink()
    scene = nsvf.load(folder, log=log)
    assert {split: len(views) for split, views in scene.splits.items()} == {"train": 2, "test": 1}
    missing, remark = log.messages
    assert missing.endswith("poses without a picture: 1, 2_003 is the first")
    assert "1_* are the test split" in remark


@pytest.mark.parametrize(("name", "further"), [("Mic", 1.2), ("Lego", 1.1), ("Chair", 1.0)])
def test_boxes_that_are_too_small_are_enlarged_further(folder, log, name, further):
    scene = nsvf.load(folder.rename(folder.with_name(name)), log=log)
    assert scene.unit_length == pytest.approx(4 * 1.05 * further)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (MATRIX, (9, 8, 4.5, 2.5)),
        ("9 0 4.5\n0 8 2.5\n0 0 1\n", (9, 8, 4.5, 2.5)),
        ("9 0 4.5 0\n0 8 2.5 0\n0 0 1 0\n", (9, 8, 4.5, 2.5)),
        (MATRIX.replace("\n", " "), (9, 8, 4.5, 2.5)),
        ("9. 4.5 2.5 0.\n0. 0. 0.\n0.\n1.\n6 8\n", (9, 9, 4.5, 2.5)),
        ("9 4.5 2.5", (9, 9, 4.5, 2.5)),
        ("9 8 4.5 2.5", (9, 8, 4.5, 2.5)),
        (MATRIX + "12 16", (4.5, 4, 2.25, 1.25)),  # of pictures twice as large
        ("12 16\n9 4.5 2.5 0", (4.5, 4.5, 2.25, 1.25)),
    ],
)
def test_every_form_of_intrinsics(folder, log, text, expected):
    (folder / "intrinsics.txt").write_text(text)
    camera = nsvf.load(folder, log=log).splits["train"].cameras[0]
    assert intrinsics(camera) == expected


@pytest.mark.parametrize(
    ("files", "text", "message"),
    [
        ("bbox.txt", "-1 -1 -1 1 1", r"bbox.txt: expected x0 y0 z0 x1 y1 z1 .* got 5 numbers"),
        ("bbox.txt", "-1 -1 -1 1 -2 1 .4", r"bbox.txt: expected each upper bound above"),
        ("bbox.txt", "-1 -1 nan 1 1 1 .4", r"bbox.txt: number 3: expected a finite number"),
        ("bbox.txt", "a b c", r"bbox.txt: expected numbers, got"),
        ("intrinsics.txt", "9 9\n1 1\n", r"intrinsics.txt: expected a 4x4, 3x4 or 3x3 matrix"),
        ("intrinsics.txt", "9 0 0\n0 8 0\n4 2 1", r"expected rows fx 0 cx, 0 fy cy and 0 0 1"),
        ("intrinsics.txt", MATRIX + "6 6", r"0_000.png: expected a picture of 6 x 6 pixels, or as"),
        ("intrinsics.txt", MATRIX.replace("9", "-9"), r"intrinsics.txt: fx: .* above 0, got -9"),
        ("intrinsics.txt", MATRIX.replace("8", "0"), r"intrinsics.txt: fy: .* above 0, got 0"),
        ("pose/0_001.txt", "1 0 0 0\n0 1 0 0\n", r"0_001.txt: expected a 4x4 matrix"),
        ("bbox.txt", None, r"bbox.txt: expected a file, got no 'bbox.txt' in"),
        ("pose/2_003.txt", None, r"pose/2_003.txt: expected a file, got no '2_003.txt'"),
        ("rgb/0_*.png", None, r"rgb: expected pictures 0_\*, got none"),
        ("rgb/[12]_*.png", None, r"rgb: expected pictures 2_\* or 1_\*, got none"),
        ("rgb/*.png", None, r"rgb: expected pictures named 0_\*"),
    ],
)
def test_what_is_wrong_or_missing_is_named(folder, log, files, text, message):
    for path in folder.glob(files):
        path.unlink() if text is None else path.write_text(text)
    with refusal(message):
        nsvf.load(folder, log=log)


def test_a_scene_far_from_its_origin_keeps_its_cameras(folder, log):
    near = nsvf.load(folder, log=log).splits["train"].cameras
    far = 1e6
    (folder / "bbox.txt").write_text(f"{far - 1} {far - 2} {far - 1} {far + 1} {far + 2} {far + 1}")
    for path in (folder / "pose").iterdir():
        pose = np.loadtxt(path)
        pose[:3, 3] += far
        np.savetxt(path, pose)
    for camera, other in zip(near, nsvf.load(folder, log=log).splits["train"].cameras, strict=True):
        # Rounded to float32 in the data set's units, they would be off by 1e6 u = 0.06.
        assert_near(other.c2w, camera.c2w, atol=1e-6)
