"""The words of verdicts: each verb, table and page takes its sentences on verdicts from here."""

import re
from collections.abc import Sequence

from gsbench.analysis.attempts import share_of_version
from gsbench.analysis.judgement import Verdict
from gsbench.analysis.notes import Note
from gsbench.analysis.results import group_by
from gsbench.analysis.statistics import (
    ALPHA,
    REFUTED,
    SUPPORTED,
    TOO_SMALL,
    UNDECIDED,
    Outcome,
    exact_for,
)
from gsbench.analysis.unfinished import lacking_words
from gsbench.analysis.verdicts import DECLARED, SECONDARY, PairVerdicts
from gsbench.runs.experiments import ERROR_RATE
from gsbench.words import counted, least_text, some_of

WORDS: dict[Outcome, str] = {
    "supported": "better",
    "refuted": "worse",
    "too small to matter": "too small to matter",
    "undecided": "undecided",
}
SYMBOLS: dict[Outcome, str] = {
    "supported": "▲",
    "refuted": "▼",
    "too small to matter": "≈",
    "undecided": "●",
}
MISSING = "trials are missing"
IN_BRACKETS = re.compile(r" \([^()]*\)")


# ---- one verdict


def outcome_words(verdict: Verdict) -> str:
    """The outcome in a few words: better, worse, higher, too small to matter, ….

    Only a metric in its own direction is better or worse; a number of Gaussians is higher.
    """
    sign, outcome = verdict.question.sign, verdict.outcome
    if not sign:
        beyond = f"different by more than {least_words(verdict)}"
        claimed = WORDS | {"supported": WORDS["too small to matter"], "refuted": beyond}
        return claimed[outcome]
    if outcome in (SUPPORTED, REFUTED) and sign != verdict.quantity.direction:
        return "higher" if (outcome == SUPPORTED) == (sign > 0) else "lower"
    return WORDS[outcome]


def least_words(verdict: Verdict) -> str:
    """The least difference that matters: ``0.1``, or ``10 %``."""
    return least_text(verdict.question.least or 0.0, verdict.question.relative)


def reason(verdict: Verdict, early: str = "") -> str:
    """The reason for a result in a few words; ``early`` is why an undecided question has one."""
    if verdict.equal and verdict.question.versions:
        return (
            f"equal to the last bit in all {counted(len(verdict.pairs.counting), 'pair')} of trials"
        )
    if verdict.untestable is not None:
        return str(verdict.untestable)
    if verdict.interval is None:
        return MISSING
    if verdict.outcome != UNDECIDED:
        return f"{outcome_words(verdict)}{_known_sign(verdict)}"
    if verdict.favours_lacking:
        return "undecided, since trials of one arm alone have no result"
    if verdict.rests_on_outlying:
        return "undecided, since it depends on trials far outside the others"
    return early or f"undecided{' by all seeds' if verdict.final else ' so far'}"


def in_words(verdict: Verdict, early: str = "") -> str:
    """A verdict in words, with its numbers if there are any.

    For example ``better in LPIPS VGG raw on these scenes: −0.0123 (interval −0.0200 to −0.0046,
    p 0.012)``. ``early`` is the reason for the result of an undecided question.
    """
    if verdict.interval is None or verdict.untestable is not None:
        return reason(verdict)
    named = early or f"{outcome_words(verdict)}{_known_sign(verdict)}"
    if verdict.favours_lacking or verdict.rests_on_outlying:
        named = reason(verdict)
    text = f"{named} in {verdict.quantity.name} on {_scope(verdict)}: {numbers(verdict)}"
    if planned := verdict.question.seeds:
        text += f", with {verdict.pairs.seeds} of at most {counted(len(planned), 'seed')}"
    return text


def with_notes(words: str, verdict: Verdict) -> str:
    """Words about a verdict, with its notes behind them."""
    return "; ".join([words, *map(str, verdict.notes)])


