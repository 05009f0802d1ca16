"""Finds the scenes of a data set: NeRF-Synthetic, or Tanks & Temples in NSVF's layout."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from bench.errors import SteerbenchError
from bench.scenes.blender import camera_file, picture_path
from bench.scenes.files import data_folder, frames_of, read_json
from bench.scenes.nsvf import picture_files
from reports.outliers import REFERENCES

MARKS = {"blender": camera_file("train"), "nsvf": "bbox.txt"}
"""The file by which a scene's layout is recognised, by the value of `scene=` that reads it."""


@dataclass(frozen=True)
class DataSet:
    """Scenes of one layout.

    Attributes:
        layout: the value of `scene=` that reads them.
        scenes: the folder of each scene by name.
        missing: why other scenes of the data set are left out, by name.
    """

    layout: str
    scenes: Mapping[str, Path]
    missing: Mapping[str, str]


def find(path: str) -> DataSet:
    """Every scene in a subfolder of `path` that has its pictures.

    Raises:
        SteerbenchError: there is none, or there are scenes of both layouts.
    """
    root = data_folder(path)
    folders = {folder.name: folder for folder in sorted(root.iterdir()) if folder.is_dir()}
    layouts = {
        name: layout
        for layout, mark in MARKS.items()
        for name, folder in folders.items()
        if (folder / mark).is_file()
    }
    known: Any = OmegaConf.load(REFERENCES)
    data_sets = [set(known["psnr"]), set(known["tanks_and_temples"])]
    wanted = next((names for names in data_sets if names & folders.keys()), set())
    no_cameras = f"no {' or '.join(MARKS.values())}"
    missing = {
        name: no_cameras if name in folders else "no folder" for name in wanted - layouts.keys()
    }
    for name, layout in layouts.items():
        if why := _lack(folders[name], layout):
            missing[name] = why
    whole = {name: folders[name] for name in sorted(layouts) if name not in missing}
    used = {layouts[name] for name in whole}
    if len(used) != 1:
        got = f"scenes of both: {', '.join(whole)}" if used else "none"
        reasons = "".join(f"; {name}: {why}" for name, why in sorted(missing.items()))
        raise SteerbenchError(
            f"data={path}: expected folders of scenes in the layout of NeRF-Synthetic or in NSVF's,"
            f" got {got}{reasons}; of a single scene the folder is scene.path"
        )
    return DataSet(used.pop(), whole, dict(sorted(missing.items())))


def _lack(folder: Path, layout: str) -> str | None:
    """Which pictures a scene lacks, judged by file names; None if none."""
    root = data_folder(folder)
    try:
        files = picture_files(root) if layout == "nsvf" else _pictures_of_blender(root)
    except SteerbenchError as error:
        return str(error)
    absent = [file for file in files if not file.is_file()]
    if len(absent) == len(files):
        return "no pictures"
    return f"{len(absent)} of {len(files)} pictures are not there" if absent else None


def _pictures_of_blender(root: Path) -> list[Path]:
    """The pictures named in the camera files of both splits, whether they exist or not."""
    names = [root / camera_file(split) for split in ("train", "test")]
    frames = [frame for path in names for frame in frames_of(read_json(root, path.name), path)]
    return [picture_path(root, frame["file_path"], where) for where, frame in frames]
