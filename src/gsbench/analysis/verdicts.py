"""The verdicts of a sweep: on each compared pair of arms in each metric that has a direction.

If the question about an arm was declared in time (``eval.primary``), the declared metric decides
it. The arms of one declaration share 5 %, one test per pair of arms, as Demšar (2006, section
3.2.2) adjusts comparisons of many methods with one control. All other metrics of these pairs are
secondary, with 5 % of their own. They are tested even if the declared metric shows nothing, so that
a metric that got worse is seen. A declaration may be about one question only
(``psnr@extrapolation``).

Otherwise the question is exploratory: all metrics of its pair of arms are one family, adjusted by
Holm (1979). So a further arm never changes the verdict on another one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from gsbench.analysis.cells import short_reason
from gsbench.analysis.declaration import ActiveDeclaration, Standing
from gsbench.analysis.designs import seeds_needed
from gsbench.analysis.judgement import Verdict, judge
from gsbench.analysis.quantities import (
    NO_DIRECTION,
    Quantity,
    asked_quantity,
    choose_quantities,
)
from gsbench.analysis.results import Arm, TrialResult, group_by
from gsbench.analysis.statistics import ALPHA, TOO_SMALL, UNDECIDED, Outcome, exact_for
from gsbench.analysis.unfinished import lacking_words
from gsbench.runs.experiments import NO_TIME, Declaration, Question
from gsbench.words import some_of

ArmPair = tuple[Arm, Arm]  # baseline, other arm
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

    ``notes`` say what could not be compared. ``declared`` is the declared metric, ``standing``
    how the declaration stands to this question. ``missing`` says why the metric has no verdict,
    ``undeclared`` why the question is exploratory if no metric was declared.
    """

    first: Arm
    second: Arm
    verdicts: tuple[Verdict, ...]
    notes: tuple[str, ...]
    declared: Quantity | None = None
    standing: Standing | None = None
    missing: str = ""
    undeclared: str = "no metric was declared (eval.primary)"

    @property
    def beforehand(self) -> bool:
        """Return whether the question was declared before any result of its arm."""
        return self.standing is not None and self.standing.beforehand

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
    lacking: Sequence[Path] = (),
) -> list[PairVerdicts]:
    """Judge each pair of arms in every metric that has a direction.

    ``declared`` defines the families of tests; ``lacking`` are folders of trials without a result.
    """
    by_arm = group_by(trials, lambda trial: trial.arm)
    primary = None if declared is None else asked_quantity(declared.metric, trials)
    standings: dict[ArmPair, Standing] = {}
    asked: list[tuple[ArmPair, Quantity, Question]] = []
    for pair in pairs:
        metrics = [
            metric for metric in choose_quantities(_trials_of(by_arm, pair)) if not metric.cost
        ]
        if declared is not None and primary is not None:
            standings[pair] = declared.standing(*(by_arm.get(arm, []) for arm in pair))
            metrics = [primary, *(metric for metric in metrics if metric.key != primary.key)]
        for metric in metrics:
            if metric.direction:
                question = _question(by_arm, pair, metric, declared, standings.get(pair))
                asked.append((pair, metric, question))
    questions = [(pair, own) for pair, _, own in asked]
    verdicts = _judge_families(trials, questions, standings, lacking)
    by_pair = group_by(zip(asked, verdicts, strict=True), lambda answered: answered[0][0])
    judged = []
    for pair in pairs:
        own, notes, missing = [], list[str](), ""
        for (_, metric, _), verdict in by_pair.get(pair, []):
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
        standing = standings.get(pair)
        judged.append(PairVerdicts(*pair, tuple(own), tuple(notes), primary, standing, missing))
    return judged


def _judge_families(
    trials: Sequence[TrialResult],
    asked: Sequence[tuple[ArmPair, Question]],
    standings: Mapping[ArmPair, Standing],
    lacking: Sequence[Path],
) -> list[Verdict]:
    """Judge each family of questions: those of one declaration, or of one exploratory pair."""

    def family(entry: tuple[int, tuple[ArmPair, Question]]) -> tuple[object, ...]:
        pair, question = entry[1]
        standing = standings.get(pair)
        if standing is None or not standing.beforehand:
            return pair
        # The baseline's own settings are a family of their own: questions about ideas pay nothing
        # for them.
        is_setting = pair[0].densify == pair[1].densify
        named = standing.declaration
        return named.time, named.hash, bool(question.seeds), is_setting

    verdicts: dict[int, Verdict] = {}
    for own in group_by(enumerate(asked), family).values():
        standing, questions = standings.get(own[0][1][0]), tuple(one for _, (_, one) in own)
        # Without a time no trial is late, so Holm's method alone adjusts for the number of metrics.
        declaration = Declaration(time=NO_TIME, questions=questions)
        if standing is not None and standing.beforehand:
            named = standing.declaration
            looks = named.looks if questions[0].seeds else ()
            # an arm without any trial yet keeps its share of the error rate
            asked_scenes = [one.scenes for one in questions]
            waiting = [one for one in named.questions if looks and one.scenes not in asked_scenes]
            declaration = Declaration(
                time=NO_TIME,
                questions=(*questions, *waiting),
                error_rate=named.error_rate,
                looks=looks,
            )
        places = [place for place, _ in own]
        verdicts |= dict(zip(places, judge(trials, declaration, lacking), strict=False))
    return [verdicts[place] for place in range(len(asked))]


