"""The verdicts of a sweep: every two arms that are compared, in every metric that has a direction, as one declaration.

Where nothing was declared (``eval.primary``), all metrics of all pairs are one family, adjusted by Holm (1979). Where a
metric was declared, at one question if one was named (``psnr@extrapolation``), two families are kept apart, each with
its own 5 %: the declared metric, one test for each pair of arms, as Demšar (2006, section 3.2.2) adjusts comparisons of
many methods with one control; and all other metrics of all pairs, called secondary.

There is no gate between the two: where the declared metric shows nothing, a secondary one that got worse must still be
seen. A metric that was declared when results were there, or to which seeds or arms were added then, has no place of
its own: then all are one family.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from gsbench.analysis import judgement
from gsbench.analysis.cells import by_key, in_brief
from gsbench.analysis.declaration import ActiveDeclaration
from gsbench.analysis.judgement import folder_key
from gsbench.analysis.planning import seeds_needed
from gsbench.analysis.quantities import Quantity, choose_quantities, metric_quantity
from gsbench.analysis.results import Arm, TrialResult
from gsbench.analysis.statistics import TOO_SMALL, Outcome
from gsbench.runs.declaration import Declaration, Question
from gsbench.words import counted, signed, some_of

Role = Literal["declared", "secondary", "one of all"]
Pair = tuple[Arm, Arm]
VERDICT = "Verdict, "  # how a line below a table begins that says one
WORDS: dict[Outcome, str] = {
    "supported": "better",
    "refuted": "worse",
    "too small to matter": "too small to matter",
    "undecided": "undecided",
}
SYMBOLS: dict[Outcome, str] = {"supported": "▲", "refuted": "▼", "too small to matter": "≈", "undecided": "●"}


@dataclass(frozen=True)
class ArmVerdict:
    """The verdict on two arms in one metric, with what it takes to read it and the family that it is one of."""

    quantity: Quantity
    verdict: judgement.Verdict
    role: Role = "one of all"

    @property
    def word(self) -> str:
        """Better, worse, too small to matter, or undecided."""
        return WORDS[self.verdict.outcome]

    @property
    def symbol(self) -> str:
        return SYMBOLS[self.verdict.outcome]

    @property
    def seeds(self) -> int | None:
        """The number of seeds that would resolve the worthwhile difference; None: unknown or beyond reach."""
        if self.verdict.deviation is None or self.quantity.worthwhile is None:
            return None
        return seeds_needed(self.verdict.deviation, len(self.verdict.scenes), self.quantity.worthwhile)


@dataclass(frozen=True)
class ArmVerdicts:
    """The verdicts of one pair of arms, the declared metric first; ``notes`` say what could not be had.

    ``missing`` says, of a declared metric that has no verdict here, why.
    """

    verdicts: tuple[ArmVerdict, ...]
    notes: tuple[str, ...]
    declared: Quantity | None = None
    missing: str = ""


def judge(
    trials: Sequence[TrialResult], pairs: Sequence[Pair], declared: ActiveDeclaration | None = None
) -> dict[Pair, ArmVerdicts]:
    """Judge each pair of arms in every metric that has a direction, in the families that ``declared`` makes."""
    by_arm = by_key(trials, lambda trial: trial.arm)
    primary = None if declared is None else declared_quantity(trials, declared)
    asked: list[tuple[Pair, Quantity]] = []
    for pair in pairs:
        own = [trial for arm in pair for trial in by_arm.get(arm, [])]
        shown = [one for one in choose_quantities(own) if not one.cost and one.direction != 0]
        if primary is not None:
            shown = [primary, *(one for one in shown if one.key != primary.key)]
        asked += [(pair, one) for one in shown if one.direction]
    questions = [_question(by_arm, pair, one, declared) for pair, one in asked]
    answers = judgement.judge(trials, _declaration(questions, declared))
    judged = {}
    for pair in pairs:
        found, notes, missing = [], list[str](), ""
        for (arms, one), answer in zip(asked, answers, strict=True):
            if arms != pair:
                continue
            if answer.pairs.rows:
                found.append(ArmVerdict(one, answer, _role(answer.question, declared)))
                notes += [f"{one.name}: {line}" for line in answer.notes]
                continue
            own = [trial for arm in pair for trial in by_arm.get(arm, [])]
            reasons = [in_brief(trial.unavailable[one.key]) for trial in own if one.key in trial.unavailable]
            reason = (*reasons, *answer.notes, f"no trials of {pair[0]} and {pair[1]} can be paired")[0]
            notes.append(f"{one.name}: {reason}")
            missing = reason if primary is not None and one.key == primary.key else missing
        if primary is not None and not primary.direction:
            missing = "whether more of it is better is not known"
            notes.append(f"{primary.name}: {missing}")
        judged[pair] = ArmVerdicts(tuple(found), tuple(notes), primary, missing)
    return judged


def _question(
    by_arm: Mapping[Arm, Sequence[TrialResult]], pair: Pair, one: Quantity, declared: ActiveDeclaration | None
) -> Question:
    """The question of two arms in one metric; of a sweep in looks, about the trials that were planned."""
    baseline, arm = pair
    question = Question(metric=one.key, sign=one.direction, least=one.worthwhile, baseline=baseline, arm=arm)
    if declared is None or not declared.beforehand:
        return question
    asks = next((trial.question for trial in by_arm.get(baseline, [])), "")
    primary = declared.question in ("", asks) and one.key == declared.metric
    for planned in declared.declaration.questions:
        keys = [{folder_key(trial) for trial in by_arm.get(side, [])} for side in pair]
        if planned.scenes and all(a in keys[0] and b in keys[1] for a, b in planned.scenes.values()):
            question = replace(question, scenes=planned.scenes, seeds=planned.seeds)
            question = replace(question, least=planned.least) if primary else question
    return replace(question, secondary=not primary)


def _declaration(questions: Sequence[Question], declared: ActiveDeclaration | None) -> Declaration:
    if declared is None or not declared.beforehand:
        return Declaration(time="1970-01-01T00:00:00Z", questions=tuple(questions))
    one = declared.declaration
    looks = one.looks if all(question.seeds for question in questions) else ()
    return Declaration(time=one.time, questions=tuple(questions), error_rate=one.error_rate, looks=looks)


def _role(question: Question, declared: ActiveDeclaration | None) -> Role:
    if declared is None or not declared.beforehand:
        return "one of all"
    return "secondary" if question.secondary else "declared"


def declared_quantity(trials: Sequence[TrialResult], declared: ActiveDeclaration) -> Quantity:
    """The declared metric; also one of the user's own that no trial could compute."""
    return metric_quantity(declared.metric, trials)


