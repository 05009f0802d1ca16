"""The paper's data sets, and the scenes of one in a folder."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from bench.errors import SteerbenchError
from bench.records import read_json
from bench.scenes.blender import camera_file
from bench.scenes.files import data_folder, frames_of
from bench.scenes.lookup import find_all
from bench.scenes.nsvf import picture_files

DATA_SETS: Any = OmegaConf.load(Path(__file__).parents[1] / "reports/paper/scenes.yaml").data_sets
FIRST = next(iter(DATA_SETS))
"""The paper's data sets by name; scenes that none of them names are compared with the first."""

MARKS = {"blender": camera_file("train"), "nsvf": "bbox.txt"}
"""The file by which a scene's layout is recognised, by the value of `scene=` that reads it."""


def data_set_of(scene: str) -> str:
    """The data set of the paper whose figures a scene is compared with."""
    wanted = (name for name, of in DATA_SETS.items() if scene in (*of["scenes"], *of["stand_ins"]))
    return next(wanted, FIRST)


def data_sets(scenes: Sequence[str]) -> list[str]:
    """The data sets of `scenes`, in the paper's order."""
    there = {data_set_of(scene) for scene in scenes}
    return [name for name in DATA_SETS if name in there]


@dataclass(frozen=True)
class DataSet:
    """Scenes of one layout: NeRF-Synthetic, or Tanks & Temples in NSVF's layout.

    `layout` is the value of `scene=` that reads them. By name: the folders of the `scenes`, and why
    others are `missing`.
    """

    layout: str
    scenes: Mapping[str, Path]
    missing: Mapping[str, str]


def find(path: str) -> DataSet:
    """Every scene in a subfolder of `path` that has its pictures; SteerbenchError if there is none,
    or there are scenes of both layouts."""
    root = data_folder(path)
    folders = {folder.name: folder for folder in sorted(root.iterdir()) if folder.is_dir()}
    layouts = {
        name: layout
        for layout, mark in MARKS.items()
        for name, folder in folders.items()
        if (folder / mark).is_file()
    }
    known = [set(of["scenes"]) for of in DATA_SETS.values()]
    wanted: set[str] = next((names for names in known if names & folders.keys()), set())
    no_cameras = f"no {' or '.join(MARKS.values())}"
    why = {name: no_cameras if name in folders else "no folder" for name in wanted - layouts.keys()}
    why |= {name: _lack(folders[name], layout) for name, layout in layouts.items()}
    missing = {name: lack for name, lack in sorted(why.items()) if lack}
    whole = {name: folders[name] for name in sorted(layouts) if name not in missing}
    used = {layouts[name] for name in whole}
    if len(used) != 1:
        got = f"scenes of both: {', '.join(whole)}" if used else "none"
        reasons = "".join(f"; {name}: {lack}" for name, lack in missing.items())
        raise SteerbenchError(
            f"data={path}: expected folders of scenes in the layout of NeRF-Synthetic or in NSVF's,"
            f" got {got}{reasons}; of a single scene the folder is scene.path"
        )
    return DataSet(used.pop(), whole, missing)


def _lack(folder: Path, layout: str) -> str:
    """Which pictures a scene lacks, judged by file names; empty if none."""
    root = data_folder(folder)
    try:
        if layout == "nsvf":
            found: Sequence[Path | None] = picture_files(root)
        else:  # those named in the camera files
            names = [root / camera_file(split) for split in ("train", "test")]
            frames = [one for path in names for one in frames_of(read_json(path), path)]
            found = find_all(root, [frame["file_path"] for frame in frames])
    except SteerbenchError as error:
        return str(error)
    absent = [*found].count(None)
    if absent == len(found):
        return "no pictures"
    return f"{absent} of {len(found)} pictures are not there" if absent else ""