def numbers(verdict: Verdict) -> str:
    """``+0.50 (interval +0.30 to +0.70, p 0.012, adjusted for 2 tests)``; "" without a mean.

    The level of the interval is told if it is not 95 %, and the arms if the tests are of several.
    """
    answer = verdict.answer
    if answer is None:
        return ""
    if answer.interval is None:
        return f"{verdict.shown(answer.mean)}, without a test"
    level = "" if answer.level == ALPHA else f"{100 * (1 - answer.level):.3g} % "
    facts = [f"{level}interval {verdict.shown_interval(answer.interval)}"]
    facts += [] if answer.p is None else [f"p {p_text(answer.p)}"]
    if verdict.family > 1:
        arms = f", of {some_of(verdict.family_arms)}" if len(verdict.family_arms) > 1 else ""
        facts.append(f"adjusted for {verdict.family} tests{arms}")
    return f"{verdict.shown(answer.mean)} ({', '.join(facts)})"


def _known_sign(verdict: Verdict) -> str:
    """``, though better`` if a difference is too small to matter but its sign is known; else ""."""
    has_sign = (
        verdict.outcome == TOO_SMALL
        and verdict.interval is not None
        and verdict.interval.excludes_zero()
    )
    if not has_sign or verdict.mean is None or not verdict.question.sign:
        return ""
    return f", though {'better' if verdict.mean * verdict.question.sign > 0 else 'worse'}"


def _scope(verdict: Verdict) -> str:
    """``this scene`` or ``these scenes``."""
    return "these scenes" if len(verdict.pairs.rows) > 1 else "this scene"


def like_these_words(verdict: Verdict) -> str:
    """The statement about scenes like these in words; "" with too few scenes.

    For example ``scenes like these: undecided; it helps in 7 of 8 (sign test p 0.070, …)``.
    """
    like = verdict.like_these
    if like is None:
        return ""
    word, what = WORDS[like.outcome], "it helps" if verdict.question.sign else "it is higher"
    least = "" if like.beyond is None else f", by the least that matters in {like.beyond}"
    median = "" if like.median is None else f"; median {verdict.shown_interval(like.median)}"
    level = f"at {100 * (1 - like.level):.3g} %"
    if like.needed is None:
        needed = f"{level}, so few scenes cannot decide it"
    else:
        how_many = "all" if like.needed == like.scenes else f"{like.needed} of the"
        needed = (
            f"{level}, {how_many} {like.scenes} scenes must agree: if the arm helps on nine scenes "
            f"in ten, {100 * like.power():.0f} % of such sweeps show it"
        )
    return (
        f"scenes like these: {word}; {what} in {like.helped} of {like.scenes}{least} (sign test p "
        f"{p_text(like.p)}, {100 * like.share.low:.0f} to {100 * like.share.high:.0f} % of such "
        f"scenes{median}); {needed}; exact for: {exact_for(verdict.pairs.seeds)}"
    )


def outlying_words(verdict: Verdict) -> str:
    """The outlying trials, and the missing ones that make it undecided, in words; "" for none.

    For example ``far outside the other seeds: garden/sfm-adc/…-seed3; without it: undecided``.
    """
    parts = [lacking_words(verdict.lacking)] if verdict.favours_lacking else []
    if verdict.outlying:
        labels = some_of([trial.label for trial in verdict.outlying])
        word = WORDS[verdict.outcome_without or "undecided"]
        them = "it" if len(verdict.outlying) == 1 else "them"
        parts.append(
            f"far outside the other seeds of its scene and arm: {labels}; without {them}: {word}"
        )
    return "; ".join(parts)


def p_text(p: float) -> str:
    """``below 0.001``, or p with three decimals."""
    return "below 0.001" if p < 0.001 else f"{p:.3f}"


# ---- two arms


