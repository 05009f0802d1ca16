"""Writes videos of 8-bit pictures with PyAV."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import numpy as np

from bench.errors import SteerbenchError, Unavailable, install_command

QUALITY = "18"  # H.264's constant rate factor: the video hardly differs from the original


@contextmanager
def recorded(path: Path, fps: float) -> Iterator[Callable[[np.ndarray], None]]:
    """A function that appends a picture, uint8 [H, W, 3], to a video; all have the same size.

    H.264 needs even sizes: if the height or width is odd, the last row or column is repeated.
    Raises Unavailable without PyAV, and SteerbenchError if the file cannot be written or its ending
    is not that of a video.
    """
    try:
        import av
    except ImportError as error:
        how = f"{install_command('video')}; without --video the pictures alone are written"
        raise Unavailable(f"{path}: videos need PyAV: {how}") from error
    try:
        with av.open(path, "w") as container:
            stream = container.add_stream("h264", rate=Fraction(fps).limit_denominator(1000))
            stream.pix_fmt, stream.options = "yuv420p", {"crf": QUALITY}

            def take(picture: np.ndarray) -> None:
                height, width = picture.shape[:2]
                even = np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
                if not stream.codec_context.is_open:
                    stream.height, stream.width = even.shape[:2]
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")
                container.mux(stream.encode(frame))

            yield take
            container.mux(stream.encode())
    except (av.error.FFmpegError, ValueError) as error:
        raise SteerbenchError(f"{path}: cannot write the video: {error}") from error
