"""Weights of the backbones of LPIPS: finds them on this machine, or downloads them.

They are searched in `weights_dir`, `$STEERBENCH_WEIGHTS` and torch's hub cache, in this order.
"""

import os
import pickle
import re
from pathlib import Path

import torch
from torch import Tensor

from bench.download import fetch
from bench.sharing import file_sha256, locked
from bench.types import Log, SteerbenchError, Unavailable

ADDRESS = "https://download.pytorch.org/models/"

BACKBONES = {
    "alex": ("alexnet-owt-7be5be79.pth", "alexnet_features.pth"),
    "vgg": ("vgg16-397923af.pth", "vgg16_features.pth"),
}
"""File names of a backbone: torchvision's own, and one with only its `features.*`."""


def locate(net: str, weights_dir: Path | None, log: Log) -> Path:
    """The weight file of backbone `net`, downloaded into torch's hub cache if need be.

    A file with a SHA-256 in its name is checked against it. Raises SteerbenchError if `net` is
    unknown or `weights_dir` no folder, and Unavailable if no sound file can be had.
    """
    if net not in BACKBONES:
        raise SteerbenchError(f"LPIPS net: expected one of {', '.join(BACKBONES)}, got {net!r}")
    if weights_dir is not None and not weights_dir.is_dir():
        raise SteerbenchError(f"weights_dir: expected a folder, got {weights_dir}")
    name, features = BACKBONES[net]
    cache = Path(torch.hub.get_dir()) / "checkpoints"
    folders = [Path(f) for f in (weights_dir, os.environ.get("STEERBENCH_WEIGHTS"), cache) if f]
    for path in (folder / file for folder in folders for file in (features, name)):
        if path.is_file():
            return _verified(path)
    try:
        cache.mkdir(parents=True, exist_ok=True)
        with locked(cache / f".{name}.lock", f"waits for another download of {name}", log):
            path = fetch(ADDRESS + name, cache / name, None, log)
            try:
                return _verified(path)
            except Unavailable:
                path.unlink()
                raise
    except (OSError, SteerbenchError) as error:
        advice = "name a folder that has it as weights_dir=DIR or in $STEERBENCH_WEIGHTS"
        raise Unavailable(f"LPIPS {net}: {name} is not here, and {error}; {advice}") from error


def load_features(net: str, weights_dir: Path | None, log: Log) -> tuple[Path, dict[str, Tensor]]:
    """The weight file of backbone `net` and the tensors in it; raises as `locate` does."""
    path = locate(net, weights_dir, log)
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError):
        state = None
    if not isinstance(state, dict):
        again = f"fetch the file again from {ADDRESS}{BACKBONES[net][0]}"
        raise Unavailable(f"{path}: expected a torch state dict, could not read one; {again}")
    return path, state


def _verified(path: Path) -> Path:
    """`path`; raises Unavailable if its name holds a SHA-256 that its content does not match."""
    promised = re.search(r"-([0-9a-f]{8})\.pth$", path.name)
    got = file_sha256(path) if promised else None
    if promised and not (got or "").startswith(promised[1]):
        said = f"{path}: expected a SHA-256 that begins with {promised[1]}, got {got}"
        raise Unavailable(f"{said}; the file is damaged: delete it and fetch it again")
    return path
