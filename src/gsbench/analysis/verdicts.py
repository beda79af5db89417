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

from gsbench.analysis.cells import short_reason
from gsbench.analysis.declaration import ActiveDeclaration, Standing
from gsbench.analysis.designs import seeds_needed
from gsbench.analysis.judgement import Verdict, judge
from gsbench.analysis.notes import Note
from gsbench.analysis.quantities import (
    NO_DIRECTION,
    Quantity,
    asked_quantity,
    choose_quantities,
)
from gsbench.analysis.results import Arm, TrialResult, group_by
from gsbench.analysis.unfinished import Unfinished
from gsbench.runs.experiments import NO_TIME, Declaration, Question

ArmPair = tuple[Arm, Arm]  # baseline, other arm
DECLARED, SECONDARY = "declared", "secondary"


@dataclass(frozen=True)
class PairVerdicts:
    """The verdicts on two arms, that on the declared metric first.

    ``notes`` say what could not be compared, each ``about`` a metric. ``declared`` is the declared
    metric, ``standing`` how the declaration stands to this question. ``undeclared`` says why the
    question is exploratory if no metric was declared.
    """

    first: Arm
    second: Arm
    verdicts: tuple[Verdict, ...]
    notes: tuple[Note, ...]
    declared: Quantity | None = None
    standing: Standing | None = None
    undeclared: str = "no metric was declared (eval.primary)"

    @property
    def beforehand(self) -> bool:
        """Return whether the question was declared before any result of its arm."""
        return self.standing is not None and self.standing.beforehand

    @property
    def missing(self) -> Note | None:
        """The reason why the declared metric has no verdict, if it has none."""
        if self.declared is None or any(
            one.quantity.key == self.declared.key for one in self.verdicts
        ):
            return None
        return next((note for note in self.notes if note.about == self.declared.name), None)

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
    lacking: Sequence[Unfinished] = (),
    others: Sequence[ArmPair] = (),
) -> list[PairVerdicts]:
    """Judge each pair of arms in every metric that has a direction.

    ``declared`` defines the families of tests; ``lacking`` are trials without a result. The pairs
    ``others`` are no questions of it.
    """
    by_arm = group_by(trials, lambda trial: trial.arm)
    primaries: dict[ArmPair, Quantity] = {}
    standings: dict[ArmPair, Standing] = {}
    undirected: dict[ArmPair, list[Note]] = {}
    asked: list[tuple[ArmPair, Quantity, Question]] = []
    before: list[tuple[ArmPair, Question, Standing]] = []
    late: dict[ArmPair, list[TrialResult]] = {}
    for pair in pairs:
        metrics = [
            metric for metric in choose_quantities(_trials_of(by_arm, pair)) if not metric.cost
        ]
        if declared is not None:
            first, second = (by_arm.get(arm, []) for arm in pair)
            standing = declared.standing(first, second, other_pair=pair in others)
            primary = asked_quantity(standing.active.metric, trials)
            standings[pair], primaries[pair] = standing, primary
            metrics = [primary, *(metric for metric in metrics if metric.key != primary.key)]
        undirected[pair] = [
            replace(Note.of("no direction", reason=NO_DIRECTION), about=metric.name)
            for metric in metrics
            if not metric.direction
        ]
        for metric in metrics:
            if metric.direction:
                question = _question(by_arm, pair, metric, standings.get(pair))
                asked.append((pair, metric, question))
        if (known := standings.get(pair)) is not None and known.added:
            # The question stays in its family as it was before, so that others keep their verdict.
            # Looks have fixed shares.
            whole = replace(known, added=())
            counts = whole.beforehand and whole.question is None
            directed = [metric for metric in metrics if metric.direction and counts]
            before += [(pair, _question(by_arm, pair, one, whole), whole) for one in directed]
            places = {(trial.scene, trial.seed) for trial in known.added}
            late[pair] = [t for t in by_arm.get(pair[1], []) if (t.scene, t.seed) in places]
    questions = [(pair, own, standings.get(pair)) for pair, _, own in asked]
    verdicts = _judge_families(trials, questions, lacking, before, late)
    by_pair = group_by(zip(asked, verdicts, strict=True), lambda answered: answered[0][0])
    judged = []
    for pair in pairs:
        own, notes = [], list[Note]()
        for (_, metric, _), verdict in by_pair.get(pair, []):
            found = verdict.notes
            if verdict.pairs.rows:
                own.append(verdict)
            else:
                found = (_why_missing(_trials_of(by_arm, pair), metric, verdict),)
            notes += [replace(note, about=metric.name) for note in found]
        said = (*notes, *undirected[pair])
        judged.append(
            PairVerdicts(*pair, tuple(own), said, primaries.get(pair), standings.get(pair))
        )
    return judged


def _why_missing(trials: Sequence[TrialResult], metric: Quantity, verdict: Verdict) -> Note:
    """The first reason why a metric has no pair of trials with values."""
    question = verdict.question
    nothing = Note.of("no pairs", baseline=question.baseline, arm=question.arm)
    why = (*verdict.notes, nothing)[0]
    lacking = [trial for trial in trials if metric.read(trial) is None]
    if not lacking:
        return why
    reasons = [trial.unavailable.get(metric.key) for trial in lacking]
    reason = next((short_reason(one) for one in reasons if one is not None), why.sentence)
    if len(lacking) == len(trials):
        return Note.of("no value", reason=reason)
    arms = [str(arm) for arm in dict.fromkeys(trial.arm for trial in lacking)]
    return Note.of("valueless", places=arms, reason=reason)


def _judge_families(
    trials: Sequence[TrialResult],
    asked: Sequence[tuple[ArmPair, Question, Standing | None]],
    lacking: Sequence[Unfinished],
    before: Sequence[tuple[ArmPair, Question, Standing | None]],
    late: Mapping[ArmPair, Sequence[TrialResult]],
) -> list[Verdict]:
    """Judge each family of questions: those of one declaration, or of one exploratory pair.

    Families also count the questions as they were ``before`` trials came that are too ``late``.
    """

    def family(entry: tuple[int, tuple[ArmPair, Question, Standing | None]]) -> tuple[object, ...]:
        pair, question, standing = entry[1]
        if standing is None or not standing.beforehand:
            return pair
        # The baseline's own settings are a family of their own: questions about ideas pay nothing
        # for them.
        is_setting = pair[0].densify == pair[1].densify
        named = standing.declaration
        return named.time, named.hash, bool(question.seeds), is_setting

    verdicts: dict[int, Verdict] = {}
    for own in group_by(enumerate([*asked, *before]), family).values():
        standing, questions = own[0][1][2], tuple(question for _, (_, question, _) in own)
        added = {t.path for at, (pair, _, _) in own if at >= len(asked) for t in late[pair]}
        counting = [trial for trial in trials if trial.path not in added] if added else trials
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
        verdicts |= dict(zip(places, judge(counting, declaration, lacking), strict=False))
    return [verdicts[place] for place in range(len(asked))]


def _trials_of(by_arm: Mapping[Arm, Sequence[TrialResult]], pair: ArmPair) -> list[TrialResult]:
    return [trial for arm in pair for trial in by_arm.get(arm, [])]


def _question(
    by_arm: Mapping[Arm, Sequence[TrialResult]],
    pair: ArmPair,
    metric: Quantity,
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
    if standing is None or not standing.beforehand:
        return question
    active, planned = standing.active, standing.question
    split_question = next((trial.question for trial in by_arm.get(baseline, [])), "")
    is_primary = active.question in ("", split_question) and metric.key == active.metric
    if planned is not None:
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