def sentence(judged: PairVerdicts) -> str:
    """The verdict on two arms in one sentence, the same wherever it is shown.

    If the question was declared in time, the sentence has only the declared metric's verdict.
    """
    verdicts, against = judged.verdicts, f"{judged.second} against {judged.first}"
    if (missing := judged.missing) is not None and judged.beforehand:
        if missing.kind == "no pairs" and (waits := _before_looks(judged)):
            return f"{against}: no verdict yet, {waits}."
        what = f"the declared metric {missing.about} has no"
        if missing.kind == "no direction":
            return f"{against}: no verdict, since {what} direction ({missing['reason']})."
        return f"{against}: no verdict, since {what} value ({missing.sentence})."
    if not verdicts:
        return f"{against}: no verdict, since {no_pairs(judged)}."
    where = _scope(verdicts[0])
    if all(verdict.equal for verdict in verdicts):
        return (
            f"{against}, on {where}: equal in every metric, to the last bit. The settings that "
            "differ had no effect: look at the events, and at train.densify_start and "
            "densify_stop."
        )
    first = verdicts[0]
    if judged.role(first) == DECLARED:
        if first.interval is None:
            why = first.untestable or _before_looks(judged) or TOO_FEW.format(where)
            return f"{against}: no verdict yet, {why}."
        waits = "" if first.final else "not decided yet, "
        details = [line for line in (like_these_words(first), outlying_words(first)) if line]
        words = "; ".join([in_words(first), *details])
        return (
            f"{against}: {waits}{words}. The metric was declared beforehand."
            f"{_versions_words(judged)}"
        )
    in_doubt = [verdict for verdict in verdicts if verdict.favours_lacking][:1]
    if all(verdict.interval is None for verdict in verdicts):
        return f"{against}: no verdict, {TOO_FEW.format(where)}."
    # in looks all metrics share the error rate equally, so none of them counts a family
    number = max(len(verdicts), *(one.family for one in verdicts))
    looks = " and for the planned looks" if first.question.seeds else ""
    return (
        f"{against}, on {where}: {_by_word(verdicts, with_numbers=True)}. Exploratory: "
        f"{_why_exploratory(judged)}, so all metrics count, adjusted for their number "
        f"({number}){looks}.{_versions_words(judged)}"
        + "".join(f" Undecided: {lacking_words(one.lacking)}." for one in in_doubt)
    )


def headline(judged: PairVerdicts) -> str:
    """The first statement of the `sentence`, without what is in brackets.

    Without a declared metric that is the outcome in every metric: no one decides.
    """
    first = IN_BRACKETS.sub("", sentence(judged)).partition(". ")[0].rstrip(".")
    return first.partition(";")[0] if judged.beforehand else first


def _versions_words(judged: PairVerdicts) -> str:
    """The sentence on an arm whose code was edited and measured again; "" if it was not."""
    if judged.versions == 1:
        return ""
    rate = 100 * ERROR_RATE * share_of_version(judged.versions)
    return (
        f" {judged.versions} versions of the arm's code were measured on these seeds, so the error "
        f"rate is {rate:.2g} % (with other seeds under another name: {100 * ERROR_RATE:.2g} %)."
    )


TOO_FEW = "one trial of each on {}; run more seeds"
BEFORE_LOOKS = (
    "not all of the first {} seeds are there in both arms; give the sweep's command again"
)


def _before_looks(judged: PairVerdicts) -> str:
    standing = judged.standing
    if standing is None or standing.question is None:
        return ""
    return BEFORE_LOOKS.format(standing.declaration.looks[0])


def no_pairs(judged: PairVerdicts) -> str:
    """The reason why no trials of two arms could be compared."""
    nothing = Note.of("no pairs", baseline=judged.first, arm=judged.second)
    return next(iter(judged.notes), nothing).sentence


def _why_exploratory(judged: PairVerdicts) -> str:
    if judged.declared is None:
        return judged.undeclared
    name = judged.declared.name
    if judged.standing is not None and judged.standing.doubt:
        return f"{name} was declared, but {judged.standing.doubt}"
    return f"the declaration of {name} asks about another split"


