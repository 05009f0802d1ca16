"""Results in the form of NerfBaselines: `results.json`, and predictions with their cameras.

The folder is laid out as the artifacts that NerfBaselines publishes, without their checkpoint:
`results.json`, and in `predictions` `info.json`, `color`, `gt-color` and `cameras`. The fields are
those that its version 1.2 writes and reads.
"""

import base64
import hashlib
import json
import struct
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from shutil import copyfile
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from bench.errors import explained, unexpected
from bench.records import read_json
from bench.results import IMPORTED, STEADY, Measurement
from bench.rows import row_table, score_rows, single
from bench.scenes.files import describe
from bench.types import Camera

VERSION = "1.2.12"
METRICS = {"psnr": "psnr", "ssim": "ssim", "lpips": "lpips_alex", "lpips_vgg": "lpips_vgg"}
"""Our metric for each of NerfBaselines'."""

PINHOLE = 0  # its number among the camera models


class Prediction(NamedTuple):
    """A scored frame: its `name`, 8-bit files of its picture and truth, its camera in the data
    set's units, and its figures by our names of the metrics."""

    name: str
    picture: Path
    truth: Path
    camera: Camera
    figures: Mapping[str, float]


def write_results(
    folder: Path,
    predictions: Sequence[Prediction],
    about: Mapping[str, Any],
    data: Mapping[str, Any],
    when: datetime,
) -> None:
    """Write the predictions and their results into `folder`.

    `about` is what `nb_info` says of the method, `data` what `dataset_metadata` says of the scene,
    with its `evaluation_protocol`; `when` the frames were rendered.
    """
    protocol = data["evaluation_protocol"]
    known = {"dataset_metadata": data, "evaluation_protocol": protocol}
    info = {**about, "nb_version": VERSION, **known}
    rendered = {
        "render_version": VERSION,
        "render_datetime": when.astimezone(UTC).replace(tzinfo=None).isoformat(timespec="seconds"),
        "render_dataset_metadata": data,
    }
    frames = sorted(predictions, key=lambda frame: Path(frame.name))  # the order of the lists
    inner, hashes = folder / "predictions", (hashlib.sha256(), hashlib.sha256())
    with explained(folder):
        for frame in frames:
            files = {"color": frame.picture, "gt-color": frame.truth}
            for digest, (kind, source) in zip(hashes, files.items(), strict=True):
                file = (inner / kind / frame.name).with_suffix(".png")
                file.parent.mkdir(parents=True, exist_ok=True)
                copyfile(source, file)
                digest.update(file.read_bytes())
            file = (inner / "cameras" / frame.name).with_suffix(".npz")
            file.parent.mkdir(parents=True, exist_ok=True)
            camera = frame.camera
            np.savez(
                file,
                poses=camera.c2w.numpy(),  # float64: they may lie far from the origin
                intrinsics=np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32),
                camera_models=np.array(PINHOLE, np.int32),
                distortion_parameters=np.zeros(0, np.float32),
                image_sizes=np.array([camera.width, camera.height], np.int32),
            )
        (inner / "info.json").write_text(json.dumps({**info, **rendered}, indent=2))
        lists = {
            theirs: [frame.figures[ours] for frame in frames]
            for theirs, ours in METRICS.items()
            if not any(np.isnan(frame.figures.get(ours, np.nan)) for frame in frames)
        }
        results = {
            **rendered,
            "nb_info": info,
            "evaluate_datetime": rendered["render_datetime"],
            "evaluate_version": VERSION,
            "metrics": {name: round(float(np.mean(of)), 5) for name, of in lists.items()},
            "metrics_raw": {name: _encoded(of) for name, of in lists.items()},
            "metrics_sha256": _metrics_sha256(lists),
            "predictions_sha256": hashes[0].hexdigest(),
            "ground_truth_sha256": hashes[1].hexdigest(),
            "evaluation_protocol": protocol,
        }
        (folder / "results.json").write_text(json.dumps(results, indent=2))


