"""Loaders on anything: a scene to be rendered, or a SteerbenchError. `make fuzz` runs long."""

import copy
import json
import math
import struct
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bench.console import ConsoleLog
from bench.memory import MemoryMeter
from bench.scenes import blender, nsvf, transforms
from bench.scenes.images import decode_bytes
from bench.types import Scene, SteerbenchError
from tests.bench.scenes.conftest import encoded, intrinsics, png
from tests.common import write_json

QUIET = ConsoleLog(Path(), quiet=True)
IN_ONE_FOLDER = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)

NUMBERS = st.one_of(
    st.sampled_from(
        [0, -1, 5e-324, 1e-310, 1e-30, 1e-5, 1e30, 1e308, 10**400, math.nan, math.inf, 1 << 40]
    ),
    st.integers(-3, 3),
    st.floats(),
)
LEAVES = st.one_of(
    st.none(), st.booleans(), NUMBERS, st.text(max_size=8), st.sampled_from(["a.png", "..", "\0"])
)
VALUES = st.recursive(
    LEAVES,
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3)
    ),
    max_leaves=6,
)
KEYS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y", "aabb_scale",
        "scale", "offset", "k1", "k2", "p1", "k3", "k4", "camera_model", "is_fisheye")  # fmt: skip
POSE = [[1.0, 0, 0, 0.5], [0, 0, -1, -4], [0, 1, 0, 0.25], [0, 0, 0, 1]]
RECORD = {
    "camera_angle_x": 0.7,
    "frames": [{"file_path": f"{i}.png", "transform_matrix": POSE} for i in range(3)],
}


def places(value: Any, at: tuple = ()) -> Iterator[tuple]:
    """Where everything in a nest of lists and objects is."""
    yield at
    if isinstance(value, dict | list):
        for key in value if isinstance(value, dict) else range(len(value)):
            yield from places(value[key], (*at, key))


@st.composite
def records(draw: st.DrawFn) -> Any:
    """The record with a few things in it replaced, added or taken away."""
    record: Any = copy.deepcopy(RECORD)
    for _ in range(draw(st.integers(0, 3))):
        inside = [place for place in places(record) if place]
        if draw(st.booleans()) or not inside:
            record[draw(st.sampled_from(KEYS))] = draw(NUMBERS | VALUES)
            continue
        *way, last = draw(st.sampled_from(inside))
        parent = record
        for key in way:
            parent = parent[key]
        if draw(st.integers(0, 3)):
            parent[last] = draw(NUMBERS | VALUES)
        else:
            del parent[last]
    return record


def changed(content: bytes) -> st.SearchStrategy[bytes]:
    """`content` cut, or with some of its bytes replaced or more put in."""

    @st.composite
    def bytes_(draw: st.DrawFn) -> bytes:
        some = bytearray(content)
        for _ in range(draw(st.integers(1, 4))):
            at = draw(st.integers(0, len(some)))
            more = draw(st.binary(max_size=5))
            some[at : at + draw(st.sampled_from([0, 1, len(more), 1 << 20]))] = more
        return bytes(some)

    return bytes_()


PICTURES = [
    *(encoded(mode, "PNG") for mode in ("1", "L", "LA", "P", "RGB", "RGBA", "I;16")),
    *(encoded(mode, "JPEG") for mode in ("L", "RGB", "CMYK")),
    encoded("P", "GIF"),
    encoded("RGBA", "TIFF"),
    encoded("RGB", "BMP"),
    encoded("RGBA", "WEBP"),
]


@st.composite
def headers(draw: st.DrawFn) -> bytes:
    """A PNG whose header says anything, and whose checksums are right."""
    size = st.sampled_from([0, 1, 8, 6, 1 << 13, 1 << 14, 1 << 20, (1 << 31) - 1, (1 << 32) - 1])
    header = struct.pack(
        ">IIBBBBB", draw(size), draw(size), *(draw(st.integers(0, 17)) for _ in range(5))
    )
    return png(header, draw(st.binary(max_size=64)) + bytes(draw(st.sampled_from([0, 200]))))


