"""NeRF-Synthetic's layout: what is read, and what is refused by name."""

import math
import shutil
import struct

import numpy as np
import pytest
import torch
from PIL import Image

from bench.cameras import move_camera
from bench.scenes import blender
from tests.bench.scenes.conftest import edit_json, encoded, picture, png
from tests.common import refusal


def test_pictures_are_read_byte_for_byte(blender_folder, log):
    scene = blender.load(blender_folder, log=log)
    assert scene.name == "chair"
    assert {name: len(split) for name, split in scene.splits.items()} == {"train": 3, "test": 2}
    for k, image in enumerate(scene.splits["test"].images):
        assert image.dtype == torch.uint8
        assert np.array_equal(image.numpy(), picture(50 + k))
    assert scene.splits["train"].names == ["train/r_0.png", "train/r_1.png", "train/r_2.png"]


def test_cameras_are_opencv_and_the_units_can_be_undone(blender_folder, log):
    scene = blender.load(blender_folder, bounds=[[-1, -1, -2], [1, 1, 2]], log=log)
    camera = scene.splits["train"].cameras[0]
    assert camera.fx == camera.fy == pytest.approx(4 / math.tan(0.35))
    assert (camera.cx, camera.cy, camera.width, camera.height) == (4, 3, 8, 6)
    assert scene.unit_length == 4
    assert scene.bounds.tolist() == [[0.25, 0.25, 0], [0.75, 0.75, 1]]
    # From (0, -4, 0) along +y with z up: right is x, down is -z, forward is y.
    expected = torch.tensor([[1.0, 0, 0, 0.5], [0, 0, 1, -0.5], [0, -1, 0, 0.5]])
    torch.testing.assert_close(camera.c2w, expected)
    back = move_camera(camera, scene.unit_length, scene.origin)
    torch.testing.assert_close(back.c2w[:, 3], torch.tensor([0.0, -4, 0]))


def test_opaque_pictures_take_the_whole_space(blender_folder, log):
    for k in range(3):
        Image.fromarray(picture(k, channels=3)).save(blender_folder / f"train/r_{k}.png")
    scene = blender.load(blender_folder, log=log)
    assert scene.unit_length == 3
    assert scene.bounds.tolist() == [[0, 0, 0], [1, 1, 1]]
    assert "no masks" in log.messages[-1]
    assert scene.splits["train"].images[0].shape == (6, 8, 3)


def test_a_validation_split_has_all_its_pictures_or_none(blender_folder, log):
    text = (blender_folder / "transforms_train.json").read_text().replace("./train", "./val")
    (blender_folder / "transforms_val.json").write_text(text)
    scene = blender.load(blender_folder, bounds="full", log=log)
    assert set(scene.splits) == {"train", "test"}
    assert log.messages == ["transforms_val.json: none of its 3 pictures are there, split left out"]
    shutil.copytree(blender_folder / "train", blender_folder / "val")
    (blender_folder / "val/r_1.png").unlink()
    with refusal(r"transforms_val.json: frames: .* 1 of 3 not there: no"):
        blender.load(blender_folder, log=log)


def test_the_digest_depends_on_content_and_options_not_on_the_place(blender_folder, tmp_path, log):
    def digest(**options):
        return blender.load(copy, **options, log=log).digest

    copy = tmp_path / "elsewhere/chair"
    shutil.copytree(blender_folder, copy)
    assert digest() == blender.load(blender_folder, log=log).digest
    flat = [[-1.5, -1.5, -0.5], [1.5, 1.5, 0.5]]  # centre and longest side are those of "full"
    options = [{}, {"background": "black"}, {"bounds": "full"}, {"bounds": flat}, {"downscale": 2}]
    digests = [digest(**some) for some in options]
    edit_json(copy / "transforms_test.json", lambda r: r.update(camera_angle_x=0.71))
    digests.append(digest())
    Image.fromarray(picture(99)).save(copy / "test/r_1.png")
    digests.append(digest())
    assert len(set(digests)) == 7


def frame(record: dict) -> dict:
    return record["frames"][1]


