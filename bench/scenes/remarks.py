"""What a reader puts right, leaves out or doubts is said in one line of each kind."""

from collections.abc import Container, Mapping, Sequence
from pathlib import Path

import torch

from bench.kinds import Say
from bench.scenes.images import ScaledView

OFF_CENTRE = 0.4  # of half a picture, from its middle: a doubtful principal point
LOSES = 0.9  # a lens is said to cut a picture if a smaller share of it is left without


class Remarks:
    """Collects remarks on a file. `tell` says the first of each kind, and how many more follow."""

    def __init__(self) -> None:
        self._kinds: dict[str, list[str]] = {}

    def add(self, where: str | Path, kind: str, got: object) -> None:
        self._kinds.setdefault(kind, []).append(f"{where}: {kind}: {got}")

    def add_unread(self, where: Path, levels: Sequence[Mapping], known: Container[str]) -> None:
        """Name the fields that say something, of a file and its entries, and are not `known`."""
        named = {name for level in levels for name, x in level.items() if says_something(x)}
        if unread := sorted(name for name in named if name not in known):
            self.add(where, "fields that are not read", ", ".join(unread))

    def add_doubts(self, pictures: Sequence[ScaledView]) -> None:
        """Remark on cameras that few captures have, and on what a lens leaves of a picture."""
        for picture in pictures:
            name, camera, seen = picture.view.name, picture.view.camera, picture.seen
            size = f"of {camera.width} x {camera.height} pixels"
            middle = 2 * camera.cx / camera.width - 1, 2 * camera.cy / camera.height - 1
            if max(map(abs, middle)) > OFF_CENTRE:
                kind = "principal point far from the middle: a crop, or of pictures of another size"
                self.add(name, kind, f"({camera.cx:g}, {camera.cy:g}) {size}")
            if seen[0] * seen[1] < LOSES * camera.width * camera.height:
                kind = "without its lens, its middle is left"
                self.add(name, kind, f"{seen[0]} x {seen[1]} {size}")
        poses = torch.stack([picture.view.camera.c2w for picture in pictures])  # [N, 3, 4]
        centres, forward = poses[:, :, 3], poses[:, :, 2]
        if len(poses) > 2 and (((centres.mean(0) - centres) * forward).sum(1) < 0).all():
            why = "right for a panorama; else poses have other axes than this format says"
            self.add("poses", "all cameras look away from their middle", why)

    def tell(self, say: Say) -> None:
        for first, *others in self._kinds.values():
            say(first + (f" (and {len(others)} more)" if others else ""))


def says_something(value: object) -> bool:
    """Whether a field could change anything: not one that is empty, false, or all zeros."""
    return any(map(says_something, value)) if isinstance(value, list) else bool(value)
