"""TrainingViews that engines are built and compared on."""

import pytest
import torch

from bench.metrics import psnr
from bench.types import Log, Scene, composite
from methods.engines import Built
from methods.steernerf.pipeline import Pipeline
from methods.steernerf.views import COMPARED, TrainingViews
from tests.methods.models import new_pipeline, small_joint, small_model


def views_of(scene: Scene, log: Log, seed: int = 0) -> TrainingViews:
    return TrainingViews(new_pipeline(small_model(frames=1)), scene, small_joint(), seed, log)


@torch.no_grad()
def test_engines_are_compared_in_the_same_frames_with_the_true_pictures(ball_scene, quiet_log):
    """A network that adds 1 to everything draws white pictures."""
    views, given = views_of(ball_scene, quiet_log), []
    network = views.pipeline.renderer.network

    def white(inputs):
        given.append(inputs.clone())
        return torch.ones_like(network(inputs))

    exact, wrong = views.compare([Built(network, 0), Built(white, 0)])
    assert views.pipeline.renderer.engine is None  # the next frame before is drawn by the network
    numbers = [place * 24 // COMPARED for place in range(COMPARED)]
    pictures = [ball_scene.splits["train"].images[number] for number in numbers]
    truth = [composite(picture, ball_scene.background) for picture in pictures]
    blank = [psnr(torch.ones_like(picture), picture) for picture in truth]
    assert wrong.psnr == pytest.approx(sum(blank) / COMPARED, abs=1e-4)
    assert exact.psnr > wrong.psnr
    assert min(exact.ms, wrong.ms) > 0
    frames = [tuple(x.flatten().tolist()) for x in given]
    assert len(set(frames)) == COMPARED  # each twice: the first is not timed
    assert len(frames) == 2 * COMPARED


def test_what_a_network_is_built_on_is_what_it_is_shown_whatever_ran_before(ball_scene, quiet_log):
    views = views_of(ball_scene, quiet_log)
    first = views.inputs(2)
    views.pipeline.renderer.engine = Built(lambda inputs: pytest.fail("asked"), 0)
    again = views.inputs(2)
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))


def test_a_frame_is_recorded_as_in_training_behind_as_many_as_the_buffer_holds_and_one_more(
    ball_scene, quiet_log, monkeypatch
):
    rendered, features = [], Pipeline.features

    def counted(self, view, preceding, rendering, probe):
        assert rendering == small_joint().rendering(self.model)
        rendered.append((view.full.c2w, len(preceding)))
        return features(self, view, preceding, rendering, probe)

    monkeypatch.setattr(Pipeline, "features", counted)
    frames, again, other = (views_of(ball_scene, quiet_log, seed).inputs(3) for seed in (0, 0, 1))
    assert [preceding for _, preceding in rendered] == 9 * [0, 1, 1]
    train = ball_scene.splits["train"].cameras
    views = [train[place].c2w for place in (0, 8, 16)]
    assert all(map(torch.equal, [c2w for c2w, _ in rendered[2::3]], 3 * views))
    assert [inputs.shape for inputs in frames] == 3 * [(1, 2 * 4, 32, 32)]
    assert not torch.equal(frames[0], frames[1])
    # The seed decides the motions.
    assert torch.equal(again[0], frames[0])
    assert not torch.equal(other[0], frames[0])
