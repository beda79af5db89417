"""Regions of renders: sums by hand, Smyth's prior and Benjamini-Hochberg against scipy, A/A."""

from base64 import b64decode
from io import BytesIO

import numpy as np
import pytest
from PIL import Image
from scipy import special, stats

from gsbench.analysis.comparison import compare
from gsbench.analysis.images import region_errors, regions_of, textured_error
from gsbench.analysis.report.build import build_report
from gsbench.analysis.report.where import (
    _p_values,
    compare_regions,
    discoveries,
    prior_of,
    region_maps,
    region_psnr,
)
from gsbench.analysis.results import load_experiment
from gsbench.claims.archive import unpack_archive
from gsbench.claims.export import write_archive
from gsbench.runs.layout import FROM_PIXELS, MASKS
from gsbench.scene.images import read_image
from tests.analysis.helpers import trials_of
from tests.helpers import refusal, write
from tests.trials import ask_about, write_runs

GRID = {"a": (6, 10), "b": (6, 10), "c": (5, 10)}


def trials(rng, seeds, effect=0.0, common=0.0, of_view=0.0, smooth=False):
    """Errors of ``seeds`` trainings on three views; noise in dB is 0.5, unlike by region."""
    noise = {
        view: np.random.default_rng(7).gamma(8, 0.5 / 8, shape) for view, shape in GRID.items()
    }
    found = []
    for _ in range(seeds):
        shift, errors = rng.normal(0, common), {}
        for view, shape in GRID.items():
            drawn = rng.normal(size=shape)
            if smooth:  # neighbours share half of their noise
                drawn = (drawn + np.roll(drawn, 1, axis=0) + np.roll(drawn, 1, axis=1)) / 3**0.5
            decibel = 25 + shift + rng.normal(0, of_view) + noise[view] * drawn
            if view == "a":
                decibel[:2] += effect
            errors[view] = 255**2 * 10 ** (-decibel / 10)
        found.append(errors)
    return found


@pytest.mark.parametrize(
    "height, width, rows, columns", [(64, 96, 2, 3), (70, 85, 2, 3), (9, 9, 1, 1)]
)
def test_a_region_has_the_mean_squared_error_of_its_pixels(height, width, rows, columns):
    rng = np.random.default_rng(0)
    render, truth = rng.integers(0, 256, (2, height, width, 3), dtype=np.uint8)
    found = region_errors(render, truth)
    assert found.shape == (rows, columns)
    for row in range(rows):
        for column in range(columns):
            part = (
                slice(32 * row, None if row == rows - 1 else 32 * (row + 1)),
                slice(32 * column, None if column == columns - 1 else 32 * (column + 1)),
            )
            expected = np.mean((render[part].astype(int) - truth[part]) ** 2)
            assert found[row, column] == pytest.approx(expected)


def test_the_psnr_of_a_perfect_region_is_finite():
    assert region_psnr(np.array([100.0]))[0] == pytest.approx(28.13, abs=0.01)
    assert np.isfinite(region_psnr(np.zeros(1)))[0]


@pytest.mark.parametrize("degrees, prior_degrees", [(2, 4.0), (3, 8.0)])
def test_the_prior_is_found_again_from_variances_drawn_from_it(degrees, prior_degrees):
    """Smyth's model: 1/σ² is scaled χ² of d0, s² is scaled χ² of d."""
    rng = np.random.default_rng(1)
    true = 0.3 * prior_degrees / rng.chisquare(prior_degrees, 200_000)
    found, variance = prior_of(true * rng.chisquare(degrees, len(true)) / degrees, degrees)
    assert found == pytest.approx(prior_degrees, rel=0.05)
    assert variance == pytest.approx(0.3, rel=0.02)