def placed(place: tuple[int, int], value: float):
    """Put a pose into a frame: the identity with one entry replaced."""
    matrix = np.eye(4)
    matrix[place] = value
    return lambda record: frame(record).update(transform_matrix=matrix.tolist())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: r.update(frames=[]), r"frames: expected a list with at least one entry"),
        (lambda r: r.pop("frames"), r"frames: expected a list .* got nothing"),
        (lambda r: r["frames"].append(3), r"frames\[3\]: expected an object, got 3"),
        (lambda r: frame(r).pop("file_path"), r"frames\[1\].file_path: expected a path"),
        (lambda r: frame(r).pop("transform_matrix"), r"frames\[1\].transform_matrix: .* 4x4"),
        (placed((0, 3), math.nan), r"frames\[1\].transform_matrix\[0\]\[3\]: .* got nan"),
        (placed((0, 0), 1.1), r"transform_matrix: expected an orthonormal .* off by 0.21"),
        (placed((0, 0), -1), r"transform_matrix: .* right-handed .* mirrored"),
        (placed((3, 2), 0.5), r"transform_matrix\[3\]: expected \[0, 0, 0, 1\]"),
        (lambda r: r.pop("camera_angle_x"), r"fl_x: expected a focal length, or camera_angle_x"),
        (lambda r: r.update(camera_angle_x=0), r"camera_angle_x: .* above 1e-09 and below 3.14"),
        (lambda r: r.update(camera_angle_x=3.2), r"camera_angle_x: .* got 3.2"),
        (lambda r: r.update(camera_angle_x="0.7"), r"camera_angle_x: .* got '0.7'"),
        (lambda r: r.update(camera_angle_x=10**400), r"camera_angle_x: expected a finite number"),
        (lambda r: frame(r).update(file_path="none"), "frames: .* 1 of 3 not there: no 'none' in"),
    ],
)
def test_bad_camera_file_names_file_and_field(blender_folder, log, change, message):
    edit_json(blender_folder / "transforms_train.json", change)
    with refusal(r"transforms_train\.json: (frames\[[01]\]\.)?" + message):
        blender.load(blender_folder, log=log)


# Black RGB of 16 bits a channel. Pillow cannot write it, and reads half of each number.
DEEP = png(struct.pack(">2I5B", 8, 6, 16, 2, 0, 0, 0), bytes(6 * (1 + 6 * 8)))


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("transforms_test.json", b'{"frames": [\n  1,,', r": line 2, column 5: expected JSON, got"),
        ("transforms_test.json", b"[1, 2]", r": expected a JSON object, got list"),
        ("transforms_test.json", b"[" * 100_000, r": expected JSON, got"),
        ("transforms_test.json", b"\xff\xfe\x00{", r": .* readable text file"),
        ("transforms_test.json", None, r": expected a file"),
        ("train/r_2.png", encoded("RGB")[:-40], r": expected a whole picture"),
        ("train/r_0.png", b"not a picture", r": expected a whole picture"),
        ("train/r_1.png", DEEP, r": expected 8 bits a channel"),
    ],
)
def test_a_file_that_is_damaged_or_missing_is_named(blender_folder, log, file, content, message):
    path = blender_folder / file
    path.unlink() if content is None else path.write_bytes(content)
    with refusal(path.name + message):
        list(blender.load(blender_folder, log=log).splits["train"].images)


@pytest.mark.parametrize("what", ["train/r_1.png", "train", "transforms_train.json"])
def test_what_a_link_leads_to_is_read(blender_folder, tmp_path, log, what):
    digest = blender.load(blender_folder, log=log).digest
    (blender_folder / what).rename(tmp_path / "outside")
    (blender_folder / what).symlink_to(tmp_path / "outside")
    assert blender.load(blender_folder, log=log).digest == digest
    with refusal(r"nowhere: expected a folder, got no"):
        blender.load(tmp_path / "nowhere", log=log)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"downscale": 0}, "downscale: expected a whole number from 1 on, got 0"),
        ({"downscale": 9}, "r_0.png: expected at least 9 x 9 pixels"),
        ({"background": "grey"}, "background: expected white or black, got 'grey'"),
        ({"bounds": "tight"}, "bounds: expected auto, full or a lower"),
        ({"bounds": [[0, 0, 0], [1, 1, 0]]}, "bounds: .* a lower and an upper corner"),
    ],
)
def test_bad_options(blender_folder, log, options, message):
    with refusal(message):
        blender.load(blender_folder, **options, log=log)
