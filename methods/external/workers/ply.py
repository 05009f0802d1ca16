"""A worker that renders a PLY file of 3D Gaussians, as most programs write it, by ours.

Options: `file`, in the coordinates of the cameras; `stop`, the transmittance at which a pixel ends.
"""

import sys
from pathlib import Path
from typing import Any

sys.path.pop(0)  # this folder: its names are those of packages
sys.path.append(str(Path(__file__).parents[3]))

import torch

from bench.cameras import place_camera
from bench.provenance import sources
from bench.types import Camera, NullProbe, Scene
from methods.gaussians import ply
from methods.gaussians.model import Gaussians
from methods.rendering.frame import FeatureFrame
from steerbench_worker import serve, stage


class Stages(NullProbe):
    """Passes the stages of a frame on to steerbench."""

    stage = staticmethod(stage)


class Ply:
    name = "ply"
    precision = "fp32"

    def __init__(self, file: str, stop: float = 1e-4) -> None:
        self.files = [file, *map(str, sources(Gaussians).values())]  # kernels are loaded later
        self.stop, self.knobs = stop, {"stop": [1e-1, 1e-2, 1e-3]}
        self.notes: list[str] = []
        self.device = "cuda" if torch.cuda.is_available() else "cpu"

    def load(self, job: Any) -> None:
        everywhere = torch.tensor([[-torch.inf] * 3, [torch.inf] * 3])
        self.background = torch.tensor(job.background).to(self.device)
        low, high = corners = torch.tensor(job.bounds, dtype=torch.float64)
        far = corners.abs().max() > ply.FAR * (high - low).max()
        self.origin = low if far else torch.zeros_like(low)  # float32 has few digits far from it
        scene = Scene("", {}, self.background, everywhere, 1.0, digest="", origin=self.origin)
        self.gaussians = ply.read(Path(self.files[0]), scene, self.notes.append).to(self.device)

    @torch.no_grad()
    def render(self, camera: Camera) -> dict[str, torch.Tensor]:
        pose = torch.from_numpy(camera.c2w).clone()
        pose[:, 3] -= self.origin
        lens = camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height
        seen = place_camera(Camera(pose.float(), *lens), self.device)
        pixels = self.gaussians.render(seen, self.stop, Stages())
        with stage("finish"):
            frame = FeatureFrame.of(seen, pixels, self.background).picture()
        return {"rgb": frame.rgb, "depth": frame.depth, "alpha": frame.alpha}

    def sizes(self) -> dict[str, int]:
        return {"gaussians": sum(4 * x.numel() for x in self.gaussians.parameters())}


if __name__ == "__main__":
    serve(Ply)