def declared_lines(declared: ActiveDeclaration, judged: dict[Pair, ArmVerdicts]) -> list[str]:
    """Lines below a table that say what was declared, and the verdict on it for each pair of arms."""
    quantity = next(iter(judged.values())).declared if judged else None
    lines = declared.sentences(declared.metric if quantity is None else quantity.name)
    for (first, second), one in judged.items():
        against = f"{second} against {first}"
        found = [verdict for verdict in one.verdicts if verdict.quantity.key == declared.metric]
        if found and found[0].role == "secondary":
            continue  # the other question
        lines += [f"{VERDICT}{against}: {in_words(verdict)}." for verdict in found]
        if not found:
            lines.append(f"{VERDICT}{against}: none, since {declared.metric} has no value: {one.missing}.")
    return lines


def families(judged: Sequence[ArmVerdicts]) -> list[str]:
    """Lines that say how many tests each family had, and how it was adjusted."""
    sizes: dict[Role, int] = {}
    looks = False
    for one in judged:
        for verdict in one.verdicts:
            sizes[verdict.role] = max(sizes.get(verdict.role, 0), verdict.verdict.family)
            looks |= bool(verdict.verdict.question.seeds)
    lines = []
    if "declared" in sizes:
        how = "tested as it is" if sizes["declared"] == 1 else f"adjusted by Holm for {sizes['declared']} pairs of arms"
        lines.append(f"The declared metric is {'judged at each planned look' if looks else how}.")
    if "secondary" in sizes:
        how = "sharing 5 % equally at each look" if looks else f"{sizes['secondary']} tests adjusted by Holm"
        lines.append(
            f"Secondary: all other metrics of all pairs of arms, {how} among themselves; they do not make the verdict."
        )
    if "one of all" in sizes:
        number = counted(sizes["one of all"], "test")
        none = any(one.declared is None for one in judged)
        opening = "No metric was declared beforehand (eval.primary): all" if none else "All"
        lines.append(f"{opening} metrics of all pairs of arms are one family, {number} adjusted by Holm.")
    return lines


