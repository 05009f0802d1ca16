"""The knobs of SteerNeRF that trade time for error, and the settings at which they are compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sweeps.skips import SWITCHES
from sweeps.variants import Variant, engines

EVERYTHING_OFF = Variant(
    "everything off",
    (
        "method=steernerf_untaught",
        "engine=torch",
        "precision=fp32",
        "method.pipeline.overlap=0",
        "method.pipeline.range.mode=off",
        "method.pipeline.refresh.age=0",
        "method.pipeline.steps=1",
        "method.pipeline.refined=1",
        "method.pipeline.skip.hidden=false",
        "method.pipeline.skip.background=false",
    ),
)
"""The trained field by a ray for every pixel, at the step of stage 1, each to its end. Where the
field is empty belongs to the model: what it holds there was never held against a picture."""

AS_IT_IS = Variant("as it is")

ALWAYS = (EVERYTHING_OFF.name, AS_IT_IS.name)
"""Not a knob: what all of them are compared with."""

TRAININGS = (
    ("L", "method.pipeline.frames", (0, 1, 3), ()),
    ("K", "method.pipeline.channels", (3, 9), ()),
    ("s from scratch", "method.pipeline.scale", (2, 4, 8), ("method.renderer.init=scratch",)),
    ("log2 T", "method.grid.log2_table", (15, 19), ()),
    ("taught step", "method.pipeline.steps", (1, 3), ()),
    ("field", "method.precision", ("fp32",), ()),
)
"""What the model is trained for: label, setting, values, and what each of them needs beside it."""


def knobs(trained: bool) -> Mapping[str, Sequence[Variant]]:
    """By the name of a knob the settings it is turned to, all else as it is; everything off comes
    first, then what is not turned at all.

    All are rendered from one training, but for those that are added with `trained`.
    """
    return {
        EVERYTHING_OFF.name: [EVERYTHING_OFF],
        AS_IT_IS.name: [AS_IT_IS],
        "step length": [_step(value) for value in (1, 1.5, 3, 4)],
        "refined step length": [_refined_step(value) for value in (1.5, 2, 3)],
        "stop": [_stop(value) for value in ("1e-1", "3e-2", "1e-3", "1e-4")],
        "range reduction": [
            _range(mode, value) for mode in ("window", "paper") for value in (0.01, 0.03, 0.1)
        ],
        "rays taken over": [_refresh(age) for age in (1, 3, 7)],
        "refined share": [_refined(value) for value in (0, 0.03, 0.06, 0.25, 0.5, 1)],
        "skips": [
            Variant(f"{name} not skipped", (f"method.pipeline.skip.{switch}=false",))
            for name, switch in SWITCHES.items()
        ],
        "engine": list(engines())[1:],  # the first is the default
        "two knobs": [
            *(
                _both(_refined(share), other)
                for share in (0, 0.06, 0.25, 0.5, 1)
                for other in (_step(1), _range("window", 0.03))
            ),
            *(_both(_refined(share), _refined_step(2)) for share in (0.06, 0.25, 0.5, 1)),
        ],
        **(_trainings() if trained else {}),
    }


def _step(value: float) -> Variant:
    """In steps of stage 1, whatever the training was taught."""
    return Variant(f"step {value}", ("method=steernerf_untaught", f"method.pipeline.steps={value}"))


def _refined_step(value: float) -> Variant:
    return Variant(f"refined step {value}", (f"method.pipeline.refined_steps={value}",))


def _stop(value: str) -> Variant:
    """A transmittance, whatever the training was taught."""
    return Variant(f"stop {value}", ("method=steernerf_untaught", f"method.pipeline.stop={value}"))


def _range(mode: str, epsilon: float) -> Variant:
    chosen = (f"method.pipeline.range.mode={mode}", f"method.pipeline.range.epsilon={epsilon}")
    return Variant(f"range {mode} {epsilon}", chosen)


def _refresh(age: int) -> Variant:
    return Variant(f"refresh age {age}", (f"method.pipeline.refresh.age={age}",))


def _refined(share: float) -> Variant:
    return Variant(f"refined {share}", (f"method.pipeline.refined={share}",))


def _both(one: Variant, other: Variant) -> Variant:
    return Variant(f"{one.name}, {other.name}", (*one.settings, *other.settings))


def _trainings() -> dict[str, list[Variant]]:
    return {
        f"{label}, trained": [
            Variant(f"{label} {value}", (f"{setting}={value}", *more)) for value in values
        ]
        for label, setting, values, more in TRAININGS
    }
