"""The verdicts of a sweep: on each compared pair of arms in each metric that has a direction.

Without a declaration (``eval.primary``), all metrics of all pairs are one family, adjusted by Holm
(1979). With one, there are two families, each with its own 5 %: the declared metric, with one test
per pair of arms, as Demšar (2006, section 3.2.2) adjusts comparisons of many methods with one
control; and all other metrics of all pairs, called secondary. A declaration may be about one
question only (``psnr@extrapolation``).

Secondary metrics are tested even if the declared metric shows nothing, so that a metric that got
worse is seen. If a metric was declared after results, or seeds or arms were added after results,
all metrics are one family again.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from gsbench.analysis.cells import short_reason
from gsbench.analysis.declaration import ActiveDeclaration
from gsbench.analysis.judgement import Verdict, judge
from gsbench.analysis.quantities import (
    NO_DIRECTION,
    Quantity,
    asked_quantity,
    choose_quantities,
)
from gsbench.analysis.results import Arm, TrialResult, group_by
from gsbench.analysis.statistics import ALPHA, TOO_SMALL, Outcome, exact_for, seeds_needed
from gsbench.runs.experiments import NO_TIME, Declaration, Question
from gsbench.words import counted, some_of

ArmPair = tuple[Arm, Arm]  # baseline, other arm
VERDICT = "Verdict, "  # prefix of the lines below a table that state verdicts
DECLARED, SECONDARY = "declared", "secondary"
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


@dataclass(frozen=True)
class PairVerdicts:
    """The verdicts on two arms, that on the declared metric first.

    ``notes`` say what could not be compared. ``declared`` is the declared metric,
    ``beforehand`` whether it was declared before any result. ``missing`` says why it has no
    verdict for these arms.
    """

    first: Arm
    second: Arm
    verdicts: tuple[Verdict, ...]
    notes: tuple[str, ...]
    declared: Quantity | None = None
    beforehand: bool = False
    missing: str = ""

    def role(self, verdict: Verdict) -> str:
        """Declared or secondary; "" if all metrics are one family."""
        return SECONDARY if verdict.question.secondary else DECLARED if self.beforehand else ""

    @property
    def primary(self) -> tuple[Verdict, ...]:
        """The verdicts that are not secondary."""
        return tuple(one for one in self.verdicts if not one.question.secondary)


def judge_pairs(
    trials: Sequence[TrialResult],
    pairs: Sequence[ArmPair],
    declared: ActiveDeclaration | None = None,
) -> list[PairVerdicts]:
    """Judge each pair of arms in every metric that has a direction.

    ``declared`` defines the families of tests.
    """
    by_arm = group_by(trials, lambda trial: trial.arm)
    primary = None if declared is None else asked_quantity(declared.metric, trials)
    asked: list[tuple[ArmPair, Quantity]] = []
    for pair in pairs:
        metrics = [
            metric for metric in choose_quantities(_trials_of(by_arm, pair)) if not metric.cost
        ]
        if primary is not None:
            metrics = [primary, *(metric for metric in metrics if metric.key != primary.key)]
        asked += [(pair, metric) for metric in metrics if metric.direction]
    questions = [_question(by_arm, pair, metric, declared) for pair, metric in asked]
    verdicts = judge(trials, _declaration(questions, declared))
    by_pair = group_by(zip(asked, verdicts, strict=True), lambda answered: answered[0][0])
    beforehand = declared is not None and declared.beforehand
    judged = []
    for pair in pairs:
        own, notes, missing = [], list[str](), ""
        for (_, metric), verdict in by_pair.get(pair, []):
            if verdict.pairs.rows:
                own.append(verdict)
                notes += [f"{metric.name}: {line}" for line in verdict.notes]
                continue
            unavailable = [trial.unavailable.get(metric.key) for trial in _trials_of(by_arm, pair)]
            reasons = [short_reason(reason) for reason in unavailable if reason is not None]
            reason = (
                *reasons,
                *verdict.notes,
                f"no trials of {pair[0]} and {pair[1]} can be paired",
            )[0]
            notes.append(f"{metric.name}: {reason}")
            missing = reason if metric == primary else missing
        if primary is not None and not primary.direction:
            missing = NO_DIRECTION
            notes.append(f"{primary.name}: {missing}")
        judged.append(PairVerdicts(*pair, tuple(own), tuple(notes), primary, beforehand, missing))
    return judged


def _trials_of(by_arm: Mapping[Arm, Sequence[TrialResult]], pair: ArmPair) -> list[TrialResult]:
    return [trial for arm in pair for trial in by_arm.get(arm, [])]


def _question(
    by_arm: Mapping[Arm, Sequence[TrialResult]],
    pair: ArmPair,
    metric: Quantity,
    declared: ActiveDeclaration | None,
) -> Question:
    """The question about two arms in one metric; in a sweep in looks, about the planned trials."""
    baseline, arm = pair
    question = Question(
        metric=metric.key,
        sign=metric.direction,
        least=metric.worthwhile,
        baseline=baseline,
        arm=arm,
    )
    if declared is None or not declared.beforehand:
        return question
    split_question = next((trial.question for trial in by_arm.get(baseline, [])), "")
    is_primary = declared.question in ("", split_question) and metric.key == declared.metric
    for planned in declared.declaration.questions:
        keys = [{trial.key for trial in by_arm.get(side, [])} for side in pair]
        if planned.scenes and all(
            a in keys[0] and b in keys[1] for a, b in planned.scenes.values()
        ):
            question = replace(question, scenes=planned.scenes, seeds=planned.seeds)
            question = replace(question, least=planned.least) if is_primary else question
    return replace(question, secondary=not is_primary)


def _declaration(questions: Sequence[Question], declared: ActiveDeclaration | None) -> Declaration:
    if declared is None or not declared.beforehand:
        # No time: the trials then are not late, so Holm's method alone adjusts for the number of
        # metrics.
        return Declaration(time=NO_TIME, questions=tuple(questions))
    recorded = declared.declaration
    looks = recorded.looks if all(question.seeds for question in questions) else ()
    return Declaration(
        time=recorded.time, questions=tuple(questions), error_rate=recorded.error_rate, looks=looks
    )


def seeds_to_resolve(verdict: Verdict) -> int | None:
    """The number of seeds that would resolve the worthwhile difference.

    None if that is unknown, or if there would be too many to run.
    """
    if verdict.deviation is None or verdict.quantity.worthwhile is None:
        return None
    return seeds_needed(verdict.deviation, len(verdict.scenes), verdict.quantity.worthwhile)


def headline(judged: PairVerdicts) -> str:
    """The verdicts on two arms in one sentence.

    If a metric was declared beforehand, the sentence has only its verdict.
    """
    verdicts, against = judged.verdicts, f"{judged.second} against {judged.first}"
    if not verdicts:
        return (
            f"{judged.second} and {judged.first} cannot be compared: no metric has paired trials."
        )
    where = _scope(verdicts[0])
    if all(one.equal for one in verdicts):
        return (
            f"{against}, on {where}: equal in every metric, to the last bit. The settings that "
            "differ had no effect: "
            "look at the events, and at train.densify_start and densify_stop."
        )
    if all(one.interval is None for one in verdicts):
        return f"{against}: no verdict, one trial of each on {where}; run more seeds."
    if judged.missing and judged.declared is not None:
        return (
            f"{against}: no verdict, since the declared metric {judged.declared.name} has no "
            f"value ({judged.missing})."
        )
    if judged.role(verdicts[0]) == DECLARED:
        return f"{against}, on {where}: {_by_word(verdicts[:1])}, the metric declared beforehand."
    adjusted = "" if judged.declared is None else ", all metrics adjusted for their number"
    return f"{against}, on {where}{adjusted}: {_by_word(verdicts)}."


def secondary(judged: PairVerdicts) -> str:
    """The verdicts in secondary metrics in one sentence; "" if none of them has an interval."""
    secondaries = [one for one in judged.verdicts if one.question.secondary]
    decidable = any(one.interval is not None for one in secondaries)
    return f"Secondary, adjusted for their number: {_by_word(secondaries)}." if decidable else ""


def _by_word(verdicts: Sequence[Verdict]) -> str:
    """``better in PSNR; undecided in SSIM, FLIP``"""
    names_by_word = {
        word: [
            f"{one.quantity.name}{_known_sign(one)}"
            for one in verdicts
            if WORDS[one.outcome] == word
        ]
        for word in WORDS.values()
    }
    return "; ".join(
        f"{word} in {', '.join(names)}" for word, names in names_by_word.items() if names
    )


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


def detail_lines(verdicts: Sequence[Verdict]) -> list[str]:
    """Lines on scenes like these and on outlying trials, for each metric that has them."""
    return [
        f"{one.quantity.name}: {line}"
        for one in verdicts
        for line in (like_these_words(one, WORDS, "it helps"), outlying_words(one))
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


def declared_lines(declared: ActiveDeclaration, judged: Sequence[PairVerdicts]) -> list[str]:
    """Lines below a table: what was declared, and its verdict for each pair of arms."""
    quantity = judged[0].declared if judged else None
    lines = declared.sentences(declared.metric if quantity is None else quantity.name)
    for one in judged:
        against = f"{one.second} against {one.first}"
        verdicts = [
            verdict for verdict in one.verdicts if verdict.question.metric == declared.metric
        ]
        if verdicts and verdicts[0].question.secondary:
            continue  # these arms' split asks another question than the declared one
        lines += [f"{VERDICT}{against}: {in_words(verdict)}." for verdict in verdicts]
        if not verdicts:
            lines.append(
                f"{VERDICT}{against}: none, since {declared.metric} has no value: {one.missing}."
            )
    return lines


def families(judged: Sequence[PairVerdicts]) -> list[str]:
    """Lines on the families of tests: their sizes, and how they are adjusted."""
    by_role = group_by(
        ((one.role(verdict), verdict) for one in judged for verdict in one.verdicts),
        lambda entry: entry[0],
    )
    sizes = {role: max(verdict.family for _, verdict in own) for role, own in by_role.items()}
    looks = any(verdict.question.seeds for own in by_role.values() for _, verdict in own)
    lines = []
    if DECLARED in sizes:
        how = (
            "not adjusted: it is one test"
            if sizes[DECLARED] == 1
            else f"adjusted by Holm for {sizes[DECLARED]} tests"
        )
        lines.append(f"The declared metric is {'judged at each planned look' if looks else how}.")
    if SECONDARY in sizes:
        how = (
            "at each look they share 5 % equally"
            if looks
            else f"Holm adjusts them for {sizes[SECONDARY]} tests"
        )
        lines.append(f"All other metrics are secondary and do not decide the verdict; {how}.")
    if "" in sizes:
        undeclared = any(one.declared is None for one in judged)
        opening = "No metric was declared beforehand (eval.primary): all" if undeclared else "All"
        number = counted(sizes[""], "test")
        lines.append(
            f"{opening} metrics of all pairs of arms are one family, {number} adjusted by Holm."
        )
    return lines


def in_words(verdict: Verdict) -> str:
    """A verdict in words.

    For example ``better in LPIPS VGG raw on these scenes: −0.0123 (interval −0.0200 to −0.0046,
    p 0.012)``.
    """
    word, name = WORDS[verdict.outcome], verdict.quantity.name
    text = f"{word} in {name} on {_scope(verdict)}: {verdict.shown(verdict.mean or 0.0)}"
    if verdict.interval is None:
        return f"{text}, no test: no trial was repeated with another seed or scene"
    text += f" (interval {verdict.shown_interval(verdict.interval)}"
    if verdict.p is not None:
        text += f", p {p_text(verdict.p)}"
    text += f", adjusted for {verdict.family} tests)" if verdict.family > 1 else ")"
    return "; ".join(
        filter(None, [text, like_these_words(verdict, WORDS, "it helps"), outlying_words(verdict)])
    )


def like_these_words(verdict: Verdict, words: Mapping[Outcome, str], what: str) -> str:
    """The statement about scenes like these in words; "" with too few scenes.

    For example ``scenes like these: undecided; it helps in 7 of 8 (sign test p 0.070, …)``.
    ``words`` has other words for outcomes, ``what`` the words for a gain.
    """
    like = verdict.like_these
    if like is None:
        return ""
    word = words.get(like.outcome, like.outcome)
    least = "" if like.beyond is None else f", by the least that matters in {like.beyond}"
    median = "" if like.median is None else f"; median {verdict.shown_interval(like.median)}"
    needed = "no number of them would" if like.needed is None else f"{like.needed} of them would"
    seen = (
        f", which {100 * like.power():.0f} % of sweeps see where nine of ten do"
        if like.needed
        else ""
    )
    return (
        f"scenes like these: {word}; {what} in {like.helped} of {like.scenes}{least} (sign test p "
        f"{p_text(like.p)}, {100 * like.share.low:.0f} to {100 * like.share.high:.0f} % of such "
        f"scenes{median}); "
        f"{needed} suffice at {100 * (1 - like.level):.3g} %{seen}; exact for: "
        f"{exact_for(verdict.pairs.seeds)}"
    )


def outlying_words(verdict: Verdict) -> str:
    """The outlying trials of a verdict in words; "" if there are none.

    For example ``far outside the other seeds: garden/sfm-adc/…-seed3; without it: undecided``.
    """
    if not verdict.outlying:
        return ""
    labels, word = (
        some_of([trial.label for trial in verdict.outlying]),
        WORDS[verdict.outcome_without or "undecided"],
    )
    return f"far outside the other seeds of its scene and arm: {labels}; without it: {word}"


def p_text(p: float) -> str:
    """``below 0.001``, or p with three decimals."""
    return "below 0.001" if p < 0.001 else f"{p:.3f}"
