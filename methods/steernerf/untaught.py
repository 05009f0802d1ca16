"""SteerNeRF rendered with other marches than it was taught: what a knob does to one trained model.

Stage 2 teaches the field to do with the steps and the stop that frames are rendered with, so that
`method=steernerf` with other ones is another training. Here the training is told apart.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

from bench.types import Budget, Log, Scene
from methods.steernerf.method import SteerNerf
from methods.steernerf.options import PipelineOptions
from methods.steernerf.pipeline import Pipeline


@dataclass(frozen=True)
class UntaughtOptions(PipelineOptions):
    """What a frame is made of.

    Attributes:
        taught_stop, taught_steps: `stop` and `steps` of the training.
    """

    taught_stop: float = PipelineOptions.stop
    taught_steps: float = PipelineOptions.steps

    def __post_init__(self) -> None:
        super().__post_init__()
        self.taught_as()  # is checked, too

    def taught_as(self) -> PipelineOptions:
        """Those of the frames that it is trained for."""
        own = {field.name: getattr(self, field.name) for field in fields(PipelineOptions)}
        return PipelineOptions(**own | {"stop": self.taught_stop, "steps": self.taught_steps})


class UntaughtSteerNerf(SteerNerf):
    """SteerNeRF that shares its training with every other `stop` and `steps` of its frames.

    Its `pipeline` is of `UntaughtOptions`.
    """

    def fit(self, scene: Scene, budget: Budget, log: Log) -> None:
        """Train as for the options that are taught, or load that; render with those asked for."""
        asked = self.options
        assert isinstance(asked, UntaughtOptions)
        self.options = asked.taught_as()
        super().fit(scene, budget, log)
        self.options = asked
        field, occupancy = self.trained.field, self.trained.occupancy
        background, renderer = self.pipeline.background[:3], self.pipeline.renderer
        self.pipeline = Pipeline(field, occupancy, background, renderer, asked)
