"""Many ideas under one error rate: what passes on to a test, the level of the test, its result.

An idea is first compared on the seeds of the ledger, which all ideas share (`screening_of`). This
cannot keep it: the next idea may follow from the results of all before, so these seeds have been
looked at, and what looks best on them is partly their luck. An idea that looks better is tested on
new seeds, on which it and its baseline are trained (`next_test`). Whatever was chosen before, the
test of an idea that is no better keeps it with at most its level.

The levels are LOND's (Javanmard and Montanari 2015, arXiv 1502.06197, eq. 3): the n-th test has
``rate * (kept + 1) * w(n)`` with weights that sum to 1. Then the false discovery rate is at most
``rate``: a false discovery is one of at least ``kept + 1`` in the end, so its expected share is at
most ``rate * w(n)``. ``kept`` counts what was kept before the test began, so tests may run side by
side. `scripts/ledger_rates.py` simulates it (findings/simulations.md).
"""

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

from gsbench.analysis.notes import Note
from gsbench.analysis.quantities import COSTS, relative_change
from gsbench.analysis.questions import plan_looks
from gsbench.analysis.results import Arm, TrialResult
from gsbench.analysis.sentences import least_words, reason, with_notes
from gsbench.analysis.statistics import REFUTED, SUPPORTED, TOO_SMALL
from gsbench.analysis.verdicts import Verdict
from gsbench.claims.stopping import SequentialTest
from gsbench.errors import InputError
from gsbench.runs.commands import ERROR_RATE, Question
from gsbench.runs.ledger import (
    BASELINE,
    DROPPED,
    FAILED,
    KEPT,
    UNDECIDED,
    Confirmed,
    Confirming,
    Difference,
    Ended,
    Ledger,
    Opened,
    Promoted,
    Result,
)
from gsbench.words import counted, listed

IDEAS, RATE = 40, 0.1  # the defaults of a ledger
# The chance, at each look, that an idea as good as the least difference that matters is given up.
# It costs power and cannot make a false discovery.
GIVE_UP = 0.05
# The chance that an idea without an effect passes on to its test, over all looks. Half of it or
# twice as much finds about as many good ideas (findings/simulations.md).
SCREEN = 0.1
LOOKS_WORSE = "looks worse"  # by this rate, which is no verdict's
SEEDS_FROM, SEEDS_TO = 100_000, 1_000_000  # of tests


def check_ideas_left(ledger: Ledger) -> None:
    """Raise InputError unless another idea may be tried."""
    if ledger.tried >= ledger.opened.ideas:
        raise InputError(
            f"all {ledger.opened.ideas} planned ideas were tried, so the error rate is spent: "
            "begin another ledger, with another baseline or other captures"
        )
    if ledger.shares_seeds:
        raise InputError(
            "an earlier version of gsbench tested the ideas of this ledger on seeds that all of "
            "them share: begin another ledger"
        )


def next_test(ledger: Ledger, idea: str, time: str) -> Promoted:
    """The test of an idea that looks better."""
    number = len(ledger.tests) + 1
    return Promoted(
        time=time,
        idea=idea,
        level=level_of_test(ledger.opened.rate, ledger.opened.ideas, number, len(ledger.kept)),
        seeds=_new_seeds(ledger, idea),
    )


def level_of_test(rate: float, ideas: int, number: int, kept: int) -> float:
    """The level of the test ``number`` (from 1) after ``kept`` ideas were kept.

    The weights ``1 / number`` give the first tests more than equal weights would: few ideas of the
    planned ones pass on to a test, and each kept one raises the levels after it.
    """
    return rate * (kept + 1) / number / sum(1 / test for test in range(1, ideas + 1))


