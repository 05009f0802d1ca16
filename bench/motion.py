"""Moves cameras: between two poses, along a random smooth path, to a random new view.

Poses are computed in float64 and returned in the type of the input. Directions and rotations are
about a `target` [3], the point in scene units that the cameras look at or move around.
"""

import math
from dataclasses import replace

import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix, rotation_matrix_to_axis_angle
from torch import Generator, Tensor
from torch.nn.functional import normalize

from bench.errors import unexpected
from bench.types import Camera, Cameras, Scene, check_shape

BEND_DEG = 2.0  # the rotation axis of a random motion turns by at most this a frame
ZOOM = 0.005
"""A random motion changes its distance by at most this share per frame, and by proportionally less
if it turns by less than a degree per frame, so that a still camera stays still."""

NEIGHBOURS = 3
JITTER_DEG = 2.0
JITTER_ZOOM = 0.02


def viewing_target(scene: Scene) -> Tensor:
    """The point [3] that cameras move around: the centre of `scene.bounds`."""
    return scene.bounds.double().mean(dim=0)


def rotation_between(first: Camera, second: Camera) -> Tensor:
    """The rotation [3] from `first` to `second`, axis times angle, in the axes of `first`."""
    relative = first.rotation.double().T @ second.rotation.double()
    return rotation_matrix_to_axis_angle(relative[None])[0]


def shift_of(target: Tensor, first: Camera, second: Camera) -> float:
    """By how much the `target` [3] moves in the axes of a camera that goes from `first` to
    `second`, as an angle in radians: 0 on an orbit, where the camera turns with it."""
    before, after = (x.rotation.double().T @ -_offset(x, target) for x in (first, second))
    return math.atan2((after - before).norm().item(), before.norm().item())


def between(first: Camera, second: Camera, turn: Tensor, share: float) -> Camera:
    """The camera at `share` of the way: rotation at constant speed, everything else linear.

    `turn` [3] is their `rotation_between`. On an orbit the centre follows the chord: at 4 degrees
    it is off by 0.06 % of the distance. Raises SteerbenchError if the pictures differ in size.
    """
    camera = lens_between(first, second, share)
    rotation = first.rotation.double() @ _rotation(share * turn)
    centre = torch.lerp(first.centre.double(), second.centre.double(), share)
    return replace(camera, c2w=torch.column_stack((rotation, centre)).to(first.c2w))


def lens_between(first: Camera, second: Camera, share: float) -> Camera:
    """`first` with its intrinsics at `share` of the way; raises if the pictures differ in size."""
    one, other = (f"{camera.width}x{camera.height}" for camera in (first, second))
    if one != other:
        expected = "pictures of one size to interpolate between"
        raise unexpected("cameras", expected, f"{one} and {other}")
    names = ("fx", "fy", "cx", "cy")
    ends = ((name, getattr(first, name), getattr(second, name)) for name in names)
    return replace(first, **{name: (1 - share) * a + share * b for name, a, b in ends})


def preceding(
    camera: Camera, target: Tensor, count: int, degrees: tuple[float, float], generator: Generator
) -> list[Camera]:
    """The `count` cameras that precede `camera` on a random smooth motion, oldest first.

    Each frame turns the camera rigidly about `target` [3], which keeps its place in the picture.
    The angle per frame is drawn once from the range `degrees`; the axis is perpendicular to the
    viewing direction; it and the distance change slightly from frame to frame.

    Raises ValueError if `target` is not [3], `count` is negative, or `degrees` no range from 0 up.
    """
    check_shape("target", target, 3)
    if count < 0 or not 0 <= degrees[0] <= degrees[1]:
        raise ValueError(f"expected count >= 0 and 0 <= low <= high: {count=}, {degrees=}")
    spin, speed, bend, zoom = torch.rand(4, generator=generator, dtype=torch.float64).tolist()
    speed = degrees[0] + (degrees[1] - degrees[0]) * speed
    bend = math.radians(BEND_DEG * (2 * bend - 1))
    zoom = 1 + ZOOM * min(speed, 1.0) * (2 * zoom - 1)
    spin *= 2 * math.pi
    axis = torch.tensor([math.cos(spin), math.sin(spin), 0.0], dtype=torch.float64)
    path = [replace(camera, c2w=camera.c2w.double())]
    for _ in range(count):
        step = math.radians(speed) * (path[-1].rotation @ axis)
        path.append(_turned(path[-1], target, step, zoom))
        axis = _rotation(axis.new_tensor([0.0, 0.0, bend])) @ axis  # about viewing direction
    return [replace(frame, c2w=frame.c2w.to(camera.c2w)) for frame in path[:0:-1]]


def novel_view(cameras: Cameras, target: Tensor, generator: Generator) -> Camera:
    """A random camera from the region in which `cameras` view `target` [3].

    It lies between a camera and one of its nearest neighbours by direction, at a distance between
    theirs, then is turned a little about the target and moved a little nearer or farther. Only
    cameras with pictures of the same size are neighbours.
    """
    check_shape("target", target, 3)
    pick = int(torch.randint(len(cameras), (), generator=generator))
    near = _nearest(cameras, target, pick)
    other = near[int(torch.randint(len(near), (), generator=generator))]
    share, angle, zoom = torch.rand(3, generator=generator, dtype=torch.float64).tolist()
    axis = torch.randn(3, generator=generator, dtype=torch.float64)
    first = cameras[pick]
    second = cameras[other]
    view = between(first, second, rotation_between(first, second), share)
    start, end, chord = (_offset(camera, target).norm().item() for camera in (first, second, view))
    # `between` moves along the chord, which comes too near to the target: restore the distance.
    zoom = ((1 - share) * start + share * end) / chord * (1 + JITTER_ZOOM * (2 * zoom - 1))
    step = math.radians(JITTER_DEG * angle) * normalize(axis, dim=0)
    return _turned(view, target, step, zoom)


def _nearest(cameras: Cameras, target: Tensor, index: int) -> list[int]:
    """The cameras whose direction to `target` is nearest to that of camera `index`, of those with
    pictures of its size; without any, that camera itself."""
    offsets = torch.stack([_offset(camera, target) for camera in cameras])  # [N, 3]
    directions = normalize(offsets, dim=-1)
    order = (directions @ directions[index]).argsort(descending=True, stable=True).tolist()
    alike = [other for other in order if cameras[other].size == cameras[index].size]
    return [other for other in alike if other != index][:NEIGHBOURS] or [index]


def _turned(camera: Camera, target: Tensor, turn: Tensor, zoom: float) -> Camera:
    """`camera` turned rigidly about `target` by `turn` [3], its distance times `zoom`."""
    rotation = _rotation(turn)
    centre = target.double() + zoom * (rotation @ _offset(camera, target))
    pose = torch.column_stack((rotation @ camera.rotation.double(), centre))
    return replace(camera, c2w=pose.to(camera.c2w))


def _offset(camera: Camera, target: Tensor) -> Tensor:
    return camera.centre.double() - target.double()


def _rotation(turn: Tensor) -> Tensor:
    return axis_angle_to_rotation_matrix(turn[None])[0]
