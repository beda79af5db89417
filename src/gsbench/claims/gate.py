"""A gate: is a new version of a trainer worse than the baseline version?

It is one question in planned looks (`gsbench.claims.stopping`). The new version passes, is worse,
or is undecided after all allowed seeds. It passes if it is better, if any difference is too small
to matter, or if it is shown not to be worse by the least difference that matters.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from gsbench.analysis.designs import POWER, Design, power_of_mean
from gsbench.analysis.judgement import Verdict
from gsbench.analysis.looks import FIRST_LOOK, look_levels, plan_looks
from gsbench.analysis.notes import Note
from gsbench.analysis.quantities import COSTS, NO_DIRECTION
from gsbench.analysis.results import Arm, TrialResult
from gsbench.analysis.statistics import REFUTED, SUPPORTED, TOO_SMALL, UNDECIDED
from gsbench.analysis.verdict_words import in_words, least_words, with_notes
from gsbench.claims.file import LeastEffect, read_least
from gsbench.claims.stopping import SequentialTest, facts_for
from gsbench.errors import InputError
from gsbench.eval.facts import known_keys
from gsbench.runs.experiments import ERROR_RATE, Declaration, Question, declared_now, trial_key
from gsbench.words import did_you_mean

# replace the configuration hash in trials' keys, since versions may share settings
BASELINE, NEW, LAST = "baseline", "new", "last"
PASSED, WORSE, NOT_DECIDED = "passed", "worse", "undecided"

ReadTrials = Callable[[], Iterable[TrialResult]]


def ask_gate(declaration: Declaration, baseline: ReadTrials, new: ReadTrials) -> SequentialTest:
    """The question of a gate, with functions that read each version's finished trials.

    It ends also as soon as the new version is shown not to be worse: a gate asks no more.
    """
    read = _versions({BASELINE: baseline, NEW: new})
    return SequentialTest(declaration, read, lambda verdicts: result_of(verdicts[0]) != NOT_DECIDED)


def _versions(sides: Mapping[str, ReadTrials]) -> ReadTrials:
    """A function that reads the trials of all versions, with the versions in their keys."""
    return lambda: [
        trial if trial.config_hash == version else replace(trial, config_hash=version)
        for version, read in sides.items()
        for trial in read()
    ]


def declare_gate(
    metric: str,
    least: str | None,
    scenes: Mapping[str, tuple[str, str]],
    seeds: Sequence[int],
    values: Mapping[str, Any],
    error_rate: float = ERROR_RATE,
) -> Declaration:
    """The declaration of a gate about ``metric``.

    ``scenes`` has, for each scene, the names of both arms, such as ``sfm-adc``. Seeds are added
    in the order of ``seeds``. Raises InputError, one line, for a metric that cannot be judged
    (`asked_difference`), and for too few seeds.
    """
    sign, size = asked_difference(metric, least, values)
    if len(seeds) < FIRST_LOOK:
        raise InputError(
            f"a gate needs at least {FIRST_LOOK} seeds, and there is {len(seeds)}: allow more"
        )
    question = Question(
        metric=metric,
        sign=sign,
        least=size.size,
        relative=size.relative,
        baseline=Arm("", BASELINE),
        arm=Arm("", NEW),
        scenes={
            scene: (trial_key(scene, baseline, BASELINE), trial_key(scene, new, NEW))
            for scene, (baseline, new) in scenes.items()
        },
        seeds=tuple(seeds),
        versions=True,
        name="gate",
    )
    return declared_now(questions=(question,), looks=plan_looks(len(seeds)), error_rate=error_rate)


def asked_difference(
    metric: str, least: str | None, values: Mapping[str, Any]
) -> tuple[int, LeastEffect]:
    """The direction of ``metric`` (1: more is better) and the least difference that matters.

    ``least`` is text such as ``0.1`` or ``10%``; None takes the metric's usual least difference.
    ``values`` is a trial's configuration, which may define the user's own metrics. Raises
    InputError, one line, for a metric that cannot be judged.
    """
    users_metrics = values["eval"].get("extra") or {}
    metrics = (*known_keys(), *COSTS, *users_metrics)
    if metric not in metrics:
        raise InputError(
            f"--metric {metric}: there is no such metric{did_you_mean(metric, metrics)}"
        )
    sign, usual = -1, None  # less is better of counts and times
    if metric not in COSTS:
        facts = facts_for(metric, values)
        sign, usual = facts.direction, facts.worthwhile
    if not sign:
        raise InputError(f"--metric {metric}: {NO_DIRECTION}")
    if least is None and usual is None:
        raise InputError(
            f"{metric} has no usual least difference that matters: give --least, such as 0.1 or 10%"
        )
    size = read_least(str(usual) if least is None else least, "--least")
    if metric in COSTS and not size.relative:
        raise InputError(f"--least of {metric} must be a part, such as 10%, got {size}")
    return sign, size


def result_of(verdict: Verdict) -> str:
    """``passed``, ``worse``, or ``undecided``; the result may change until the verdict is final."""
    if verdict.equal or _not_worse(verdict):
        return PASSED
    results = {SUPPORTED: PASSED, TOO_SMALL: PASSED, REFUTED: WORSE}
    return results.get(verdict.outcome, NOT_DECIDED)


def _not_worse(verdict: Verdict) -> str:
    """The reason why an undecided version passes; "" if it does not."""
    passes = verdict.outcome == UNDECIDED and verdict.loss_excluded
    return f"not worse by {least_words(verdict)}" if passes else ""


def describe(verdict: Verdict) -> str:
    """The result in a sentence.

    For example ``worse: worse in PSNR (dB) on this scene: −1.20 (interval −1.50 to −0.90), …``.
    """
    sentence = in_words(verdict, _not_worse(verdict))
    return with_notes(f"{result_of(verdict)}: {sentence}", verdict)


def deviations(baseline: Sequence[TrialResult], new: Sequence[TrialResult]) -> list[Note]:
    """A note for each difference of machine or libraries between the two versions' trials."""
    machine = ""  # beside the names of libraries, and sorted before them
    sides = [
        [{machine: trial.machine or "not recorded"} | trial.record.versions for trial in trials]
        for trials in (baseline, new)
    ]
    notes = []
    for name in sorted(set().union(*sides[0], *sides[1]) - {"gsbench"}):
        old, now = (sorted({made.get(name, "none") for made in side}) for side in sides)
        if old != now:
            kind = "other machine" if name == machine else "other library"
            notes.append(Note.of(kind, library=name, baseline=old, new=now))
    return notes


