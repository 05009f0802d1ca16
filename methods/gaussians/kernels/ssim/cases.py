"""Cases of SSIM: agreement of the backends."""

from bench.case import U32, Bound, Cases, Given, Operation, Random
from methods.gaussians.kernels.ssim import ssim
from methods.kernels.dispatch import served

SIMILARITY = 960 * U32
SSIM = Operation(
    "ssim",
    served(__package__),
    ssim,
    {
        "similarity": Bound(
            "means of numbers below 1 by 22 products; the variances they leave, off by 48 u, are "
            "above 1 / 20 in noise: 960 u",
            SIMILARITY,
        )
    },
    {
        "picture": Bound(
            "of a mean of n similarities: means under the window of three slopes below 2 x 20, off "
            "as the similarity is: 3 x 40 x 960 u / n",
            lambda given: 3 * 40 * SIMILARITY / given["picture"].numel(),
        )
    },
)


def cases() -> Cases:
    """Sizes from one pixel to larger than the window; noise, a noisy patch, equal, half black."""
    found = []
    for height, width in ((40, 33), (1, 1), (3, 20), (400, 400)):
        for kind in ("noise", "patch", "equal", "black"):
            items = height * width if (height, kind) == (400, "noise") else 0
            both = SSIM.cases(
                f"{kind}, {width} x {height}",
                _pictures,
                kind,
                height,
                width,
                items=items,
            )
            found += both[:1] if kind == "equal" else both  # there its gradient is 0
    return found


def _pictures(kind: str, height: int, width: int) -> Given:
    one, other = Random(height).share(2, height, width, 3)
    if kind == "black":
        one[:, : width // 2] = 0
    if kind == "patch":
        rows = slice(height // 4, height // 2 + 1)
        columns = slice(width // 5, width // 2 + 1)
        patch = other[rows, columns]
        other = one.clone()
        other[rows, columns] = patch
    return {"picture": one, "target": one if kind == "equal" else other}
