"""The knobs of SteerNeRF that trade time for error, and the settings at which they are compared."""

from __future__ import annotations

from collections.abc import Sequence

from sweeps.skips import SWITCHES
from sweeps.variants import Variant, engines

EVERYTHING_OFF = Variant(
    "everything off",
    (
        "method=steernerf_untaught",
        "method.pipeline.steps=1",
        "method.pipeline.refined=1",
        "method.pipeline.skip.hidden=false",
        "method.pipeline.skip.background=false",
    ),
)
"""The trained field by a ray for every pixel, at the step of stage 1, each to its end. Where the
field is empty belongs to the model: what it holds there was never held against a picture."""

SHIPPED = Variant("as shipped")

Knob = tuple[str, Sequence[Variant]]


def knobs(trained: bool) -> list[Knob]:
    """What is turned and to what, all else as shipped; with `trained`, also what asks for another
    training."""
    return [
        ("reference", [EVERYTHING_OFF]),
        ("as shipped", [SHIPPED]),
        ("step length", [_steps(value) for value in (1, 1.5, 3, 4)]),
        ("stop", [_stop(value) for value in ("1e-1", "3e-2", "1e-3", "1e-4")]),
        (
            "range reduction",
            [_range(mode, value) for mode in ("window", "paper") for value in (0.01, 0.03, 0.1)],
        ),
        ("refined share", [_refined(value) for value in (0, 0.03, 0.06, 0.25, 0.5, 1)]),
        (
            "skips",
            [
                Variant(f"{name} not skipped", (f"method.pipeline.skip.{switch}=false",))
                for name, switch in SWITCHES.items()
            ],
        ),
        ("engine", list(engines())[1:]),
        (
            "two knobs",
            [
                _both(_refined(share), other)
                for share in (0, 0.06, 0.25, 0.5, 1)
                for other in (_steps(1), _steps(3), _range("window", 0.03))
            ],
        ),
        *(_trainings() if trained else ()),
    ]


def _steps(value: float) -> Variant:
    """Of one training, whatever the step."""
    return Variant(f"step {value}", ("method=steernerf_untaught", f"method.pipeline.steps={value}"))


def _stop(value: str) -> Variant:
    """Of one training, whatever the stop."""
    return Variant(f"stop {value}", ("method=steernerf_untaught", f"method.pipeline.stop={value}"))


def _range(mode: str, epsilon: float) -> Variant:
    chosen = (f"method.pipeline.range.mode={mode}", f"method.pipeline.range.epsilon={epsilon}")
    return Variant(f"{mode} {epsilon}", chosen)


def _refined(share: float) -> Variant:
    return Variant(f"refined {share}", (f"method.pipeline.refined={share}",))


def _both(one: Variant, other: Variant) -> Variant:
    return Variant(f"{one.name}, {other.name}", (*one.settings, *other.settings))


def _trainings() -> list[Knob]:
    """What stage 2, or both stages, are trained for."""
    scratch = "method.renderer.init=scratch"
    return [
        ("L, trained", [_trained("L", "method.pipeline.frames", value) for value in (0, 1, 3)]),
        ("K, trained", [_trained("K", "method.pipeline.channels", value) for value in (3, 9)]),
        (
            "s, trained",
            [_trained("s", "method.pipeline.scale", value, scratch) for value in (2, 4, 8)],
        ),
        ("T, trained", [_trained("T = 2^", "method.grid.log2_table", value) for value in (15, 19)]),
        ("step, trained", [_trained("taught step", "method.pipeline.steps", v) for v in (1, 3)]),
        ("field, trained", [Variant("field in fp32", ("method.precision=fp32",))]),
    ]


def _trained(label: str, setting: str, value: float, *more: str) -> Variant:
    gap = "" if label.endswith("^") else " "
    return Variant(f"{label}{gap}{value}", (f"{setting}={value}", *more))
