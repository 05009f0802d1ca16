"""The inputs of the network in training views, on which engines are built."""

import pytest
import torch

from methods.engines import Built
from methods.steernerf.pipeline import Pipeline
from methods.steernerf.views import recorded_inputs
from tests.methods.models import new_pipeline, small_joint


def test_what_a_network_is_built_on_is_what_it_is_shown_whatever_ran_before(ball_scene, quiet_log):
    pipeline = new_pipeline(frames=1)
    given = pipeline, ball_scene, small_joint(), 2, 0, quiet_log
    first = recorded_inputs(*given)
    assert pipeline.renderer.engine is None
    pipeline.renderer.engine = Built(lambda inputs: pytest.fail("asked"), 0)
    assert all(map(torch.equal, first, recorded_inputs(*given)))


def test_a_frame_is_recorded_as_in_training_behind_as_many_as_the_buffer_holds_and_one_more(
    ball_scene, quiet_log, monkeypatch
):
    rendered, features = [], Pipeline.features

    def counted(self, view, preceding, rendering, probe):
        assert rendering == small_joint().rendering(self.model)
        rendered.append((view.full.c2w, len(preceding)))
        return features(self, view, preceding, rendering, probe)

    monkeypatch.setattr(Pipeline, "features", counted)
    frames, again, other = (
        recorded_inputs(new_pipeline(frames=1), ball_scene, small_joint(), 3, seed, quiet_log)
        for seed in (0, 0, 1)
    )
    assert [preceding for _, preceding in rendered] == 9 * [0, 1, 1]
    train = ball_scene.splits["train"].cameras
    views = [train[place].c2w for place in (0, 8, 16)]
    assert all(map(torch.equal, [c2w for c2w, _ in rendered[2::3]], 3 * views))
    assert [inputs.shape for inputs in frames] == 3 * [(1, 2 * 4, 32, 32)]
    assert not torch.equal(frames[0], frames[1])
    # The seed decides the motions.
    assert torch.equal(again[0], frames[0])
    assert not torch.equal(other[0], frames[0])
