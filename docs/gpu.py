"""Checks and measures steerbench on the GPU of this machine: `make gpu`, in about 12 minutes.

Each step is a process of its own with a time limit, because a wrong kernel may crash or hang. After
each step the page outputs/gpu/report.md is written: please send us that file. A step that succeeded
is not repeated at the same commit.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import torch

from bench import provenance

FOLDER = Path("outputs/gpu")
PAGE = "report.md"
SHOWN = 60  # lines of what a step printed
STEERBENCH = Path(sys.executable).with_name("steerbench")


class Step(NamedTuple):
    name: str
    limit_s: float
    question: str
    words: Sequence[str]  # of a command of steerbench


class Done(NamedTuple):
    """How a step ended, what it printed, and its last words if it failed."""

    status: int | str
    took_s: float
    printed: str
    said: str


def steps(run: Sequence[str], checks: Sequence[str]) -> Iterator[Step]:
    """What is done, the most important first. `run` is what the words of all trainings, and
    `checks` what those of the checks of kernels have in common."""
    yield Step("stress", 150, "Are all kernels right?", ("stress", *checks))
    yield Step("kernels", 90, "Which are faster than plain torch?", ("kernels", *checks))
    common = "run", "device=cuda", f"outputs={FOLDER}/runs", "budget=full", "budget.frames=20"
    ngp = *common, "protocol.name=frames", "protocol.stages=false"
    for count, limit in (1000, 60), (5000, 90):
        question = f"Instant-NGP: how good and fast after {count} steps?"
        yield Step(f"ngp-{count}", limit, question, (*ngp, f"budget.steps={count}", *run))
    words = *common, "protocol.name=waits", "protocol.waits=true", "budget.steps=1000", *run
    yield Step("waits", 60, "Instant-NGP: what takes the time, where does the host wait?", words)
    # The renderer of the release, trained for a moment: for its times, not for its quality.
    common = *common, "protocol.name=stages", "budget.steps=1000", "budget.renderer_steps=200"
    for engine, precision in ("torch", "fp16"), ("tensorrt", "fp16"), ("tensorrt", "int8"):
        by = "method=steernerf", f"engine={engine}", f"precision={precision}"
        question = f"SteerNeRF as released, {engine}, {precision}: how fast is a frame?"
        yield Step(f"{engine}-{precision}", 90, question, (*common, *by, *run))


def main(argv: Sequence[str]) -> int:
    """Take all steps that are not done; return 1 if one of them failed."""
    parser = argparse.ArgumentParser(description="Check and measure steerbench on a GPU.")
    parser.add_argument("--data", help="a scene of NeRF-Synthetic, such as mic (default: totem)")
    parser.add_argument("--filter", help="only kernels with this in their names", default="")
    parser.add_argument("overrides", help="settings of the trainings", nargs="*")
    options = parser.parse_args(argv)
    if not torch.cuda.is_available():
        raise SystemExit("make gpu: torch sees no GPU here; `make install` gets torch for CUDA")
    scene = ("scene=blender", f"scene.path={options.data}") if options.data else ("scene=totem",)
    FOLDER.mkdir(parents=True, exist_ok=True)
    commit = provenance.commit()
    done: dict[Step, Done] = {}
    for step in steps((*scene, *options.overrides), ("--filter", options.filter)):
        file = FOLDER / f"{step.name}.json"
        kept = json.loads(file.read_text()) if file.exists() else None
        made = kept and kept["made"] == [commit, *step.words] and kept["done"][0] == 0
        if made and not commit.endswith("-dirty"):
            done[step] = Done(*kept["done"])
        else:
            print(f"{step.name}: steerbench {' '.join(step.words)}", file=sys.stderr)
            done[step] = taken(step)
            file.write_text(
                json.dumps({"made": [commit, *step.words], "done": done[step]}, indent=1)
            )
        (FOLDER / PAGE).write_text(page(done), encoding="utf-8")
    print(FOLDER / PAGE)
    return int(any(end.status != 0 for end in done.values()))


def taken(step: Step) -> Done:
    """Take a step, within its time."""
    start = time.monotonic()
    try:
        ended = ran(step)
        status: int | str = ended.returncode
    except subprocess.TimeoutExpired as late:
        ended, status = late, f"stopped after {step.limit_s:.0f} s"
    printed, said = (
        x.decode(errors="replace") if isinstance(x, bytes) else x or ""
        for x in (ended.stdout, ended.stderr)
    )
    return Done(status, time.monotonic() - start, printed, "" if status == 0 else said[-2000:])


def ran(step: Step) -> subprocess.CompletedProcess[str]:
    """A process that takes the step. Raises `subprocess.TimeoutExpired`."""
    command = [STEERBENCH, *step.words]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=step.limit_s, check=False
    )


def page(done: dict[Step, Done]) -> str:
    """A table of the steps, then what each printed, without the JSON."""
    machine = {"commit": provenance.commit(), **provenance.machine(), "torch": torch.__version__}
    lines = ["# steerbench on a GPU", "", *(f"- {name}: {x}" for name, x in machine.items()), ""]
    lines += ["| step | question | ended | seconds |", "|---|---|---|---:|"]
    for step, end in done.items():
        ended = {0: "well"}.get(end.status, end.status)
        lines.append(f"| {step.name} | {step.question} | {ended} | {end.took_s:.0f} |")
    for step, end in done.items():
        command = f"`steerbench {' '.join(step.words)}`"
        lines += ["", f"## {step.name}", "", command, "", *_shown(end.printed)]
        lines += ["", "```", end.said.strip(), "```"] if end.said else []
    return "\n".join(lines) + "\n"


def _shown(printed: str) -> list[str]:
    """What was printed, but of long tables only the ends and what failed; without the JSON."""
    lines = [line for line in printed.splitlines() if line[:1] not in ("[", "{")]
    ends = range(len(lines) - SHOWN, len(lines))
    return [x for i, x in enumerate(lines) if i in ends or x.startswith("#") or "failed" in x]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
