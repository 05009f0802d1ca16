"""How long a hash table a scene needs."""

import pytest
import torch

from bench.types import Budget, Split
from methods.instant_ngp.table import LONG, SHORT, detail, hash_grid
from methods.kernels.encode import HashGrid
from tests.methods.trainings import QUICK
from tests.methods.usual import new_ngp

SHAPE = {"levels": 2, "features": 2, "n_min": 4, "n_max": 8}
BUDGET = Budget("test", steps=1, samples=64)


def split_of(*images: torch.Tensor) -> Split:
    return Split([], images, [])


def test_detail_is_counted_where_colours_change_on_matter():
    picture = torch.full((20, 30, 4), 100, dtype=torch.uint8)
    picture[..., 3] = 255
    assert detail(split_of(picture)) == 0
    picture[:, 10:, 1] += 11  # 0.043 of 1, in one channel, over a vertical edge
    assert detail(split_of(picture)) == 19  # the first row has no row above
    picture[15:, :, 3] = 0
    assert detail(split_of(picture)) == 14
    picture[:, 10:, 1] -= 2
    assert detail(split_of(picture)) == 0


def test_detail_is_a_mean_over_pictures_from_all_over_the_path():
    plain = torch.zeros(9, 9, 3, dtype=torch.uint8)
    dotted = plain.clone()
    dotted[4, 4] = 255  # differs from the left and from above, as do its right and its lower pixel
    assert detail(split_of(dotted)) == 3
    assert detail(split_of(*[plain] * 16, *[dotted] * 16)) == pytest.approx(1.5)


@pytest.mark.parametrize(("fine", "expected"), [(10**6, SHORT), (0, LONG)])
def test_a_field_gets_the_table_that_its_scene_needs(
    ball_scene, quiet_log, monkeypatch, fine, expected
):
    monkeypatch.setattr("methods.instant_ngp.table.FINE", fine)
    method = new_ngp(grid=hash_grid(log2_table=None, **SHAPE), training=QUICK, device="cpu")
    method.fit(ball_scene, BUDGET, quiet_log)
    assert method.trained.field.grid == HashGrid(log2_table=expected, **SHAPE)
    assert method.setup.key(ball_scene, BUDGET)["grid"] == {"log2_table": expected, **SHAPE}
