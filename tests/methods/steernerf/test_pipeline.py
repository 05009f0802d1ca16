"""A frame of the pipeline: views, cold start, what follows what, what is chosen afterwards."""

from dataclasses import replace

import pytest
import torch
from torch.nn import functional

from bench.cameras import cast, project
from bench.types import NullProbe
from methods.steernerf.buffer import Buffer
from methods.steernerf.options import RangeReduction
from methods.steernerf.pipeline import near_matter
from methods.steernerf.unet import RIM
from tests.common import assert_near
from tests.methods.conftest import Work, look_at_the_middle
from tests.methods.models import new_pipeline, small_rendering

USUAL = small_rendering()
CAMERA = look_at_the_middle(0.1, 0.3)


@pytest.mark.parametrize("size", [(32, 32), (33, 30)])
def test_a_ray_of_the_low_resolution_goes_through_the_middle_of_its_cell(size):
    view = new_pipeline().view(replace(CAMERA, width=size[0], height=size[1]))
    assert (view.full.width, view.full.height) == (4 * view.low.width, 4 * view.low.height)
    rays = cast(view.low)
    pixels, _ = project(view.full, rays.origins + 2 * rays.directions)
    assert torch.allclose(pixels[0], torch.tensor((2.0, 2.0)), atol=1e-4)  # float32 at 32 pixels
    assert torch.allclose(pixels[1] - pixels[0], torch.tensor((4.0, 0.0)), atol=1e-4)


def test_a_part_of_a_view_looks_as_the_view_does():
    view = new_pipeline().view(CAMERA)
    part = view.crop((slice(3, 7), slice(2, 6)))
    for whole, some, scale in ((view.low, part.low, 1), (view.full, part.full, 4)):
        directions = cast(whole).directions.view(whole.height, whole.width, 3)
        there = directions[3 * scale : 7 * scale, 2 * scale : 6 * scale]
        got = cast(some).directions.view(some.height, some.width, 3)
        assert_near(got, there, atol=1e-6)


@pytest.mark.parametrize("frames", [0, 1, 3])
@pytest.mark.parametrize("size", [(32, 32), (33, 30), (5, 3)])
def test_frames_have_the_size_of_the_camera_whatever_is_remembered(frames, size):
    pipeline = new_pipeline(frames=frames)
    camera = replace(CAMERA, width=size[0], height=size[1])
    buffer = Buffer(maxlen=frames)
    for remembered in range(frames + 2):
        assert len(buffer) == min(remembered, frames)
        frame = pipeline.render(camera, buffer, USUAL, NullProbe())
        assert frame.rgb.shape == (size[1], size[0], 3)
        assert frame.depth.shape == frame.alpha.shape == (size[1], size[0])
        assert frame.rgb.isfinite().all()


def test_what_is_remembered_without_drawing_is_the_same(monkeypatch):
    pipeline, drawn = new_pipeline(), []
    rendered, remembered = Buffer(maxlen=2), Buffer(maxlen=2)
    pipeline.render(CAMERA, rendered, USUAL, NullProbe())
    monkeypatch.setattr(pipeline, "renderer", lambda *given: drawn.append(given))
    pipeline.remember(CAMERA, remembered, USUAL)
    assert not drawn
    for name in ("points", "values", "alpha"):
        assert torch.equal(getattr(rendered[0], name), getattr(remembered[0], name))


def test_the_newest_frames_are_remembered_newest_first():
    pipeline, buffer = new_pipeline(), Buffer(maxlen=2)
    for turn in (0.1, 0.103, 0.106, 0.109):
        camera = look_at_the_middle(turn, 0.3)
        pipeline.render(camera, buffer, USUAL, NullProbe())
    for turn, cloud in zip((0.109, 0.106), buffer, strict=True):
        view = pipeline.view(look_at_the_middle(turn, 0.3))
        assert torch.equal(cloud.camera.c2w, view.low.c2w)


