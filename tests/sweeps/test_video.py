"""Videos: as many pictures as were given, of their size and colours; missing libraries."""

import re
import sys

import numpy as np
import pytest

from sweeps.commands.render import recorded
from tests.common import refusal


def test_a_video_shows_its_pictures_in_turn_and_what_is_no_video_is_one_line(tmp_path):
    av = pytest.importorskip("av")
    levels = (40, 120, 200)
    with recorded(tmp_path / "a.mp4", fps=10) as take:
        for level in levels:
            take(np.full((17, 30, 3), level, np.uint8))
    with av.open(tmp_path / "a.mp4") as video:
        assert float(video.streams.video[0].average_rate) == 10
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert [frame.shape for frame in frames] == [(18, 30, 3)] * 3  # H.264 has even sizes
    for frame, level in zip(frames, levels, strict=True):
        assert np.abs(frame.astype(int) - level).max() <= 3  # limited range of YUV, and its loss

    refused = refusal(r"a\.nothing: cannot write the video")
    with refused, recorded(tmp_path / "a.nothing", fps=10) as take:
        take(np.zeros((8, 8, 3), np.uint8))


@pytest.mark.parametrize(
    ("library", "extra", "command"),
    [("av", "video", ("render", "--video", "a.mp4")), ("viser", "viewer", ("view",))],
)
def test_a_missing_library_is_noticed_before_any_training(
    steerbench, monkeypatch, library, extra, command
):
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.setattr(f"sweeps.commands.{command[0]}.trained", lambda *of: pytest.fail("trained"))
    outcome = steerbench(*command, "scene=totem", "scene.width=16", "scene.train=2", "scene.test=2")
    assert re.search(rf"pip install .*\[{extra}\]", outcome.refused())
