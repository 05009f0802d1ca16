"""Loads NeRF-Synthetic: `transforms_{train,val,test}.json` beside RGBA pictures."""

from collections import ChainMap
from pathlib import Path

from bench.errors import unexpected
from bench.scenes.assemble import Box, assemble, cube, describe_splits, hull_box, parse_box
from bench.scenes.files import data_folder, frames_of, read_json
from bench.scenes.images import Pictures, View, image_size
from bench.scenes.lookup import absent, find_all, report
from bench.scenes.remarks import Remarks
from bench.scenes.transforms import KNOWN, read_view
from bench.types import Log, Scene

HALF_EXTENT = 1.5  # the objects of NeRF-Synthetic lie in [-1.5, 1.5]^3


def load(
    path: str | Path,
    *,
    downscale: int = 1,
    background: str = "white",
    bounds: str | list = "auto",
    name: str | None = None,
    log: Log,
) -> Scene:
    """Read the scene folder `path`; `name`, in result rows, is by default that of the folder.

    `downscale` averages blocks of so many pixels squared; pixels at the right and bottom that do
    not fill a block are dropped. RGBA pictures are composited onto `background`, "white" or
    "black". `bounds` fill the unit cube: the box of the visual hull of the training masks ("auto";
    without masks as "full"), [-1.5, 1.5]^3 ("full"), or [[x, y, z], [x, y, z]]. The split val is
    left out if none of its pictures exist.
    """
    root = data_folder(path)
    read = ((split, read_split(root, split, log)) for split in ("train", "val", "test"))
    views = {split: of_split for split, of_split in read if of_split}
    pictures = describe_splits(views, downscale, log)
    box = scene_box(bounds, pictures["train"], log)
    files = [root / camera_file(split) for split in views]
    return assemble(name or root.name, pictures, box, background=background, camera_files=files)


def camera_file(split: str) -> str:
    return f"transforms_{split}.json"


def read_split(root: Path, split: str, log: Log) -> list[View]:
    """The views of a split; empty if it is optional and its pictures do not exist."""
    optional = split == "val"
    path = root / camera_file(split)
    if optional and not path.exists():
        return []
    record = read_json(root, path.name)
    frames = frames_of(record, path)
    names = [frame["file_path"] for _, frame in frames]
    found = find_all(root, names)
    files = [file for file in found if file]
    if optional and not files:
        log.info(f"{path.name}: none of its {len(found)} pictures are there, split left out")
        return []
    if len(files) < len(found):
        first = found.index(None)
        raise unexpected(f"{frames[first][0]}.file_path", "a picture", absent(root, names[first]))
    report(root, names, found, path.name, log)
    size, remarks, views = image_size(files[0]), Remarks(), []
    remarks.add_unread(path, [record, *(frame for _, frame in frames)], KNOWN)
    for (at, frame), file in zip(frames, files, strict=True):
        settings = ChainMap(frame, record, dict(zip("wh", size, strict=True)))
        views.append(read_view(root, file, settings, at, remarks))
    remarks.tell(log.info)
    return views


def scene_box(bounds: str | list, train: Pictures, log: Log) -> Box:
    """The box, in the data set's units, that `bounds` of `load` stands for."""
    space = cube(HALF_EXTENT)
    if bounds == "full":
        return space
    if bounds != "auto":
        return parse_box(bounds)
    hull = hull_box([picture.camera for picture in train.described], train, space)
    if hull is None:
        half = HALF_EXTENT
        log.info(f"bounds: the training pictures hold no masks, taking [-{half}, {half}]^3")
    return hull or space
