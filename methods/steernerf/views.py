"""Training views with the frames before them, on which engines build the network."""

import torch
from torch import Tensor

from bench.motion import preceding, viewing_target
from bench.types import Log, NullProbe, Scene
from methods.engines import Built
from methods.steernerf.buffer import Buffer
from methods.steernerf.options import JointOptions
from methods.steernerf.pipeline import Pipeline


def recorded_inputs(
    pipeline: Pipeline, scene: Scene, joint: JointOptions, count: int, seed: int, log: Log
) -> list[Tensor]:
    """The inputs of the network of `pipeline`, as an engine gets them, drawn whole: in `count`
    training views of `scene`, evenly spread, rendered as in training, whatever is chosen
    afterwards. Before each come L + 1 frames of a random motion, which `seed` decides, so that even
    the oldest in the buffer had a preceding one."""
    renderer, recorded = pipeline.renderer, list[Tensor]()
    cameras, target = scene.splits["train"].cameras, viewing_target(scene)
    frames, rendering = pipeline.model.frames, joint.rendering(pipeline.model)
    generator = torch.Generator().manual_seed(seed)

    def record(inputs: Tensor) -> Tensor:
        recorded.append(inputs.clone())  # the next frame overwrites it
        return renderer.network(inputs)

    with log.progress("frames to build the network on", count) as progress:
        for place in range(count):
            camera, buffer = cameras[place * len(cameras) // count], Buffer(maxlen=frames)
            renderer.engine = None  # the network itself draws the frames before
            for before in preceding(camera, target, frames + 1, joint.motion.degrees, generator):
                pipeline.remember(before, buffer, rendering)
            renderer.engine = Built(record, 0)
            pipeline.render(camera, buffer, rendering, NullProbe())
            progress.advance()
    renderer.engine = None
    return recorded
