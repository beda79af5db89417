"""The fast simulator of ``scripts/decision_rules.py`` decides as the judge does."""

from dataclasses import replace

import numpy as np
import pytest

from gsbench.analysis import judgement
from gsbench.analysis.judgement import Verdict
from gsbench.analysis.looks import look_levels
from gsbench.analysis.pairing import Pairs
from gsbench.analysis.quantities import asked_quantity
from gsbench.analysis.statistics import t_test
from gsbench.runs.experiments import Question
from tests.analysis.untruths import KINDS, rates, scene_pairs
from tests.analysis.untruths import decision_rules as rules

OUTCOMES = ("undecided", "supported", "refuted", "too small to matter")
RATE = 0.0125
CHECKS = 100


@pytest.mark.parametrize("row", range(9))
def test_the_simulator_decides_as_the_judge_does(row):
    name, draws = list(rules.rows(np.random.default_rng(7), CHECKS))[row]
    scenes, most = draws.arm.shape[1:]
    looks = (2, 3, 4)[: most - 1]
    question = Question(metric="psnr", sign=1, least=rules.LEAST)
    for effect in (0.0, 1.0, 2.0):
        at = replace(draws, effect=effect)
        outcomes, taken = rules.decide(at, rules.CHOSEN, looks, look_levels(scenes, looks, RATE))
        for draw in range(CHECKS):
            both = np.stack([at.baseline[draw, :, :most], at.arm[draw]], axis=1)
            pairs = Pairs(tuple(scene_pairs(k, own, effect) for k, own in enumerate(both)))
            asked = Verdict(question, asked_quantity("psnr"), pairs)
            verdict = judgement._at_looks(asked, looks, RATE)
            found = OUTCOMES[outcomes[draw]], taken[draw]
            assert found == (verdict.outcome, verdict.pairs.seeds), (name, effect, draw)


def test_the_simulator_has_the_test_of_the_judge():
    draws = rules.normal(np.random.default_rng(8), np.ones((3, 2)), 4, 50)
    for seeds in (2, 3, 4):
        mean, error, shape = draws.test(rules.CHOSEN, seeds)
        p = rules.p_values(mean, error, shape)
        for draw in range(50):
            test = t_test(draws.arm[draw, :, :seeds] - draws.baseline[draw, :, :seeds])
            assert (mean[draw], error[draw], p[draw]) == pytest.approx(
                (test.mean, test.error, test.p), rel=1e-9
            )


@pytest.mark.parametrize("kind", ["normal", "one scene in eight stands out"])
def test_the_simulator_finds_the_error_rates_of_the_judge(kind):
    assert rates(KINDS[kind], 1.0, 20, fast=True) == rates(KINDS[kind], 1.0, 20)