def _new_seeds(ledger: Ledger, idea: str) -> tuple[int, ...]:
    """As many seeds as the ledger has, in a row, of which no trial of it has one.

    The row begins where the hash of all lines before says, so another ledger on the same captures
    has other seeds.
    """
    count, text = len(ledger.opened.seeds), f"{ledger.head} {idea}"
    while True:
        text = hashlib.sha256(text.encode()).hexdigest()
        first = SEEDS_FROM + int(text, 16) % (SEEDS_TO - SEEDS_FROM - count)
        seeds = tuple(range(first, first + count))
        if not ledger.has_seen(seeds):
            return seeds


def screening_of(ledger: Ledger, idea: str) -> Question:
    """The question whether an idea looks better on the seeds of all ideas, in looks."""
    started = ledger.started[idea]
    level = SCREEN if started.level is None else started.level
    return _in_looks(ledger, idea, ledger.opened.seeds, level)


def test_of(ledger: Ledger, idea: str) -> Question:
    """The question of an idea's test, in looks on its new seeds."""
    test = ledger.tests[idea]
    return _in_looks(ledger, idea, test.seeds, test.level)


def _in_looks(ledger: Ledger, idea: str, seeds: tuple[int, ...], level: float) -> Question:
    """An idea passes by one side of the interval, so the interval has twice the level."""
    started = ledger.started[idea]
    question = _question(
        ledger.opened,
        (started.against, ledger.keys_of(started.against)),
        (idea, started.keys),
        seeds,
    )
    return replace(question, looks=plan_looks(len(seeds)), level=min(1.0, 2 * level))


def confirmation_of(opened: Opened, confirming: Confirming) -> list[Question]:
    """The questions of a confirmation. All seeds are judged at once; the ideas share 5 %."""
    questions = [
        _question(opened, (BASELINE, confirming.keys[BASELINE]), (idea, keys), confirming.seeds)
        for idea, keys in confirming.keys.items()
        if idea != BASELINE
    ]
    return [replace(one, level=ERROR_RATE / len(questions)) for one in questions]


def _question(
    opened: Opened,
    baseline: tuple[str, Mapping[str, str]],
    idea: tuple[str, Mapping[str, str]],
    seeds: tuple[int, ...],
) -> Question:
    """The question of an idea against a baseline, each a name with its trials by scene."""
    (against, old), (name, new) = baseline, idea
    # The baseline's trials are older than the question, as those of a gate are.
    return Question(
        metric=opened.metric,
        sign=opened.sign,
        least=opened.least,
        relative=opened.relative,
        baseline=Arm("", against),
        idea=Arm("", name),
        digests={scene: (old[scene], new[scene]) for scene in new},
        seeds=dict.fromkeys(new, seeds),
        rule="lond",
        versions=True,
        name=name,
    )


def ask_idea(question: Question, read: Callable[[], Iterable[TrialResult]]) -> SequentialTest:
    """The question of an idea; it ends also as soon as the idea is given up."""
    return SequentialTest(
        (question,),
        lambda: named_by_key(read()),
        lambda verdicts: result_of(verdicts[0]) != UNDECIDED,
    )


def named_by_key(trials: Iterable[TrialResult]) -> list[TrialResult]:
    """The trials as the questions of a ledger name them: by their keys."""
    return [replace(trial, alias=trial.key) for trial in trials]


def result_of(verdict: Verdict) -> Result:
    """``kept``, ``dropped`` or ``undecided``; an undecided idea may change with more seeds."""
    if verdict.outcome == SUPPORTED:
        return KEPT
    if verdict.equal or verdict.outcome in (REFUTED, TOO_SMALL) or _hopeless(verdict):
        return DROPPED
    return UNDECIDED


def _hopeless(verdict: Verdict) -> str:
    """The reason why an undecided idea is given up (`GIVE_UP`); "" if a gain is still possible."""
    if not verdict.gain_excluded(GIVE_UP):
        return ""
    return f"a gain of {least_words(verdict)} is unlikely"


