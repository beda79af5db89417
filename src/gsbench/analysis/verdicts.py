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

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from gsbench.analysis.attempts import measured_versions, of_same_arm, share_of_version
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
from gsbench.analysis.statistics import UNDECIDED
from gsbench.analysis.unfinished import Unfinished
from gsbench.runs.experiments import NO_TIME, Declaration, Question
from gsbench.runs.seen import SeenResult

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
            verdict.quantity.key == self.declared.key for verdict in self.verdicts
        ):
            return None
        return next((note for note in self.notes if note.about == self.declared.name), None)

    @property
    def undecided(self) -> bool:
        """Return whether no verdict that decides about the arms is decided."""
        return all(one.outcome == UNDECIDED for one in self.primary)

    def role(self, verdict: Verdict) -> str:
        """Declared or secondary; "" if all metrics are one family."""
        return SECONDARY if verdict.question.secondary else DECLARED if self.beforehand else ""

    @property
    def primary(self) -> tuple[Verdict, ...]:
        """The verdicts that are not secondary."""
        return tuple(verdict for verdict in self.verdicts if not verdict.question.secondary)


def judge_pairs(
    trials: Sequence[TrialResult],
    pairs: Sequence[ArmPair],
    declared: ActiveDeclaration | None = None,
    lacking: Sequence[Unfinished] = (),
    others: Sequence[ArmPair] = (),
    older: Sequence[TrialResult] = (),
    seen: Sequence[SeenResult] = (),
    turned: Collection[ArmPair] = (),
) -> list[PairVerdicts]:
    """Judge each pair of arms in every metric that has a direction.

    ``declared`` defines the families of tests; ``lacking`` are trials without a result, ``older``
    those of earlier code, ``seen`` what was ever measured. The pairs ``others`` are no questions of
    the declaration, and those that are ``turned`` are questions of it with the sides exchanged.
    """
    by_arm = group_by(trials, lambda trial: trial.arm)
    primaries: dict[ArmPair, Quantity] = {}
    standings: dict[ArmPair, Standing] = {}
    undirected: dict[ArmPair, list[Note]] = {}
    versions: dict[ArmPair, int] = {}
    asked: list[PairQuestion] = []
    gone: list[tuple[PairQuestion, OtherTest]] = []
    # All questions are collected before one is judged, since families span pairs.
    for pair in pairs:
        first, second = (by_arm.get(arm, []) for arm in pair)
        metrics = [
            metric for metric in choose_quantities(_trials_of(by_arm, pair)) if not metric.cost
        ]
        # of a question that is turned, what was asked of the arm stands in the baseline's place
        sides = (second, first) if pair in turned else (first, second)
        if declared is not None:
            standing = declared.standing(*sides, other_pair=pair in others)
            primary = asked_quantity(standing.active.metric, trials)
            standings[pair], primaries[pair] = standing, primary
            metrics = [primary, *(metric for metric in metrics if metric.key != primary.key)]
        undirected[pair] = [
            replace(Note.of("no direction", reason=NO_DIRECTION), about=metric.name)
            for metric in metrics
            if not metric.direction
        ]
        directed = [metric for metric in metrics if metric.direction]
        versions[pair] = measured_versions(*sides, older, seen)
        known = standings.get(pair)
        asked += [
            PairQuestion(pair, metric, _question(first, pair, metric, known), known, versions[pair])
            for metric in directed
        ]
        if declared is not None:
            gone += _before_late_trials(pair, directed, *sides, known)
            gone += _of_earlier_code(pair, directed, *sides, declared)
    verdicts = _judge_families(by_arm, trials, asked, gone, lacking)
    by_pair = group_by(zip(asked, verdicts, strict=True), lambda answered: answered[0].pair)
    judged = []
    for pair in pairs:
        own, notes = [], list[Note]()
        for question, verdict in by_pair.get(pair, []):
            metric, found = question.metric, verdict.notes
            if verdict.pairs.rows:
                own.append(verdict)
            else:
                found = (_why_missing(_trials_of(by_arm, pair), metric, verdict),)
            notes += [replace(note, about=metric.name) for note in found]
        judged.append(
            PairVerdicts(
                *pair,
                tuple(own),
                (*notes, *undirected[pair]),
                declared=primaries.get(pair),
                standing=standings.get(pair),
                versions=versions[pair],
            )
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
    reason = next((short_reason(text) for text in reasons if text is not None), why.sentence)
    if len(lacking) == len(trials):
        return Note.of("no value", reason=reason)
    arms = [str(arm) for arm in dict.fromkeys(trial.arm for trial in lacking)]
    return Note.of("valueless", places=arms, reason=reason)


@dataclass(frozen=True)
class PairQuestion:
    """A question about a pair of arms, with the standing of the declaration to it."""

    pair: ArmPair
    metric: Quantity
    question: Question
    standing: Standing | None
    versions: int = 1

    @property
    def declaration(self) -> Declaration | None:
        """The declaration that fixed the question beforehand."""
        in_time = self.standing is not None and self.standing.beforehand
        return self.standing.declaration if self.standing is not None and in_time else None

    @property
    def family(self) -> tuple[object, ...]:
        """Questions with the same value share an error rate.

        The baseline's own settings are a family of their own: questions about ideas pay nothing for
        them.
        """
        named = self.declaration
        if named is None:
            return self.pair
        return named.time, named.hash, bool(self.question.seeds), _is_setting(self.pair)


def _judge_families(
    by_arm: Mapping[Arm, Sequence[TrialResult]],
    trials: Sequence[TrialResult],
    asked: Sequence[PairQuestion],
    gone: Sequence[tuple[PairQuestion, OtherTest]],
    lacking: Sequence[Unfinished],
) -> list[Verdict]:
    """Judge each family of questions: those of one declaration, or of one exploratory pair.

    Families also count the tests of questions that are ``gone`` from them, so that the verdicts on
    the others stay.
    """
    verdicts: dict[int, Verdict] = {}
    for key, whole in group_by(enumerate(asked), lambda entry: entry[1].family).items():
        # Versions of one number have one error rate. The others count as members of the family.
        for number, own in group_by(whole, lambda entry: entry[1].versions).items():
            questions = tuple(one.question for _, one in own)
            others = [
                other_test(_trials_of(by_arm, one.pair), one.question)
                for _, one in whole
                if one.versions != number
            ]
            others += [test for one, test in gone if one.family == key]
            # Without a time no trial is late, so Holm's method alone adjusts for the number of
            # metrics.
            declaration = Declaration(time=NO_TIME, questions=questions)
            standing = own[0][1].standing
            if standing is not None and questions[0].seeds:
                # also if it is exploratory: its trials end at the look that pleased
                declaration = replace(declaration, looks=standing.declaration.looks)
            if (named := own[0][1].declaration) is not None:
                looks = declaration.looks
                # an arm without any trial yet keeps its share of the error rate
                asked_scenes = [question.scenes for question in questions]
                waiting = [
                    question
                    for question in named.questions
                    if looks and question.scenes not in asked_scenes
                ]
                # a look's own questions wait already
                others = [other for other in others if other.secondary or not looks]
                declaration = replace(
                    declaration,
                    questions=(*questions, *waiting),
                    error_rate=named.error_rate,
                )
            rate = declaration.error_rate * share_of_version(number)
            found = judge(trials, replace(declaration, error_rate=rate), lacking, others)
            verdicts |= dict(zip((place for place, _ in own), found, strict=False))
    return [verdicts[place] for place in range(len(asked))]


def _before_late_trials(
    pair: ArmPair,
    metrics: Sequence[Quantity],
    baseline: Sequence[TrialResult],
    arm: Sequence[TrialResult],
    standing: Standing | None,
) -> list[tuple[PairQuestion, OtherTest]]:
    """The tests of a pair's questions as they were before trials were added too late."""
    if standing is None or not standing.added:
        return []
    whole = replace(standing, added=())
    if not whole.beforehand:
        return []
    late = {(trial.scene, trial.seed) for trial in standing.added}
    in_time = [trial for trial in arm if (trial.scene, trial.seed) not in late]
    questions = [
        PairQuestion(pair, metric, _question(baseline, pair, metric, whole), whole)
        for metric in metrics
    ]
    return [
        (question, other_test([*baseline, *in_time], question.question)) for question in questions
    ]


def _of_earlier_code(
    pair: ArmPair,
    metrics: Sequence[Quantity],
    baseline: Sequence[TrialResult],
    arm: Sequence[TrialResult],
    declared: ActiveDeclaration,
) -> list[tuple[PairQuestion, OtherTest]]:
    """The tests of a pair's questions with each earlier version of the arm's code.

    The new code is tested in another family.
    """
    found = []
    old = [replace(trial, variant=arm[0].variant) for trial in of_same_arm(arm, declared.older)]
    for version in group_by(old, lambda trial: frozenset(trial.code.items())).values():
        # the state when this version was trained
        first = min(trial.measured for trial in version)
        known = replace(
            declared,
            older=tuple(one for one in declared.older if one.measured < first),
            seen=tuple(one for one in declared.seen if one.moment < first),
        )
        standing = known.standing(baseline, version)
        questions = [
            PairQuestion(pair, metric, _question(baseline, pair, metric, standing), standing)
            for metric in metrics
        ]
        found += [
            (question, other_test([*baseline, *version], question.question))
            for question in questions
            if question.declaration is not None
        ]
    return found


def _is_setting(pair: ArmPair) -> bool:
    """Return whether a pair compares two settings of one densifier."""
    return pair[0].densify == pair[1].densify


def _trials_of(by_arm: Mapping[Arm, Sequence[TrialResult]], pair: ArmPair) -> list[TrialResult]:
    return [trial for arm in pair for trial in by_arm.get(arm, [])]


def _question(
    of_baseline: Sequence[TrialResult],
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
    if standing is None:
        return question
    active, planned = standing.active, standing.question
    if planned is not None:
        question = replace(question, scenes=planned.scenes, seeds=planned.seeds)
    if not standing.beforehand:
        return question
    split_question = next((trial.question for trial in of_baseline), "")
    is_primary = active.question in ("", split_question) and metric.key == active.metric
    if planned is not None and is_primary:
        question = replace(question, least=planned.least)
    return replace(question, secondary=not is_primary)


def seeds_to_resolve(verdict: Verdict) -> int | None:
    """The number of seeds that would resolve the worthwhile difference.

    None if that is unknown, or if there would be too many to run.
    """
    if verdict.deviation is None or verdict.quantity.worthwhile is None:
        return None
    return seeds_needed(verdict.deviation, len(verdict.scenes), verdict.quantity.worthwhile)
