"""The area between curves against shapes whose area is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from gsbench.analysis.quantities import quantity
from gsbench.analysis.results import Experiment
from gsbench.analysis.tradeoffs import Curve, curve_gap, family_curve, training_curve


def curve(cost: list[float], quality: list[float]) -> Curve:
    return Curve(np.array(cost), np.array(quality), tuple(map(str, cost)))


def test_a_shifted_curve_has_its_shift() -> None:
    cost = [1e4, 3e4, 1e5, 3e5]
    gap = curve_gap(curve(cost, [20, 22, 23, 23.5]), curve(cost, [20.4, 22.4, 23.4, 23.9]))
    assert gap.gap == pytest.approx(0.4)
    assert (gap.low, gap.high) == pytest.approx((1e4, 3e5))


def test_only_the_common_range_counts_and_nothing_is_extrapolated() -> None:
    # Quality is log10 of cost in both, and one higher in the second: equal spacing, different ranges.
    first = curve([1e3, 1e4, 1e5], [3.0, 4.0, 5.0])
    second = curve([1e4, 1e5, 1e6], [5.0, 6.0, 7.0])
    gap = curve_gap(first, second)
    assert gap.gap == pytest.approx(1.0)
    assert (gap.low, gap.high) == pytest.approx((1e4, 1e5))
    assert curve_gap(first, curve([2e5, 1e6], [1.0, 2.0])) is None
    assert curve_gap(first, curve([1e4], [1.0])) is None


def test_crossing_curves_cancel() -> None:
    gap = curve_gap(curve([1.0, 100.0], [0.0, 2.0]), curve([1.0, 100.0], [1.0, 1.0]))
    assert gap.gap == pytest.approx(0.0, abs=1e-12)


def test_a_densifier_has_a_point_for_each_variant(make_experiment: Callable[..., Experiment]) -> None:
    experiment = make_experiment()
    trials = [replace(trial, variant=(("seed", str(trial.seed)),)) for trial in experiment.trials]
    for trial in trials:
        object.__setattr__(trial.record, "num_gaussians", 1000 * (1 + trial.seed))
    psnr = quantity("psnr", trials)
    found = family_curve(trials, ("sfm", "adc"), psnr, "gaussians")
    assert found.cost.tolist() == [1000, 2000, 3000]
    expected = [
        np.mean([t.metrics["psnr"] for t in experiment.trials if t.seed == seed and t.densify == "adc"])
        for seed in range(3)
    ]
    assert found.quality.tolist() == pytest.approx(expected)


def test_training_curves_use_the_steps_that_all_trials_have(make_experiment: Callable[..., Experiment]) -> None:
    trials = [t for t in make_experiment().trials if t.densify == "adc"]
    assert len(training_curve(trials, "seconds", "psnr").cost) == 20
    lines = (trials[0].path / "metrics.jsonl").read_text().splitlines()
    (trials[0].path / "metrics.jsonl").write_text("\n".join(lines[:5]))
    assert len(training_curve(trials, "gaussians", "psnr").cost) == 5
