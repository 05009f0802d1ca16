"""`steerbench score`: scores pictures of any program against true ones, under a named protocol."""

import argparse
import shlex
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from bench import pictures as given
from bench.console import ConsoleLog
from bench.errors import SteerbenchError, unknown
from bench.isolation import as_begun
from bench.provenance import digest, libraries
from bench.results import REPORTED, Store
from reports.runs import Run, load_runs
from sweeps.configured import checked_settings, protocol_of, scene_of, use_threads
from sweeps.overrides import composed
from sweeps.terminal import show_run

NOTHING = "-"  # in place of facts of a row that do not apply to given pictures


def main(options: argparse.Namespace) -> int:
    """Score the pictures, keep the rows in the store, print them."""
    words = {name: getattr(options, name) for name in ("name", "match", "sequence", "times")}
    run = score(options.pictures, options.truth, *options.overrides, **words)
    show_run(run, f"{run.label} on {run.facts['scene']}, protocol {run.facts['protocol']}")
    return 0


@as_begun()
def score(
    pictures: str | Path,
    truth: str | Path | None = None,
    *settings: str,
    name: str | None = None,
    match: given.Match = "name",
    sequence: bool = False,
    times: str | Path | None = None,
) -> Run:
    """Score a folder of pictures as `steerbench score` does: against the folder `truth` or, without
    it, the split of the scene in `settings`, which are those of `steerbench run`.

    Rows show `name`, or else that of the folder. Pictures are matched to true ones by "name" or by
    "order". Those of a `sequence` are consecutive frames: their flicker is scored, too. `times` is
    a CSV file with a column `frame_ms`, see `bench.pictures.reported_times`: rows then have them,
    and the device "reported". Raises SteerbenchError if a setting is wrong, or a picture missing,
    damaged or of another size.
    """
    folder, config = Path(pictures), composed(settings)
    plain = checked_settings(config)
    use_threads(plain)
    if config.report:
        raise SteerbenchError("report: a page compares times, which given pictures do not have")
    log, store = ConsoleLog(Path(plain.outputs)), Store(Path(plain.outputs))
    protocol = protocol_of(config)
    weights = Path(plain.weights_dir) if plain.weights_dir else None
    surface = None
    if truth is None:
        OmegaConf.update(config, "scene.background", protocol.background)
        scene, split = scene_of(config), config.split
        if split not in scene.splits:
            raise unknown("split", split, scene.splits)
        pairs = given.pairs_with_split(folder, scene.splits[split], match)
        place, surface = {"scene": scene.name, "split": split}, scene.surface
    else:
        if named := [word for word in settings if word.startswith("scene")]:
            raise SteerbenchError(f"--truth and {named[0]}: expected one of them")
        pairs = given.pairs_with_folder(folder, Path(truth), match)
        place = {"scene": Path(truth).resolve().name, "split": NOTHING}
    facts = {"method": name or folder.resolve().name, **place, "trajectory": "pictures", "seed": 0}
    computed = "device", "backend", "engine", "precision", "field_precision"
    facts |= dict.fromkeys(("budget", *computed), NOTHING)
    reported = given.reported_times(Path(times), pairs) if times else []
    facts |= {"device": REPORTED} if times else {}
    example = f"{pairs[0].picture.relative_to(folder)} is scored against {pairs[0].name}"
    others = len(given.below(folder, "**/*", given.SUFFIXES)) - len(pairs)
    left = f"; {others} others below {folder} are not scored" if others else ""
    log.info(f"{len(pairs)} pictures, matched by {match}: {example}{left}")
    lpips, missing = protocol.load_lpips(weights, log)
    measurement = given.score(
        pairs,
        protocol,
        lpips,
        facts,
        log,
        sequence=sequence,
        kept=plain.pictures,
        surface=surface,
        times=reported,
    )
    record: Any = measurement.record
    parts = {
        "score": digest(given.score),
        "libraries": libraries(given.score),
        **{part: record[part] for part in ("pictures", "truths")},
        "protocol": asdict(protocol),
        "lpips": protocol.find_lpips(weights, log),
        "names": [pair.name for pair in pairs],
        "facts": facts,
        "sequence": sequence,
        "kept": plain.pictures,
        **({"times": reported} if times else {}),
    }
    words = {"--truth": truth, "--name": name, "--match": match, "--times": times}
    typed = [str(x) for pair in words.items() if pair[1] is not None for x in pair]
    typed += ["--sequence"] if sequence else []
    more = {
        "command": shlex.join(["steerbench", "score", str(folder), *typed, *settings]),
        "missing": {**record["missing"], **missing},
        "scene": {"name": facts["scene"], "digest": record["truths"]},
        "budget": {"name": NOTHING},
    }
    key = store.save(parts, replace(measurement, record={**record, **more}))
    store.use(key)
    (run,) = load_runs(store, [key])
    return run
