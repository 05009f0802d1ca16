"""More views to learn from, rendered by the field of stage 1 (Section 3.5)."""

import time

import torch

from bench.cameras import place_camera
from bench.motion import novel_view, viewing_target
from bench.provenance import digest
from bench.sharing import missing
from bench.types import Budget, Log, NullProbe, Scene, Split
from methods.instant_ngp.stage1 import Setup, TrainedField
from methods.rendering.frame import everywhere, render_frame
from methods.training import checkpoint


def distilled_views(
    setup: Setup, trained: TrainedField, scene: Scene, budget: Budget, count: int, log: Log
) -> tuple[Split, float]:
    """Render `count` random views among the training cameras with `trained`, at full resolution,
    or load them if they were rendered before; also return the seconds that took."""
    if not count:
        return Split([], [], []), 0.0
    key = {**setup.key(scene, budget), "views": count, "distillation": digest(distilled_views)}
    path = log.stage_dir("distilled", key) / "views.safetensors"
    generator = setup.generator()
    taken = scene.splits["train"].cameras
    target = viewing_target(scene)
    cameras = [novel_view(taken, target, generator) for _ in range(count)]
    names = [str(number) for number in range(count)]
    with missing(path, log) as to_render:
        if to_render:
            began = time.monotonic()
            pictures = {}
            probe = NullProbe()
            field = trained.field
            occupancy = trained.occupancy
            background = scene.background.to(field.device)
            render = everywhere(field, occupancy, probe, trained.sampling)
            with log.progress("distilling", count) as progress:
                for name, camera in zip(names, cameras, strict=True):
                    placed = place_camera(camera, field.device)
                    rgb = render_frame(placed, occupancy, background, probe, render).values
                    pictures[name] = (rgb.clamp(0, 1) * 255).round().to(torch.uint8).cpu()
                    progress.advance()
            digest(distilled_views)  # refuses if the code was changed meanwhile
            checkpoint.write(path, pictures, {"seconds": time.monotonic() - began})
    pictures, figures = checkpoint.read(path)
    with checkpoint.restoring(path):
        return Split(cameras, [pictures[name] for name in names], names), figures["seconds"]
