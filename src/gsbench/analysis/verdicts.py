"""The verdicts of a sweep: every two arms that are compared, in every metric that has a direction, as one declaration.

Where nothing was declared (``eval.primary``), all metrics of all pairs are one family, adjusted by Holm (1979). Where a
metric was declared, at one question if one was named (``psnr@extrapolation``), two families are kept apart, each with
its own 5 %: the declared metric, one test for each pair of arms, as Demšar (2006, section 3.2.2) adjusts comparisons of
many methods with one control; and all other metrics of all pairs, called secondary.

There is no gate between the two: where the declared metric shows nothing, a secondary one that got worse must still be
seen. A metric that was declared when results were there, or to which seeds or arms were added then, has no place of
its own: then all are one family.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from gsbench.analysis.cells import short_reason
from gsbench.analysis.declaration import ActiveDeclaration
from gsbench.analysis.judgement import Verdict, judge
from gsbench.analysis.planning import seeds_needed
from gsbench.analysis.quantities import Quantity, asked_quantity, choose_quantities
from gsbench.analysis.results import Arm, TrialResult, by_key
from gsbench.analysis.statistics import ALPHA, TOO_SMALL, Outcome
from gsbench.runs.declaration import Declaration, Question
from gsbench.words import counted, some_of

Pair = tuple[Arm, Arm]
VERDICT = "Verdict, "  # how a line below a table begins that says one
DECLARED, SECONDARY = "declared", "secondary"
WORDS: dict[Outcome, str] = {
    "supported": "better",
    "refuted": "worse",
    "too small to matter": "too small to matter",
    "undecided": "undecided",
}
SYMBOLS: dict[Outcome, str] = {"supported": "▲", "refuted": "▼", "too small to matter": "≈", "undecided": "●"}


@dataclass(frozen=True)
class PairVerdicts:
    """The verdicts on two arms, the declared metric's first; ``notes`` say what could not be had.

    ``declared`` is the metric that was declared, ``beforehand`` whether it was before any result; ``missing`` says why
    it has no verdict here.
    """

    first: Arm
    second: Arm
    verdicts: tuple[Verdict, ...]
    notes: tuple[str, ...]
    declared: Quantity | None = None
    beforehand: bool = False
    missing: str = ""

    def role(self, verdict: Verdict) -> str:
        """Declared, secondary, or "" of one of all."""
        return SECONDARY if verdict.question.secondary else DECLARED if self.beforehand else ""

    @property
    def primary(self) -> tuple[Verdict, ...]:
        """The verdicts that are not secondary."""
        return tuple(one for one in self.verdicts if not one.question.secondary)


def judge_pairs(
    trials: Sequence[TrialResult], pairs: Sequence[Pair], declared: ActiveDeclaration | None = None
) -> list[PairVerdicts]:
    """Judge each pair of arms in every metric that has a direction, in the families that ``declared`` makes."""
    by_arm = by_key(trials, lambda trial: trial.arm)
    primary = None if declared is None else asked_quantity(declared.metric, trials)
    asked: list[tuple[Pair, Quantity]] = []
    for pair in pairs:
        shown = [one for one in choose_quantities(_own(by_arm, pair)) if not one.cost]
        if primary is not None:
            shown = [primary, *(one for one in shown if one.key != primary.key)]
        asked += [(pair, one) for one in shown if one.direction]
    questions = [_question(by_arm, pair, one, declared) for pair, one in asked]
    answers = by_key(
        zip(asked, judge(trials, _declaration(questions, declared)), strict=True), lambda answered: answered[0][0]
    )
    alone = declared is not None and declared.beforehand
    judged = []
    for pair in pairs:
        found, notes, missing = [], list[str](), ""
        for (_, one), answer in answers.get(pair, []):
            if answer.pairs.rows:
                found.append(answer)
                notes += [f"{one.name}: {line}" for line in answer.notes]
                continue
            reasons = [short_reason(t.unavailable[one.key]) for t in _own(by_arm, pair) if one.key in t.unavailable]
            reason = (*reasons, *answer.notes, f"no trials of {pair[0]} and {pair[1]} can be paired")[0]
            notes.append(f"{one.name}: {reason}")
            missing = reason if one == primary else missing
        if primary is not None and not primary.direction:
            missing = "nobody said whether more or less of it is better"
            notes.append(f"{primary.name}: {missing}")
        judged.append(PairVerdicts(*pair, tuple(found), tuple(notes), primary, alone, missing))
    return judged


def _own(by_arm: Mapping[Arm, Sequence[TrialResult]], pair: Pair) -> list[TrialResult]:
    return [trial for arm in pair for trial in by_arm.get(arm, [])]


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
        keys = [{trial.key for trial in by_arm.get(side, [])} for side in pair]
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


def seeds_to_resolve(verdict: Verdict) -> int | None:
    """The number of seeds that would resolve the worthwhile difference; None: unknown or beyond reach."""
    if verdict.deviation is None or verdict.quantity.worthwhile is None:
        return None
    return seeds_needed(verdict.deviation, len(verdict.scenes), verdict.quantity.worthwhile)


def headline(judged: PairVerdicts) -> str:
    """The verdicts on two arms in one sentence, the declared metric's alone where there is one."""
    verdicts, against = judged.verdicts, f"{judged.second} against {judged.first}"
    if not verdicts:
        return f"{judged.second} and {judged.first} cannot be compared: no metric has paired trials."
    where = _scope(verdicts[0])
    if all(one.equal for one in verdicts):
        return (
            f"{against}, on {where}: equal in every metric, to the last bit. The settings that differ had no effect: "
            "look at the events, and at train.densify_start and densify_stop."
        )
    if all(one.interval is None for one in verdicts):
        return f"{against}: no verdict, one trial of each on {where}; run more seeds."
    if judged.missing and judged.declared is not None:
        return (
            f"{against}: no verdict, since the declared metric {judged.declared.name} has no value ({judged.missing})."
        )
    if judged.role(verdicts[0]) == DECLARED:
        return f"{against}, on {where}: {_by_word(verdicts[:1])}, the metric declared beforehand."
    adjusted = "" if judged.declared is None else ", all metrics adjusted for their number"
    return f"{against}, on {where}{adjusted}: {_by_word(verdicts)}."


