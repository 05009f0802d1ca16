"""A renderer in another process, as a `bench.types.Method`."""

import json
import math
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
import weakref
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bench.errors import SteerbenchError, explained, some, unexpected
from bench.kinds import Size
from bench.provenance import code_sha256, computed_by, files_at, sums_of
from bench.records import read_record, without
from bench.results import content_key
from bench.scenes.export import data_camera, picture_file, write_blender
from bench.sharing import check_sums, missing, whole, write_sums
from bench.study import Study, turned
from bench.types import Budget, Camera, Frame, Log, Probe, Scene
from methods.external.worker import Header, Worker

WORKERS = Path(__file__).with_name("workers")  # those that come with steerbench

UNTOLD: dict[str, Any] = {
    **{"device": "cpu", "precision": "unknown", "memory": 0},
    **{"can": [], "knobs": {}, "files": [], "packages": {}},
}
"""What holds of a worker that does not tell; the types are those that it has to tell."""


@dataclass(kw_only=True, eq=False)
class External:
    """A renderer in another process, with the settings of `sweeps/configs/method/external.yaml`.
    The process starts when something is asked of it, and ends with this object."""

    command: str
    python: str | None
    options: Mapping[str, Any]
    files: list[str]
    environment: Mapping[str, str]
    lock: str | None
    folders: list[str]
    start_s: float
    fit_s: float
    frame_s: float
    seed: int

    train_s = 0.0
    _asking_ns = 0  # the least that a question and its answer have taken, without any work

    @property
    def _typed(self) -> list[str]:
        """The words of the command; files are those beside the YAML, or in the current folder."""
        return [
            next(filter(os.path.isfile, (str(Path(at) / word) for at in self.folders)), word)
            for word in _words("method.command", self.command)
        ]

    @cached_property
    def _worker(self) -> Worker:
        words = self._typed
        if (shipped := WORKERS / f"{words[0]}.py").exists():
            words[0] = str(shipped)
        if words[0].endswith(".py"):
            words.insert(0, self.python or sys.executable)
        worker = Worker(words, self.start_s, self.environment)
        self._closing = weakref.finalize(self, _close, worker)
        return worker

    @cached_property
    def _about(self) -> Header:
        """What the worker tells about itself, made with the options."""
        worker = self._worker
        told, _ = worker.ask("settings", self.start_s, {"options": self.options})
        about = {"name": worker.name, **UNTOLD, **told}
        for name, usual in UNTOLD.items():
            kind = type(usual)
            worker.expect(type(about[name]) is kind, "settings", f"{name}: {kind.__name__}", told)
        lists = all(type(values) is list for values in about["knobs"].values())
        worker.expect(lists, "settings", "knobs: lists of values", told)
        worker.name = about["name"]
        return about

    @property
    def name(self) -> str:
        return self._about["name"]

    @property
    def memory(self) -> int:
        return self._about["memory"]

    @property
    def study(self) -> Study:
        """The knobs that the worker declares."""
        knobs = self._about["knobs"].items()
        return Study({name: turned(name, f"++method.options.{name}", of) for name, of in knobs})

    @property
    def trains(self) -> bool:
        """Whether it learns from a scene; if not, it was trained elsewhere."""
        return "fit" in self._about["can"]

    @property
    def reads(self) -> list[Path]:
        """The files that its pictures depend on: code that it has loaded, words, and `files`."""
        words = filter(Path.is_file, map(Path, self._typed))
        given = [Path(path) for path in self.files]
        for path in given:
            if not path.exists():
                raise unexpected("method.files", "files and folders", f"{path}, which is not there")
        return [*given, *words, *map(Path, self._about["files"])]

    @cached_property
    def _packages(self) -> Mapping[str, object]:
        """The versions of what its environment holds."""
        if self.lock is None:
            return self._about["packages"]
        try:
            words = _words("method.lock", self.lock)
            done = subprocess.run(words, capture_output=True, text=True, check=True)
        except (OSError, subprocess.CalledProcessError) as error:
            why = error.strerror if isinstance(error, OSError) else error.stderr.strip()[-200:]
            raise SteerbenchError(f"method.lock: {self.lock}: {why}") from error
        return {"lock": done.stdout}

    def settings(self) -> dict[str, str]:
        """What rows show, and a hash of its environment for the key of a run."""
        device, precision = self._about["device"], self._about["precision"]
        if device != "cpu" and not (device.startswith("cuda") and torch.cuda.is_available()):
            device = f"worker's {device}"  # nothing here can wait for it
        shown = {"device": device, "backend": "external", "field_precision": precision}
        shown |= {"engine": "none", "precision": "none"}
        return {**shown, "environment": content_key(self._packages)[:16]}

    def fit(self, scene: Scene, budget: Budget, log: Log) -> None:
        """Let it train and store the result, load what it stored before, or get ready."""
        self._scene, can = scene, self._about["can"]
        corners = scene.origin.double() + scene.unit_length * scene.bounds.double()
        job = {
            "background": scene.background.tolist(),
            "bounds": corners.tolist(),
            "steps": budget.steps,
            "samples": budget.samples,
            "renderer_steps": budget.renderer_steps,
            "seed": self.seed,
        }
        if not self.trains:
            if "load" in can:
                self._load({**job, "state": None}, log)
            return
        key = self._key(job)
        folder = log.stage_dir("external", key)
        finished = folder / "trained.json"
        with missing(finished, log) as untrained:
            if untrained:
                self.train_s = self._train(folder, job, log)
                if self._key(job) != key:
                    raise SteerbenchError(f"{self.name}: its code was changed meanwhile: run again")
                if "load" in can:  # otherwise the next process trains again, alone
                    with whole(finished) as new:
                        new.write_text(json.dumps({"train_s": self.train_s}) + "\n")
                    self._restart()  # without the memory of a training
            else:
                log.info(f"{self.name}: found in {folder}")
                check_sums(folder)
                self.train_s = read_record(finished)["train_s"]
        if "load" in can:
            self._load({**job, "state": str(folder / "state")}, log)

    def _load(self, job: Mapping[str, object], log: Log) -> None:
        told, _ = self._worker.ask("load", self.start_s, job)
        for note in told.get("notes") or ():
            log.info(f"{self.name}: {note}")

    def _restart(self) -> None:
        """End the process, and begin another one with the same options."""
        self._closing()
        del self._worker
        self._worker.ask("settings", self.start_s, {"options": self.options})

    def _key(self, job: Mapping[str, object]) -> Mapping[str, object]:
        knobs = self._about["knobs"]
        return {
            **job,
            "scene": self._scene.digest,
            "name": self.name,
            "options": without(self.options, knobs),
            "command": [
                code_sha256(Path(word)) if Path(word).is_file() else word for word in self._typed
            ],
            "files": sums_of(self.reads, f"{self.name}: its files"),
            "of_worker": [self._packages, dict(self.environment)],
            "device": self._about["device"],
            **computed_by(write_blender),
        }

    def _train(self, folder: Path, job: Mapping[str, object], log: Log) -> float:
        """Let it train on the scene as files, and put what it stores into `folder`; the seconds."""
        pictures = [
            {"file": picture_file("train", number), **self._described(camera)}
            for number, camera in enumerate(self._scene.splits["train"].cameras)
        ]
        with explained(folder), tempfile.TemporaryDirectory(dir=folder) as temporary:
            place, state = Path(temporary) / "scene", Path(temporary) / "state"
            # Programs want all three files: none of them shows a picture that is held out.
            write_blender(self._scene, place, dict.fromkeys(("train", "val", "test"), "train"), log)
            state.mkdir()
            with log.progress(f"{self.name}: training", 1000) as bar:
                shown = 0

                def progress(told: Header) -> None:
                    nonlocal shown
                    done, total = told.get("done"), told.get("total")
                    if type(done) is not int or type(total) is not int or not 0 <= done <= total:
                        raise ValueError(f"progress {told}")
                    now = 1000 * done // max(total, 1)
                    bar.advance(now - shown, str(told.get("note", ""))[:40])
                    shown = now

                begun = time.monotonic()
                where = {"scene": str(place), "pictures": pictures, "state": str(state)}
                self._worker.ask("fit", self.fit_s, {**job, **where}, progress)
                seconds = time.monotonic() - begun
            shutil.rmtree(folder / "state", ignore_errors=True)
            state.rename(folder / "state")
        (folder / "output.txt").write_text(self._worker.output())
        write_sums(folder)
        return seconds

    def _described(self, camera: Camera) -> Mapping[str, object]:
        """A camera in scene units, as the protocol has it."""
        names = ("width", "height", "fx", "fy", "cx", "cy")
        pose = data_camera(self._scene, camera).c2w.tolist()
        return {**{name: getattr(camera, name) for name in names}, "c2w": pose}

    def reset(self) -> None:
        begun = time.perf_counter_ns()
        self._worker.ask("reset", self.frame_s, {})
        passed = time.perf_counter_ns() - begun
        self._asking_ns = min(self._asking_ns or passed, passed)

    def render(self, camera: Camera, probe: Probe) -> Frame:
        """Let it render one frame; the times are its own."""
        described = self._described(camera)
        told, arrays = self._worker.ask("render", self.frame_s, described)
        frame = self._frame(arrays, (camera.height, camera.width))
        transfer_ns = time.perf_counter_ns() - self._worker.answered_ns + self._asking_ns
        stages = told.get("stages", {})
        counters = told.get("counters", {})
        for of in (stages, counters):
            self._expect(isinstance(of, dict), "stages and counters by name", told)
        try:
            probe.report(told.get("ns", 0), stages, told.get("peak_bytes"), transfer_ns)
            for name, done in counters.items():
                probe.count(name, done)
        except SteerbenchError as error:
            raise self._worker.fault(f"answered 'render' with a wrong {error}") from error
        return frame

    def _frame(self, arrays: Mapping[str, np.ndarray], size: Size) -> Frame:
        """What has arrived as a frame; its values are checked where they are used."""
        shapes = {"rgb": [*size, 3], "depth": [*size], "alpha": [*size]}
        self._expect("rgb" in arrays, f"rgb {shapes['rgb']}", "rgb none")
        for name in shapes.keys() & arrays.keys():
            got = list(arrays[name].shape)
            self._expect(got == shapes[name], f"{name} {shapes[name]}", f"{name} {got}")
        rgb = torch.from_numpy(arrays["rgb"])
        if rgb.dtype == torch.uint8:
            rgb = rgb / 255
        depth = torch.tensor(math.inf).expand(size)
        if "depth" in arrays:
            in_units_of_data = torch.from_numpy(arrays["depth"])
            depth = in_units_of_data.float() / self._scene.unit_length
        alpha = torch.ones(()).expand(size)
        if "alpha" in arrays:
            alpha = torch.from_numpy(arrays["alpha"]).float()
        return Frame(rgb.float(), depth, alpha)

    def _expect(self, holds: bool, expected: str, got: object) -> None:
        self._worker.expect(holds, "render", expected, got)

    def sizes(self) -> dict[str, int]:
        """The bytes of its components. Asked last: what it has loaded meanwhile is known now."""
        told, _ = self._worker.ask("sizes", self.frame_s, {})
        sizes: Any = told.get("sizes")
        self._worker.expect(_counts(sizes), "sizes", "sizes in bytes", told)
        known = {str(file) for place in self.reads for file in files_at(place)}
        late = {*told.get("files", ())} - {*self._about["files"], *known}
        if late:
            raise SteerbenchError(
                f"{self.name} has loaded {some(sorted(late))} after it was made, so no key holds "
                "that: import it at the top of the worker, or list it in its `files`"
            )
        return sizes


def _words(setting: str, text: str) -> list[str]:
    """The words of a command; raises SteerbenchError if there are none, or a quote is open."""
    with suppress(ValueError):
        if words := shlex.split(text):
            return words
    raise unexpected(setting, "a program and its arguments", repr(text))


def _counts(told: object) -> bool:
    """Whether a worker has told whole numbers from 0 on, by name."""
    return isinstance(told, dict) and all(type(x) is int and x >= 0 for x in told.values())


def _close(worker: Worker) -> None:
    try:
        worker.close()
    except SteerbenchError as error:
        print(f"steerbench: {error}", file=sys.stderr)
