"""Finds or downloads the backbone weights of LPIPS.

The folders `weights_dir`, `$STEERBENCH_WEIGHTS` and torch's hub cache are searched in this order,
for torchvision's file or for one with only its `features.*`. If there is none, torchvision's file
is downloaded into the cache. A file with a SHA-256 in its name is checked against it.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import re
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from bench.download import fetch
from bench.sharing import locked
from bench.types import Log, SteerbenchError, Unavailable

ADDRESS = "https://download.pytorch.org/models/"


class Backbone(NamedTuple):
    """File names of a backbone: torchvision's own, and one with only its `features.*`."""

    published: str
    features: str


BACKBONES = {
    "alex": Backbone("alexnet-owt-7be5be79.pth", "alexnet_features.pth"),
    "vgg": Backbone("vgg16-397923af.pth", "vgg16_features.pth"),
    "squeeze": Backbone("squeezenet1_1-b8a52dc0.pth", "squeezenet1_1_features.pth"),
}

_unreachable: list[str] = []  # why the download failed: each process tries only once


def locate(net: str, weights_dir: Path | None, log: Log) -> Path:
    """The weight file of backbone `net`, downloaded if need be.

    Raises:
        SteerbenchError: `net` is unknown, or `weights_dir` is not a folder.
        Unavailable: there is no file and the download failed, or the file is damaged.
    """
    if net not in BACKBONES:
        raise SteerbenchError(f"LPIPS net: expected one of {', '.join(BACKBONES)}, got {net!r}")
    if weights_dir is not None and not weights_dir.is_dir():
        raise SteerbenchError(f"weights_dir: expected a folder, got {weights_dir}")
    backbone = BACKBONES[net]
    for folder in _folders(weights_dir):
        for name in (backbone.features, backbone.published):
            if (folder / name).is_file():
                return _verified(folder / name)
    try:
        return _download(backbone.published, log)
    except Unavailable as error:
        raise Unavailable(
            f"{backbone.published} is not on this machine, and {error}; "
            "name a folder that has it as weights_dir=DIR or in $STEERBENCH_WEIGHTS"
        ) from error


def load_features(net: str, weights_dir: Path | None, log: Log) -> tuple[Path, dict[str, Tensor]]:
    """The weight file of backbone `net` and the tensors in it; raises as `locate` does."""
    path = locate(net, weights_dir, log)
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise Unavailable(
            f"{path}: expected a torch state dict, could not read one; fetch the file again "
            f"from {ADDRESS}{BACKBONES[net].published}"
        ) from error
    if not isinstance(state, dict):
        raise Unavailable(f"{path}: expected a torch state dict, got a {type(state).__name__}")
    return path, state


def _folders(weights_dir: Path | None) -> list[Path]:
    cache = Path(torch.hub.get_dir()) / "checkpoints"
    named = (weights_dir, os.environ.get("STEERBENCH_WEIGHTS"), cache)
    return [Path(folder) for folder in named if folder]


def _verified(path: Path) -> Path:
    """Return `path`; raise if its name holds a SHA-256 that its content does not match."""
    promised = re.search(r"-([0-9a-f]{8})\.pth$", path.name)
    if promised is None:
        return path
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if not digest.startswith(promised[1]):
        raise Unavailable(
            f"{path}: expected a SHA-256 that begins with {promised[1]}, got {digest[:8]}; "
            "the file is damaged: delete it and fetch it again"
        )
    return path


def _download(name: str, log: Log) -> Path:
    """Download a file into torch's hub cache.

    Raises Unavailable if that fails; after one failure, without trying again.
    """
    if _unreachable:
        raise Unavailable(_unreachable[0])
    folder = Path(torch.hub.get_dir()) / "checkpoints"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with locked(folder / f".{name}.lock", f"waits for another download of {name}", log):
            path = fetch(ADDRESS + name, folder / name, None, log)
            try:
                return _verified(path)
            except Unavailable:
                path.unlink()
                raise
    except (OSError, SteerbenchError) as error:
        _unreachable.append(str(error))
        raise Unavailable(str(error)) from error