def in_words(one: ArmVerdict) -> str:
    """``better in LPIPS VGG raw on these scenes: −0.0123 (95 % interval −0.0200 to −0.0046), p 0.012``"""
    verdict, spec = one.verdict, f".{one.quantity.decimals + 1}f"
    word = f"{one.word} in" if one.word in ("better", "worse") else f"{one.word}, in"
    text = f"{word} {one.quantity.name} on {scope(verdict)}: {signed(verdict.mean or 0.0, spec)}"
    if verdict.interval is None:
        return f"{text}, no test: no trial was repeated with another seed or scene"
    text += f" (interval {signed(verdict.interval.low, spec)} to {signed(verdict.interval.high, spec)}"
    if verdict.p is not None:
        text += f", p {p_text(verdict.p)}"
    text += f", adjusted for {verdict.family} tests)" if verdict.family > 1 else ")"
    return "; ".join([text, *beyond_words(verdict), *outlying_words(verdict)])


def scope(verdict: judgement.Verdict) -> str:
    """The scenes that the verdict speaks of."""
    return "these scenes" if len(verdict.pairs.rows) > 1 else "this scene"


def sign_words(verdict: judgement.Verdict) -> str:
    """``, and better`` of a difference that is too small to matter and whose sign is known."""
    known = verdict.outcome == TOO_SMALL and verdict.interval is not None and verdict.interval.excludes_zero()
    if not known or verdict.mean is None or not verdict.question.sign:
        return ""
    return f", though {'better' if verdict.mean * verdict.question.sign > 0 else 'worse'}"


def beyond_words(verdict: judgement.Verdict) -> list[str]:
    """``it helps in 7 of 8 scenes (p 0.070; 8 would suffice)``: what is said of scenes like these, if anything."""
    one = verdict.like_these
    if one is None:
        return []
    needed = "no count would" if one.needed is None else f"{one.needed} would"
    power = f"{needed} suffice, which is seen in {one.power():.0%} where it helps in nine of ten".replace("%", " %")
    share = f"{one.share.low:.0%} to {one.share.high:.0%}".replace("%", " %")
    beyond = "" if one.beyond is None else f", in {one.beyond} by the least that matters"
    median = ""
    if one.median is not None:
        median = f"; median effect {verdict.shown(one.median.low)} to {verdict.shown(one.median.high)}"
    return [
        f"scenes like these: {WORDS[one.outcome]}, it helps in {one.helped} of {one.scenes}{beyond} (p "
        f"{p_text(one.p)}; {share} "
        f"of such scenes{median}; {power})"
    ]


def outlying_words(verdict: judgement.Verdict) -> list[str]:
    """``far outside the other seeds: garden/sfm-adc/…-seed3; without it: undecided``."""
    if not verdict.outlying:
        return []
    labels = some_of([trial.label for trial in verdict.outlying])
    words = (
        f"far outside the other seeds of its scene and arm: {labels}; without: {WORDS[verdict.without or 'undecided']}"
    )
    return [words]


def p_text(p: float) -> str:
    """``below 0.001``, or p to three places."""
    return "below 0.001" if p < 0.001 else f"{p:.3f}"
