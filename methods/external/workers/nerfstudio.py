"""A worker for a model of nerfstudio, run by the Python of an environment with that package.

Options: `config`, the config.yml of a training on data in the coordinates of the cameras; `output`,
the picture among the outputs of the model.
"""

import sys
from pathlib import Path

sys.path.pop(0)  # this folder: its names are those of packages
sys.path.append(str(Path(__file__).parents[3]))

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.utils.eval_utils import eval_setup

from steerbench_worker import SteerbenchError, serve

METRICS = ("psnr", "ssim", "lpips")  # submodules of a model that no picture needs


class Nerfstudio:
    def __init__(self, config, output="rgb"):
        self.output = output
        trained, self.pipeline, checkpoint, _ = eval_setup(Path(config), test_mode="inference")
        self.name, self.files = trained.method_name, [config, checkpoint]
        data = self.pipeline.datamanager.train_dataparser_outputs
        self.transform, self.scale = data.dataparser_transform.double(), data.dataparser_scale
        self.device = str(self.pipeline.device)

    @torch.no_grad()
    def render(self, camera):
        pose = torch.from_numpy(camera.c2w) * torch.tensor([1.0, -1.0, -1.0, 1.0])  # OpenGL's axes
        pose = self.transform @ torch.cat((pose, pose.new_tensor([[0.0, 0.0, 0.0, 1.0]])))
        pose[:, 3] *= self.scale
        lens = camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height
        seen = Cameras(pose.float()[None], *lens).to(self.pipeline.device)
        pictures = self.pipeline.model.get_outputs_for_camera(seen)
        if self.output not in pictures:
            raise SteerbenchError(
                f"output: expected one of {', '.join(pictures)}, got {self.output}"
            )
        return pictures[self.output]

    def sizes(self):
        kept = self.pipeline.model.state_dict().items()
        own = (x for name, x in kept if name.partition(".")[0] not in METRICS)
        return {"model": sum(x.numel() * x.element_size() for x in own)}


if __name__ == "__main__":
    serve(Nerfstudio)
