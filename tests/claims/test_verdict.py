"""Verdicts from result files with known effects: each word, and what must not become one."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gsbench.claims.file import Claim, ClaimsFile, parse_claims
from gsbench.claims.verdict import Pair, PairKey, judge_claim
from tests.claims.test_file import changed

Pairs = dict[PairKey, Pair]
MakePairs = Callable[..., Pairs]
SCENES = ("courtyard", "garden")


def claim_with(**changes: Any) -> tuple[Claim, ClaimsFile]:
    content = changed("scenes", to={"courtyard": None, "garden": None})
    content["claims"][0] |= {"metric": "psnr", "direction": "higher", "least": 0.3} | changes
    file = parse_claims(content)
    return file.claims[0], file


@pytest.mark.parametrize(
    ("effect", "direction", "word", "reason"),
    [
        (1.0, "higher", "supported", "higher"),
        (1.0, "lower", "refuted", "contrary"),
        (-1.0, "lower", "supported", "lower"),
        (0.0, "higher", "refuted", "smaller than the least"),
        (0.0, "same", "supported", "smaller than the least"),
        (1.0, "same", "refuted", "more than 0.3"),
    ],
)
def test_each_word(make_pairs: MakePairs, effect: float, direction: str, word: str, reason: str) -> None:
    claim, file = claim_with(direction=direction)
    pairs = make_pairs(effect={"psnr": effect}, seeds=range(4), trial_noise=0.03, residual_noise=0.01)
    found = judge_claim(claim, file, pairs, SCENES)
    assert found.word == word
    assert reason in found.reason
    assert found.decision is not None
    assert found.decision.interval is not None
    assert found.decision.interval.low < effect < found.decision.interval.high
    assert len(found.trials) == found.decision.trials
    assert found.baseline == pytest.approx(26.0, abs=3.0)
    assert [scene for scene, _ in found.by_scene] == list(SCENES)
    assert found.beforehand


def test_noise_is_undecided_after_the_last_seed_and_open_before(make_pairs: MakePairs) -> None:
    claim, file = claim_with(least=0.01)
    pairs = make_pairs(seeds=range(4), trial_noise=0.5)
    assert "all 4 seeds" in judge_claim(claim, file, pairs, SCENES).reason
    some = {key: pair for key, pair in pairs.items() if key != ("garden", 3)}
    found = judge_claim(claim, file, some, SCENES)
    assert found.word == "undecided"
    assert found.reason == "trials are missing: the next look waits for garden"


def test_a_missing_seed_stops_the_looks_and_its_return_changes_no_earlier_one(make_pairs: MakePairs) -> None:
    claim, file = claim_with()
    pairs = make_pairs(effect={"psnr": 1.0}, seeds=range(4), trial_noise=0.03, residual_noise=0.01)
    without = {key: pair for key, pair in pairs.items() if key != ("garden", 1)}
    assert "waits for garden" in judge_claim(claim, file, without, SCENES).reason
    later = {key: pair for key, pair in pairs.items() if key != ("garden", 3)}
    assert judge_claim(claim, file, later, SCENES).decision == judge_claim(claim, file, pairs, SCENES).decision


def test_counts_are_compared_as_ratios(make_pairs: MakePairs) -> None:
    claim, file = claim_with(metric="gaussians", least="10%")
    found = judge_claim(claim, file, make_pairs(seeds=range(4)), SCENES)  # 20,000 and 26,000
    assert found.word == "supported"
    assert found.decision is not None
    assert found.decision.mean == pytest.approx(np.log(1.3), abs=1e-3)
    assert found.shown(found.decision.mean) == "+30.0 %"
    few = judge_claim(*claim_with(metric="gaussians", least="50%"), make_pairs(seeds=range(4)), SCENES)
    assert few.word == "refuted"


def test_a_sure_sign_is_not_yet_the_least_effect(make_pairs: MakePairs) -> None:
    pairs = make_pairs(effect={"psnr": 1.0}, seeds=range(4), trial_noise=0.03, residual_noise=0.01)
    sure = judge_claim(*claim_with(least=0.3), pairs, SCENES)
    open_yet = judge_claim(*claim_with(least=0.99), pairs, SCENES)
    assert (sure.word, sure.reason) == ("supported", "it is higher")
    assert (open_yet.word, open_yet.reason) == ("supported", "it is higher; whether by 0.99 or more is open")


def test_what_cannot_be_tested_says_why(make_pairs: MakePairs) -> None:
    pairs = make_pairs(seeds=range(4))
    claim, file = claim_with(not_testable="too large")
    assert judge_claim(claim, file, pairs, SCENES).reason == "too large"
    claim, file = claim_with()
    assert judge_claim(claim, file, {}, ()).word == "not testable here"
    assert judge_claim(claim, file, {}, SCENES).word == "undecided"  # they can be run, and were not
    claim, file = claim_with(metric="lpips_alex")
    found = judge_claim(claim, file, pairs, SCENES)
    assert (found.word, found.decision) == ("not testable here", None)
    assert "weights file alexnet.pth not found" in found.reason


def test_arms_under_other_conditions_are_not_compared(make_pairs: MakePairs) -> None:
    claim, file = claim_with()
    pairs = make_pairs(effect={"psnr": 1.0}, seeds=range(4))
    for one, _ in pairs.values():
        object.__setattr__(one.record, "iterations", 7000)
    found = judge_claim(claim, file, pairs, SCENES)
    assert found.word == "not testable here"
    assert "differ in iterations" in found.reason


def test_a_plan_that_came_after_results_loses_its_place(make_pairs: MakePairs) -> None:
    claim, file = claim_with()
    pairs = make_pairs(effect={"psnr": 1.0}, seeds=range(4), trial_noise=0.03, residual_noise=0.01)
    before = judge_claim(claim, file, pairs, SCENES, declared_at=time.time() - 3600)
    after = judge_claim(claim, file, pairs, SCENES, declared_at=time.time() + 3600)
    assert before.beforehand
    assert not before.notes
    assert not after.beforehand
    assert "measured before this plan" in after.notes[0]
    assert before.design is not None
    assert after.design is not None
    assert after.design.alpha == pytest.approx(before.design.alpha / 4)  # four metrics were measured


def test_tests_share_the_error_rate(make_pairs: MakePairs) -> None:
    claim, file = claim_with()
    pairs = make_pairs(seeds=range(4))
    shared = judge_claim(claim, file, pairs, SCENES, sharing=5)
    assert shared.design is not None
    assert shared.design.alpha == pytest.approx(0.01)


def test_error_in_textured_parts_sees_the_blurred_grass(make_pairs: MakePairs) -> None:
    claim, file = claim_with(metric="error_textured", direction="lower", least="2%")
    pairs = make_pairs(seeds=range(2), pictures=True, scenes=("courtyard",), views=2)
    file = replace(file, seeds=2)
    found = judge_claim(replace(claim, scenes=["courtyard"]), file, pairs, ["courtyard"])
    assert found.word == "supported"  # "adc" blurs the grass more
    for one, _ in pairs.values():
        for picture in (one.path / "renders").glob("*.png"):
            picture.unlink()
    assert "renders" in judge_claim(replace(claim, scenes=["courtyard"]), file, pairs, ["courtyard"]).reason


def test_arms_that_are_one_and_the_same_refute_nothing(make_pairs: MakePairs) -> None:
    """A training that ends before a rule first acts says nothing about the rule."""
    pairs = make_pairs(seeds=range(4))
    twins = {key: (one, replace(other, record=one.record)) for key, (one, other) in pairs.items()}
    for changes in ({}, {"direction": "same"}, {"metric": "train_time", "least": "10%"}):
        found = judge_claim(*claim_with(**changes), twins, SCENES)
        assert found.word == "not testable here"
        assert "equal to the last bit" in found.reason
        assert found.decision is None
    one_differs = {**twins, ("garden", 0): pairs["garden", 0]}
    assert judge_claim(*claim_with(), one_differs, SCENES).word != "not testable here"
    capped = {  # counts alone are equal
        key: (one, replace(other, record=replace(other.record, num_gaussians=one.record.num_gaussians)))
        for key, (one, other) in pairs.items()
    }
    assert judge_claim(*claim_with(metric="gaussians", least="10%"), capped, SCENES).word == "refuted"
