"""NeRF as a method: its network is that of the paper, and skipping changes no picture."""

import torch
from torch import nn

from methods.kernels.composite import STOP
from methods.nerf.field import NerfField
from methods.rendering.sampling import Sampling
from tests.common import assert_near, seeded
from tests.methods.conftest import Work
from tests.methods.small_students import fitted
from tests.methods.trainings import EXACT_TEACHER


def test_skipping_changes_no_picture_and_saves_products(ball_scene, shared_log):
    method = fitted("nerf", ball_scene, shared_log, 20, stop=STOP)
    assert method.sizes() == {"network": 4 * 595_844, "occupancy": 128**3 // 8}
    camera = ball_scene.splits["test"].cameras[0]
    skipping, dense = Work(), Work()
    fast = method.render(camera, skipping)
    method.skip = False
    slow = method.render(camera, dense)
    # A ray has 1024 samples of the usual step at most; the faint ones, which only the dense picture
    # has colours of, weigh at most `Sampling.least_weight` each. Sums differ by their rounding.
    faint = 1024 / EXACT_TEACHER.training.march_step * Sampling(stop=STOP).least_weight
    assert_near(fast.rgb, slow.rgb, atol=faint + 1e-5)
    assert_near(fast.alpha, slow.alpha, atol=1e-5)
    # Weights of the network that the paper draws, without biases, and without those of the layer
    # between trunk and view, which no activation separates from the latter.
    trunk = 63 * 256 + 4 * 256**2 + (63 + 256) * 256 + 2 * 256**2
    products = trunk + 256 + (256 + 27) * 128 + 128 * 3
    assert dense.done["products"] == dense.done["samples"] * products
    assert skipping.done["products"] < dense.done["products"] / 3


class PaperNerf(nn.Module):
    """Figure 7 of Mildenhall et al. (2020), written as the figure is read."""

    def __init__(self):
        super().__init__()
        self.first = nn.Sequential(
            nn.Linear(63, 256), *(m for _ in range(4) for m in (nn.ReLU(), nn.Linear(256, 256)))
        )
        self.second = nn.Sequential(
            nn.Linear(319, 256), *(m for _ in range(2) for m in (nn.ReLU(), nn.Linear(256, 256)))
        )
        self.sigma, self.feature = nn.Linear(256, 1), nn.Linear(256, 256)
        self.view, self.rgb = nn.Linear(283, 128), nn.Linear(128, 3)

    def forward(self, x, d):
        x, d = gamma(x, 10), gamma(d, 4)
        hidden = torch.relu(self.first(x))
        hidden = torch.relu(self.second(torch.cat((x, hidden), dim=1)))
        view = torch.relu(self.view(torch.cat((self.feature(hidden), d), dim=1)))
        return torch.relu(self.sigma(hidden)), torch.sigmoid(self.rgb(view))


def gamma(p: torch.Tensor, frequencies: int) -> torch.Tensor:
    """Eq. 4, behind the values themselves."""
    waves = [f(2**k * torch.pi * p) for k in range(frequencies) for f in (torch.sin, torch.cos)]
    return torch.cat((p, *waves), dim=1)


def test_the_network_is_that_of_the_paper():
    generator = seeded(0)
    field = NerfField("fp32", "auto", generator).double()
    paper = PaperNerf().double()
    paper.load_state_dict(dict(zip(paper.state_dict(), field.state_dict().values(), strict=True)))
    positions = torch.rand(200, 3, generator=generator, dtype=torch.float64)
    directions = torch.randn(200, 3, generator=generator, dtype=torch.float64)
    unit = directions / directions.norm(dim=1, keepdim=True)

    sigma, geometry = field.density(positions)
    colour = field.features(geometry, field.encode_directions(directions))
    opacity, rgb = paper(2 * positions - 1, unit)

    # Doubling an angle 10 times loses 10 bits of 53.
    assert_near(sigma * 5 * 3**0.5 / 1024, opacity[:, 0], atol=1e-9)
    assert_near(colour, rgb, atol=1e-9)
