"""FLIP against its authors' own program."""

import flip_evaluator
import numpy as np
import pytest
import torch

from gsbench.eval.flip import flip, flip_map
from tests.eval.test_metrics import distorted_pair


def of_authors(image, target, ppd):
    """The map of the authors' program, [H, W], of arrays [H, W, 3]."""
    images = [np.ascontiguousarray(x, dtype=np.float32) for x in (target, image)]
    errors, _, _ = flip_evaluator.evaluate(
        *images, "LDR", applyMagma=False, parameters={"ppd": ppd}
    )
    return errors[..., 0]


def colors(height, width, seed):
    """Colours of the whole cube, in blocks with sharp edges, and a copy with other blocks."""
    rng = np.random.default_rng(seed)
    blocks = rng.integers(0, 5, (2, height // 8 + 1, width // 8 + 1, 3)) / 4
    image, other = blocks.repeat(8, axis=1).repeat(8, axis=2)[:, :height, :width]
    return image, np.where(rng.random((height, width, 1)) < 0.3, other, image)


@pytest.mark.parametrize("ppd", [8.0, 67.02, 150.0])
@pytest.mark.parametrize(
    "pair",
    [distorted_pair(), distorted_pair(64, 9, 1), colors(50, 71, 2), colors(1, 3, 3)],
    ids=["noise", "narrow", "colors", "tiny"],
)
def test_each_pixel_has_the_error_of_the_authors_program(pair, ppd):
    target, image = pair
    expected = of_authors(image, target, ppd)
    for dtype in (torch.float32, torch.float64):
        found = flip_map(torch.tensor(image, dtype=dtype), torch.tensor(target, dtype=dtype), ppd)
        # Powers below 1 enlarge what rounding leaves of differences near 0, in both programs.
        assert np.abs(found.numpy() - expected).max() < 2e-4
    assert float(flip(torch.tensor(image), torch.tensor(target), ppd)) == pytest.approx(
        expected.mean(dtype=np.float64), abs=2e-6
    )


def test_flip_is_zero_for_identical_and_one_for_black_against_white():
    image = torch.rand(24, 30, 3)
    assert float(flip(image, image)) == 0.0
    black, white = torch.zeros(24, 30, 3), torch.ones(24, 30, 3)
    assert float(flip(white, black)) > 0.95


def test_flip_depends_on_the_viewing_distance():
    x, y = (torch.tensor(image) for image in distorted_pair())
    # Seen from farther away (more pixels per degree) fine noise is less visible.
    assert float(flip(y, x, ppd=200.0)) < float(flip(y, x, ppd=67.0)) < float(flip(y, x, ppd=20.0))
