"""Stopping when decided, against scipy's multivariate normal, plain simulation with scipy's t test, and by rule."""

from __future__ import annotations

import importlib.util
import sys

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from gsbench.claims.sequential import Design, decide, most_seeds, plan_looks, spending, t_bounds
from gsbench.errors import InputError
from tests.conftest import ROOT

spec = importlib.util.spec_from_file_location("stopping_rates", ROOT / "scripts" / "stopping_rates.py")
assert spec is not None
assert spec.loader is not None
rates = importlib.util.module_from_spec(spec)
sys.modules[spec.name] = rates  # where its dataclasses look their types up
spec.loader.exec_module(rates)


# --- the bounds


def test_with_many_units_the_bounds_are_those_of_the_normal() -> None:
    """The chance to stay inside all bounds, by scipy's integral over the joint normal of the looks."""
    looks = (200, 400, 600, 800)
    bounds = np.array(t_bounds(5, looks, 0.05))
    for count in range(1, len(looks) + 1):
        shares = np.array(looks[:count]) / looks[-1]
        covariance = np.sqrt(np.minimum.outer(shares, shares) / np.maximum.outer(shares, shares))
        normal = scipy.stats.multivariate_normal(np.zeros(count), covariance)
        inside = normal.cdf(bounds[:count], lower_limit=-bounds[:count])
        assert 1 - inside == pytest.approx(spending(shares[-1], 0.05), abs=0.001)


@pytest.mark.parametrize(("scenes", "looks"), [(1, (2, 3, 5)), (4, (2, 3, 4)), (6, (2, 3, 4)), (8, (2, 6))])
def test_with_few_units_what_is_spent_is_what_was_planned(scenes: int, looks: tuple[int, ...]) -> None:
    design, count = Design(scenes, looks), 100_000
    values = np.random.default_rng(5).normal(0, 1, (count, scenes, looks[-1]))
    inside = np.ones(count, dtype=bool)
    for seeds, bound in zip(looks, design.bounds(), strict=True):
        units = values[:, :, :seeds].mean(axis=2) if scenes >= 6 else values[:, :, :seeds].reshape(count, -1)
        inside &= np.abs(scipy.stats.ttest_1samp(units, 0, axis=1).statistic) < bound
        expected = spending(seeds / looks[-1], 0.05)
        assert 1 - inside.mean() == pytest.approx(expected, abs=4 * (expected / count) ** 0.5 + 0.0006)


def test_a_single_look_is_the_ordinary_test() -> None:
    assert t_bounds(3, (4,), 0.05)[0] == pytest.approx(scipy.stats.t.ppf(0.975, 11))
    assert t_bounds(7, (4,), 0.05)[0] == pytest.approx(scipy.stats.t.ppf(0.975, 6))


def test_a_smaller_error_rate_asks_for_more_at_every_look() -> None:
    strict, loose = (t_bounds(4, (2, 3, 4, 6), alpha) for alpha in (0.01, 0.05))
    assert all(one > other for one, other in zip(strict, loose, strict=True))


# --- looks


def test_looks_are_planned_up_to_the_most_seeds() -> None:
    assert plan_looks(2) == (2,)
    assert plan_looks(5) == (2, 3, 4, 5)
    assert plan_looks(12) == tuple(range(2, 13))
    assert plan_looks(19) == (*range(2, 13), 16, 19)
    assert [most_seeds(fixed) for fixed in (1, 2, 3, 4, 6, 9, 10)] == [2, 2, 3, 5, 7, 11, 13]


@given(st.integers(2, 60))
def test_looks_rise_to_the_end(maximum: int) -> None:
    looks = plan_looks(maximum)
    assert looks[0] == 2
    assert looks[-1] == maximum
    assert list(looks) == sorted(set(looks))


@pytest.mark.parametrize(
    ("scenes", "looks", "alpha"),
    [(0, (2, 3), 0.05), (1, (), 0.05), (1, (1, 2), 0.05), (1, (3, 3), 0.05), (1, (4, 2), 0.05), (1, (2,), 0.0)],
)
def test_designs_that_cannot_be_are_refused(scenes: int, looks: tuple[int, ...], alpha: float) -> None:
    with pytest.raises(InputError):
        Design(scenes, looks, alpha)
    with pytest.raises(InputError):
        plan_looks(1)


# --- decisions

