"""DIVeR's decoder: as many parameters as published, and the same after layers were merged."""

import torch

from bench.types import NullProbe
from methods.diver.kernels.segments import as_intervals
from methods.diver.method import Baked
from methods.diver.model import CornerModel, Decoder
from methods.kernels.composite import composite
from methods.kernels.march.cases import some_rays
from methods.kernels.voxel_walk import walk
from methods.students.networks import encode_directions
from tests.common import assert_near, seeded

SIZE = 16


def test_it_has_the_parameters_of_the_published_one():
    assert sum(parameter.numel() for parameter in Decoder().parameters()) == 5220


def test_rendered_rays_are_those_of_the_trained_model():
    """The baked model, in rounds, with merged layers, against the layers as they were trained; all
    voxels of a small grid, with random features."""
    generator, rays = seeded(0), some_rays(200)
    voxels = torch.cartesian_prod(*[torch.arange(SIZE)] * 3).int()
    model = CornerModel(voxels, SIZE, Decoder(generator), "auto")
    with torch.no_grad():
        model.table.normal_(generator=generator)
        model.decoder.first.bias.normal_(generator=generator)
        model.decoder.third.bias.normal_(generator=generator)[0] = 1.0
        crossings = walk(rays, model.voxels)
        features = model.features(crossings.voxel, model.weights(rays, crossings))
        raw, geometry = model.decoder.density(features)
        encoded = encode_directions(rays.directions)
        colours = model.decoder.colours(geometry, encoded, crossings.ray)
        want = composite(raw.relu(), colours, as_intervals(crossings), stop=0.0)
    got = Baked(model, "fp32").render_rays(rays, NullProbe(), stop=0.0, faint=0.0)
    # Five layers of 32 numbers below 8 with sums of 32 roundings: 5 x 32 x 8 u = 8e-5.
    assert_near(got.values, want.values, atol=1e-4)
    assert_near(got.alpha, want.alpha, atol=1e-4)
    assert got.alpha.max() > 0.5
