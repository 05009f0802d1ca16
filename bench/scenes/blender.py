"""Loads NeRF-Synthetic: `transforms_{train,val,test}.json` beside RGBA pictures."""

from pathlib import Path

from bench.records import read_json
from bench.scenes.assemble import assemble, cube, describe_splits, hull_box, parse_box
from bench.scenes.files import data_folder
from bench.scenes.transforms import read_views
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
    views = {}
    for split in ("train", "val", "test"):
        file, optional = root / camera_file(split), split == "val"
        if optional and not file.exists():
            continue
        listed = read_views(root, read_json(file), file, log, every=True, optional=optional)
        if listed:
            views[split] = [view for _, view in listed if view]
    pictures = describe_splits(views, downscale, log)
    train, box = pictures["train"], cube(HALF_EXTENT)
    if bounds == "auto":
        hull = hull_box([picture.camera for picture in train.described], train, box)
        if hull is None:
            log.info("bounds: the training pictures hold no masks, taking [-1.5, 1.5]^3")
        box = hull or box
    elif bounds != "full":
        box = parse_box(bounds)
    files = [root / camera_file(split) for split in views]
    return assemble(name or root.name, pictures, box, background=background, camera_files=files)


def camera_file(split: str) -> str:
    return f"transforms_{split}.json"
