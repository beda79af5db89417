"""The verdicts of a sweep: on each compared pair of arms in each metric that has a direction.

If the question about an arm was declared in time (``eval.primary``), the declared metric decides
it. The arms of one declaration share 5 %, one test per pair of arms, as Demšar (2006, section
3.2.2) adjusts comparisons of many methods with one control. All other metrics of these pairs are
secondary, with 5 % of their own. They are tested even if the declared metric shows nothing, so that
a metric that got worse is seen. A declaration may be about one question only
(``psnr@extrapolation``).

Otherwise the question is exploratory: all metrics of its pair of arms are one family, adjusted by
Holm (1979). So a further arm never changes the verdict on another one.

If several versions of an arm's code were measured on the pairs of a question, its error rate is
smaller (`gsbench.analysis.attempts`). The other arms of its declaration are still adjusted for it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from gsbench.analysis.attempts import is_of, measured_versions, share_of_version
from gsbench.analysis.cells import short_reason
from gsbench.analysis.declaration import ActiveDeclaration, Standing
from gsbench.analysis.designs import seeds_needed
from gsbench.analysis.judgement import OtherTest, Verdict, judge, other_test
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
    question is exploratory if no metric was declared. ``versions`` of the arm's code were measured
    on these pairs.
    """

    first: Arm
    second: Arm
    verdicts: tuple[Verdict, ...]
    notes: tuple[Note, ...]
    declared: Quantity | None = None
    standing: Standing | None = None
    undeclared: str = "no metric was declared (eval.primary)"
    versions: int = 1

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
    older: Sequence[TrialResult] = (),
) -> list[PairVerdicts]:
    """Judge each pair of arms in every metric that has a direction.

    ``declared`` defines the families of tests; ``lacking`` are trials without a result, ``older``
    those of earlier code.
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
    versions = {
        (first, second): measured_versions(by_arm.get(first, []), by_arm.get(second, []), older)
        for first, second in pairs
    }
    questions = [(pair, own) for pair, _, own in asked]
    verdicts = _judge_families(trials, questions, standings, versions, older, lacking)
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
        if primary is not None and not primary.direction:
            notes.append(replace(Note.of("no value", reason=NO_DIRECTION), about=primary.name))
        standing = standings.get(pair)
        judged.append(
            PairVerdicts(
                *pair,
                tuple(own),
                tuple(notes),
                declared=primary,
                standing=standing,
                versions=versions[pair],
            )
        )
    return judged


def _why_missing(trials: Sequence[TrialResult], metric: Quantity, verdict: Verdict) -> Note:
    """The first reason why a metric has no pair of trials with values."""
    reasons = [trial.unavailable.get(metric.key) for trial in trials]
    if found := [short_reason(reason) for reason in reasons if reason is not None]:
        return Note.of("no value", reason=found[0])
    question = verdict.question
    nothing = Note.of("no pairs", baseline=question.baseline, arm=question.arm)
    return (*verdict.notes, nothing)[0]


Asked = tuple[ArmPair, Question]


def _judge_families(
    trials: Sequence[TrialResult],
    asked: Sequence[Asked],
    standings: Mapping[ArmPair, Standing],
    versions: Mapping[ArmPair, int],
    older: Sequence[TrialResult],
    lacking: Sequence[Unfinished],
) -> list[Verdict]:
    """Judge each family of questions: those of one declaration, or of one exploratory pair."""
    by_arm = group_by(trials, lambda trial: trial.arm)

    def family(entry: tuple[int, Asked]) -> tuple[object, ...]:
        pair, question = entry[1]
        standing = standings.get(pair)
        if standing is None or not standing.beforehand:
            return pair
        # The baseline's own settings are a family of their own: questions about ideas pay nothing
        # for them.
        named = standing.declaration
        return named.time, named.hash, bool(question.seeds), _is_setting(pair)

    verdicts: dict[int, Verdict] = {}
    for whole in group_by(enumerate(asked), family).values():
        standing = standings.get(whole[0][1][0])
        named = standing.declaration if standing is not None and standing.beforehand else None
        replaced = [] if named is None else _of_earlier_code(named, by_arm, asked, whole, older)
        # Versions of one number have one error rate. The others count as members of the family.
        for number, own in group_by(whole, lambda entry: versions[entry[1][0]]).items():
            questions = tuple(one for _, (_, one) in own)
            others = [
                other_test(_trials_of(by_arm, pair), one)
                for _, (pair, one) in whole
                if versions[pair] != number
            ]
            others += replaced
            # Without a time no trial is late, so Holm's method alone adjusts for the number of
            # metrics.
            declaration = Declaration(time=NO_TIME, questions=questions)
            if named is not None:
                looks = named.looks if questions[0].seeds else ()
                # an arm without any trial yet keeps its share of the error rate
                asked_scenes = [one.scenes for one in questions]
                waiting = [
                    one for one in named.questions if looks and one.scenes not in asked_scenes
                ]
                others = [one for one in others if one.secondary or not looks]
                declaration = replace(
                    declaration,
                    questions=(*questions, *waiting),
                    error_rate=named.error_rate,
                    looks=looks,
                )
            rate = declaration.error_rate * share_of_version(number)
            found = judge(trials, replace(declaration, error_rate=rate), lacking, others)
            verdicts |= dict(zip((place for place, _ in own), found, strict=False))
    return [verdicts[place] for place in range(len(asked))]


def _of_earlier_code(
    named: Declaration,
    by_arm: Mapping[Arm, Sequence[TrialResult]],
    asked: Sequence[Asked],
    family: Sequence[tuple[int, Asked]],
    older: Sequence[TrialResult],
) -> list[OtherTest]:
    """The tests of a declaration's arms whose code was edited since, with their earlier trials.

    The new code is tested in another family. Without these tests an edit of one arm would change
    the verdicts on the others of its declaration.
    """
    present = {pair for _, (pair, _) in family}
    metric = named.questions[0].metric
    tests = []
    for pair, question in asked:
        baseline, arm = pair
        declared = [
            replace(one, variant=arm.variant)
            for one in older
            if is_of(arm, one) and one.key in named.planned
        ]
        alike = _is_setting(pair) == any(map(_is_setting, present))
        if declared and alike and pair not in present:
            question = replace(question, scenes={}, seeds=(), secondary=question.metric != metric)
            tests.append(other_test([*by_arm.get(baseline, []), *declared], question))
    return tests


def _is_setting(pair: ArmPair) -> bool:
    """Return whether a pair compares two settings of one densifier."""
    return pair[0].densify == pair[1].densify


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
