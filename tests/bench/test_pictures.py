"""Pictures of other programs: matched with their truth, read, and scored as frames are."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image
from torch import Tensor

from bench import pictures
from bench.types import Split
from tests.common import refusal, seeded
from tests.conftest import QUICK

FACTS = {"method": "theirs", "scene": "a"}


def write(folder: Path, images: dict[str, Tensor]) -> Path:
    folder.mkdir()
    for name, image in images.items():
        Image.fromarray(image.numpy()).save(folder / name)
    return folder


def noise(channels: int = 3, size: tuple[int, int] = (16, 20), seed: int = 0) -> Tensor:
    return torch.randint(256, (*size, channels), dtype=torch.uint8, generator=seeded(seed))


@pytest.fixture
def scored(quiet_log):
    """Scores pairs of pictures."""

    def score(pairs, protocol=QUICK, **how):
        return pictures.score(pairs, protocol, {}, FACTS, quiet_log, **how)

    return score


GREY = torch.full((16, 20, 3), 100, dtype=torch.uint8)


def test_pictures_have_a_psnr_and_a_sequence_a_flicker_where_the_error_changes(tmp_path, scored):
    shown = {"1.png": GREY + 51, "2.png": GREY + 51, "10.png": GREY}  # off by 0.2, then not
    ours = write(tmp_path / "ours", shown)
    true = write(tmp_path / "true", dict.fromkeys(shown, GREY))
    pairs = pictures.pairs_with_folder(ours, true)
    found = scored(pairs)
    off = 20 * math.log10(255 / 51)
    assert found.frames["psnr"].tolist() == pytest.approx([off, off, math.inf], abs=1e-5)
    assert set(found.rows["metric"]) == {"psnr", "ssim"}
    assert set(found.rows["resolution"]) == {"20x16"}
    found = scored(pairs, sequence=True)
    assert math.isnan(found.frames["flicker"][0])
    assert found.frames["flicker"][1:].tolist() == pytest.approx([0.0, 0.2], abs=1e-6)


@pytest.mark.parametrize(("background", "level"), [("white", 255), ("black", 0)])
def test_alpha_is_put_on_the_background_of_the_protocol(tmp_path, scored, background, level):
    clear = torch.zeros(16, 20, 4, dtype=torch.uint8)
    plain = torch.full((16, 20, 3), level, dtype=torch.uint8)
    ours, true = write(tmp_path / "ours", {"a.png": clear}), write(tmp_path / "b", {"a.png": plain})
    protocol = replace(QUICK, name="mine", background=background)
    for pair in (ours, true), (true, ours):
        found = scored(pictures.pairs_with_folder(*pair), protocol)
        assert found.frames["psnr"][0] == math.inf


def test_names_match_without_their_endings_and_folders(tmp_path, scored):
    images = [noise(seed=number) for number in (9, 10)]
    ours = write(tmp_path / "ours", {"r_9.bmp": images[0], "r_10.bmp": images[1]})
    split = Split([], images, ["test/r_9.png", "test/r_10.png"])
    found = scored(pictures.pairs_with_split(ours, split))
    assert found.frames["psnr"].tolist() == [math.inf] * 2
    assert found.frames["name"].tolist() == split.names
    mask = torch.arange(16)[:, None].expand(16, 20) > 3
    spoiled = [torch.where(mask[..., None], image, 0) for image in images]
    masked = pictures.pairs_with_split(ours, replace(split, images=spoiled, masks=[mask, None]))
    again = scored(masked)
    assert again.frames["psnr"].isin([math.inf]).tolist() == [True, False]


@pytest.mark.parametrize("folder", ["", "out/"])
def test_pictures_in_subfolders_match_by_their_path(tmp_path, scored, folder):
    images = {name: noise(seed=k) for k, name in enumerate(("back/1", "front/1", "front/2"))}
    for name, image in images.items():
        path = tmp_path / f"ours/{folder}{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(image.numpy()).save(path)
    split = Split([], list(images.values()), [f"images/{name}.jpg" for name in images])
    for pairs in (
        pictures.pairs_with_split(tmp_path / "ours", split),
        pictures.pairs_with_split(tmp_path / "ours", split, "order"),
    ):
        found = scored(pairs)
        assert found.frames["psnr"].tolist() == [math.inf] * 3
    flat = write(tmp_path / "flat", {"1.png": noise(), "2.png": noise()})
    with refusal(r"true pictures of different names.* several of 1"):
        pictures.pairs_with_split(flat, split)


def test_accents_of_another_system_match(tmp_path):
    ours = write(tmp_path / "ours", {"e\u0301.png": noise()})
    assert pictures.matched(ours, ["\u00e9"], "name") == pictures.listed(ours)


def test_depth_and_normals_beside_a_picture_are_ignored(tmp_path):
    names = ["r_0.png", "r_0_depth_0001.png", "r_0_normal.png", "r_1_depth.png"]
    there = pictures.listed(write(tmp_path / "there", dict.fromkeys(names, noise())))
    assert [path.name for path in there] == ["r_0.png", "r_1_depth.png"]


@pytest.mark.parametrize(
    ("match", "names", "said"),
    [
        ("name", ["a.png"], "none for b"),
        ("name", ["a.png", "b.png", "c.png"], "also c"),
        ("name", ["c.png", "d.png"], "none for a, b, also c, d; --match order"),
        ("name", ["a.png", "a.jpg", "b.png"], "several of a"),
        ("name", [], "none"),
        ("order", ["a.png"], "2 pictures, as many as true ones, got 1"),
        ("name", ["a.png", "\udce9.png"], r"names in UTF-8 that can be printed, got '.udce9.png'"),
    ],
)
def test_pictures_that_do_not_match_are_named(tmp_path, match, names, said):
    ours = write(tmp_path / "ours", dict.fromkeys(names, noise()))
    true = write(tmp_path / "true", dict.fromkeys(["a.png", "b.png"], noise()))
    with refusal(said):
        pictures.pairs_with_folder(ours, true, match)
    with refusal("expected a folder, got no"):
        pictures.listed(tmp_path / "nowhere")
    (tmp_path / "linear").mkdir()
    (tmp_path / "linear/0.exr").touch()
    with refusal(r"expected pictures .* got 0\.exr"):
        pictures.listed(tmp_path / "linear")


def test_pictures_that_a_run_kept_are_refused_by_their_names(tmp_path):
    for kind in ("rendered", "truth", "error"):
        Image.new("RGB", (4, 4)).save(tmp_path / f"0003-{kind}.png")
    with refusal(r"scored already.*steerbench compare"):
        pictures.listed(tmp_path)


def test_two_truths_of_one_name_have_no_picture_of_their_own(tmp_path):
    ours = write(tmp_path / "ours", {"r_10.png": noise(), "r_9.png": noise()})
    said = "--match order takes both in their order, got several of 0001"
    with refusal(said):
        pictures.matched(ours, ["0001", "0001"], "name")
    with refusal(r"in the order of letters, got r_9\.png, r_10\.png"):
        pictures.matched(ours, ["images/10", "images/9"], "order")
    files = pictures.matched(ours, ["0001", "0001"], "order")
    assert [file.name for file in files] == ["r_9.png", "r_10.png"]


@pytest.mark.parametrize(
    ("ours", "true", "message"),
    [
        (noise(size=(8, 10)), noise(), r"ours/a.png: expected 20 x 16 .* a.png .* 10 x 8"),
        (noise(size=(8, 10)), noise(size=(8, 10)), r"ours/a.png: ssim needs"),
        (None, noise(), r"ours/a.png: expected a whole picture"),
    ],
)
def test_a_picture_that_cannot_be_scored_is_named(tmp_path, scored, ours, true, message):
    theirs = write(tmp_path / "ours", {"a.png": noise() if ours is None else ours})
    if ours is None:  # a file cut in half
        whole = (theirs / "a.png").read_bytes()
        (theirs / "a.png").write_bytes(whole[: len(whole) // 2])
    pairs = pictures.pairs_with_folder(theirs, write(tmp_path / "true", {"a.png": true}))
    with refusal(message):
        scored(pairs)


def test_what_a_run_rendered_has_its_figures(store, stored_run, tiny_scene, tmp_path, scored):
    kept = sorted((store.folder / stored_run / "pictures").glob("*-rendered.png"))
    measured = store.frames(stored_run).set_index("frame")
    measured = measured.loc[[int(path.stem.partition("-")[0]) for path in kept]]
    names, folder = list(measured["name"]), write(tmp_path / "theirs", {})
    for path, name in zip(kept, names, strict=True):
        (folder / f"{name}.png").write_bytes(path.read_bytes())
    split = tiny_scene.splits["test"]
    truths = dict(zip(split.names, split.images, strict=True))
    pairs = pictures.pairs_with_split(folder, Split([], [truths[name] for name in names], names))
    found = scored(pairs).frames
    for metric in ("psnr", "ssim"):
        assert found[metric].tolist() == measured[metric].tolist()