def end_of(idea: str, verdict: Verdict, time: str, tested: bool = True) -> Ended:
    """The ledger's entry for a final verdict, that of a test or of the comparison before it."""
    baseline, new = verdict.pairs.of_baseline, verdict.pairs.of_arm
    ratios = {}
    for cost in ("gaussians", "train_time"):
        change = relative_change(baseline, new, COSTS[cost][1])
        ratios[cost] = None if change is None else 1 + change.of_totals
    words = _hopeless(verdict) or reason(verdict)
    if not tested and verdict.outcome == REFUTED:
        words = LOOKS_WORSE
    return Ended(
        time=time,
        idea=idea,
        result=result_of(verdict),
        reason=with_notes(words, verdict),
        seeds=verdict.pairs.seeds,
        difference=difference_of(verdict),
        gaussians=ratios["gaussians"],
        seconds=ratios["train_time"],
    )


def confirmed(number: int, verdicts: Sequence[Verdict], time: str) -> Confirmed:
    """The ledger's entry for the verdicts of the confirmation ``number``."""
    differences = {verdict.question.name: difference_of(verdict) for verdict in verdicts}
    return Confirmed(
        time=time,
        number=number,
        results={verdict.question.name: result_of(verdict) for verdict in verdicts},
        differences={idea: one for idea, one in differences.items() if one is not None},
    )


def difference_of(verdict: Verdict) -> Difference | None:
    """The mean difference with its interval; None without a test."""
    if verdict.mean is None or verdict.interval is None:
        return None
    return Difference(mean=verdict.mean, low=verdict.interval.low, high=verdict.interval.high)


def contradictions(ledger: Ledger, trials: Sequence[TrialResult]) -> list[Note]:
    """A note for each idea whose recorded result is not what its trials show.

    It is judged again from the seeds that it was decided by, if all its trials are still there.
    """
    notes = []
    for idea, ended in ledger.ended.items():
        if ended.result == FAILED:
            continue
        question = (test_of if idea in ledger.tests else screening_of)(ledger, idea)
        seeds = next(iter(question.seeds.values()))[: ended.seeds]
        counting = [trial for trial in trials if trial.seed in seeds]
        (verdict,) = ask_idea(question, counting.copy).verdicts()
        now = result_of(verdict)
        if verdict.pairs.seeds == ended.seeds and now != ended.result:
            notes.append(Note.of("contradiction", idea=idea, recorded=ended.result, now=now))
    return notes


def check_unknown_trials(ledger: Ledger, trials: Sequence[TrialResult]) -> None:
    """Raise InputError for trials of the experiment that the ledger does not know.

    Such trials are looks that were not counted: another command trained them, or the end of the
    ledger was cut off.
    """
    unknown = sorted({trial.key for trial in trials} - ledger.all_keys())
    if unknown:
        raise InputError(
            f"the ledger does not know {counted(len(unknown), 'configuration')} with trials "
            f"({unknown[0]}): give other sweeps another name; if lines of the ledger are missing, "
            "bring them back"
        )


def check_untouched(ledger: Ledger, trials: Sequence[TrialResult], asked: Confirming) -> None:
    """Raise InputError if ``asked`` has a capture that was used before, by name or by photographs.

    ``trials`` are all trials of the experiment that are done.
    """
    scenes, earlier = asked.keys[BASELINE], set(ledger.opened.keys)
    for confirming, _ in ledger.confirmations:
        if (confirming.keys, confirming.seeds) != (asked.keys, asked.seeds):
            earlier |= confirming.keys[BASELINE].keys()
    photographs = {trial.record.hashes.get("data") for trial in trials if trial.scene in earlier}
    used = {scene for scene in scenes if scene in earlier}
    for trial in trials:
        if trial.scene in scenes and trial.record.hashes.get("data") in photographs:
            used.add(trial.scene)
    if used:
        raise InputError(
            f"{listed(sorted(used))} was seen by the ideas, or by an earlier confirmation: confirm "
            "on other captures"
        )
