"""A method of NerfBaselines, in an environment that pip makes for it, as a method of ours."""

import os
import subprocess
import sys

import pytest
import torch

from bench.types import Budget, NullProbe, composite
from tests.common import assert_near

VERSION = "1.2.12"
METHOD = '''
"""The mean colour of the training pictures, a share of it at each step."""

import os

import numpy as np
from nerfbaselines import Method


class Mean(Method):
    def __init__(self, *, checkpoint=None, train_dataset=None, config_overrides=None):
        self.overrides, self.checkpoint = config_overrides or {}, checkpoint
        if checkpoint:
            self.colour = np.load(os.path.join(checkpoint, "colour.npy"))
        else:
            over = np.array(train_dataset["metadata"]["background_color"]) / 255
            pictures = np.array(train_dataset["images"]) / 255
            alpha = pictures[..., 3:]
            self.pictures = pictures[..., :3] * alpha + over * (1 - alpha)
            self.colour = np.zeros(3)

    @classmethod
    def get_method_info(cls):
        return {"method_id": "mean", "supported_camera_models": frozenset(("pinhole",))}

    def get_info(self):
        return {**self.get_method_info(), "num_iterations": self.overrides.get("steps", 4)}

    def train_iteration(self, step):
        self.colour += self.pictures.mean(axis=(0, 1, 2)) / self.get_info()["num_iterations"]
        return {"psnr": 10.0}

    def save(self, path):
        np.save(os.path.join(path, "colour.npy"), self.colour)

    def render(self, camera, *, options=None):
        width, height = camera.item().image_sizes
        return {"color": np.broadcast_to(self.colour, (height, width, 3)).astype(np.float32)}
'''

SPEC = """
from nerfbaselines import register

register({"id": "mean", "method_class": "mean_method:Mean"})
"""


@pytest.fixture(scope="module")
def nerfbaselines(tmp_path_factory) -> str:
    """A Python that has NerfBaselines: $NERFBASELINES_PYTHON, or that of a new environment, because
    it needs an older numpy than ours; skips where pip cannot install it."""
    if given := os.environ.get("NERFBASELINES_PYTHON"):
        return given
    folder = tmp_path_factory.mktemp("nerfbaselines")
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    python = str(folder / "bin/python")
    install = [python, "-m", "pip", "install", "--quiet", f"nerfbaselines=={VERSION}"]
    done = subprocess.run(install, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"pip cannot install NerfBaselines here: {done.stderr.strip()[-200:]}")
    return python


@pytest.mark.slow
def test_a_registered_method_trains_renders_and_is_loaded(
    nerfbaselines, external, moved_scene, quiet_log, tmp_path, monkeypatch
):
    (tmp_path / "mean_method.py").write_text(METHOD)
    (tmp_path / "mean_spec.py").write_text(SPEC)
    monkeypatch.setenv("NERFBASELINES_REGISTER", str(tmp_path / "mean_spec.py"))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    given, background = moved_scene.splits["train"].images, moved_scene.background
    train = [composite(picture, background) for picture in given]
    expected = torch.stack(train).mean(dim=(0, 1, 2))
    pictures, seconds = [], []
    for _ in range(2):
        options = {"id": "mean", "overrides": {"steps": 5}, "weights": "*.npy"}
        method = external("nerfbaselines", python=nerfbaselines, options=options)
        method.fit(moved_scene, Budget("test", steps=1, samples=1), quiet_log)
        pictures.append(method.render(moved_scene.splits["test"].cameras[0], NullProbe()).rgb)
        seconds.append(method.train_s)
        assert (method.name, method.sizes()) == ("mean", {"model": 128 + 3 * 8})
    assert_near(pictures[0][0, 0], expected, atol=1e-6)
    assert torch.equal(*pictures)
    assert seconds[0] == seconds[1] > 0  # the second was loaded
    assert method._packages["nerfbaselines"] == VERSION
