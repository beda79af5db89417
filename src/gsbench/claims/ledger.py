"""Many ideas under one error rate: the level of each test, and what its trials show.

The levels are LOND's (Javanmard and Montanari 2015, arXiv 1502.06197, eq. 3) with equal weights:
with ``ideas`` planned tests and a false discovery rate ``rate``, the next test has the level
``rate * (kept + 1) / ideas``, divided by `RETRIES`. LOND controls the false
discovery rate for p values with positive dependence (Zrnic, Ramdas and Jordan 2021, theorem 4),
such as those of ideas that share the trainings of one baseline. Tests that run side by side count
the ideas that were kept before they began, as the same paper does. `scripts/ledger_rates.py`
simulates it (findings/simulations.md).
"""

from collections.abc import Callable, Iterable, Mapping, Sequence

from gsbench.analysis.comparison import unused_trials
from gsbench.analysis.judgement import Verdict, judge
from gsbench.analysis.looks import plan_looks
from gsbench.analysis.notes import Note
from gsbench.analysis.quantities import COSTS, relative_change
from gsbench.analysis.results import Arm, TrialResult
from gsbench.analysis.statistics import REFUTED, SUPPORTED, TOO_SMALL
from gsbench.analysis.verdict_words import least_words, reason, with_notes
from gsbench.claims.stopping import Asked
from gsbench.errors import InputError
from gsbench.runs.experiments import Declaration, Question
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
    Result,
)
from gsbench.words import counted, listed

IDEAS, RATE = 40, 0.1  # the defaults of a ledger
# The chance, at each look, that an idea as good as the least difference that matters is given up.
# It costs power and cannot make a false discovery.
GIVE_UP = 0.05
# Tries of what looked best share its noise, so they are kept by chance more often than their level
# says. With equally noisy captures the test is careful enough for that, but nobody knows
# beforehand that one of them has not all of the noise.
RETRIES = 3.0


def next_level(ledger: Ledger) -> float:
    """The level of the next test; raises InputError if all planned ideas were tried."""
    opened = ledger.opened
    if ledger.tried >= opened.ideas:
        raise InputError(
            f"all {opened.ideas} planned ideas were tried, so the error rate is spent: begin "
            "another ledger, with another baseline or other captures"
        )
    return opened.rate * (len(ledger.kept) + 1) / opened.ideas / RETRIES


def declaration_of(ledger: Ledger, idea: str) -> Declaration:
    """The question of an idea, answered in looks.

    An idea is kept by one side of the interval, and the idea's level is that of this side. So
    the interval with both sides has twice the level.
    """
    started = ledger.started[idea]
    question = _question(
        ledger.opened,
        (started.against, ledger.keys_of(started.against)),
        (idea, started.keys),
        ledger.opened.seeds,
    )
    return Declaration(
        time=started.time,
        questions=(question,),
        looks=plan_looks(len(question.seeds)),
        error_rate=min(1.0, 2 * started.level),
    )


def confirmation_of(opened: Opened, confirming: Confirming) -> Declaration:
    """The questions of a confirmation. All seeds are judged at once; the ideas share 5 %."""
    questions = tuple(
        _question(opened, (BASELINE, confirming.keys[BASELINE]), (idea, keys), confirming.seeds)
        for idea, keys in confirming.keys.items()
        if idea != BASELINE
    )
    return Declaration(time=confirming.time, questions=questions)


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
        arm=Arm("", name),
        scenes={scene: (old[scene], new[scene]) for scene in new},
        seeds=seeds,
        versions=True,
        name=name,
    )


def ask_idea(declaration: Declaration, read: Callable[[], Iterable[TrialResult]]) -> Asked:
    """The question of an idea; it ends also as soon as the idea is given up."""
    return Asked(declaration, read, lambda verdicts: result_of(verdicts[0]) != UNDECIDED)


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


def end_of(idea: str, verdict: Verdict, time: str) -> Ended:
    """The ledger's entry for a final verdict."""
    baseline, new = verdict.pairs.of_baseline, verdict.pairs.of_arm
    ratios = {}
    for cost in ("gaussians", "train_time"):
        change = relative_change(baseline, new, COSTS[cost][1])
        ratios[cost] = None if change is None else 1 + change.of_totals
    return Ended(
        time=time,
        idea=idea,
        result=result_of(verdict),
        reason=with_notes(reason(verdict, _hopeless(verdict)), verdict),
        seeds=verdict.pairs.seeds,
        difference=difference_of(verdict),
        gaussians=ratios["gaussians"],
        seconds=ratios["train_time"],
    )


def confirmed(number: int, verdicts: Sequence[Verdict], time: str) -> Confirmed:
    """The ledger's entry for the verdicts of the confirmation ``number``."""
    differences = {one.question.name: difference_of(one) for one in verdicts}
    return Confirmed(
        time=time,
        number=number,
        results={one.question.name: result_of(one) for one in verdicts},
        differences={idea: one for idea, one in differences.items() if one is not None},
    )


def difference_of(verdict: Verdict) -> Difference | None:
    """The mean difference with its interval; None without a test."""
    if verdict.mean is None or verdict.interval is None:
        return None
    return Difference(mean=verdict.mean, low=verdict.interval.low, high=verdict.interval.high)


def unused(ledger: Ledger, trials: Sequence[TrialResult]) -> list[Note]:
    """A note with the reason for the trials that are in no verdict on an idea."""
    declarations = [declaration_of(ledger, idea) for idea in ledger.started]
    declarations += [confirmation_of(ledger.opened, asked) for asked, _ in ledger.confirmations]
    verdicts = [verdict for one in declarations for verdict in judge(trials, one)]
    return unused_trials(trials, verdicts)


def contradictions(ledger: Ledger, trials: Sequence[TrialResult]) -> list[str]:
    """A line for each idea whose recorded result is not what its trials show.

    It is judged again from the seeds that it was decided by, if all its trials are still there.
    """
    lines = []
    for idea, ended in ledger.ended.items():
        if ended.result == FAILED:
            continue
        seeds = ledger.opened.seeds[: ended.seeds]
        own = [trial for trial in trials if trial.seed in seeds]
        (verdict,) = ask_idea(declaration_of(ledger, idea), own.copy).judged()
        now = result_of(verdict)
        if verdict.pairs.seeds == ended.seeds and now != ended.result:
            lines.append(
                f"{idea}: the ledger says {ended.result}, but its trials say {now}: one of them "
                "was edited"
            )
    return lines


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