def secondary(judged: PairVerdicts) -> str:
    """The secondary metrics in one sentence, where one was declared and they can be decided."""
    others = [one for one in judged.verdicts if one.question.secondary]
    decidable = any(one.interval is not None for one in others)
    return f"Secondary, adjusted for their number: {_by_word(others)}." if decidable else ""


def _by_word(verdicts: Sequence[Verdict]) -> str:
    """``better in PSNR; undecided in SSIM, FLIP``"""
    found = {
        word: [f"{one.quantity.name}{_known_sign(one)}" for one in verdicts if WORDS[one.outcome] == word]
        for word in WORDS.values()
    }
    return "; ".join(f"{word} in {', '.join(names)}" for word, names in found.items() if names)


def _known_sign(verdict: Verdict) -> str:
    """``, though better`` of a difference that is too small to matter and whose sign is known."""
    known = verdict.outcome == TOO_SMALL and verdict.interval is not None and verdict.interval.excludes_zero()
    if not known or verdict.mean is None or not verdict.question.sign:
        return ""
    return f", though {'better' if verdict.mean * verdict.question.sign > 0 else 'worse'}"


def _scope(verdict: Verdict) -> str:
    """The scenes that the verdict speaks of."""
    return "these scenes" if len(verdict.pairs.rows) > 1 else "this scene"


def detail_lines(verdicts: Sequence[Verdict]) -> list[str]:
    """A line for each metric that says more than its row: scenes like these, trials far outside the others."""
    return [
        f"{one.quantity.name}: {line}"
        for one in verdicts
        for line in (like_these_words(one, WORDS, "it helps"), outlying_words(one))
        if line
    ]


def by_scene_lines(verdicts: Sequence[Verdict]) -> list[str]:
    """A line for each metric in which single scenes are decided (p below 5 %, adjusted), which names them.

    A mean over scenes that disagree hides both sides of what was found.
    """
    lines = []
    for one in verdicts:
        decided = [scene for scene in one.scenes if scene.p is not None and scene.p < ALPHA]
        sides = {
            word: [scene.scene for scene in decided if scene.mean * one.question.sign * side > 0]
            for word, side in (("better", 1), ("worse", -1))
        }
        found = [f"{word} on {', '.join(scenes)}" for word, scenes in sides.items() if scenes]
        if len(one.scenes) > 1 and found:
            warning = ": the scenes disagree, so their mean says little" if len(found) > 1 else ""
            lines.append(f"{one.quantity.name} by scene: {', '.join(found)}{warning}")
    return lines


