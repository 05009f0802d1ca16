"""Where networks are, and where their lessons are drawn."""

from types import SimpleNamespace

import torch

from methods.kernels.types import Occupancy
from methods.kilonerf.field import KiloField, place_networks
from methods.kilonerf.method import KiloTraining
from tests.common import seeded
from tests.methods.usual import lessons

BOUNDS = torch.tensor([[0.1, 0.2, 0.1], [0.9, 0.8, 0.7]])


def occupied(*cells: tuple[int, int, int]) -> Occupancy:
    return Occupancy.at(torch.tensor(cells).reshape(len(cells), 3), 32)


def test_networks_are_where_matter_is():
    grid, pieces = place_networks(occupied((8, 8, 8), (20, 12, 9)), BOUNDS, 4)
    assert grid.networks.shape == (4, 3, 3)
    # Cubes of 0.2 from (0.1, 0.2, 0.1). The cells are [0.25, 0.28]^3, whose z reaches into one
    # cube only, and [0.625, 0.656] x [0.375, 0.406] x [0.281, 0.3125], which faces cross twice.
    there = (grid.networks >= 0).nonzero().tolist()
    assert there == [[0, 0, 0], [2, 0, 0], [2, 0, 1], [2, 1, 0], [2, 1, 1]]
    cells = ((pieces.low + pieces.high) / 2 * 32).long().tolist()
    assert cells == [[8, 8, 8]] + 4 * [[20, 12, 9]]


def test_the_pieces_of_a_cell_make_up_the_cell():
    cells = occupied((9, 10, 11), (15, 15, 15), (22, 17, 19))
    for along in (1, 3, 4, 7, 32):
        _, pieces = place_networks(cells, BOUNDS, along)
        volume = (pieces.high - pieces.low).prod(dim=1).sum().item()
        assert abs(volume * 32**3 - 3) < 1e-3


def test_lessons_are_as_many_for_each_network_and_in_it():
    grid, pieces = place_networks(occupied((8, 8, 8), (8, 8, 9), (20, 12, 9)), BOUNDS, 4)
    points = pieces.draw(50, seeded(0))
    cube = ((points - grid.corner) / grid.side).floor().long()
    numbers = grid.networks[tuple(cube.T)]
    assert numbers.tolist() == [n for n in range(grid.count) for _ in range(50)]


def test_networks_begin_alike_and_nothing_is_where_there_is_none():
    grid, _ = place_networks(occupied((8, 8, 8), (20, 12, 9)), BOUNDS, 4)
    field = KiloField(grid, "auto", seeded(0))
    for parameter in field.parameters():
        assert (parameter == parameter[:1]).all()
    networks = grid.count * 6212 * 4  # bytes of float32 of the published size
    assert field.sizes() == {"networks": networks, "network_grid": 2 * grid.networks.numel()}
    with torch.no_grad():
        field.biases["density"].fill_(5.0)
        positions = torch.rand(4000, 3, generator=seeded(1))
        sigma, geometry = field.density(positions)
        colour = field.features(geometry, field.encode_directions(torch.ones(4000, 3)))
    cube = ((positions - grid.corner) / grid.side).floor().long()
    inside = ((cube >= 0) & (cube < torch.tensor(grid.networks.shape))).all(dim=1)
    there = inside & (grid.networks[tuple(torch.where(inside[:, None], cube, 0).T)] >= 0)
    assert there.any()
    assert torch.equal(sigma > 0, there)
    assert torch.equal((colour > 0).all(dim=1), there)


def test_a_scene_without_matter_has_no_network():
    grid, _ = place_networks(occupied(), BOUNDS, 4)
    assert grid.count == 0
    sigma, _ = KiloField(grid, "auto").density(torch.rand(9, 3))
    assert not sigma.any()


def test_layers_that_see_directions_are_drawn_to_zero_by_the_gradient_of_their_norm():
    grid, _ = place_networks(occupied((8, 8, 8)), BOUNDS, 4)
    field = KiloField(grid, "auto", seeded(0))
    for parameter in field.parameters():
        parameter.grad = torch.zeros_like(parameter)
    options = lessons("kilonerf", view_cost=0.25)
    KiloTraining._smooth_views(SimpleNamespace(field=field, options=options))
    seeing = (field.weights["direction"], field.weights["colour"])
    for parameter in seeing:
        torch.testing.assert_close(parameter.grad, 0.25 * parameter / parameter.norm())
    others = (field.weights[name].grad for name in ("in", "mid", "density", "feature"))
    assert not any(grad.any() for grad in others if grad is not None)
