"""Declarations of gsbench 0.1 (``declared.jsonl``), read as questions.

They were written before their trials, too, but without levels: 5 % is divided by the arms of a
declaration and by the versions of an arm's code.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field, replace

from gsbench.analysis.cells import with_variants
from gsbench.analysis.quantities import asked_quantity
from gsbench.analysis.questions import Asked, choose_pairs, draft, level_of
from gsbench.analysis.results import Experiment, TrialResult, group_by
from gsbench.parsing import Amount, Count, Record
from gsbench.runs.commands import ERROR_RATE, Digest, Question, code_in
from gsbench.runs.experiments import Arm, unix_time
from gsbench.runs.layout import DECLARED
from gsbench.runs.trial_files import read_rows

LATE = "it was declared after the first result"


class _OldQuestion(Record):
    metric: str
    sign: int = 1
    least: Amount | None = None
    relative: bool = False
    baseline: Arm | None = None
    arm: Arm | None = None
    scenes: dict[str, tuple[str, str]] = field(default_factory=dict)
    seeds: tuple[Count, ...] = ()
    name: str = ""


class _OldDeclaration(Record):
    time: str
    questions: tuple[_OldQuestion, ...]
    looks: tuple[Count, ...] = ()
    trials: dict[str, tuple[Count, ...]] = field(default_factory=dict)


def all_questions(experiment: Experiment) -> list[Question]:
    """All questions of an experiment, the newest last."""
    return [*old_questions(experiment), *experiment.history.questions]


def old_questions(experiment: Experiment) -> list[Question]:
    """The questions of the experiment's old declarations; the last about each pair counts."""
    declarations = read_rows(experiment.folder / DECLARED, _OldDeclaration)
    if not declarations:
        return []
    trials = [*with_variants(experiment.trials), *experiment.older]
    found: dict[object, Question] = {}
    for declaration in declarations:
        for asked in declaration.questions:
            if asked.scenes:
                share = ERROR_RATE / len(declaration.questions)
                own = [replace(_named(asked, trials), looks=declaration.looks, level=share)]
            else:
                own = _of_sweep(asked.metric, declaration, trials)
            for question in own:
                found[question.baseline, question.idea, question.metric, question.name] = question
    numbered = []
    for question in found.values():
        # the versions of the idea's code that were measured on the question's places
        versions = {
            code_in(trial.digest)
            for trial in trials
            if (trial.scene, trial.seed) in question.places
            and f"{trial.init}-{trial.densify}" == question.idea.name
        }
        n = max(1, len(versions))
        level = level_of(n, rate=question.level)
        numbered.append(
            replace(question, n=n, level=level, rule="declaration").with_id("declaration")
        )
    return numbered


def _named(asked: _OldQuestion, trials: Sequence[TrialResult]) -> Question:
    """A question that names its trials, as of a file of claims or of planned looks."""
    of_key = {trial.key: trial for trial in trials}

    def digest(key: str) -> Digest:
        return of_key[key].digest if key in of_key else key

    sides: list[Arm] = []
    for side, arm in enumerate((asked.baseline, asked.arm)):
        own = [of_key[both[side]].arm for both in asked.scenes.values() if both[side] in of_key]
        sides.append((*own, arm or Arm("", asked.name))[0])
    return Question(
        idea=sides[1],
        baseline=sides[0],
        metric=asked.metric,
        sign=asked.sign,  # type: ignore[arg-type]
        least=asked.least,
        relative=asked.relative,
        digests={scene: (digest(one), digest(two)) for scene, (one, two) in asked.scenes.items()},
        seeds=dict.fromkeys(asked.scenes, asked.seeds),
        name=asked.name,
    )


def _of_sweep(
    key: str, declaration: _OldDeclaration, trials: Sequence[TrialResult]
) -> list[Question]:
    """The questions of a sweep's metric about all compared arms."""
    planned = declaration.trials
    own = [trial for trial in trials if trial.seed in planned.get(trial.key, ())]
    metric = asked_quantity(key, own)
    if not (own and metric.direction):
        return []
    terms = Asked(metric=key, sign=metric.direction, least=metric.worthwhile)
    pairs = choose_pairs(own, terms)
    known, moment = {trial.arm for trial in own}, unix_time(declaration.time) or 0
    questions = []
    for baseline, idea in pairs:
        if not known.issuperset((baseline, idea)):
            continue
        question = draft(baseline, idea, own, terms)
        of_idea = [trial for trial in own if trial.arm == idea]
        # failed ones, too
        seeds = {one.scene: planned[one.key] for one in of_idea if one.scene in question.seeds}
        digests, of_missing = _of_missing(question, planned, own)
        late = min(trial.measured for trial in of_idea) < moment
        level, why = ERROR_RATE / len(pairs), LATE if late else ""
        question = replace(question, digests=digests, seeds=seeds | of_missing)
        questions.append(replace(question, level=level, untested=why))
    return questions


def _of_missing(
    question: Question, planned: Mapping[str, tuple[int, ...]], trials: Sequence[TrialResult]
) -> tuple[dict[str, tuple[Digest, Digest]], dict[str, tuple[int, ...]]]:
    """The digests of a question, with the declared scenes of which an arm has no trial yet.

    Returns also the seeds of these scenes. Without them a sweep would be decided by the scenes that
    happen to be trained first. A declaration has keys of trials, not arms: arms that differ in
    swept settings only have one name, and each of them lacks what one of them lacks.
    """
    measured = {(trial.scene, trial.arm): trial.digest for trial in trials}
    keys = group_by([key for key in planned if key.count("/") == 2], lambda key: key.split("/")[0])
    arms = question.baseline, question.idea
    digests, seeds = dict(question.digests), {}
    for scene in sorted(keys.keys() - question.seeds.keys()):
        own = [[key for key in keys[scene] if key.split("/")[1] == arm.name] for arm in arms]
        if all(own):
            # a key stands for the digest of what is not trained yet
            first, second = (
                measured.get((scene, arm), of_arm[0]) for arm, of_arm in zip(arms, own, strict=True)
            )
            digests[scene], seeds[scene] = (first, second), planned[own[1][0]]
    return digests, seeds
