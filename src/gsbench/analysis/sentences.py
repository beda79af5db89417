"""The words of verdicts: each verb, table and page takes its sentences on verdicts from here."""

from collections.abc import Sequence

from gsbench.analysis.questions import ordinal, places_text
from gsbench.analysis.results import Unfinished
from gsbench.analysis.statistics import Outcome, exact_for
from gsbench.analysis.verdicts import Verdict, gives_up, passes
from gsbench.words import command, counted, least_text, some_of

CONDITION = " It holds if metric, scenes and seeds were chosen before the results were seen."
WORDS: dict[Outcome, str] = {
    "supported": "better",
    "refuted": "worse",
    "too small to matter": "too small to matter",
    "undecided": "undecided",
}


# classes of badges, which give their colours
CLASSES = {"BETTER": "better", "WORSE": "worse", "DIFFERENT": "worse", "TOO SMALL": "small"}


def outcome_words(verdict: Verdict) -> str:
    """The outcome in a few words: better, worse, higher, too small to matter, ….

    Only a metric in its own direction is better or worse; a number of Gaussians is higher.
    """
    sign, outcome = verdict.question.sign, verdict.outcome
    if not sign:
        beyond = f"different by more than {least_words(verdict)}"
        claimed = WORDS | {"supported": WORDS["too small to matter"], "refuted": beyond}
        return claimed[outcome]
    if outcome in ("supported", "refuted") and sign != verdict.quantity.direction:
        return "higher" if (outcome == "supported") == (sign > 0) else "lower"
    return WORDS[outcome]


def least_words(verdict: Verdict) -> str:
    """The least difference that matters: ``0.1``, or ``10 %``."""
    return least_text(verdict.question.least or 0.0, verdict.question.relative)


def badge(verdict: Verdict) -> str:
    """The verdict in one or two words: ``BETTER``, ``TOO SMALL``, ``RUNNING 3/6``."""
    if verdict.is_open and not verdict.untestable:
        return f"{verdict.state.upper()} {verdict.done}/{verdict.question.trials}"
    if not verdict.is_tested:
        return verdict.state.removesuffix(" beforehand").upper()
    if verdict.outcome == "refuted" and not verdict.question.sign:
        return "DIFFERENT"
    return outcome_words(verdict).removesuffix(" to matter").upper()


def badge_class(verdict: Verdict) -> str:
    """The class of a badge on a page."""
    return "open" if verdict.is_open else CLASSES.get(badge(verdict), "")


def with_notes(words: str, verdict: Verdict) -> str:
    """Words about a verdict, with its notes behind them."""
    return "; ".join([words, *map(str, verdict.notes)])


def numbers(verdict: Verdict) -> str:
    """``+0.50 (95 % interval +0.30 to +0.70)``; "" without a mean."""
    if verdict.mean is None:
        return ""
    shown, pairs = verdict.shown(verdict.mean), len(verdict.pairs.counting)
    if pairs == 1:
        return f"{shown} (one pair of trainings has no interval)"
    if verdict.equal:
        return f"{shown} in each of {pairs} pairs of trainings"
    if verdict.interval is None:
        return shown
    return f"{shown} ({interval_words(verdict.level)} {verdict.shown_interval(verdict.interval)})"


def interval_words(level: float) -> str:
    """``98.3 % interval``"""
    return f"{100 * (1 - level):.4g} % interval"


def reason(verdict: Verdict) -> str:
    """The reason for a verdict in a few words."""
    if verdict.equal and verdict.question.versions:
        return (
            f"equal to the last bit in all {counted(len(verdict.pairs.counting), 'pair')} of trials"
        )
    if verdict.untestable is not None:
        return str(verdict.untestable)
    if verdict.state == "not tested":
        why = verdict.question.untested
        return why if why == verdict.state else f"not tested, since {why}"
    if verdict.state == "not asked beforehand":
        return verdict.state
    if verdict.is_open:
        return _waits(verdict)
    if verdict.outcome != "undecided":
        return f"{outcome_words(verdict)}{_known_sign(verdict)}"
    if verdict.favours_lacking:
        return f"undecided, since {lacking_words(verdict.lacking)}"
    if verdict.interval is None:
        return "undecided: one pair of trainings has no test"
    if gives_up(verdict):
        return f"a gain of {least_words(verdict)} is unlikely"
    if passes(verdict):
        return f"not worse by {least_words(verdict)}"
    return f"undecided{'' if verdict.final else ' so far'}"


def _waits(verdict: Verdict) -> str:
    """Why a question has no verdict yet, and the command that goes on."""
    count = f"{verdict.done} of {counted(verdict.question.trials, 'trial')}"
    if verdict.state == "running":
        return f"no verdict before all its trials are done: {count}"
    if verdict.question.rule in ("table", "declared table"):
        return f"no verdict without all its trials: the table has {count}"
    if verdict.missing:
        again = command("retry", verdict.missing[0].path.parts[-4])
        return f"stopped at {count}; to go on: {again}"
    return f"{count}: no command has planned the others yet, such as {verdict.question.baseline}"


