"""`steerbench scenes`: downloads published data sets, checks copies, exports scenes."""

import argparse
from pathlib import Path

from bench import layouts
from bench.console import ConsoleLog
from bench.datasets import Published, get, published, verify
from bench.errors import unknown
from sweeps.configured import build, scene_of
from sweeps.overrides import composed

SHOWN = 5  # missing or extra files to print by name, because there may be hundreds


def main(options: argparse.Namespace) -> int:
    """Do what `options.action` says; return 1 if a file differs from the release or none exists."""
    log = ConsoleLog(Path("outputs"))
    if options.action == "verify":
        return _verify(Path(options.name), log)
    if options.action == "export":
        return _export(options, log)
    known: dict[str, tuple[Published, list[str]]] = {}
    for data in published():
        known |= {name: (data, [name]) for name in data.scenes}
        known[data.name] = data, sorted(data.scenes)
    if options.name not in known:
        raise unknown("scene", options.name, known)
    data, scenes = known[options.name]
    folder = options.to / data.name if len(data.scenes) > 1 else options.to
    for scene in scenes:
        path = get(data, scene, folder, log)
        print(f"{path}: scene={data.layout} scene.path={path}")
    print(f"licence: {data.licence}")
    return 0


def _export(options: argparse.Namespace, log: ConsoleLog) -> int:
    """Write the scene and its path; print how to run on it, and how to score what others render."""
    words = [f"scene={options.name}", f"trajectory={options.path}", *options.overrides]
    config = composed(words)
    scene = scene_of(config)
    path = build(config, "trajectory", scene)
    layouts.export(scene, path, options.to, options.layout, log)
    reader, inner = ("colmap", "test/images") if options.layout == "colmap" else ("blender", "test")
    print(f"{options.to}: scene={reader} scene.path={options.to}")
    print(f"its path: steerbench score PICTURES --truth {options.to / inner} --sequence")
    return 0


def _verify(path: Path, log: ConsoleLog) -> int:
    report = verify(path, log)
    for name in report.wrong:
        print(f"wrong    {name}")
    for kind, names in (("missing", report.missing), ("extra", report.extra)):
        for name in names[:SHOWN]:
            print(f"{kind:8} {name}")
        if len(names) > SHOWN:
            print(f"{kind:8} ... and {len(names) - SHOWN} more")
    print(f"{path}: {report}")
    return 0 if report.passed else 1
