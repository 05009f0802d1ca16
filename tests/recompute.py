"""Recomputes stored figures from kept pictures and frames: `python recompute.py OUTPUTS WEIGHTS`,
where WEIGHTS is the file of the features of AlexNet.

It imports nothing of steerbench, so that a fault there cannot hide here. Prints how far each kind
of figure is off at most, by the name of its metric, as JSON.
"""

import hashlib
import json
import sys
from collections import defaultdict
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from PIL import Image
from scipy import fft, stats
from skimage.metrics import structural_similarity
from torch.nn import functional

CONVOLUTIONS = {0: (4, 2), 3: (1, 2), 6: (1, 1), 8: (1, 1), 10: (1, 1)}
"""Stride and padding of the layers of AlexNet, by torchvision's numbers."""


class LpipsAlex:
    """LPIPS v0.1 of Zhang et al. 2018, from the layers of AlexNet as torchvision numbers them and
    the linear layers in the package `lpips`, whose own code needs torchvision."""

    def __init__(self, backbone: Path) -> None:
        (package,) = find_spec("lpips").submodule_search_locations
        linear = torch.load(Path(package, "weights/v0.1/alex.pth"), "cpu", weights_only=True)
        self.linear = [linear[f"lin{n}.model.1.weight"] for n in range(5)]
        self.backbone = torch.load(backbone, weights_only=True)

    def features(self, pixels: np.ndarray) -> list[torch.Tensor]:
        """The activations of the five layers for a picture in [0, 1], of unit length each."""
        shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
        x = ((torch.tensor(pixels).float() * 2 - 1 - shift) / scale).movedim(-1, 0)[None]
        found = []
        for number, (stride, padding) in CONVOLUTIONS.items():
            if number in (3, 6):
                x = functional.max_pool2d(x, 3, 2)
            names = (f"features.{number}.{kind}" for kind in ("weight", "bias"))
            weight, bias = (self.backbone[name] for name in names)
            x = functional.conv2d(x, weight, bias, stride, padding).relu()
            found.append(x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10))
        return found

    def __call__(self, one: np.ndarray, other: np.ndarray) -> float:
        pairs = zip(self.features(one), self.features(other), self.linear, strict=True)
        layers = (functional.conv2d((a - b) ** 2, weight).mean() for a, b, weight in pairs)
        return float(sum(layers))


def picture(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path), dtype=np.float64) / 255


def qualities(folder: Path, frame: int, perceived: LpipsAlex) -> dict[str, float]:
    """PSNR, SSIM and LPIPS of a frame whose pictures were kept, by the published definitions."""
    rendered, truth = (picture(folder / f"{frame:04}-{kind}.png") for kind in ("rendered", "truth"))
    mse = ((rendered - truth) ** 2).mean()
    ssim = structural_similarity(
        rendered,
        truth,
        data_range=1.0,
        channel_axis=-1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    distance = perceived(rendered, truth)
    return {"psnr": -10 * np.log10(mse), "ssim": ssim, "lpips_alex": distance}


def half(values: np.ndarray) -> float:
    """Half the interval of a mean over frames of a path (Lazarus et al. 2018), from the definition
    of the cosine transform; a single frame has none."""
    if len(values) < 2:
        return np.nan
    count, n = int(np.ceil(0.4 * len(values) ** (2 / 3))), len(values)
    places = np.arange(n) + 0.5
    waves = [np.sqrt(2 / n) * np.cos(np.pi * k * places / n) for k in range(1, count + 1)]
    slow = np.array([wave @ (values - values.mean()) for wave in waves])
    assert np.allclose(slow, fft.dct(values - values.mean(), norm="ortho")[1 : count + 1])
    return stats.t.ppf(0.975, count) * np.sqrt((slow**2).mean() / n)


def recomputed(frames: pd.DataFrame) -> dict[str, tuple[float, float, float]]:
    """Value, lower and upper end of every figure over these frames."""
    found = {}
    for name in frames.columns.difference(["frame", "name", "phase"]):
        values = frames[name].dropna().to_numpy(float)
        if len(values):
            mean, by = values.mean(), half(values)
            found[name] = (mean, mean - by, mean + by)
    for part in (50, 95, 99):
        found[f"frame_ms.p{part}"] = (np.percentile(frames["frame_ms"], part), np.nan, np.nan)
    ms, low, high = found["frame_ms"]
    found["fps"] = (1000 / ms, 1000 / high, 1000 / low if low > 0 else np.nan)
    return found


def off(stored: float, again: float) -> float:
    if np.isnan(stored) and np.isnan(again):
        return 0.0
    return abs(stored - again) / max(abs(again), 1.0)


def main(outputs: Path, weights: Path) -> dict[str, float]:
    worst: dict[str, float] = defaultdict(float)
    perceived = LpipsAlex(weights)

    def compare(kind: str, stored: float, again: float) -> None:
        difference = off(stored, again)
        assert not np.isnan(difference), (kind, stored, again)
        worst[kind] = max(worst[kind], difference)

    for folder in sorted((outputs / "runs").glob("[!.]*")):
        for line in (folder / "SHA256SUMS").read_text().splitlines():
            digest, _, name = line.partition("  ")
            assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest, name
        rows, frames = (pd.read_csv(folder / f"{name}.csv") for name in ("rows", "frames"))
        record = json.loads((folder / "record.json").read_text())
        assert set(rows["run"]) == {folder.name} == {record["run"]}
        assert set(rows["seed"]) == {record["made_of"]["config"]["seed"]}
        for kept in (folder / "pictures").glob("*-rendered.png"):
            frame = int(kept.name.partition("-")[0])
            (own,) = frames[frames["frame"] == frame].to_dict("records")
            for metric, again in qualities(folder / "pictures", frame, perceived).items():
                if metric != "lpips_alex" or not np.isnan(own[metric]):  # without its weights
                    compare(f"picture: {metric}", own[metric], again)
        for phase, of_phase in rows[(rows["phase"] != "all") & (rows["n"] > 0)].groupby("phase"):
            again = recomputed(frames[frames["phase"] == phase])
            assert set(of_phase["metric"]) == again.keys()
            for row in of_phase.to_dict("records"):
                ends = zip(("value", "lo", "hi"), again[row["metric"]], strict=True)
                for end, value in ends:
                    compare(row["metric"].partition(".")[0], row[end], value)
        stages = frames.filter(regex=r"^stage_ms\.")
        for total, ms in zip(stages.sum(axis=1), frames["frame_ms"], strict=True):
            compare("sum of stages", total, ms)
        sizes = rows[rows["metric"].str.startswith("size_bytes.")].set_index("metric")["value"]
        total = sizes.pop("size_bytes.total")
        compare("sum of sizes", sizes.sum(), total)
    return worst


if __name__ == "__main__":
    print(json.dumps(main(*map(Path, sys.argv[1:]))))