def in_words(verdict: Verdict) -> str:
    """A verdict in words, with its numbers if there are any.

    For example ``better in PSNR (dB) on these scenes: +0.50 (95 % interval +0.30 to +0.70)``.
    """
    if verdict.untestable is not None:
        return reason(verdict)
    if not (shown := numbers(verdict)):
        # without a pair of trials, the first note says why there is none
        return "; ".join([reason(verdict), *map(str, verdict.pairs.left_out[:1])])
    link = "; " if verdict.state != "answered" or verdict.favours_lacking else " in "
    return f"{reason(verdict)}{link}{verdict.quantity.name} on {scope(verdict)}: {shown}"


def _known_sign(verdict: Verdict) -> str:
    """``, though better`` if a difference is too small to matter but its sign is known; else ""."""
    interval, mean, sign = verdict.interval, verdict.mean, verdict.question.sign
    if verdict.outcome != "too small to matter" or not (sign and interval and mean):
        return ""
    word = f", though {'better' if mean * sign > 0 else 'worse'}"
    return word if interval.excludes_zero() else ""


def scope(verdict: Verdict) -> str:
    """``this scene`` or ``these scenes``."""
    return "these scenes" if len(verdict.question.seeds) > 1 else "this scene"


def sentence(verdict: Verdict) -> str:
    """The verdict on an idea in one sentence or two, the same wherever it is shown."""
    question = verdict.question
    details = [like_these_words(verdict), outlying_words(verdict)]
    words = "; ".join(filter(None, [in_words(verdict), *details]))
    return f"{question.idea} against {question.baseline}: {words}.{_level_words(verdict)}"


def headline(verdict: Verdict) -> str:
    """The sentence without details: ``sfm-mine against sfm-adc: better in PSNR (dB): +0.50``"""
    question, name = verdict.question, verdict.quantity.name
    mean = "" if verdict.mean is None else f", {name} {verdict.shown(verdict.mean)}"
    return f"{question.idea} against {question.baseline}: {badge(verdict)}{mean}"


def _level_words(verdict: Verdict) -> str:
    question = verdict.question
    if question.rule == "table" and verdict.state == "answered":
        return CONDITION
    if not verdict.is_tested or (question.n == 1 and not question.looks):
        return ""
    which, level = ordinal(question.n), f"{100 * question.level:.2g} %"
    text = f" The {which} command about it on these seeds: level {level}"
    if question.looks:
        text += f", in looks at {', '.join(map(str, question.looks))} seeds"
    return f"{text}."


def asked_words(verdict: Verdict) -> str:
    """The subject of a question: metric, scenes, seeds and level."""
    question = verdict.question
    level = f", level {100 * question.level:.2g} %" if verdict.is_tested else ""
    return f"{verdict.quantity.name} on {places_text(question.places)}{level}"


def like_these_words(verdict: Verdict) -> str:
    """The statement about scenes like these in words; "" with too few scenes.

    For example ``scenes like these: undecided; it helps in 7 of 8 (all 8 must agree), …``.
    """
    like = verdict.like_these
    if like is None:
        return ""
    word, what = WORDS[like.outcome], "it helps" if verdict.question.sign else "it is higher"
    least = "" if like.beyond is None else f", by the least that matters in {like.beyond}"
    level = f"at {100 * like.level:.2g} %"
    if like.needed is None:
        needed = f"{level}, so few scenes cannot decide it"
    else:
        how_many = "all" if like.needed == like.scenes else f"{like.needed} of the"
        needed = f"{level}, {how_many} {like.scenes} scenes must agree"
    return (
        f"scenes like these: {word}; {what} in {like.helped} of {like.scenes}{least}; {needed}; "
        f"exact for: {exact_for(verdict.pairs.seeds)}"
    )


def outlying_words(verdict: Verdict) -> str:
    """The trials far outside the others in words; "" for none."""
    labels = [trial.label for trial in verdict.outlying]
    if not labels:
        return ""
    return f"far outside the other seeds of its scene and arm: {some_of(labels)}"


def lacking_words(lacking: Sequence[Unfinished]) -> str:
    """The reason why a verdict that would favour an arm with such trials is undecided."""
    return (
        f"{counted(len(lacking), 'trial')} of one arm alone failed, stopped, went missing or gave "
        f"no value, perhaps its bad ones: {some_of([one.label for one in lacking])}"
    )


def risk(verdicts: Sequence[Verdict]) -> str:
    """The risk of a page with these verdicts: the sum of the levels of its statements."""
    asked = [one for one in verdicts if one.statements]
    if not asked:
        return ""
    statements = sum(one.statements for one in asked)
    most = sum(one.statements * one.question.level for one in asked)
    return (
        f"{counted(len(asked), 'question')}, {counted(statements, 'statement')}; if none had an "
        f"effect, at most {most:.2g} of them would be called better or worse."
    )