def _trials_of(by_arm: Mapping[Arm, Sequence[TrialResult]], pair: ArmPair) -> list[TrialResult]:
    return [trial for arm in pair for trial in by_arm.get(arm, [])]


def _question(
    by_arm: Mapping[Arm, Sequence[TrialResult]],
    pair: ArmPair,
    metric: Quantity,
    declared: ActiveDeclaration | None,
    standing: Standing | None,
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
    if declared is None or standing is None or not standing.beforehand:
        return question
    split_question = next((trial.question for trial in by_arm.get(baseline, [])), "")
    is_primary = declared.question in ("", split_question) and metric.key == declared.metric
    for planned in standing.declaration.questions:
        keys = [{trial.key for trial in by_arm.get(side, [])} for side in pair]
        if planned.scenes and all(
            a in keys[0] and b in keys[1] for a, b in planned.scenes.values()
        ):
            question = replace(question, scenes=planned.scenes, seeds=planned.seeds)
            question = replace(question, least=planned.least) if is_primary else question
    return replace(question, secondary=not is_primary)


def seeds_to_resolve(verdict: Verdict) -> int | None:
    """The number of seeds that would resolve the worthwhile difference.

    None if that is unknown, or if there would be too many to run.
    """
    if verdict.deviation is None or verdict.quantity.worthwhile is None:
        return None
    return seeds_needed(verdict.deviation, len(verdict.scenes), verdict.quantity.worthwhile)


def sentence(judged: PairVerdicts) -> str:
    """The verdict on two arms in one sentence, the same wherever it is shown.

    If the question was declared in time, the sentence has only the declared metric's verdict.
    """
    verdicts, against = judged.verdicts, f"{judged.second} against {judged.first}"
    if judged.missing and judged.declared is not None and judged.beforehand:
        return (
            f"{against}: no verdict, since the declared metric {judged.declared.name} has no "
            f"value ({judged.missing})."
        )
    if not verdicts:
        return f"{against}: no verdict, since {no_pairs(judged)}."
    where = _scope(verdicts[0])
    if all(one.equal for one in verdicts):
        return (
            f"{against}, on {where}: equal in every metric, to the last bit. The settings that "
            "differ had no effect: look at the events, and at train.densify_start and "
            "densify_stop."
        )
    first = verdicts[0]
    if judged.role(first) == DECLARED:
        if first.interval is None:
            return f"{against}: no verdict yet, {first.untestable or _too_few(judged, first)}."
        waits = "" if first.final else "not decided yet, "
        seeds = ""
        if planned := first.question.seeds:
            seeds = f", with {first.pairs.seeds} of at most {len(planned)} seeds"
        return f"{against}: {waits}{in_words(first)}{seeds}. The metric was declared beforehand."
    in_doubt = [one for one in verdicts if one.favours_lacking][:1]
    if all(one.interval is None for one in verdicts):
        return f"{against}: no verdict, {TOO_FEW.format(where)}."
    return (
        f"{against}, on {where}: {_by_word(verdicts, with_numbers=True)}. Exploratory: "
        f"{_why_exploratory(judged)}, so all metrics count, adjusted for their number "
        f"({max(one.family for one in verdicts)})."
        + "".join(f" Undecided: {lacking_words(one.lacking)}." for one in in_doubt)
    )


TOO_FEW = "one trial of each on {}; run more seeds"
BEFORE_LOOKS = (
    "not all of the first {} seeds are there in both arms; give the sweep's command again"
)


def _too_few(judged: PairVerdicts, verdict: Verdict) -> str:
    standing = judged.standing
    if verdict.question.seeds and standing is not None and standing.declaration.looks:
        return BEFORE_LOOKS.format(standing.declaration.looks[0])
    return TOO_FEW.format(_scope(verdict))


def no_pairs(judged: PairVerdicts) -> str:
    """The reason why no trials of two arms could be compared."""
    return next(
        (note.partition(": ")[2] for note in judged.notes),
        f"no trials of {judged.first} and {judged.second} can be paired",
    )


def _why_exploratory(judged: PairVerdicts) -> str:
    if judged.declared is None:
        return judged.undeclared
    name = judged.declared.name
    if judged.standing is not None and judged.standing.doubt:
        return f"{name} was declared, but {judged.standing.doubt}"
    return f"the declaration of {name} asks about another split"


def secondary(judged: PairVerdicts) -> str:
    """The verdicts in secondary metrics in one sentence; "" if none of them has an interval."""
    secondaries = [one for one in judged.verdicts if one.question.secondary]
    decidable = any(one.interval is not None for one in secondaries)
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
        word: [named(one) for one in verdicts if WORDS[one.outcome] == word]
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


def families(judged: Sequence[PairVerdicts]) -> list[str]:
    """Lines on the families of tests: their sizes, and how they are adjusted."""
    by_role = group_by(
        ((one.role(verdict), verdict) for one in judged for verdict in one.verdicts),
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
        lines.append(
            "Exploratory verdicts: all metrics of a pair of arms are one family, "
            f"{number} adjusted by Holm."
        )
    return lines


def _or(sizes: Sequence[int]) -> str:
    return " or ".join(map(str, sizes))


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
        parts.append(
            f"far outside the other seeds of its scene and arm: {labels}; without it: {word}"
        )
    return "; ".join(parts)


def p_text(p: float) -> str:
    """``below 0.001``, or p with three decimals."""
    return "below 0.001" if p < 0.001 else f"{p:.3f}"
