"""The jobs of tables."""

from dataclasses import dataclass
from itertools import product
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from bench.errors import Unavailable, unexpected
from bench.kinds import Words
from reports.paper_tables import METHOD, PaperTable, Place
from sweeps import experiments
from sweeps.configured import build
from sweeps.data_sets import DataSet, data_set_of
from sweeps.measurement import Job, turns_of
from sweeps.overrides import composed, setting, swept, taken, target_of, unquoted, variants
from sweeps.processes import on_gpu


@dataclass(frozen=True, kw_only=True)
class Planned(Job):
    """A job for the line of a table at a `place`; `label` is what the line is shown as. `scene` is
    one of several, or of a data set, or empty."""

    place: Place
    label: str
    scene: str


def repeats(seeds: int) -> int:
    """How much of the tables is measured: `tables` in run.yaml, which explains it."""
    if seeds < 1:
        raise ValueError(f"seeds: expected 1 or more, got {seeds}")
    return seeds


def plan(table: PaperTable, words: Words, data: DataSet | None = None) -> list[Planned]:
    """The jobs of `table` under the settings in `words`, for each line, seed and scene.

    Scenes are those of `data` or in `words`; each goes to the blocks with figures of its data set.
    Seeds are those in `words`, otherwise those of the experiment's grid, otherwise the first
    `tables.seeds`, of which lines with a method of their own use only one, but for lines with
    `every_seed`. Settings that a line lacks are those of the experiment. Lines at a precision that
    the engine lacks are left out. On a GPU the engine is torch; one that `words` choose is that of
    all lines. SteerbenchError if a word gives several values to another setting than these two.
    """
    scenes = scenes_of(words, data)
    words, seeds = taken(words, experiments.SEED)
    declared = experiments.grid(experiments.experiment(table.name, words))
    seeds = seeds or declared.get(experiments.SEED, [])
    single = data is None and len(scenes) == 1
    words = words if single else taken(words, "scene")[0]
    fixed = [f"+experiment={table.name}", *words, *([f"scene={data.layout}"] if data else [])]
    first = [] if single or data else [f"scene={scenes[0]}"]
    experiment = composed([*fixed, *first])
    if replaced := _engine_here(experiment):
        fixed[1:1] = replaced
        experiment = composed([*fixed, *first])
    build(experiment, "budget")  # refuses a wrong one before anything runs
    several = build(experiment, "tables")
    asked = {"engine"} if any(word.startswith("engine=") for word in words) else set()
    usual = [str(seed) for seed in range(several)]
    precisions = target_of(experiment.engine).precisions

    varied = variants(fixed)
    jobs = []
    lines = ((x, key, line) for x, of in table.blocks.items() for key, line in of.items())
    for data_set, key, line in lines:
        if "precision" in line.job and line.job["precision"] not in precisions:
            continue
        settings = [f"{name}={of}" for name, of in line.job.items() if name not in asked]
        repeated = line.every_seed or METHOD not in line.job
        of_line = seeds or (usual if repeated else usual[:1])
        of_block = [name for name in scenes if data_set in (data_set_of(name), "")]
        for seed, name in product(of_line, of_block):
            scene = "" if single else name
            of_scene = [] if single else [f"scene={name}"]
            if data:
                of_scene = [setting("scene.path", str(data.scenes[name]))]
            own = [*settings, *of_scene, f"seed={seed}"]
            config = varied(own)
            OmegaConf.resolve(config)  # once, or each build would resolve `${...}` again
            command = ["steerbench", "run", *fixed, *own, "hydra.mode=RUN"]
            parts = (f"{table.name}: {line.label}", scene, f"seed {config.seed}")
            told = ", ".join(filter(None, parts))
            turns = turns_of(table.name, config) if experiment.in_turns else ""
            place = Place(table.name, data_set, key)
            job = Planned(config, command, told, turns, place=place, label=line.label, scene=scene)
            jobs.append(job)
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
        return ["precision=fp32"]
    return []


def scenes_of(words: Words, data: DataSet | None = None) -> list[str]:
    """The names of the scenes in `data` or in `words`; of a folder, its last part.

    SteerbenchError if a word gives several values to another setting than scene and seed.
    """
    several = swept(words)
    if others := sorted(several.keys() - {"scene", experiments.SEED}):
        got = f"{', '.join(several[others[0]])}; only scene and seed may take several here"
        raise unexpected(others[0], "one value", got)
    if data:
        return list(data.scenes)
    _, folders = taken(words, "scene.path")
    return [Path(unquoted(folders[-1])).name] if folders else taken(words, "scene")[1] or [""]
