"""Captures: intrinsics by frame, missing pictures, lens distortion, and what is refused."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from kornia.geometry.calibration import undistort_points
from PIL import Image
from scipy.spatial.transform import Rotation

from bench.cameras import pixel_grid
from bench.scenes import transforms
from bench.scenes.assemble import hold_out
from bench.scenes.files import Fields
from bench.scenes.images import Fisheye, RadialTangential, undistort, undistorted_camera
from bench.types import Camera
from tests.bench.scenes.conftest import edit_json, intrinsics, picture, pose
from tests.common import assert_near, refusal, write_json


@pytest.fixture
def folder(tmp_path) -> Path:
    """Ten pictures of 8 x 6, listed out of order, without a lens."""
    root = tmp_path / "desk"
    (root / "images").mkdir(parents=True)
    frames = []
    for k in reversed(range(10)):
        Image.fromarray(picture(k, channels=3)).save(root / f"images/{k:03}.png")
        frames.append({"file_path": f"images/{k:03}.png", "transform_matrix": pose(k)})
    record = {"fl_x": 9.0, "fl_y": 8.0, "cx": 4.5, "cy": 2.5, "w": 8, "h": 6, "aabb_scale": 2}
    write_json(root / "transforms.json", {**record, "frames": frames})
    return root


def of_picture(number: int, **settings: object) -> Callable[[dict], object]:
    """Put settings into the frame of a picture."""
    return lambda record: record["frames"][9 - number].update(settings)


@pytest.mark.parametrize(
    ("focal", "fx"), [({"fl_x": 7.0}, 7), ({"camera_angle_x": 2 * np.arctan(0.25)}, 8 / 2 / 0.25)]
)
def test_intrinsics_of_a_frame_go_first(folder, log, focal, fx):
    edit_json(folder / "transforms.json", of_picture(8, cx=4.0, **focal))
    first, second = transforms.load(folder, log=log).splits["test"].cameras
    assert intrinsics(first) == (9, 8, 4.5, 2.5)
    assert intrinsics(second) == pytest.approx((fx, 8, 4, 2.5))


def every(**settings: object) -> Callable[[dict], object]:
    return lambda record: record.update(settings)


def turned(scale: float, digits: int, *flip: int) -> Callable[[dict], object]:
    """Turn the rotation of every pose by 0.3 radians, scale, round and flip its axes."""

    def change(record: dict) -> None:
        for frame in record["frames"]:
            matrix = np.array(frame["transform_matrix"])
            turn = matrix[:3, :3] @ Rotation.from_euler("z", 0.3).as_matrix()
            matrix[:3, :3] = (scale * turn).round(digits) * (flip or 1)
            frame["transform_matrix"] = matrix.tolist()

    return change


def only_the_angle(record: dict) -> None:
    for name in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
        del record[name]
    record["camera_angle_x"] = 2 * np.arctan(0.5)


GIVEN = (9, 8, 4.5, 2.5)
FISHEYE = {"is_fisheye": True, "fl_x": 2.6, "fl_y": 2.6, "cx": 4, "cy": 3}  # of 176 degrees


@pytest.mark.parametrize(
    ("change", "lens", "said"),
    [
        (every(cx=-4, cy=7.5), (9, 8, -4, 7.5), r"001.png: .* far from .*: \(-4, 7.5\) of 8 x 6 "),
        (every(w=16, h=12, cx=9, cy=5), (4.5, 4, 4.5, 2.5), None),
        (every(x_fov=50), (8.578, *GIVEN[1:]), r"x_fov: is taken, not fl_x, .*: 9.0 \(and 9"),
        (every(camera_angle_x=2), GIVEN, r"fl_x: is taken, not camera_angle_x, .*: 2 \(and 9"),
        (lambda r: r.pop("fl_x"), (8, 8, 4.5, 2.5), None),
        (only_the_angle, (8, 8, 4, 3), None),
        (every(aabb=[[0, 0], [0, 1]], sharpen=0.0), GIVEN, "not read: aabb$"),
        (turned(0.25, 15), GIVEN, r"matrix: scaled or rounded rot.*: 0.25 \(and 9 more\)$"),
        (turned(1, 2), GIVEN, r"frames\[0\].transform_matrix: scaled or rounded rotation, taking"),
        (turned(1, 15, 1, -1, -1), GIVEN, "poses: all cameras look away from their middle"),
        (every(**FISHEYE), (2.6, 2.6, 4, 3), "001.png: without its lens, .*: . x . of 8 x 6"),
    ],
)
def test_what_is_put_right_or_doubted_is_said_once(folder, log, change, lens, said):
    edit_json(folder / "transforms.json", change)
    camera = transforms.load(folder, log=log).splits["test"].cameras[0]
    assert intrinsics(camera) == pytest.approx(lens, abs=1e-3)
    torch.testing.assert_close(camera.c2w[:, :3].T @ camera.c2w[:, :3], torch.eye(3))
    assert [bool(re.search(str(said), line)) for line in log.messages] == [True] * bool(said)


def test_pictures_of_several_sizes(folder, log):
    Image.fromarray(picture(0, 12, 10, 3)).save(folder / "images/000.png")
    edit_json(folder / "transforms.json", of_picture(0, w=12, h=10))
    first, second = transforms.load(folder, log=log).splits["test"].images
    assert (tuple(first.shape), tuple(second.shape)) == ((10, 12, 3), (6, 8, 3))


def test_missing_pictures_are_named_once_and_left_out(folder, log):
    for k in (3, 7):
        (folder / f"images/{k:03}.png").unlink()
    scene = transforms.load(folder, log=log)
    assert len(scene.splits["train"]) == 6
    assert scene.splits["test"].names == ["images/000.png", "images/008.png"]
    (message,) = log.messages
    left_out = "2 of 10 pictures are not there, left out: images/007.png, images/003.png"
    assert message.endswith(left_out)


def test_a_picture_in_train_and_in_test_is_named(folder, log):
    edit_json(folder / "transforms.json", of_picture(1, file_path="./images/000.png"))
    transforms.load(folder, log=log)
    assert log.messages[0].startswith(f"in train and test: 1 pictures, {folder}/images/000.png")


BLACK = np.where(np.arange(8) < 3, 0, np.full((6, 8), 9)).astype(np.uint8)  # hides three columns


@pytest.mark.parametrize("where", ["dynamic_mask", "m.png", "m.jpg"])
def test_masked_pixels_do_not_count(folder, log, where):
    before = transforms.load(folder, log=log)
    if where == "dynamic_mask":
        white = Image.fromarray(np.where(BLACK == 0, 255, 0).astype(np.uint8))
        white.save(folder / "images/dynamic_mask_008.png")
    else:
        bright = 25 if where == "m.jpg" else 1  # its black is nearly black
        Image.fromarray(bright * BLACK).save(folder / where, quality=50)
        edit_json(folder / "transforms.json", of_picture(8, mask_path=where))
    scene = transforms.load(folder, log=log)
    assert scene.splits["test"].mask(0) is None is scene.splits["train"].mask(0)
    assert torch.equal(scene.splits["test"].mask(1), torch.from_numpy(BLACK > 0))
    assert scene.digest != before.digest
    assert [message.split(":")[0] for message in log.messages] == ["1 of 10 pictures have masks"]
    held_out = hold_out(replace(scene, splits={"train": scene.splits["test"]}), "held", 2)
    assert torch.equal(held_out.splits["held"].mask(0), scene.splits["test"].mask(1))


def test_a_pixel_of_an_undistorted_smaller_picture_counts_if_all_of_it_does(folder, log):
    spots = np.uint8(255 * (np.random.default_rng(0).random((76, 100)) < 0.02))
    for k in range(10):
        Image.fromarray(spots).convert("RGB").save(folder / f"images/{k:03}.png")
        Image.fromarray(spots).save(folder / f"images/dynamic_mask_{k:03}.png")
    record = {"w": 100, "h": 76, "fl_x": 90, "fl_y": 84, "cx": 52.3, "cy": 37.1, "k1": 0.06}
    edit_json(folder / "transforms.json", lambda r: r.update(record))
    whole, half = (transforms.load(folder, downscale=k, log=log).splits["test"] for k in (1, 2))
    touched = whole.images[0][..., 0] > 0
    assert torch.equal(whole.mask(0), ~touched)
    height, width = half.images[0].shape[:2]
    blocks = touched[: 2 * height, : 2 * width].reshape(height, 2, width, 2)
    assert torch.equal(half.mask(0), ~blocks.any(3).any(1))
    assert {image.shape for image in half.images} == {(height, width, 3)}
    camera = half.cameras[0]
    assert (camera.height, camera.width, camera.fx) == (height, width, 45)
    assert width < 50  # cropped


MAPPED = {"scale": 0.1, "offset": [0.5, 0.7, 0.5]}


@pytest.mark.parametrize(
    ("given", "override", "side", "y"),
    [({}, None, 2 / 0.33, 0.5), ({}, 4, 4 / 0.33, 0.5), (MAPPED, 1, 1 / 0.1, 0.7)],
)
def test_the_cube_is_that_of_instant_ngp(folder, log, given, override, side, y):
    edit_json(folder / "transforms.json", lambda record: record.update(given))
    scene = transforms.load(folder, aabb_scale=override, space="box", log=log)
    assert scene.unit_length == pytest.approx(side)
    assert scene.bounds.tolist() == [[0, 0, 0], [1, 1, 1]]
    # Picture 0 was taken from (0, -4, 0): scale x + offset in instant-ngp's cube of side 1.
    expected = torch.tensor([0.5, y - 4 / side, 0.5])
    torch.testing.assert_close(scene.splits["test"].cameras[0].c2w[:, 3], expected)


def test_an_object_in_a_file_without_a_cube_is_where_the_cameras_are(folder, log):
    def change(record):
        del record["aabb_scale"]
        for frame in record["frames"]:
            frame["transform_matrix"][0][3] += 40

    edit_json(folder / "transforms.json", change)
    scene = transforms.load(folder, space="box", log=log)
    eyes = torch.stack([camera.c2w[:, 3] for camera in scene.splits["train"].cameras])
    assert ((eyes > -0.1) & (eyes < 1.1)).all()


def test_in_all_of_space_the_box_is_the_middle_half_of_the_cube(folder, log):
    boxed = transforms.load(folder, aabb_scale=1, space="box", log=log)
    endless = transforms.load(folder, aabb_scale=1, log=log)
    assert endless.bounds.tolist() == [[0.25] * 3, [0.75] * 3]
    assert endless.cells.tolist() == [[0.0] * 3, [1.0] * 3]
    assert endless.unit_length == 2 * boxed.unit_length
    assert endless.digest != boxed.digest
    first, second = (scene.splits["train"].cameras[0].c2w[:, 3] for scene in (boxed, endless))
    torch.testing.assert_close((first - 0.5) / 2, second - 0.5)
    # Without a box that is asked for, that of the cameras: 4 units away, they look at the origin.
    assert transforms.load(folder, log=log).unit_length == pytest.approx(2 * 8, rel=1e-3)


def test_a_background_is_what_is_neither_transparent_nor_plain(folder, log):
    assert transforms.load(folder, log=log).space == "all"
    Image.fromarray(picture(1)).save(folder / "images/001.png")
    assert transforms.load(folder, log=log).space == "box"
    white = np.full((6, 8, 3), 250, np.uint8)
    white[2:4, 3:5] = 0
    for k in range(10):
        Image.fromarray(white).save(folder / f"images/{k:03}.png")
    assert transforms.load(folder, log=log).space == "box"
    assert transforms.load(folder, background="black", log=log).space == "all"
    with refusal(r"scene.space: .* auto or box or all, got 'no'"):
        transforms.load(folder, space="no", log=log)


def first(**settings: object) -> Callable[[dict], object]:
    return of_picture(9, **settings)


FAR = [[1, 0, 0, 1e308], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (every(fl_x=0), r"frames\[0\].fl_x: expected a finite number above 0, got 0"),
        (first(fl_y="9"), r"transforms\.json: frames\[0\].fl_y: .* got '9'"),
        (first(mask_path=5), r"frames\[0\].mask_path: expected a path, got 5"),
        (first(mask_path="m.png"), r"mask_path: expected a picture, got no .m\.png. in"),
        (first(cx=[9]), r"frames\[0\].cx: expected a finite number, got list of 1"),
        (every(w=10), r"images/009.png: expected a picture of 10 x 6 pixels, or as wide"),
        (first(w=0), r"frames\[0\].w: expected a whole number from 1 on"),
        (first(k1=None), r"frames\[0\].k1: expected a finite number, got nothing"),
        (every(k4=0.1), r"frames\[0\].k4: expected a lens of k1 k2 p1 p2 k3"),
        (every(is_fisheye=True, p1=0.1), r"frames\[0\].p1: expected a lens of k1 k2 k3 k4"),
        (every(camera_model="EQUIRECTANGULAR"), r"frames\[0\].camera_model: expected one of OP"),
        (every(aabb_scale=0), r"transforms\.json: aabb_scale: .* above 0"),
        (every(scale=-1), r"transforms\.json: scale: .* above 0"),
        (every(offset=[1, 2]), r"transforms\.json: offset: expected 3 numbers, got list of 2"),
        (every(fl_x=1e-310), r"images/\d+.png: expected lengths of"),
        (every(fl_x=1e300), r"images/\d+.png: expected lengths of"),
        (every(scale=1e-300), "bounds: expected lengths of"),
        (every(k1=1e300, k2=-1e300), "expected a lens distortion that can be undone"),
        (every(k1=-2.0), "expected a lens distortion that can be undone, .* it folds the picture"),
        (first(transform_matrix=FAR), r"images/009.png: expected lengths of"),
    ],
)
def test_a_bad_field_and_what_float32_cannot_hold_are_named(folder, log, change, message):
    edit_json(folder / "transforms.json", change)
    with refusal(message):
        transforms.load(folder, space="box", log=log)


def test_too_few_pictures_and_a_bad_split_are_refused(folder, log):
    for value in (0, 1, 2.5, "8"):
        with refusal(r"split_every: expected a whole number from 2"):
            transforms.load(folder, split_every=value, log=log)
    first, *others = (folder / f"images/{k:03}.png" for k in range(10))
    for path in others:
        path.unlink()
    with refusal(r"expected a picture to train on"):
        transforms.load(folder, log=log)
    first.unlink()
    with refusal(r"frames: expected pictures, got 10 of 10 not there"):
        transforms.load(folder, log=log)


LENSES = {
    "pincushion": (0.06, 0.02, 0.0, 0.0, 0.0),
    "barrel": (-0.12, 0.02, 0.0, 0.0, 0.0),
    "phone": (0.058, -0.081, -0.001, 0.0002, 0.01),
    "tangential": (0.0, 0.0, 0.01, -0.008, 0.0),
}


def pinhole() -> Camera:
    return Camera(torch.eye(4)[:3], 90.0, 84.0, 52.3, 37.1, 100, 76)


def wave(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """A smooth picture of the image plane, [..., 3] in [0, 255]."""
    return 127.5 + 100 * torch.stack(
        (torch.sin(6 * x), torch.cos(5 * y), torch.sin(4 * (x + y))), -1
    )


@pytest.mark.parametrize("name", LENSES)
def test_undistortion_recovers_the_pinhole_picture(name):
    camera, lens = pinhole(), LENSES[name]

    def places(camera):
        pixels = pixel_grid(camera.width, camera.height).double()
        middle, focal = torch.tensor([[camera.cx, camera.cy], [camera.fx, camera.fy]]).double()
        return (pixels - middle) / focal

    numbers = torch.tensor(lens, dtype=torch.float64)
    seen = undistort_points(places(camera), torch.eye(3).double(), numbers, num_iters=60)
    distorted = wave(*seen.T).view(camera.height, camera.width, 3).round().to(torch.uint8)

    straight = undistort(distorted, camera, RadialTangential(lens))
    cropped = undistorted_camera(camera, RadialTangential(lens), Path("picture.png"))
    assert straight.shape == (cropped.height, cropped.width, 3)
    # The crop loses a border only: most of the picture stays.
    assert cropped.width * cropped.height > 0.85 * camera.width * camera.height
    # Bilinear: h^2 / 8 of the second derivatives along u and v, at most 100 * 36 / 84^2 a pixel
    # squared each, 1.5 for the lens' own stretch; and half a level for each rounding.
    bilinear = 2 * 1.5 * 100 * 36 / 84**2 / 8
    assert_near(straight.flatten(0, 1).double(), wave(*places(cropped).T), atol=bilinear + 1)


def test_colours_between_pixels_weigh_by_their_alpha():
    image = torch.zeros(76, 100, 4, dtype=torch.uint8)
    image[..., 0] = 200
    image[:, 50:, 3] = 255
    image[:, :50, :3] = 90  # not seen: alpha is 0
    straight = undistort(image, pinhole(), RadialTangential(LENSES["pincushion"]))
    colours = straight[straight[..., 3] > 0][:, :3]
    assert (colours.float() - torch.tensor([200.0, 0, 0])).abs().max() <= 1


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({}, None),
        ({"k1": 0.1, "p2": 0.2}, RadialTangential((0.1, 0.0, 0.0, 0.2, 0.0))),
        (
            {"camera_model": "FULL_OPENCV", "k1": 0.1, "k6": 0.2},
            RadialTangential((0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.2)),
        ),
        ({"camera_model": "OPENCV_FISHEYE", "k4": 0.1}, Fisheye((0.0, 0.0, 0.0, 0.1))),
        ({"is_fisheye": True}, Fisheye((0.0, 0.0, 0.0, 0.0))),
    ],
)
def test_the_lens_is_that_of_the_camera_model(settings, expected):
    assert transforms.read_lens(Fields("here", settings)) == expected
