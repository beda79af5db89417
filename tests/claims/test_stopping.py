"""Looks: the trials that each look needs, their order, and questions whose trials failed."""

from dataclasses import replace
from shlex import split

import pytest

from gsbench.analysis.judgement import Verdict
from gsbench.analysis.looks import plan_looks
from gsbench.analysis.pairing import Pairs
from gsbench.analysis.quantities import asked_quantity
from gsbench.claims.stopping import SequentialTest, plan_sweep, trials_of_look
from gsbench.runs.experiments import Arm, Declaration, Question
from tests.composed import composed
from tests.helpers import refusal

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


def verdict(final):
    return Verdict(BOTH, asked_quantity("psnr"), Pairs(()), final=final)


def test_trials_of_a_look_are_ordered_by_seed_and_each_is_listed_once():
    assert trials_of_look(DECLARATION, [0], 2) == [("a", 7), ("b", 7), ("a", 5), ("b", 5)]
    assert trials_of_look(DECLARATION, [1], 9) == [("a", 5), ("c", 5), ("a", 7), ("c", 7)]
    both = trials_of_look(DECLARATION, [0, 1], 1)
    assert both == [("a", 7), ("b", 7), ("a", 5), ("c", 5)]
    # the second question shares its baseline's trials
    assert len(trials_of_look(DECLARATION, [0, 1], 3)) == 3 * 2 + 2


@pytest.mark.parametrize(
    "finals, looked",
    [
        ([(True, True)], []),  # decided before: nothing is run
        ([(False, True), (True, True)], [4]),
        # no pair after the first look: both questions wait for failed trials
        ([(False, False)] * 3, [6]),
    ],
)
def test_looks_end_when_nothing_can_be_decided(finals, looked, monkeypatch):
    batches = []
    answers = iter(finals)
    monkeypatch.setattr(
        "gsbench.claims.stopping.judge", lambda *_: [verdict(final) for final in next(answers)]
    )
    verdicts = SequentialTest(DECLARATION, list).answer(batches.append)
    assert [len(batch) for batch in batches] == looked
    assert [one.final for one in verdicts] == list(finals[min(len(looked), len(finals) - 1)])


# ---- the looks of a sweep

WORDS = split("launch.stop_when_decided=true seed=3,1,2 eval.primary=psnr densify=adc,mcmc")


@pytest.mark.usefixtures("runs")
def test_each_pair_of_arms_is_a_question_about_the_primary_metric():
    trials = composed([*WORDS, "scene=courtyard", "densify=adc,mcmc,volumetric"])
    stopping = plan_sweep(trials)
    first, second = stopping.declaration.questions
    assert (first.metric, first.sign, first.least) == ("psnr", 1, 0.1)
    assert {str(one.arm) for one in (first, second)} == {"sfm-mcmc", "sfm-volumetric"}
    assert {str(one.baseline) for one in (first, second)} == {"sfm-adc"}
    assert first.seeds == (3, 1, 2)
    assert stopping.declaration.looks == plan_looks(3)
    assert stopping.home == trials[0].files.home
    assert {key: trial.values["seed"] for key, trial in stopping.trials.items()} == {
        key: key[1] for key in stopping.trials
    }
    assert len(stopping.trials) == len(trials)
    assert stopping.describe() == (
        "stops when decided, by psnr and a least difference of 0.1: 2 pairs of arms, looks at 2, 3 "
        "seeds, 6 trials until the first, 9 at most"
    )
    control = plan_sweep(
        composed([*WORDS, "densify=adc,mcmc,volumetric", "+eval.controls={volumetric: mcmc}"])
    )
    asked = [(str(one.arm), str(one.baseline)) for one in control.declaration.questions]
    assert asked[2:] == [("sfm-volumetric", "sfm-mcmc")]
    (own,) = plan_sweep(composed([*WORDS, "launch.least_difference=0.25"])).declaration.questions
    assert own.least == 0.25


@pytest.mark.usefixtures("runs")
@pytest.mark.parametrize(
    "words, message",
    [
        ([*WORDS, "name=a,b"], "all trials of the sweep need one name and one eval.primary"),
        ([*WORDS, "eval.primary=null"], "needs the metric that decides"),
        ([*WORDS, "eval.primary=fps", "eval.fps=[64,64]"], "fps has no usual least difference"),
        ([*WORDS, "densify=adc"], "compares arms, and this sweep has one: give two densifiers"),
    ],
)
def test_a_sweep_that_cannot_be_tested_in_looks_is_refused(words, message):
    with refusal(message):
        composed(words)


@pytest.mark.usefixtures("runs")
def test_arms_of_a_sweep_in_looks_share_scenes_and_seeds():
    """Joined grids may give them other ones."""
    adc, mcmc = (
        [one for one in composed([*WORDS, seeds]) if one.values["densify"]["name"] == name]
        for name, seeds in (("adc", "seed=0,1"), ("mcmc", "seed=2,3"))
    )
    with refusal("sfm-mcmc on courtyard has 2, 3, others 0, 1"):
        plan_sweep([*adc, *mcmc])
    for trial in mcmc:
        trial.values["scene"]["name"] = "garden"
        trial.values["seed"] -= 2
    with refusal("sfm-mcmc and sfm-adc have no scene in common"):
        plan_sweep([*adc, *mcmc])