def test_equal_variances_have_a_prior_that_is_known_exactly():
    rng = np.random.default_rng(2)
    drawn = 2.0 * rng.chisquare(4, 50) / 4
    drawn = np.sort(drawn)[10:-10]  # less spread than chance gives
    found, variance = prior_of(drawn, 4)
    assert np.isinf(found)
    logs = np.log(drawn) - special.digamma(2.0) + np.log(2.0)
    assert variance == pytest.approx(np.exp(logs.mean()))


def test_discoveries_are_those_of_scipys_adjusted_p():
    rng = np.random.default_rng(3)
    p = [rng.uniform(size=(4, 5)) ** 3, rng.uniform(size=(2, 7)) ** 2]
    adjusted = stats.false_discovery_control(np.concatenate([each.ravel() for each in p]))
    lit = np.concatenate([each.ravel() for each in discoveries(p, 0.1)])
    assert 0 < lit.sum() < len(lit)
    np.testing.assert_array_equal(lit, adjusted <= 0.1)


def test_without_a_common_shift_p_is_that_of_the_moderated_t():
    """Smyth's equations 3 to 6 restated, where scene and views differ by nothing."""
    rng = np.random.default_rng(4)
    rows = rng.normal(size=(3, 400)) * rng.gamma(3, 1, 400)
    rows -= rows.mean(axis=1, keepdims=True)  # no common shift
    found = _p_values([rows])[0]
    own = rows.var(axis=0, ddof=1)
    d0, s0 = prior_of(own, 2)
    moderated = (2 * own + d0 * s0) / (2 + d0)
    t = rows.mean(axis=0) / np.sqrt(moderated / 3)
    np.testing.assert_allclose(found, 2 * stats.t.sf(np.abs(t), 2 + d0), rtol=1e-6)


def test_regions_with_an_effect_light_up_and_the_others_do_not():
    rng = np.random.default_rng(5)
    found = compare_regions(trials(rng, 4, effect=4.0), trials(rng, 4))
    lit = dict(zip(found, discoveries([view.p for view in found.values()]), strict=True))
    assert lit["a"][:2].mean() > 0.8
    assert found["a"].change[:2].mean() == pytest.approx(4.0, abs=0.3)
    others = np.concatenate([lit["a"][2:].ravel(), lit["b"].ravel(), lit["c"].ravel()])
    assert others.mean() < 0.05
    assert found["b"].spread.mean() == pytest.approx(0.5, rel=0.3)


def test_too_few_seeds_and_other_views_are_refused():
    rng = np.random.default_rng(6)
    with refusal("needs 3 pairs of seeds, got 2"):
        compare_regions(trials(rng, 2), trials(rng, 2))
    other = [{"a": errors["a"]} for errors in trials(rng, 3)]
    with refusal("other test views"):
        compare_regions(trials(rng, 3), other)


@pytest.mark.parametrize(
    "seeds, noise",
    [
        (3, {"common": 0.2, "smooth": True}),
        (4, {"of_view": 0.5}),
        *(
            pytest.param(seeds, noise, marks=pytest.mark.slow)
            for seeds in (3, 4)
            for noise in ({}, {"common": 0.5}, {"smooth": True})
        ),
    ],
    ids=str,
)
def test_trainings_of_one_arm_light_a_region_in_at_most_one_report_of_twenty(seeds, noise):
    rng, lit, reports = np.random.default_rng(8), 0, 400
    for _ in range(reports):
        found = compare_regions(trials(rng, seeds, **noise), trials(rng, seeds, **noise))
        lit += any(each.any() for each in discoveries([view.p for view in found.values()]))
    assert lit / reports <= 0.07  # 5 % and two standard errors of the simulation


def shape_of(uri):
    """Height and width of the picture in a data URI."""
    return Image.open(BytesIO(b64decode(uri.partition(",")[2]))).size[::-1]


def report_of(folder, **plan):
    write_runs(folder, scenes=("garden",), densifiers=("adc", "volumetric"), inits=("sfm",), **plan)
    ask_about(folder)
    return load_experiment(folder, "exp")