NOISE = np.random.default_rng(0).normal(0, 0.05, (4, 8))
DESIGN = Design(4, plan_looks(8))


@pytest.mark.parametrize(
    ("effect", "sign", "least", "outcome"),
    [
        (1.0, 1, 0.5, "for"),
        (1.0, -1, 0.5, "against"),
        (-1.0, -1, 0.5, "for"),
        (0.0, 1, 0.5, "equivalent"),
        (0.3, 1, 0.5, "equivalent"),  # there for sure, and too small to matter
        (0.0, 1, 0.001, "undecided"),
    ],
)
def test_each_kind_of_verdict(effect: float, sign: int, least: float, outcome: str) -> None:
    found = decide(list(effect + NOISE), DESIGN, least, sign)
    assert found.outcome == outcome
    assert found.trials == 2 * 4 * found.seeds
    assert found.interval is not None
    assert found.interval.low < effect < found.interval.high


def test_a_large_effect_stops_early_and_what_comes_later_changes_nothing() -> None:
    found = decide(list(1.0 + NOISE), DESIGN, 0.5)
    assert found.seeds == 2
    later = 1.0 + NOISE
    later[:, 2:] = -5.0
    assert decide(list(later), DESIGN, 0.5) == found


def test_a_look_waits_for_the_slowest_scene() -> None:
    rows = list(1.0 + NOISE)
    assert decide([row[:1] for row in rows], DESIGN, 0.5).outcome == "open"
    assert decide([rows[0][:1], *rows[1:]], DESIGN, 0.5).outcome == "open"
    assert decide([rows[0][:2], *rows[1:]], DESIGN, 0.5).outcome == "for"


def test_trials_that_differ_in_nothing_are_decided() -> None:
    """Under a hard cap all counts are one number: no noise, and no interval to speak of."""
    assert decide([np.zeros(2)] * 4, DESIGN, 0.5).outcome == "equivalent"
    assert decide([np.full(2, 0.7)] * 4, DESIGN, 0.5).outcome == "for"
    assert decide([np.full(2, 0.7)] * 4, DESIGN, 0.5, -1).outcome == "against"


def test_bad_questions_are_refused() -> None:
    with pytest.raises(InputError, match="above 0"):
        decide(list(NOISE), DESIGN, 0.0)
    with pytest.raises(InputError, match="above 0"):
        decide(list(NOISE), DESIGN, float("nan"))
    with pytest.raises(InputError, match="4 scenes"):
        decide(list(NOISE[:3]), DESIGN, 1.0)


# --- rates: a small version of the tables of docs/verdict.md

SWEEPS = 400
LIMIT = 0.05 + 3 * (0.05 * 0.95 / SWEEPS) ** 0.5  # three standard errors above the stated rate


@pytest.mark.parametrize(("scenes", "fixed"), [(1, 9), (4, 6), (8, 6)])
def test_errors_stay_below_the_stated_rate_and_trials_are_saved(scenes: int, fixed: int) -> None:
    size = rates.Size(scenes, fixed)
    none, least, twice = (rates.sweeps(size, effect, SWEEPS) for effect in (0.0, 1.0, 2.0))
    assert rates.share(none, "for", "against") < LIMIT
    assert rates.share(least, "equivalent", "against") < LIMIT
    assert rates.share(least, "for") > 0.6
    assert rates.share(twice, "for") > 0.95
    assert max(decision.seeds for decision, _ in none + least + twice) <= 1.3 * fixed
    if scenes > 1:
        assert np.mean([decision.seeds for decision, _ in twice]) < 0.55 * fixed


def test_sharing_the_rate_holds_it_over_six_correlated_claims() -> None:
    size = rates.Size(3, 3)
    assert rates.any_of_many(size, SWEEPS, together=True) < LIMIT
    assert rates.any_of_many(size, SWEEPS, together=False) > 0.09


def test_the_page_has_the_tables_that_the_script_writes() -> None:
    """The heads of the tables, whose numbers take minutes to make."""
    page = rates.PAGE.read_text(encoding="utf-8")
    found = {match[2]: match[0] for match in rates.SECTION.finditer(page)}
    assert found.keys() == rates.TABLES.keys()
    for name, table in rates.TABLES.items():
        made = table(2)
        assert made[0] in found[name]
        assert len(made) == len(found[name].splitlines()) - 2
