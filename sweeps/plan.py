"""The jobs of the tables of the paper, and the scenes of a data set that they are means over."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from bench.errors import SteerbenchError, Unavailable, unexpected, unknown
from bench.scenes.blender import camera_file, picture_path
from bench.scenes.files import data_folder, frames_of, read_json
from bench.scenes.nsvf import picture_files
from reports.paper_tables import DATA_SETS, FIRST, METHOD, Line, PaperTable, paper_tables
from sweeps.configured import build
from sweeps.measurement import Job
from sweeps.overrides import CONFIGS, changed, choices, composed, setting, swept, target_of
from sweeps.processes import on_gpu

TABLES = CONFIGS / "experiment"  # the folder of the experiments that declare the tables

MARKS = {"blender": camera_file("train"), "nsvf": "bbox.txt"}
"""The file by which a scene's layout is recognised, by the value of `scene=` that reads it."""


@dataclass(frozen=True)
class DataSet:
    """Scenes of one layout: NeRF-Synthetic, or Tanks & Temples in NSVF's layout.

    `layout` is the value of `scene=` that reads them. By name: the folders of the `scenes`, and why
    others are `missing`.
    """

    layout: str
    scenes: Mapping[str, Path]
    missing: Mapping[str, str]


@dataclass(frozen=True, kw_only=True)
class Planned(Job):
    """A job of a table: `line` is what it fills, `block` the title of the lines beside it.

    `scene` is its scene in a data set, empty without a data set.
    """

    table: str
    block: str
    line: str
    scene: str = ""


def chosen(
    name: str | None, methods: Sequence[str], data_sets: Sequence[str] = (FIRST,)
) -> list[PaperTable]:
    """The table called `name`, or all, with the paper's figures on `data_sets`; `methods` get extra
    lines in the table of methods."""
    tables = {table.name: table for table in paper_tables(TABLES, data_sets)}
    if name is not None and name not in tables:
        raise unknown("table", name, tables)
    wanted = [tables[name]] if name else list(tables.values())
    of_methods = [any(METHOD in line.job for line in table.lines) for table in wanted]
    if methods and not any(of_methods):
        raise SteerbenchError(f"--with: {name} compares no methods; table1 does")
    further = [Line(method, {METHOD: method}) for method in methods]
    return [
        replace(table, lines=[*table.lines, *further]) if compares else table
        for table, compares in zip(wanted, of_methods, strict=True)
    ]


def repeats(seeds: int, beyond: bool) -> tuple[int, bool]:
    """How much of the tables is measured: `tables` in run.yaml, which explains both."""
    if seeds < 1:
        raise ValueError(f"seeds: expected 1 or more, got {seeds}")
    return seeds, beyond


def plan(table: PaperTable, words: Sequence[str], data: DataSet | None = None) -> list[Planned]:
    """The jobs of `table` under the settings in `words`, for each line, seed and scene.

    Scenes are those of `data` or in `words`; each goes to the blocks with figures of its data set.
    Seeds are those in `words`, otherwise the first `tables.seeds`; methods other than the paper's
    use only one of them, but for lines with `every_seed`. Settings that a line lacks are those of
    the experiment. Lines at a precision that the engine lacks are left out. On a GPU the engine is
    torch; one that `words` choose is that of all lines. SteerbenchError if a word gives several
    values to another setting than scene and seed.
    """
    scenes = scenes_of(words, data)
    words, seeds = _taken(words, "seed")
    single = data is None and len(scenes) == 1
    words = words if single else _taken(words, "scene")[0]
    fixed = [f"+experiment={table.name}", *words, *([f"scene={data.layout}"] if data else [])]
    first = [] if single or data else [f"scene={scenes[0]}"]
    experiment = composed([*fixed, *first])
    if replaced := _engine_here(experiment):
        fixed[1:1] = replaced
        experiment = composed([*fixed, *first])
    build(experiment, "budget")  # refuses a wrong one before anything runs
    several, beyond = build(experiment, "tables")
    asked = {"engine"} if any(word.startswith("engine=") for word in words) else set()
    usual = [str(seed) for seed in range(several)]
    precisions = target_of(experiment.engine).precisions

    @cache  # values are set afterwards without composing again
    def with_choices(*groups: str) -> DictConfig:
        return composed([*fixed, *groups])

    jobs = []
    lines = list(_lines(table, beyond))
    if not precisions and any("precision" in line.job for _, _, line, _ in lines):
        raise SteerbenchError(
            f"engine: {table.name} has lines at several precisions, and this engine chooses one"
        )
    for title, block, line, repeated in lines:
        if "precision" in line.job and line.job["precision"] not in precisions:
            continue
        own_settings = {name: of for name, of in line.job.items() if name not in asked}
        settings = [f"{name}={value}" for name, value in own_settings.items()]
        groups = [word for word in settings if choices(word.partition("=")[0], fixed)]
        values = [word for word in settings if word not in groups]
        of_line = seeds or (usual if repeated else usual[:1])
        of_block = [name for name in scenes if block.data_set in (data_set_of(name), "")]
        for seed, name in product(of_line, of_block):
            scene = "" if single else name
            place = [] if single or data else [f"scene={name}"]
            config = changed(with_choices(*groups, *place), [*values, f"seed={seed}"])
            if data:
                folder = str(data.scenes[name])
                config.scene.path = folder
                place = [setting("scene.path", folder)]
            OmegaConf.resolve(config)  # once, or each build would resolve `${...}` again
            own = [*settings, *place, f"seed={seed}"]
            command = ["steerbench", "run", *fixed, *own, "hydra.mode=RUN"]
            parts = (f"{table.name}: {line.label}", scene, f"seed {config.seed}")
            told = ", ".join(filter(None, parts))
            where_timed = Path(config.scene.get("path") or config.scene.get("name", "")).name
            turns = f"{table.name}, {seed}, {where_timed}" if block.in_turns else ""
            where = {"table": table.name, "block": title, "line": line.label, "scene": scene}
            jobs.append(Planned(config, command, told, turns, **where))
    return jobs