# ---- bisection: the search for the commit that made a trainer worse
#
# The last commit is compared with the first. Each other commit is compared with both. It is as good
# as the first or as bad as the last. So it passes if it is shown to be better than the last, and is
# worse if it is shown to be worse than the first. Only one of its two questions can then be
# answered wrongly, and only on one side.


def ask_step(
    gate: Declaration, share: float, good: ReadTrials, last: ReadTrials, new: ReadTrials
) -> SequentialTest:
    """The questions about a commit against a first one and a worse last one.

    ``gate`` is the declaration of the last commit; ``share`` is the chance that a step is wrong.
    Both questions end as soon as the step has a result.
    """
    (question,) = gate.questions
    of_last = {
        scene: (old.removesuffix(BASELINE) + LAST, own)
        for scene, (old, own) in question.scenes.items()
    }
    against_last = replace(question, baseline=Arm("", LAST), scenes=of_last, name="last")
    # The two share the error rate, and half of a share is that of one side.
    declaration = replace(gate, questions=(question, against_last), error_rate=4 * share)
    read = _versions({BASELINE: good, LAST: last, NEW: new})
    return SequentialTest(declaration, read, lambda verdicts: step_result(verdicts) != NOT_DECIDED)


def step_result(verdicts: Sequence[Verdict]) -> str:
    """``passed`` or ``worse``; ``undecided`` also for a commit that is between both ends."""
    first, last = verdicts
    if first.equal or last.equal:
        return NOT_DECIDED if first.equal and last.equal else PASSED if first.equal else WORSE
    worse = first.outcome == REFUTED or _known_side(first) < 0
    better = last.outcome == SUPPORTED or _known_side(last) > 0
    return NOT_DECIDED if worse == better else WORSE if worse else PASSED


def describe_step(verdicts: Sequence[Verdict]) -> str:
    """The result with both verdicts in a sentence."""
    ends = zip(("first", "last"), verdicts, strict=True)
    parts = [f"against the {end}: {with_notes(in_words(one), one)}" for end, one in ends]
    return "; ".join([step_result(verdicts), *parts])


def too_small_to_place(verdict: Verdict, share: float) -> Note | None:
    """A note if steps will often not see the loss of the last commit."""
    deviation, most = verdict.deviation, len(verdict.question.seeds)
    if not deviation or verdict.mean is None:
        return None
    looks = plan_looks(most)
    level = look_levels(len(verdict.pairs.rows), looks, 2 * share)[-1]
    chance = power_of_mean(deviation, Design(len(verdict.pairs.rows), most), verdict.mean, level)
    if chance >= POWER:
        return None
    difference = verdict.shown(verdict.mean)
    return Note.of("small loss", difference=difference, seeds=most, chance=f"{100 * chance:.0f}")


def _known_side(verdict: Verdict) -> int:
    """1 or -1 if a difference too small to matter is known to be better or worse; 0 else."""
    interval, sign = verdict.interval, verdict.question.sign
    if verdict.outcome != TOO_SMALL or interval is None or not interval.excludes_zero():
        return 0
    return sign if interval.low > 0 else -sign


SPARE = 2  # undecided commits that the search skips before it ends with a range


def most_steps(count: int) -> int:
    """The most gates that a bisection of ``count`` commits takes.

    They are the gate of the last commit, the halvings, and `SPARE`.

    Examples:
        >>> most_steps(1), most_steps(12)
        (1, 7)
    """
    return 1 if count == 1 else 1 + math.ceil(math.log2(count)) + SPARE


def first_worse(count: int, result: Callable[[int], str | None]) -> tuple[int, int] | None:
    """The last good and the first worse of the commits 0 to ``count``, as (good, worse).

    Commits between the two remain unknown. Commit 0 is good, and quality is assumed to change
    once. ``result`` gives a commit's result: ``PASSED``, ``WORSE``, ``NOT_DECIDED``, or
    None if it does not train, which is no step. Returns None if the last
    commit is not worse.

    Examples:
        >>> first_worse(12, lambda commit: WORSE if commit >= 7 else PASSED)
        (6, 7)
    """
    if result(count) != WORSE:
        return None
    good, bad, spare = 0, count, SPARE
    skipped: set[int] = set()
    while left := [commit for commit in range(good + 1, bad) if commit not in skipped]:
        commit = min(left, key=lambda one: abs(2 * one - good - bad))  # the nearest to the middle
        answer = result(commit)
        if answer == PASSED:
            good = commit
        elif answer == WORSE:
            bad = commit
        elif answer is not None and not spare:
            break
        else:
            skipped.add(commit)
            spare -= answer is not None
    return good, bad
