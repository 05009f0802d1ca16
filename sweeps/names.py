"""Errors about unknown names: they give the name's replacement or near matches, and what exists."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from difflib import get_close_matches

from bench.errors import SteerbenchError

RENAMED = {
    "command=generic": "steerbench pretrain",
    "budget=generic": "budget=pretrain",
    "method=steernerf_paper": "method=steernerf",
    "sizing.refined_step": "sizing.lean_step",
    "method=steernerf_frozen": "method=steernerf_lean_frozen",
    "method=steernerf_k3": "method=steernerf_lean_k3",
    "method=steernerf_untaught": "method=steernerf_lean with method.rendering.step or .stop",
    "renderer=s2d": "renderer=lean",
    "renderer=unet_release": "renderer=unet",
    "method.pipeline": "method.model, or method.rendering for what needs no training",
    "method.pipeline.steps": "method.model.step, or method.rendering.step after the training",
    "method.pipeline.stop": "method.model.stop, or method.rendering.stop after the training",
    "method.pipeline.refined_steps": "method.rendering.refined_step",
    "method.joint.doubt": "method.joint.error_weight",
}
RENAMED |= {
    f"method.pipeline.{name}": f"method.{part}.{name}"
    for part, names in {
        "model": "channels frames scale reprojection history surface feature_background",
        "rendering": "range overlap refined skip",
    }.items()
    for name in names.split()
}
"""Names of earlier versions and their present names; each also covers all settings below it."""

REMOVED = {
    "method=ngp_guided",
    "protocol=steerbench-1-lookahead",
    "protocol.lookahead",
    "method.joint.precision",
    "method.pipeline.jitter",
    "method.pipeline.levels",
    "method.pipeline.refresh",
}


def unknown(kind: str, name: str, existing: Iterable[str]) -> SteerbenchError:
    """The error for a `name` not among `existing`; it suggests the new name, or near ones."""
    old, below = name if kind == "setting" else f"{kind}={name}", ""
    while old and old not in RENAMED and old not in REMOVED:
        old, dot, last = old.rpartition(".")
        below = f"{dot}{last}{below}"
    if old in REMOVED:
        return SteerbenchError(f"{kind} '{name}' was removed; its figures are in docs/log.md")
    if old:
        new = RENAMED[old] if " " in RENAMED[old] else f"{RENAMED[old]}{below}"
        return SteerbenchError(f"{kind} '{name}' was renamed; use {new}")
    names = sorted(existing)
    near = _nearest(name, names)
    guess = f" Did you mean {' or '.join(near)}?" if near else ""
    return SteerbenchError(f"unknown {kind} '{name}'.{guess} There are: {', '.join(names)}.")


def _nearest(name: str, names: Sequence[str]) -> list[str]:
    """Near names on the same level (scene.path for scene.pth); if none, near names anywhere."""
    place = name[: name.rfind(".") + 1]
    beside = {other.removeprefix(place): other for other in names if other.startswith(place)}
    near = get_close_matches(name.removeprefix(place), beside)
    return [beside[last] for last in near] or get_close_matches(name, names)
