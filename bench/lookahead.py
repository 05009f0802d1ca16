"""Telling a method of the camera after the one that it renders."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from bench.types import Camera, Method


@runtime_checkable
class Foreseeing(Protocol):
    """A method that can begin a frame beside the one before it."""

    def foresee(self, camera: Camera) -> bool:
        """Be told that the frame after the next one to be rendered will be that of `camera`, this
        very object; whether that is of use. The picture is the same as without."""


def announce_next(method: Method, cameras: Sequence[Camera], index: int) -> bool:
    """Tell `method` of the camera after that of the `index`-th frame, which it is about to render;
    whether there is one and the method has a use for it.

    After the last frame it is told of that camera once more. What it begins is thrown away, but so
    each of any number of frames in a row is charged with what was begun beside it, and as many are
    begun beside them as they are.
    """
    following = min(index + 1, len(cameras) - 1)
    useful = isinstance(method, Foreseeing) and method.foresee(cameras[following])
    return useful and following > index