def read_results(file: Path) -> tuple[Measurement, dict[str, Any]]:
    """The measurement in a `results.json`, and the facts of its rows, whose device is "imported".

    Metrics that we do not have are left out. Raises SteerbenchError if a field is missing, or the
    figures do not match their checksum.
    """
    file = file.resolve()
    record = read_json(file)
    record.pop("metrics", None)  # means, of which one perfect frame makes the PSNR infinite
    try:
        json.dumps(record, allow_nan=False)
    except ValueError as error:
        raise unexpected(file, "finite numbers", error) from error
    raw, info = _field(record, "metrics_raw", dict, file), _field(record, "nb_info", dict, file)
    data = record.get("render_dataset_metadata") or _field(info, "dataset_metadata", dict, file)
    try:
        lists = {name: _decoded(text) for name, text in raw.items()}
    except (ValueError, TypeError, struct.error) as error:
        raise unexpected(f"{file}: metrics_raw", "float32 numbers in base64", error) from error
    if (got := _metrics_sha256(lists)) != record.get("metrics_sha256"):
        raise unexpected(f"{file}: metrics_sha256", f"{got}, that of its figures", "another one")
    scores = {ours: lists[theirs] for theirs, ours in METRICS.items() if theirs in lists}
    if "psnr" not in scores or len({len(of) for of in scores.values()}) > 1:
        raise unexpected(f"{file}: metrics_raw", "a PSNR and as many of other figures", [*lists])
    frames = pd.DataFrame(scores)
    frames.insert(0, "frame", range(len(frames)))
    frames.insert(1, "name", "")
    frames.insert(2, "phase", STEADY)
    used = info.get("resources_utilization")
    memory = used.get("gpu_memory") if isinstance(used, dict) else None  # in MiB
    told = {"train_s": (info.get("total_train_time"), 1), "train_peak_bytes": (memory, 2**20)}
    whole = {k: x * unit for k, (x, unit) in told.items() if isinstance(x, int | float)}
    summary = score_rows(frames, list(scores))
    summary += [single(name, value) for name, value in whole.items() if value]
    protocol = f"nerfbaselines-{record.get('evaluation_protocol')}"
    budget = f"{info.get('num_iterations')} steps"
    facts = {
        "method": _field(info, "method", str, file),
        "scene": _field(data, "scene", str, file),
        **dict.fromkeys(("split", "trajectory"), "test"),
        "protocol": protocol,
        "budget": budget,
        "device": IMPORTED,
        **dict.fromkeys(("resolution", "backend", "engine", "precision", "field_precision"), "-"),
        "seed": 0,
    }
    rows = row_table([{"phase": STEADY, **row} for row in summary], **facts)
    about: dict[str, object] = {
        "protocol": {"name": protocol},
        "budget": {"name": budget},
        "scene": {"name": facts["scene"], "digest": str(record.get("ground_truth_sha256"))},
        "missing": {},
        "peak_bytes": "GPU memory while training, as NerfBaselines saw it",
        "imported": {key: value for key, value in record.items() if key != "metrics_raw"},
    }
    return Measurement(rows, frames, {}, about), facts


def _encoded(values: Sequence[float]) -> str:
    return base64.b64encode(np.array(values, "<f4").tobytes()).decode("ascii")


def _decoded(text: str) -> list[float]:
    return np.frombuffer(base64.b64decode(text, validate=True), "<f4").astype(float).tolist()


def _metrics_sha256(lists: Mapping[str, Sequence[float]]) -> str:
    digest = hashlib.sha256()
    for name in sorted(lists):
        digest.update(f"{name.lower()}{_encoded(sorted(lists[name]))}\n".encode())
    return digest.hexdigest()


def _field(record: Mapping[str, Any], name: str, kind: type, file: Path) -> Any:
    if not isinstance(record.get(name), kind):
        raise unexpected(f"{file}: {name}", kind.__name__, describe(record.get(name)))
    return record[name]
