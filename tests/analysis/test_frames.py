"""Verdicts on a table of another trainer's results, by SciPy and by hand."""

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from gsbench.analysis import judge
from gsbench.analysis.sentences import badge
from tests.helpers import refusal

rng = np.random.default_rng(0)
FRAME = pd.DataFrame(
    [
        (method, scene, seed, 26 + gain + rng.normal(0, 0.1), 3.0 - gain)
        for method, gain in (("base", 0.0), ("mine", 0.5), ("other", 0.0))
        for scene in ("garden", "room")
        for seed in range(3)
    ],
    columns=["method", "scene", "seed", "psnr", "blur"],
)


def test_each_method_is_judged_against_the_baseline():
    found = judge(FRAME, "base", "psnr")
    assert {name: badge(one) for name, one in found.items()} == {
        "mine": "BETTER",
        "other": "UNDECIDED",
    }
    one_scene = FRAME[FRAME.scene == "garden"]
    verdict = judge(one_scene, "base", "psnr")["mine"]
    values = {name: own.psnr.to_numpy() for name, own in one_scene.groupby("method")}
    expected = stats.ttest_rel(values["mine"], values["base"]).confidence_interval(0.95)
    assert (verdict.interval.low, verdict.interval.high) == pytest.approx(expected)


def test_order_of_rows_and_further_methods_change_nothing():
    shuffled = FRAME.sample(frac=1, random_state=1)
    alone = FRAME[FRAME.method != "other"]
    intervals = [
        judge(frame, "base", "psnr")["mine"].interval for frame in (FRAME, shuffled, alone)
    ]
    assert intervals[0].low == pytest.approx(intervals[1].low) == pytest.approx(intervals[2].low)


def test_a_least_difference_may_be_a_part_and_directions_of_own_metrics_are_given():
    part = judge(FRAME, "base", "psnr", least="50%")
    assert badge(part["mine"]) == "TOO SMALL"
    assert badge(judge(FRAME, "base", "blur", direction=-1)["mine"]) == "BETTER"


def test_a_missing_seed_costs_its_pair_only():
    lacking = FRAME.drop(FRAME[(FRAME.method == "mine") & (FRAME.seed == 2)].index)
    verdict = judge(lacking, "base", "psnr")["mine"]
    assert (verdict.pairs.seeds, verdict.question.trials) == (2, 8)


@pytest.mark.parametrize(
    "method, places, said",
    [
        ("mine", [("garden", 2)], "UNDECIDED"),
        ("mine", [("garden", 0)], "UNDECIDED"),
        ("mine", [("garden", seed) for seed in range(3)], "UNDECIDED"),  # of a scene, all rows
        ("base", [("garden", 2)], "BETTER"),  # what the favoured arm has, the other one lacks
        ("other", [("garden", 2)], "BETTER"),  # another question's row
    ],
)
@pytest.mark.parametrize("rename", [{}, {"garden": "a/b"}])
def test_a_row_that_one_arm_lacks_counts_as_its_failed_training(method, places, said, rename):
    gone = [
        index
        for index, row in FRAME.iterrows()
        if row.method == method and (row.scene, row.seed) in places
    ]
    for frame in (FRAME.drop(gone), FRAME.assign(psnr=FRAME.psnr.mask(FRAME.index.isin(gone)))):
        renamed = frame.assign(scene=frame.scene.replace(rename))
        assert badge(judge(renamed, "base", "psnr")["mine"]) == said


@pytest.mark.parametrize(
    "frame, words, said",
    [
        (FRAME.drop(columns="seed"), ("base", "psnr"), "no column 'seed'"),
        (FRAME.iloc[:0], ("base", "psnr"), "no rows"),
        (FRAME, ("base", "psnr", None, -1), "higher values are better: leave --better out"),
        (pd.concat([FRAME, FRAME[:1]]), ("base", "psnr"), "base, garden, seed 0 is twice"),
    ],
)
def test_a_table_that_cannot_be_judged_is_refused_in_one_line(frame, words, said):
    with refusal(said):
        judge(frame, *words)