def test_the_report_maps_where_the_arm_is_better_and_where_it_is_worse(tmp_path):
    """`write_pictures`: volumetric blurs the grass at the right less, and is off in a corner."""
    experiment = report_of(tmp_path, seeds=(0, 1, 2), views=2, pictures=True)
    answers = compare(experiment).answers
    ((found,),) = region_maps(experiment.trials, answers).values()
    assert (found["scene"], found["seeds"], found["regions"]) == ("garden", 3, 2 * 4 * 5)
    assert found["better"] >= 2 * 4 * 2  # two columns of grass in each view
    assert 2 <= found["worse"] <= 2 * 4  # the corner, and parts of its neighbours
    page = build_report(experiment)
    said = f"{found['better']} of 40 regions are better, {found['worse']} worse"
    assert f"garden, 3 seeds: {said}. View {found['view']} has most of them." in page


def test_two_seeds_or_no_pictures_give_no_map(tmp_path):
    for name, plan in (
        ("two", {"seeds": (0, 1), "pictures": True}),
        ("none", {"seeds": (0, 1, 2)}),
    ):
        experiment = report_of(tmp_path / name, views=2, **plan)
        assert region_maps(experiment.trials, compare(experiment).answers) == {}
        assert "beyond noise" not in build_report(experiment)


def test_an_archive_keeps_the_errors_of_regions_in_place_of_pictures(tmp_path):
    experiment = report_of(tmp_path / "runs", seeds=(0, 1, 2), views=2, pictures=True)
    write_archive(experiment, tmp_path / "exp.zip")
    unpacked = unpack_archive(tmp_path / "exp.zip", tmp_path / "elsewhere")
    assert not list((tmp_path / "elsewhere").rglob("*.png"))
    for one, other in zip(experiment.trials, unpacked.trials, strict=True):
        for view, errors in regions_of(one).items():
            np.testing.assert_allclose(regions_of(other)[view], errors, rtol=1e-3)
    maps = [
        next(iter(region_maps(own.trials, compare(own).answers).values()))[0]
        for own in (experiment, unpacked)
    ]
    assert (maps[0]["better"], maps[0]["worse"]) == (maps[1]["better"], maps[1]["worse"])
    photograph = read_image(next(experiment.trials[0].path.glob("ground_truth/*.png")))
    # over the photograph; without one, as many whole regions
    assert [shape_of(own["lit"]) for own in maps] == [photograph.shape[:2], (4 * 32, 5 * 32)]
    assert shape_of(maps[0]["noise"]) == photograph.shape[:2]


# ---- the error in textured parts, against its definition pixel by pixel


def test_textured_error_is_the_mean_error_in_the_most_textured_fifth(tmp_path):
    """Texture grows from left to right, as steps do.

    The render is off by a tenth of the column's number.
    """
    write_runs(
        tmp_path, scenes=("garden",), densifiers=("adc",), seeds=(0,), views=1, pictures=True
    )
    (trial,) = trials_of(tmp_path)
    column = np.arange(100)
    truth = np.repeat((9 + column**2 // 50)[None], 20, axis=0)
    render = truth - column // 10
    for folder, pixels in (("ground_truth", truth), ("renders", render)):
        picture = np.repeat(pixels[..., None], 3, axis=2).astype(np.uint8)
        Image.fromarray(picture).save(trial.path / f"{folder}/view000.png")
    assert textured_error(trial) == pytest.approx(8.5, abs=0.2)  # of the last twenty columns
    counts = np.full((20, 100), 255, np.uint8)
    counts[:, 50:] = 0
    (trial.path / MASKS).mkdir()
    Image.fromarray(counts).save(trial.path / f"{MASKS}/view000.png")
    # the last ten columns of the left half
    assert textured_error(trial) == pytest.approx(4.0, abs=0.2)
    for picture in (trial.path / "renders").iterdir():
        picture.unlink()
    with refusal("holds no renders"):
        textured_error(trial)
    write(trial.path / FROM_PIXELS, {"error_textured": 3.25})
    assert textured_error(trial) == 3.25
