"""Metrics in regions of the test views."""

import numpy as np
import pytest

from gsbench.eval.evaluator import Evaluator
from gsbench.eval.options import EvalConfig
from gsbench.eval.protocol import STANDARD
from gsbench.eval.regions import depths_of_points, regions_by_distance
from gsbench.scene.types import Camera
from tests.helpers import refusal, table

EVAL = {"name": "standard", "protocol": "standard"}


def camera():
    return Camera(12, 9, 10.0, 10.0, 6.0, 4.5, np.eye(3), np.array([0.0, 0.0, 1.0]))


def test_a_pixel_has_the_depth_of_the_point_that_is_projected_nearest():
    rng = np.random.default_rng(1)
    points = rng.uniform([-2, -2, -3], [2, 2, 6], (40, 3))
    depths = depths_of_points(points, camera())
    shown = []
    for x, y, z in points + np.array([0, 0, 1]):
        place = 10 * x / z + 6, 10 * y / z + 4.5
        if z > 0 and 0 <= place[0] < 12 and 0 <= place[1] < 9:
            shown.append((*place, z))
    assert 3 < len(shown) < 40
    for row in range(9):
        for column in range(12):
            nearest = min(shown, key=lambda s: (s[0] - column - 0.5) ** 2 + (s[1] - row - 0.5) ** 2)
            assert depths[row, column] == pytest.approx(nearest[2])
    assert not depths_of_points(np.array([[0.0, 0.0, -5.0]]), camera()).any()  # behind it


def test_regions_are_terciles_over_all_test_views():
    depths = {"a": np.array([[1.0, 2, 3], [0, 4, 5]]), "b": np.array([[6.0, 7, 8], [9, 0, 0]])}
    regions = regions_by_distance({name: own.astype(np.float32) for name, own in depths.items()})
    found = {
        region: sorted(np.concatenate([depths[name][regions[name][region]] for name in depths]))
        for region in ("near", "middle", "far")
    }
    assert found == {"near": [1, 2, 3], "middle": [4, 5, 6], "far": [7, 8, 9]}
    assert regions_by_distance({"a": np.zeros((2, 2), np.float32)}) == {"a": {}}


def test_metrics_in_a_region_are_those_of_its_pixels():
    rng = np.random.default_rng(2)
    image, truth = (rng.integers(0, 256, (40, 50, 3), dtype=np.uint8) for _ in range(2))
    mask = rng.random((40, 50)) > 0.2
    left = np.zeros((40, 50), bool)
    left[:, :20] = True
    few = np.zeros((40, 50), bool)
    few[:3, :5] = True  # 15 of 2000 pixels: below 1 %
    evaluator = Evaluator(STANDARD, lpips=["squeeze"], download=False)
    values = evaluator.evaluate_view(image, truth, mask, {"left": left, "few": few})
    errors = ((image / 255.0 - truth / 255.0) ** 2)[mask & left]
    assert values["psnr@left"] == pytest.approx(-10 * np.log10(errors.mean()), abs=1e-4)
    assert {key for key in values if "@" in key} == {"psnr@left", "ssim@left", "flip@left"}
    alone = evaluator.evaluate_view(image, truth, mask)
    assert alone == {key: value for key, value in values.items() if "@" not in key}


@pytest.mark.parametrize(
    "settings",
    [
        {"regions": "distance", "primary": "psnr@far"},
        {"regions": {"sky": "masks/sky"}, "primary": "flip@sky"},
        {"regions": "distance", "primary": "psnr@near@extrapolation"},
        {"primary": "psnr@interpolation"},
    ],
)
def test_the_metric_of_the_verdict_may_be_one_of_a_region(settings):
    assert EvalConfig(**EVAL, **settings).primary == settings["primary"]


@pytest.mark.parametrize(
    "settings,error",
    table(__file__, "refused"),
)
def test_other_metrics_of_the_verdict_are_refused(settings, error):
    with refusal(error):
        EvalConfig(**EVAL, **settings)
