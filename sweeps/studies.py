"""The lines of a study: variants of the methods that it is about, as these declare them."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from bench.errors import SteerbenchError, unknown
from bench.kinds import Words
from bench.study import Axis, Study, Variant, study_of
from reports.studies import StudyLine
from sweeps import experiments
from sweeps.configured import build
from sweeps.measurement import Job
from sweeps.overrides import (
    CONFIGS,
    beside,
    composed,
    engine_kinds,
    folder_words,
    taken,
    target_of,
    variants,
)

AS_IT_IS = Variant("as it is")  # the settings as typed
NOTHING = "nothing"  # is skipped

SIZES = ((200, 200), (400, 400), (800, 800), (1920, 1080), (3840, 2160))
"""Widths and heights of frames that the time is measured at."""


@dataclass(frozen=True, eq=False)
class Subject:
    """A method that is studied, `name`, as the `words` of a command describe it."""

    name: str
    words: list[str]

    @cached_property
    def config(self) -> DictConfig:
        return composed(self.words, return_hydra_config=True)

    @property
    def has_engine(self) -> bool:
        """Whether the method has a 2D network, which an engine computes."""
        return "engine" in self.config.method

    @cached_property
    def study(self) -> Study:
        """What the method declares: its class or, if only that knows, an object.

        A method that still lacks a setting declares nothing.
        """
        method = self.config.method
        target = target_of(method)
        if isinstance(getattr(target, "study", None), property):
            return Study() if OmegaConf.missing_keys(method) else build(self.config, "method").study
        return study_of(target)

    @property
    def off(self) -> dict[str, str]:
        """By what is skipped, the word that switches this skipping off."""
        return {name: f"{setting}=false" for name, setting in self.study.skips.items()}

    @property
    def engine(self) -> str:
        return str(self.config.hydra.runtime.choices.engine)

    def engines(self) -> dict[str, list[Variant]]:
        """All precisions of each engine; torch in fp32, the standard, comes first."""
        return {
            engine: [
                Variant(f"{engine}, {precision}", (f"engine={engine}", f"precision={precision}"))
                for precision in kind.precisions
            ]
            for engine, kind in engine_kinds(self.words).items()
        }

    def axes(self) -> dict[str, Axis]:
        """What tables vary of the method, and what it declares itself."""
        return {**experiments.axes(self.name), **self.study.axes}

    def lines(self, group: str, variants: Sequence[Variant]) -> Iterator[StudyLine]:
        for each in variants:
            yield StudyLine(self.name, group, each.name, each.settings)


def accuracy(subject: Subject, only: Sequence[str], trained: bool) -> Iterator[StudyLine]:
    """Every knob, beside two that all of them are compared with: everything off, if the method
    declares what that is, and nothing changed. All use the same training, but those of `trained`
    knobs."""
    study = subject.study
    standard, *others = chain(*subject.engines().values()) if subject.has_engine else [AS_IT_IS]
    exact = (*standard.settings, *study.exact)
    first = [Variant("everything off", exact), AS_IT_IS] if exact else [AS_IT_IS]
    knobs: dict[str, Sequence[Variant]] = {**study.knobs, **({"engine": others} if others else {})}
    if trained:
        for name, axis in subject.axes().items():
            knobs[f"{name}, trained"] = [variant for _, variant in _points(axis)]
        knobs |= study.trained
    for knob in chosen(knobs, only, "knob") or [AS_IT_IS.name]:
        yield from subject.lines(knob, [*first, *knobs.get(knob, ())])


def parity(subject: Subject) -> Iterator[StudyLine]:
    """Every engine and precision, beside torch in fp32."""
    engines = subject.engines()
    first, *_ = chain(*engines.values())
    for engine, own in engines.items():
        yield from subject.lines(engine, [first, *(x for x in own if x != first)])


def skips(subject: Subject) -> Iterator[StudyLine]:
    """All skips, further savings on top, all skips but each one, nothing skipped."""
    off = subject.off
    each = [Variant(f"all but {name}", (word,)) for name, word in off.items() if len(off) > 1]
    nothing = Variant(NOTHING, tuple(off.values()))
    yield from subject.lines("skips", [Variant("all"), *subject.study.savings, *each, nothing])


def breakdown(subject: Subject) -> Iterator[StudyLine]:
    """Each precision of the engine, or the method as it is without one; with and without skips."""
    variants = [Variant(subject.name)]
    if subject.has_engine:
        own = subject.engines().get(subject.engine, ())
        variants = [Variant(f"{subject.name}, {each.name}", each.settings) for each in own]
    if off := subject.off.values():
        variants += [Variant(f"{x.name}, {NOTHING} skipped", (*x.settings, *off)) for x in variants]
    yield from subject.lines("parts", variants)


def scaling(subject: Subject, only: Sequence[str]) -> Iterator[StudyLine]:
    """Frame sizes, numbers of threads and the axes of the method, each measured alone."""
    config = subject.config
    most = config.budget.threads or torch.get_num_threads()
    counts = Axis("{} threads", "threads", tuple(range(1, most + 1)))
    points: dict[str, list[tuple[float, Variant]]] = {
        "pixels": [(w * h, Variant(f"{w} x {h}", (f"frame_size=[{w},{h}]",))) for w, h in SIZES],
        "threads": _points(counts),
        **{name: _points(axis) for name, axis in subject.axes().items()},
    }
    wanted = chosen(points, only, "axis")
    if "threads" in wanted and subject.has_engine and subject.engine != "torch":
        others = ", ".join(name for name in points if name != "threads")
        raise SteerbenchError(
            "threads: expected engine=torch, whose threads can be chosen afterwards; for another "
            f"engine choose from {others} with --only"
        )
    # A 2D renderer costs the same however long it was trained; its own steps would win.
    short = ("method.steps=null",) if config.method.get("steps") else ()
    for name in wanted:
        # The threads are those of the frames; all have the same training.
        trained = (f"budget.threads={most}",) if name == "threads" else ()
        for value, each in points[name]:
            settings = (*short, *each.settings, *trained)
            yield StudyLine(subject.name, name, each.name, settings, value)


def _points(axis: Axis) -> list[tuple[float, Variant]]:
    """A variant for each value of an axis, beside the size of the value."""
    return [
        (axis.size(value), Variant(axis.label.format(value), (f"{axis.setting}={value}",)))
        for value in axis.values
    ]


def chosen(names: Sequence[str] | Mapping[str, Any], parts: Sequence[str], kind: str) -> list[str]:
    """Those of `names` that have any of `parts` in them; all without parts."""
    for part in parts:
        if not any(part in name for name in names):
            raise unknown(kind, part, names)
    return [name for name in names if not parts or any(part in name for part in parts)]


LINES: Mapping[str, Callable[..., Iterator[StudyLine]]] = {
    make.__name__: make for make in (accuracy, parity, skips, breakdown, scaling)
}
"""What makes the lines of each study, by its name."""


def subjects(study: str, words: Words) -> list[Subject]:
    """The methods that the words choose (method=a,b), otherwise those of the experiment `study`.

    With several, what the words set of a method is left out for one that lacks it. SteerbenchError
    if one of them has nothing that the study could vary; of the usual ones, it is left out.
    """
    others, typed = taken(words, "method")
    folders = folder_words(words)
    rest = [*folders, f"+experiment={study}", *(word for word in others if word not in folders)]
    names = typed or OmegaConf.load(CONFIGS / "experiment" / f"{study}.yaml").study.methods
    alone = len(names) == 1
    found = [
        Subject(name, [*rest, f"method={name}"] if alone else beside(name, rest)) for name in names
    ]
    lacks = {subject.name: _lack(study, subject) for subject in found}
    fit = [subject for subject in found if not lacks[subject.name]]
    if typed and len(fit) < len(found):
        raise SteerbenchError(next(filter(None, lacks.values())))
    return fit


def _lack(study: str, subject: Subject) -> str:
    """Why the study can vary nothing of a method; empty if it can."""
    if study == "parity" and not subject.has_engine:
        return (
            f"steerbench parity compares the engines of a 2D network: {subject.name} has none; "
            "expected a method with the setting method.engine, for example method=steernerf"
        )
    if study == "skips" and not subject.study.skips:
        return (
            f"steerbench skips: {subject.config.method._target_} declares nothing in `study.skips` "
            "(bench/study.py); expected a method that does, for example method=steernerf"
        )
    return ""


@dataclass(frozen=True, kw_only=True)
class StudyJob(Job):
    """A job of a study, and the line that it fills."""

    line: StudyLine


def jobs_of(study: str, found: Sequence[Subject], options: Mapping[str, Any]) -> Iterator[StudyJob]:
    """The jobs of all lines; those of a group in turns, if the study compares times."""
    for subject in found:
        varied = variants(subject.words)
        for line in LINES[study](subject, **options):
            words = [*subject.words, *line.settings]
            config = varied(line.settings)
            whose = [] if study == "breakdown" else [subject.name]  # all methods in turns
            turns = "" if study == "scaling" else ", ".join((study, *whose, line.group))
            name = f"{study}: {subject.name}, {line.group}: {line.label}"
            command = ["steerbench", "run", *words]
            yield StudyJob(config, command, name, turns, line=line)