def declared_lines(declared: ActiveDeclaration, judged: Sequence[PairVerdicts]) -> list[str]:
    """Lines below a table that say what was declared, and the verdict on it for each pair of arms."""
    quantity = judged[0].declared if judged else None
    lines = declared.sentences(declared.metric if quantity is None else quantity.name)
    for one in judged:
        against = f"{one.second} against {one.first}"
        found = [verdict for verdict in one.verdicts if verdict.question.metric == declared.metric]
        if found and found[0].question.secondary:
            continue  # the other question
        lines += [f"{VERDICT}{against}: {in_words(verdict)}." for verdict in found]
        if not found:
            lines.append(f"{VERDICT}{against}: none, since {declared.metric} has no value: {one.missing}.")
    return lines


def families(judged: Sequence[PairVerdicts]) -> list[str]:
    """Lines that say how many tests each family had, and how it was adjusted."""
    every = [(one.role(verdict), verdict) for one in judged for verdict in one.verdicts]
    sizes = {role: max(own.family for which, own in every if which == role) for role, _ in every}
    looks = any(verdict.question.seeds for _, verdict in every)
    lines = []
    if DECLARED in sizes:
        how = (
            "not adjusted: it is one test" if sizes[DECLARED] == 1 else f"adjusted by Holm for {sizes[DECLARED]} tests"
        )
        lines.append(f"The declared metric is {'judged at each planned look' if looks else how}.")
    if SECONDARY in sizes:
        how = "at each look they share 5 % equally" if looks else f"Holm adjusts them for {sizes[SECONDARY]} tests"
        lines.append(f"All other metrics are secondary and do not decide the verdict; {how}.")
    if "" in sizes:
        none = any(one.declared is None for one in judged)
        opening = "No metric was declared beforehand (eval.primary): all" if none else "All"
        number = counted(sizes[""], "test")
        lines.append(f"{opening} metrics of all pairs of arms are one family, {number} adjusted by Holm.")
    return lines


def in_words(verdict: Verdict) -> str:
    """``better in LPIPS VGG raw on these scenes: −0.0123 (interval −0.0200 to −0.0046, p 0.012)``"""
    word, name = WORDS[verdict.outcome], verdict.quantity.name
    text = f"{word} in {name} on {_scope(verdict)}: {verdict.shown(verdict.mean or 0.0)}"
    if verdict.interval is None:
        return f"{text}, no test: no trial was repeated with another seed or scene"
    text += f" (interval {verdict.shown_interval(verdict.interval)}"
    if verdict.p is not None:
        text += f", p {p_text(verdict.p)}"
    text += f", adjusted for {verdict.family} tests)" if verdict.family > 1 else ")"
    return "; ".join(filter(None, [text, like_these_words(verdict, WORDS, "it helps"), outlying_words(verdict)]))


def like_these_words(verdict: Verdict, words: Mapping[Outcome, str], what: str) -> str:
    """``scenes like these: undecided; it helps in 7 of 8 (sign test p 0.070, …)``; "" of too few scenes."""
    found = verdict.like_these
    if found is None:
        return ""
    least = "" if found.beyond is None else f", by the least that matters in {found.beyond}"
    median = "" if found.median is None else f"; median effect {verdict.shown_interval(found.median)}"
    needed = "no number of them would" if found.needed is None else f"{found.needed} of them would"
    seen = f", which {100 * found.power():.0f} % of sweeps see where nine of ten do" if found.needed else ""
    return (
        f"scenes like these: {words[found.outcome]}; {what} in {found.helped} of {found.scenes}{least} (sign test p "
        f"{p_text(found.p)}, {100 * found.share.low:.0f} to {100 * found.share.high:.0f} % of such scenes{median}); "
        f"{needed} suffice at {100 * (1 - found.level):.3g} %{seen}"
    )


def outlying_words(verdict: Verdict) -> str:
    """``far outside the other seeds: garden/sfm-adc/…-seed3; without it: undecided``; "" where none is."""
    if not verdict.outlying:
        return ""
    labels, word = some_of([trial.label for trial in verdict.outlying]), WORDS[verdict.outcome_without or "undecided"]
    return f"far outside the other seeds of its scene and arm: {labels}; without it: {word}"


def p_text(p: float) -> str:
    """``below 0.001``, or p to three places."""
    return "below 0.001" if p < 0.001 else f"{p:.3f}"