def test_range_reduction_reprojects_the_depth_that_it_is_told_to():
    """Expected depths are those of a cloud that has them instead."""
    pipeline, buffer, probe = new_pipeline(), Buffer(maxlen=2), NullProbe()
    pipeline.render(CAMERA, buffer, USUAL, probe)
    view = pipeline.view(look_at_the_middle(0.15, 0.3))

    def values(cloud, depth):
        rendering = replace(USUAL, range=RangeReduction("paper", 0.02, depth))
        return pipeline.features(view, (cloud,), rendering, probe).values

    expected = values(buffer[0], "expected")
    assert torch.equal(expected, values(buffer[0].expected(), "sum"))
    assert not torch.equal(expected, values(buffer[0], "sum"))


def samples(**others) -> int:
    """How many samples a frame takes."""
    probe = Work()
    new_pipeline().render(CAMERA, Buffer(maxlen=2), replace(USUAL, **others), probe)
    return probe.done["samples"]


def test_what_is_not_skipped_is_more_work_and_longer_steps_and_earlier_stops_are_less():
    usual, some = samples(), samples(stop=0.5)
    assert samples(step=16.0) < 0.7 * usual
    assert 0 < some < usual
    for unskipped in ("empty", "hidden"):
        skip = replace(USUAL.skip, **{unskipped: False})
        assert samples(stop=0.5, skip=skip) > some


@pytest.mark.parametrize(
    ("rows", "columns", "part"),
    [
        ((30, 33), (40, 42), (slice(19, 43), slice(29, 53))),  # 3 + 16 rows, 2 + 16 columns: 24
        ((0, 1), (97, 100), (slice(0, 24), slice(76, 100))),  # it stays inside the picture
        ((5, 85), (20, 84), (slice(0, 90), slice(12, 92))),  # no larger than the picture
        ((0, 0), (0, 0), (slice(0, 24), slice(0, 24))),  # a view of nothing has one, too
    ],
)
def test_the_part_that_is_drawn_surrounds_matter(rows, columns, part):
    seen = torch.zeros(90, 100, dtype=torch.bool)
    seen[slice(*rows), slice(*columns)] = True
    assert near_matter(seen) == part


def test_far_from_matter_a_picture_is_background_and_near_it_that_of_the_whole():
    """At the border of its part the network sees less than in the whole picture; what it draws of
    a pixel depends on no other farther away than 52: 2 + 3 convolutions at full size, 2 + 4 at
    half and 8 at a quarter of it, and what is pooled."""
    lens = {"fx": 500.0, "fy": 500.0, "cx": 400.0, "cy": 400.0}
    camera, pipeline = replace(CAMERA, width=800, height=800, **lens), new_pipeline()
    whole = replace(USUAL, skip=replace(USUAL.skip, background=False))
    work = Work(), Work()
    some, every = (
        pipeline.render(camera, Buffer(maxlen=2), rendering, probe)
        for rendering, probe in zip((USUAL, whole), work, strict=True)
    )
    assert torch.equal(every.alpha, some.alpha)
    seen = every.alpha[::4, ::4] > 0
    rows, columns = near_matter(seen)
    drawn = torch.zeros(800, 800, dtype=torch.bool)
    drawn[4 * rows.start : 4 * rows.stop, 4 * columns.start : 4 * columns.stop] = True
    assert 0.05 < drawn.float().mean() < 0.9
    border = functional.max_pool2d((~drawn)[None].float(), 2 * RIM + 1, 1, RIM)[0] == 1
    assert (some.rgb[border] - pipeline.background[:3]).abs().max() < 1e-6
    inner = functional.max_pool2d((~drawn)[None].float(), 105, 1, 52)[0] == 0
    assert inner.sum() > 2500
    # Float32, sums of a few hundred products, in another order where the size is another.
    assert_near(some.rgb[inner], every.rgb[inner], atol=1e-5)
    assert not torch.equal(some.rgb, every.rgb)
    less, more = (probe.done["products"] for probe in work)
    left_out = (~drawn).float().mean() * pipeline.renderer.network.products(drawn[None, None])
    assert more - less == pytest.approx(left_out.item(), rel=1e-4)
