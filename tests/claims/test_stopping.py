"""Looks: the trials that each look needs, their order, and questions whose trials failed."""

from dataclasses import replace

import pytest

from gsbench.analysis.judgement import Verdict
from gsbench.analysis.pairing import Pairs
from gsbench.analysis.quantities import asked_quantity
from gsbench.analysis.statistics import Answer, StudentT
from gsbench.claims.stopping import KeyAndSeed, headline, run_looks, trials_of_look
from gsbench.runs.experiments import Arm, Declaration, Question

BOTH = Question(
    metric="psnr",
    baseline=Arm("sfm", "adc"),
    arm=Arm("sfm", "new"),
    scenes={"x": ("a", "b")},
    seeds=(7, 5, 6),
    sign=1,
)
DECLARATION = Declaration(
    time="2020-01-01T00:00:00Z",
    questions=(BOTH, replace(BOTH, scenes={"x": ("a", "c")}, seeds=(5, 7))),
    looks=(2, 3),
)


def verdict(final: bool) -> Verdict:
    return Verdict(BOTH, asked_quantity("psnr"), Pairs(()), final=final)


def test_trials_of_a_look_are_ordered_by_seed_and_each_is_listed_once():
    assert trials_of_look(DECLARATION, [0], 2) == [("a", 7), ("b", 7), ("a", 5), ("b", 5)]
    assert trials_of_look(DECLARATION, [1], 9) == [("a", 5), ("c", 5), ("a", 7), ("c", 7)]
    both = trials_of_look(DECLARATION, [0, 1], 1)
    assert both == [("a", 7), ("b", 7), ("a", 5), ("c", 5)]
    # the second question shares its baseline's trials
    assert len(trials_of_look(DECLARATION, [0, 1], 3)) == 3 * 2 + 2


@pytest.mark.parametrize(
    ("finals", "looked"),
    [
        ([(True, True)], []),  # decided before: nothing is run
        ([(False, True), (True, True)], [4]),
        # no pair after the first look: both questions wait for failed trials
        ([(False, False)] * 3, [6]),
    ],
)
def test_looks_end_when_nothing_can_be_decided(finals, looked):
    batches: list[list[KeyAndSeed]] = []
    answers = iter(finals)
    verdicts = run_looks(
        DECLARATION, lambda: [verdict(final) for final in next(answers)], batches.append
    )
    assert [len(batch) for batch in batches] == looked
    assert [one.final for one in verdicts] == list(finals[min(len(looked), len(finals) - 1)])


def test_the_verdict_on_a_pair_is_one_sentence():
    assert headline(verdict(False)) == "sfm-new against sfm-adc: no verdict yet, trials are missing"
    assert headline(replace(verdict(True), untestable="no scene")).endswith(
        "no verdict yet, no scene"
    )
    answer = Answer(1.0, StudentT(1.0, 0.0, 3.0), 0.05, 0.05, 0.05, 0.0)
    waits, decided = (
        headline(replace(verdict(final), answer=answer, outcome="supported", notes=("a note",)))
        for final in (0, 1)
    )
    assert "sfm-adc: not decided yet, " in waits
    assert "not decided yet" not in decided
    assert decided.endswith("with 0 of at most 3 seeds; a note")
