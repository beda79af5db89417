"""A gate: is a new version of a trainer worse than the baseline version?

It is one question in planned looks (`gsbench.claims.stopping`). The new version passes, is worse,
or is undecided after all allowed seeds. It passes if it is better, if any difference is too small
to matter, or if it is shown not to be worse by the least difference that matters.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

from gsbench.analysis.notes import Note
from gsbench.analysis.quantities import COSTS, NO_DIRECTION
from gsbench.analysis.questions import FIRST_LOOK, plan_looks, read_least
from gsbench.analysis.results import Arm, TrialResult
from gsbench.analysis.sentences import in_words, reason, with_notes
from gsbench.analysis.statistics import REFUTED, SUPPORTED, TOO_SMALL
from gsbench.analysis.verdicts import GATE, Verdict, passes
from gsbench.claims.stopping import SequentialTest
from gsbench.errors import InputError
from gsbench.eval.facts import known_keys
from gsbench.pipeline.metric_facts import facts_for
from gsbench.runs.commands import Question
from gsbench.words import did_you_mean

# stand for the digests of trials, since versions may share settings
BASELINE, NEW = "baseline", "new"
PASSED, WORSE, NOT_DECIDED = "passed", "worse", "undecided"

ReadTrials = Callable[[], Iterable[TrialResult]]


def ask_gate(question: Question, baseline: ReadTrials, new: ReadTrials) -> SequentialTest:
    """The question of a gate, with functions that read each version's finished trials.

    The versions are the digests of their trials.
    """
    sides = {BASELINE: baseline, NEW: new}

    def read() -> list[TrialResult]:
        return [replace(one, alias=version) for version, own in sides.items() for one in own()]

    return SequentialTest((question,), read)


def declare_gate(
    metric: str,
    least: str | None,
    scenes: Iterable[str],
    seeds: Sequence[int],
    values: Mapping[str, Any],
) -> Question:
    """The question of a gate about ``metric`` on ``scenes``.

    Seeds are added in the order of ``seeds``. Raises InputError, one line, for a metric that cannot
    be judged (`asked_difference`), and for too few seeds.
    """
    sign, size = asked_difference(metric, least, values)
    if len(seeds) < FIRST_LOOK:
        raise InputError(
            f"a gate needs at least {FIRST_LOOK} seeds, and there is {len(seeds)}: allow more"
        )
    names = list(scenes)
    return Question(
        metric=metric,
        sign=sign,
        least=size[0],
        relative=size[1],
        baseline=Arm("", BASELINE),
        idea=Arm("", NEW),
        digests=dict.fromkeys(names, (BASELINE, NEW)),
        seeds=dict.fromkeys(names, tuple(seeds)),
        looks=plan_looks(len(seeds)),
        rule=GATE,
        versions=True,
        name="gate",
    )


def asked_difference(
    metric: str, least: str | None, values: Mapping[str, Any]
) -> tuple[Literal[-1, 1], tuple[float, bool]]:
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
    size = read_least(str(usual) if least is None else least, "--least", metric in COSTS)
    return (1 if sign > 0 else -1), size


def result_of(verdict: Verdict) -> str:
    """``passed``, ``worse``, or ``undecided``; the result may change until the verdict is final."""
    if verdict.equal or passes(verdict):
        return PASSED
    results = {SUPPORTED: PASSED, TOO_SMALL: PASSED, REFUTED: WORSE}
    return results.get(verdict.outcome, NOT_DECIDED)


def describe(verdict: Verdict) -> str:
    """The result in a sentence.

    For example ``worse: worse in PSNR (dB) on this scene: −1.20 (interval −1.50 to −0.90), …``.
    """
    sentence = reason(verdict) if passes(verdict) else in_words(verdict)
    return with_notes(f"{result_of(verdict)}: {sentence}", verdict)


def deviations(baseline: Sequence[TrialResult], new: Sequence[TrialResult]) -> list[Note]:
    """A note for each difference of machine or libraries between the two versions' trials."""

    def made(trials: Sequence[TrialResult], name: str) -> list[str]:
        values = (
            one.record.versions.get(name, "none") if name else one.machine or "not recorded"
            for one in trials
        )
        return sorted(set(values))

    names = {name for one in (*baseline, *new) for name in one.record.versions} - {"gsbench"}
    return [
        Note.of("other library" if name else "other machine", library=name, baseline=old, new=now)
        for name in ("", *sorted(names))  # the machine, and each library
        if (old := made(baseline, name)) != (now := made(new, name))
    ]
