"""The mean of many studies: Student's t over them, refused where protocols are unlike."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from gsbench.analysis.statistics import Interval
from gsbench.claims.pooling import Study, describe, pool, pooled_forest
from gsbench.errors import InputError

EFFECTS = (0.5, 0.9, 0.4, 0.7)
STUDIES = [Study(f"trial {k}", effect, Interval(effect - 0.1, effect + 0.1)) for k, effect in enumerate(EFFECTS)]


def test_studies_are_the_units() -> None:
    found, expected = pool(STUDIES), stats.ttest_1samp(EFFECTS, 0)
    interval = expected.confidence_interval()
    assert found.mean == pytest.approx(np.mean(EFFECTS))
    assert found.p == pytest.approx(expected.pvalue)
    assert found.interval is not None
    assert (found.interval.low, found.interval.high) == pytest.approx((interval.low, interval.high))
    assert found.prediction is not None
    assert found.prediction.high - found.prediction.low > found.interval.high - found.interval.low


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    """Errors of two or three seeds' making, which random-effects methods would take as known."""
    rng, held = np.random.default_rng(0), 0
    for _ in range(600):
        effects = rng.normal(1.0, 0.3, 5) + rng.normal(0, rng.uniform(0.1, 0.5, 5))
        found = pool([Study(str(k), float(effect)) for k, effect in enumerate(effects)])
        assert found.interval is not None
        held += found.interval.low <= 1.0 <= found.interval.high
    assert held / 600 > 0.95 - 3 * (0.05 * 0.95 / 600) ** 0.5


def test_no_mean_where_protocols_differ() -> None:
    studies = [Study("a", 1.0, None, {"protocol": "paper-1"}), Study("b", 1.1, None, {"protocol": "standard-1"})]
    found = pool(studies)
    assert found.mean is None
    assert found.refusal == "the studies differ in protocol (a: paper-1; b: standard-1)"
    assert describe(found) == [f"no mean: {found.refusal}"]
    assert "all together" not in pooled_forest(found, "t", "x")
    unknown = pool([studies[0], Study("c", 1.0)])
    assert "c: unknown" in unknown.refusal
    assert pool([studies[0], Study("c", 1.0, None, {"protocol": "paper-1"})]).mean == pytest.approx(1.0)


def test_one_study_is_no_pool_and_two_of_one_name_are_refused() -> None:
    assert pool(STUDIES[:1]).mean is None
    assert pool([]).mean is None
    with pytest.raises(InputError, match="twice"):
        pool([STUDIES[0], STUDIES[0]])
    with pytest.raises(InputError, match=r"^a: "):
        pool([Study("a", float("nan")), STUDIES[0]])


def test_the_forest_plot_has_a_row_for_each_study_and_the_mean() -> None:
    text = pooled_forest(pool(STUDIES), "BCG", "log risk ratio", -1)
    assert all(f"trial {k}" in text for k in range(4))
    assert "all together" in text
    assert any("a further one" in line for line in describe(pool(STUDIES)))