@pytest.fixture(autouse=True)
def within_a_gigabyte() -> Iterator[None]:
    """No test makes the process grow by 1 GiB at its peak."""
    before, meter = MemoryMeter("cpu"), MemoryMeter("cpu")
    with before:
        pass
    with meter:
        yield
    assert meter.peak_bytes - before.peak_bytes < 1 << 30


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Pictures and camera files of all formats, which a test may overwrite."""
    root = tmp_path_factory.mktemp("scene")
    for i in range(3):
        (root / f"{i}.png").write_bytes(encoded("RGBA", "PNG"))
    (root / "pose").mkdir()
    (root / "rgb").mkdir()
    for name in ("0_a", "0_b", "2_c"):
        (root / f"rgb/{name}.png").write_bytes(encoded("RGBA", "PNG"))
        (root / f"pose/{name}.txt").write_text(TEXTS["pose/0_a.txt"])
    write_json(root / "transforms_test.json", RECORD)
    return root


TEXTS = {
    "bbox.txt": "-1 -1 -1 1 1 1 0.1",
    "intrinsics.txt": "10 4 3 0\n0 0 0\n0\n1\n6 8",
    "pose/0_a.txt": "\n".join(" ".join(map(str, row)) for row in POSE),
}


def loads_or_refuses(load: Callable[[], Scene]) -> None:
    """What is loaded is fit to be rendered."""
    try:
        scene = load()
    except SteerbenchError:
        return
    assert scene.bounds.isfinite().all()
    assert 0 < scene.unit_length < math.inf
    assert scene.origin.isfinite().all()
    for split in scene.splits.values():
        for camera, image in zip(split.cameras, split.images, strict=True):
            assert camera.c2w.isfinite().all()
            numbers = torch.tensor(intrinsics(camera))
            assert numbers.isfinite().all()
            assert (numbers[:2] > 0).all()
            assert image.shape[:2] == (camera.height, camera.width)
            assert image.dtype == torch.uint8


FILES = {
    "transforms.json": transforms.load,
    "transforms_train.json": partial(blender.load, bounds="full"),
}


@pytest.mark.parametrize("file", FILES)
@IN_ONE_FOLDER
@given(records().map(json.dumps).map(str.encode) | changed(json.dumps(RECORD).encode()))
def test_a_camera_file_of_any_structure_or_bytes(folder, file, content):
    (folder / file).write_bytes(content)
    loads_or_refuses(lambda: FILES[file](folder, downscale=len(content) % 2 + 1, log=QUIET))


@st.composite
def texts(draw: st.DrawFn) -> tuple[str, str]:
    """A file of NSVF's layout with some of its words replaced, or none left alone."""
    name = draw(st.sampled_from(sorted(TEXTS)))
    lines = [line.split() for line in TEXTS[name].splitlines()]
    for _ in range(draw(st.integers(1, 3))):
        line = draw(st.sampled_from(lines))
        if line:
            at = draw(st.integers(0, len(line) - 1))
            line[at : at + 1] = draw(st.lists(NUMBERS.map(str) | st.text(max_size=4), max_size=2))
    return name, "\n".join(" ".join(line) for line in lines)


@IN_ONE_FOLDER
@given(texts())
def test_an_nsvf_scene_of_any_text(folder, changed_file):
    for name, text in (*TEXTS.items(), changed_file):
        (folder / name).write_text(text, errors="replace")
    loads_or_refuses(lambda: nsvf.load(folder, log=QUIET))


@given(st.sampled_from(PICTURES).flatmap(changed) | headers())
def test_a_picture_of_any_bytes(content):
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow's, of things it puts up with
            picture = decode_bytes(content, Path("a.png"))
    except SteerbenchError:
        return
    assert picture.dtype == torch.uint8
    assert picture.shape[2] in (3, 4)
