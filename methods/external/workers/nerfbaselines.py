"""A worker for all methods of NerfBaselines, run by the Python of an environment with it.

Options: `id` of the method; `backend`, "python" if this environment can run the method itself;
`presets`, a list, or null for those that it has for the layout of the data; `overrides` of its
configuration; `iterations`, null for as many as the method wants; `weights`, a pattern for the
files of a checkpoint that rendering needs.
"""

import importlib
import random
import sys
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path

sys.path.pop(0)  # this folder: its names are those of packages
sys.path.append(str(Path(__file__).parents[3]))

import nerfbaselines
import numpy as np
from nerfbaselines.backends import mount
from nerfbaselines.datasets import dataset_load_features
from nerfbaselines.training import get_presets_and_config_overrides

from steerbench_worker import SteerbenchError, serve


class NerfBaselines:
    late = True  # a method is loaded when it is built; it is that of the version of nerfbaselines

    def __init__(
        self, id, backend="python", presets=None, overrides=None, iterations=None, weights=None
    ):
        self.name, self.backend, self.presets = id, backend, presets
        self.overrides, self.iterations, self.weights = overrides or {}, iterations, weights
        self.spec, self.stack = nerfbaselines.get_method_spec(id), ExitStack()
        # Which a method loads only when it is built.
        self.torch = importlib.import_module("torch") if find_spec("torch") else None
        self.device = "cuda" if self.torch and self.torch.cuda.is_available() else "cpu"
        if backend != "python":  # the model is in another process
            self.peak_bytes = lambda: None

    def _method(self, job, *folders):
        """The class of the method, in its backend, which sees the `folders`."""
        for folder in map(str, folders):
            self.stack.enter_context(mount(folder, folder))
        self.background, self.bounds = np.array(job.background), np.array(job.bounds)
        build = nerfbaselines.build_method_class(self.spec, self.backend)
        return self.stack.enter_context(build)

    def fit(self, job):
        if self.presets is None and list(job.background) != [1, 1, 1]:
            raise SteerbenchError("presets: those for this layout are for a white background")
        random.seed(job.seed)
        np.random.seed(job.seed)
        if self.torch:
            self.torch.manual_seed(job.seed)
        kind = self._method(job, job.scene, job.state)
        info, paths = kind.get_method_info(), [str(path) for path, _ in job.pictures]
        metadata = {
            "id": "blender",  # the layout; presets depend on it
            "type": "object-centric",
            "color_space": "srgb",
            "evaluation_protocol": "nerf",
            "background_color": (255 * self.background).round().astype(np.uint8),
            "expected_scene_scale": float(np.ptp(self.bounds, axis=0).max()),
        }
        data = nerfbaselines.new_dataset(
            cameras=self._cameras([camera for _, camera in job.pictures]),
            image_paths=paths,
            image_paths_root=str(job.scene),
            metadata=metadata,
        )
        models = info.get("supported_camera_models", frozenset(("pinhole",)))
        data = dataset_load_features(data, info.get("required_features"), models)
        presets, overrides = get_presets_and_config_overrides(
            self.spec, metadata, presets=self.presets, config_overrides=self.overrides
        )
        print(f"presets: {presets}, overrides: {overrides}")
        self.method = kind(train_dataset=data, config_overrides=overrides)
        steps = self.iterations or self.method.get_info()["num_iterations"]
        for step in range(steps):
            figures = self.method.train_iteration(step)
            job.progress(step + 1, steps, f"{figures['psnr']:.1f} dB" if "psnr" in figures else "")
        self.method.save(str(job.state))

    def load(self, job):
        self.state = job.state
        self.method = self._method(job, job.state)(checkpoint=str(job.state))

    def render(self, camera):
        options = {"outputs": ("color",), "keep_torch": True}
        color = self.method.render(self._cameras([camera])[0], options=options)["color"]
        if color.shape[-1] == 4:
            color = color[..., :3] * color[..., 3:] + (1 - color[..., 3:]) * self.background
        return color

    def sizes(self):
        files = self.state.rglob(self.weights) if self.weights else ()
        sizes = [path.stat().st_size for path in files if path.is_file()]
        return {"model": sum(sizes)} if sizes else {}  # a checkpoint may hold the optimiser, too

    def _cameras(self, cameras):
        pinhole = nerfbaselines.camera_model_to_int("pinhole")
        poses = np.array([camera.c2w for camera in cameras], np.float32)
        lenses = [(camera.fx, camera.fy, camera.cx, camera.cy) for camera in cameras]
        away = np.linalg.norm(poses[:, :, 3] - self.bounds.mean(axis=0), axis=1)
        radius = np.linalg.norm(np.ptp(self.bounds, axis=0)) / 2
        near = np.maximum(away - radius, 0.01 * radius)
        return nerfbaselines.new_cameras(
            poses=poses,
            intrinsics=np.array(lenses, np.float32),
            camera_models=np.full(len(cameras), pinhole, np.int32),
            image_sizes=np.array([(camera.width, camera.height) for camera in cameras], np.int32),
            nears_fars=np.stack((near, away + radius), axis=1).astype(np.float32),
        )


if __name__ == "__main__":
    serve(NerfBaselines)
