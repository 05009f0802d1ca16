"""`steerbench export nerfbaselines` and `import nerfbaselines`: results to and from others."""

import argparse
import shlex
from collections import Counter
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

from bench.errors import unexpected
from bench.nerfbaselines import METRICS, Prediction, read_results, write_results
from bench.provenance import digest, sha256
from bench.results import RECORD, Store, existing_store
from bench.scenes.export import check_empty, data_camera
from reports.comparison import comparison
from reports.lines import as_lines
from reports.runs import load_runs
from sweeps.commands.render import words_of_run
from sweeps.configured import build, scene_of
from sweeps.overrides import composed, setting
from sweeps.terminal import console, show


def main(options: argparse.Namespace) -> int:
    """Export a run, or import a file and print its figures beside those of other runs."""
    return (_export if options.command == "export" else _import)(options)


def _export(options: argparse.Namespace) -> int:
    store = existing_store(options.outputs)
    key = store.whole_key(options.run)
    (run,), place = load_runs(store, [key]), setting("outputs", str(options.outputs))
    config = composed([*words_of_run(key, [place]), place])
    scene = scene_of(config)
    if scene.digest != run.record["scene"]["digest"]:
        raise unexpected(f"run {key}", "the scene that it was measured on", "one that has changed")
    steps = build(config, "trajectory", scene).steps
    frames = run.frames.dropna(subset="psnr")
    if twice := [name for name, count in Counter(frames["name"]).items() if count > 1]:
        raise unexpected(f"run {key}", "a path that shows each view once", f"{twice[0]} again")
    predictions = []
    for _, row in frames.iterrows():
        index = int(row["frame"])
        picture, truth = (run.pictures / f"{index:04}-{x}.png" for x in ("rendered", "truth"))
        camera = data_camera(scene, steps[index].camera)
        figures = {ours: float(row[ours]) for ours in METRICS.values() if ours in row}
        predictions.append(Prediction(str(row["name"]), picture, truth, camera, figures))
    if absent := sum(not one.picture.is_file() for one in predictions):
        expected = f"all {len(predictions)} scored frames as pictures"
        again = f"{len(predictions) - absent}; measure it with pictures={len(predictions)}"
        raise unexpected(f"run {key}", expected, again)
    check_empty(options.to)
    budget: Any = run.record["budget"]
    about = {
        "method": str(run.facts["method"]),
        "num_iterations": budget["steps"],
        "total_train_time": run.values["train_s"],
        "config_overrides": run.settings,
        "steerbench": {
            name: run.record[name] for name in ("run", "commit", "command", "protocol", "machine")
        },
    }
    blender = config.scene["_target_"] == "bench.scenes.blender.load"
    data = {
        "id": "blender" if blender else "steerbench",
        "scene": scene.name,
        "color_space": "srgb",
        "background_color": [round(255 * value) for value in scene.background.tolist()],
        "evaluation_protocol": "nerf" if blender else "default",
    }
    when = datetime.fromtimestamp((store.folder / key / RECORD).stat().st_mtime, UTC)
    write_results(options.to, predictions, about, data, when)
    console().print(f"{options.to}: {len(predictions)} predictions of {run.facts['method']}")
    return 0


def _import(options: argparse.Namespace) -> int:
    store, file = Store(options.outputs), options.file
    measurement, facts = read_results(file)
    parts = {"import": digest(read_results), "file": sha256(file), "facts": facts}
    command = shlex.join(["steerbench", "import", options.form, str(file)])
    record = {**measurement.record, "command": command}
    key = store.save(parts, replace(measurement, record=record))
    others = [store.whole_key(run) for run in options.beside]
    imported, *runs = load_runs(store, [key, *others])
    labelled = [replace(run, label=f"{run.label}, run {run.key[:8]}") for run in runs]
    named = replace(imported, label=f"{imported.label}, imported")
    for table in comparison(as_lines([named, *labelled]), {}):
        show(table)
    console().print(f"run {key}", markup=False)
    return 0