def _engine_here(experiment: DictConfig) -> list[str]:
    """What replaces the engine of an experiment, which is OpenVINO for some tables, where that
    cannot compute: on a GPU, or in half precision on a CPU without it."""
    if on_gpu(str(experiment.get("device"))):
        return ["engine=torch"]
    if experiment.precision != "bf16":
        return []
    try:
        build(experiment, "engine")
    except Unavailable:
        return ["engine=torch", "precision=fp32"]
    return []


def _lines(table: PaperTable, beyond: bool) -> Iterator[tuple[str, PaperTable, Line, bool]]:
    """The lines of a table's blocks and curves, each with its block and whether it repeats.

    Only lines of the paper's method are repeated with several seeds, because the paper's
    conclusions are about it, and those that it is trained from. A table that varies the training
    omits the method beyond the paper unless `beyond`.
    """
    for block in table.blocks if beyond or not table.curve else [table, *table.beside]:
        for line in block.lines:
            yield block.title, block, line, line.every_seed or METHOD not in line.job
    curves = replace(table, in_turns=False)  # they are not timed
    yield from (("curves", curves, line, True) for line in table.marks.values())


def scenes_of(words: Sequence[str], data: DataSet | None = None) -> list[str]:
    """The names of the scenes in `data` or in `words`; of a folder, its last part."""
    if data:
        return list(data.scenes)
    folders = [
        word.partition("=")[2] for word in words if word.lstrip("+").startswith("scene.path=")
    ]
    return [Path(folders[-1].strip("'\"")).name] if folders else _taken(words, "scene")[1] or [""]


def data_set_of(scene: str) -> str:
    """The data set of the paper whose figures a scene is compared with."""
    wanted = (name for name, of in DATA_SETS.items() if scene in (*of["scenes"], *of["stand_ins"]))
    return next(wanted, FIRST)


def data_sets(scenes: Sequence[str]) -> list[str]:
    """The data sets of `scenes`, in the paper's order."""
    there = {data_set_of(scene) for scene in scenes}
    return [name for name in DATA_SETS if name in there]


def _taken(words: Sequence[str], name: str) -> tuple[list[str], list[str]]:
    """The words without those that set `name`, and the values that they give it.

    SteerbenchError if one gives several values to another setting than scene and seed.
    """
    several = swept(words)
    if others := sorted(several.keys() - {"scene", "seed"}):
        got = f"{', '.join(several[others[0]])}; only scene and seed may take several here"
        raise unexpected(others[0], "one value", got)
    named = [word for word in words if word.lstrip("+").partition("=")[0] == name]
    values = several.get(name) or [word.partition("=")[2] for word in named[-1:]]
    return [word for word in words if word not in named], list(dict.fromkeys(values))


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
            files = picture_files(root)
        else:  # those named in the camera files
            names = [root / camera_file(split) for split in ("train", "test")]
            frames = [one for path in names for one in frames_of(read_json(root, path.name), path)]
            files = [picture_path(root, frame["file_path"], where) for where, frame in frames]
    except SteerbenchError as error:
        return str(error)
    absent = [file for file in files if not file.is_file()]
    if len(absent) == len(files):
        return "no pictures"
    return f"{len(absent)} of {len(files)} pictures are not there" if absent else ""
