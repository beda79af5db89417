"""Meta-analysis against published values: the BCG trials (Colditz et al. 1994) as metafor's documentation has them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from gsbench.claims.pooling import Study, describe, mean_of, pool, pooled_forest, restricted_likelihood_tau2
from gsbench.errors import InputError

# (tuberculosis, none) of the vaccinated and of the others, by trial
BCG = (
    *((4, 119, 11, 128), (6, 300, 29, 274), (3, 228, 11, 209), (62, 13536, 248, 12619), (33, 5036, 47, 5761)),
    *((180, 1361, 372, 1079), (8, 2537, 10, 619), (505, 87886, 499, 87892), (29, 7470, 45, 7232), (17, 1699, 65, 1600)),
    *((186, 50448, 141, 27197), (5, 2493, 3, 2338), (27, 16886, 29, 17825)),
)


def log_risk_ratio(name: str, a: int, b: int, c: int, d: int) -> Study:
    error = math.sqrt(1 / a - 1 / (a + b) + 1 / c - 1 / (c + d))
    return Study(name, math.log(a / (a + b) / (c / (c + d))), error)


STUDIES = [log_risk_ratio(f"trial {k}", *counts) for k, counts in enumerate(BCG)]


def test_published_values_of_the_bcg_trials() -> None:
    """metafor's rma(yi, vi, method="REML", test="knha") of dat.bcg."""
    found = pool(STUDIES)
    assert found.mean == pytest.approx(-0.7145, abs=5e-5)
    assert found.tau2 == pytest.approx(0.3132, abs=5e-5)
    assert found.q == pytest.approx(152.2330, abs=5e-5)
    assert found.i2 == pytest.approx(0.9222, abs=5e-5)
    assert found.interval is not None
    assert found.interval.high - found.interval.low == pytest.approx(2 * 2.1788 * 0.1807, abs=5e-4)
    assert found.q_p is not None
    assert found.q_p < 1e-20
    assert sum(found.weights) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("tau2", "mean", "error"),
    [
        (0.30876026286237634, -0.7141172220732269, 0.18069662833554745),
        (0.3180684522038206, -0.714968153493337, 0.18089219153759872),
    ],
    ids=["DerSimonian and Laird", "Paule and Mandel"],
)
def test_mean_and_error_are_those_of_statsmodels(tau2: float, mean: float, error: float) -> None:
    """statsmodels 0.15.0, combine_effects(…, method_re="chi2" and "iterated"): mean_effect_re, root of var_hksj_re."""
    effects, variances = np.array([one.effect for one in STUDIES]), np.array([one.error**2 for one in STUDIES])
    assert mean_of(effects, variances, tau2) == pytest.approx((mean, error), rel=1e-9)


def test_tau_is_where_the_density_of_the_contrasts_is_largest() -> None:
    """Restricted likelihood as it is defined: the density of k - 1 contrasts, in which the mean has no part."""
    effects, variances = np.array([one.effect for one in STUDIES]), np.array([one.error**2 for one in STUDIES])
    contrasts = np.linalg.svd(np.ones((1, len(effects))))[2][1:]  # [k - 1, k], orthogonal to the mean
    grid = np.arange(0.25, 0.40, 1e-4)
    densities = [
        stats.multivariate_normal(cov=contrasts @ np.diag(variances + tau2) @ contrasts.T).logpdf(contrasts @ effects)
        for tau2 in grid
    ]
    assert restricted_likelihood_tau2(effects, variances) == pytest.approx(grid[int(np.argmax(densities))], abs=1e-4)


def test_studies_that_agree_have_no_variance_between_them() -> None:
    found = pool([Study(str(k), 0.5 + 0.01 * k, 0.2) for k in range(4)])
    assert (found.tau2, found.i2) == (0.0, 0.0)
    assert found.mean == pytest.approx(0.515)
    assert found.interval is not None
    # not narrower than the plain interval, though the studies agree better than chance would have them
    assert found.interval.high - found.mean == pytest.approx(3.1824 * 0.1, abs=1e-4)
    equal = pool([Study("a", 1.0, 0.1), Study("b", 1.0, 0.1)])
    assert (equal.tau2, equal.prediction) == (0.0, None)


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    rng, held = np.random.default_rng(0), 0
    for _ in range(600):
        errors = rng.uniform(0.1, 0.5, 5)
        effects = rng.normal(1.0, 0.3, 5) + rng.normal(0, errors)
        found = pool([Study(str(k), *values) for k, values in enumerate(zip(effects, errors, strict=True))])
        assert found.interval is not None
        held += found.interval.low <= 1.0 <= found.interval.high
    assert held / 600 > 0.93


def test_no_mean_where_protocols_differ() -> None:
    studies = [Study("a", 1.0, 0.1, {"protocol": "paper-1"}), Study("b", 1.1, 0.1, {"protocol": "standard-1"})]
    found = pool(studies)
    assert found.mean is None
    assert found.refusal == "the studies differ in protocol (a: paper-1; b: standard-1)"
    assert describe(found) == [f"no mean: {found.refusal}"]
    assert "all together" not in pooled_forest(found, "t", "x")
    unknown = pool([studies[0], Study("c", 1.0, 0.1)])
    assert "c: unknown" in unknown.refusal
    assert pool([studies[0], Study("c", 1.0, 0.1, {"protocol": "paper-1"})]).mean == pytest.approx(1.0)


def test_one_study_is_no_pool_and_two_of_one_name_are_refused() -> None:
    assert pool(STUDIES[:1]).mean is None
    assert pool([]).mean is None
    with pytest.raises(InputError, match="twice"):
        pool([STUDIES[0], STUDIES[0]])
    for study in (Study("a", float("nan"), 1.0), Study("a", 1.0, 0.0), Study("a", 1.0, float("inf"))):
        with pytest.raises(InputError, match=r"^a: "):
            pool([study, STUDIES[0]])


def test_the_forest_plot_has_a_row_for_each_study_and_the_mean() -> None:
    text = pooled_forest(pool(STUDIES), "BCG", "log risk ratio", -1)
    assert all(f"trial {k}" in text for k in range(13))
    assert "all together" in text
    assert any("a further study" in line for line in describe(pool(STUDIES)))