def secondary(judged: PairVerdicts) -> str:
    """The verdicts in secondary metrics in one sentence; "" if none of them has an interval."""
    secondaries = [verdict for verdict in judged.verdicts if verdict.question.secondary]
    decidable = any(verdict.interval is not None for verdict in secondaries)
    return f"Secondary, adjusted for their number: {_by_word(secondaries)}." if decidable else ""


def _by_word(verdicts: Sequence[Verdict], with_numbers: bool = False) -> str:
    """``better in PSNR; undecided in SSIM, FLIP``; with numbers for what is decided."""

    def named(one: Verdict) -> str:
        name = f"{one.quantity.name}{_known_sign(one)}"
        if not with_numbers or one.outcome == UNDECIDED or one.interval is None:
            return name
        numbers = f"{one.shown(one.mean or 0.0)}, interval {one.shown_interval(one.interval)}"
        return f"{name} ({numbers})"

    names_by_word = {
        word: [named(verdict) for verdict in verdicts if WORDS[verdict.outcome] == word]
        for word in WORDS.values()
    }
    return "; ".join(
        f"{word} in {', '.join(names)}" for word, names in names_by_word.items() if names
    )


def detail_lines(verdicts: Sequence[Verdict]) -> list[str]:
    """Lines on scenes like these and on outlying trials, for each metric that has them."""
    return [
        f"{verdict.quantity.name}: {line}"
        for verdict in verdicts
        for line in (like_these_words(verdict), outlying_words(verdict))
        if line
    ]


def by_scene_lines(verdicts: Sequence[Verdict]) -> list[str]:
    """A line for each metric in which single scenes are decided, with the names of these scenes.

    A scene is decided if its adjusted p is below 5 %. A mean over scenes that disagree would
    hide both results.
    """
    lines = []
    for one in verdicts:
        decided = [scene for scene in one.scenes if scene.p is not None and scene.p < ALPHA]
        scenes_by_word = {
            word: [scene.scene for scene in decided if scene.mean * one.question.sign * side > 0]
            for word, side in (("better", 1), ("worse", -1))
        }
        parts = [
            f"{word} on {', '.join(scenes)}" for word, scenes in scenes_by_word.items() if scenes
        ]
        if len(one.scenes) > 1 and parts:
            warning = ": the scenes disagree, so their mean says little" if len(parts) > 1 else ""
            lines.append(f"{one.quantity.name} by scene: {', '.join(parts)}{warning}")
    return lines


def families(judged: Sequence[PairVerdicts]) -> list[str]:
    """Lines on the families of tests: their sizes, and how they are adjusted."""
    by_role = group_by(
        ((pair.role(verdict), verdict) for pair in judged for verdict in pair.verdicts),
        lambda entry: entry[0],
    )
    sizes = {role: sorted({one.family for _, one in own}) for role, own in by_role.items()}
    looks = any(verdict.question.seeds for own in by_role.values() for _, verdict in own)
    lines = []
    if DECLARED in sizes:
        how = (
            "not adjusted: it is one test"
            if sizes[DECLARED] == [1]
            else f"adjusted by Holm for {_or(sizes[DECLARED])} tests"
        )
        lines.append(f"The declared metric is {'judged at each planned look' if looks else how}.")
    if SECONDARY in sizes:
        how = (
            "at each look they share 5 % equally"
            if looks
            else f"Holm adjusts them for {_or(sizes[SECONDARY])} tests"
        )
        lines.append(f"All other metrics are secondary and do not decide the verdict; {how}.")
    if "" in sizes:
        number = f"{_or(sizes[''])} {'test' if sizes[''] == [1] else 'tests'}"
        how = "with equal shares of 5 % at each look" if looks else f"{number} adjusted by Holm"
        lines.append(f"Exploratory verdicts: all metrics of a pair of arms are one family, {how}.")
    return lines


def _or(sizes: Sequence[int]) -> str:
    return " or ".join(map(str, sizes))
