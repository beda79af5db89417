"""Pooling results of many laboratories: their mean, with an interval of a known error rate.

A study is one archive's mean difference of two arms in one metric, over its pairs of trials
(docs/verdict.md). Student's t tests the mean of studies, each with the same weight. Weights from
the studies' standard errors would treat estimates from two or three seeds as exact: 7 to 10 % of
the intervals of usual random-effects methods then miss the mean. Studies are pooled only if their
protocols agree.
"""

import itertools
import math
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from gsbench.analysis.addresses import fitting
from gsbench.analysis.cells import select_trials, with_variants
from gsbench.analysis.declaration import active_declaration
from gsbench.analysis.differences import between_scenes_notes
from gsbench.analysis.fairness import budget_words
from gsbench.analysis.notes import Note
from gsbench.analysis.pairing import Pairs, ScenePairs, pair
from gsbench.analysis.results import Arm, TrialResult, group_by
from gsbench.analysis.statistics import Interval, StudentT, t_test
from gsbench.analysis.unfinished import lacking_words, one_sided, unfinished
from gsbench.claims.archive import unpack_archive
from gsbench.errors import InputError
from gsbench.runs.experiments import Question
from gsbench.runs.layout import TUNING
from gsbench.runs.nested import sha256_of

MIN_STUDIES = 2


@dataclass(frozen=True)
class Study:
    """One archive's difference of two arms in a metric; ``interval`` is None for a single pair.

    Only studies with the same ``protocol`` are pooled. ``budget`` says what limited the growth of
    its arms; "" if that is unknown.
    """

    name: str
    effect: float
    interval: Interval | None = None
    protocol: str = ""
    budget: str = ""


@dataclass(frozen=True)
class Pooled:
    """Studies with the ``test`` of their mean; if there is none, ``refusal`` says why."""

    studies: tuple[Study, ...]
    refusal: str = ""
    test: StudentT | None = None

    @property
    def deviation(self) -> float:
        """The deviation of the studies' effects."""
        return float(np.std([study.effect for study in self.studies], ddof=1))

    @property
    def prediction(self) -> Interval:
        """The prediction interval of a further study's effect."""
        assert self.test is not None
        reach = self.deviation * math.sqrt(1 + 1 / len(self.studies))
        return replace(self.test, error=reach).interval()


def pool(studies: Sequence[Study]) -> Pooled:
    """Pool the studies, unless they are too few or follow several protocols.

    Raises InputError for a study that is given twice.
    """
    names = [study.name for study in studies]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InputError(
            f"{twice[0]} is given twice: results that are counted twice look surer than they are"
        )
    refusal = ""
    if len(studies) < MIN_STUDIES:
        refusal = f"a mean needs {MIN_STUDIES} studies, and there are {len(studies)}"
    elif len({study.protocol for study in studies}) > 1:
        shown = "; ".join(f"{study.name}: {study.protocol or 'unknown'}" for study in studies)
        refusal = f"the studies differ in protocol ({shown})"
    effects = np.array([[study.effect] for study in studies])  # [k, 1]
    return Pooled(tuple(studies), refusal, None if refusal else t_test(effects))


def markdown_table(pooled: Pooled) -> list[str]:
    """The studies as lines of a Markdown table."""
    lines = ["| study | difference | 95 % interval | protocol |", "|---|---|---|---|"]
    for study in pooled.studies:
        interval = (
            "–"
            if study.interval is None
            else f"{study.interval.low:+.4g} to {study.interval.high:+.4g}"
        )
        lines.append(f"| {study.name} | {study.effect:+.4g} | {interval} | {study.protocol} |")
    return lines


def describe(pooled: Pooled) -> list[str]:
    """The result of pooling in sentences."""
    test = pooled.test
    if test is None:
        return [f"no mean: {pooled.refusal}"]
    interval, further = test.interval(), pooled.prediction
    lines = [
        f"mean {test.mean:+.4g} (95 % interval {interval.low:+.4g} to {interval.high:+.4g}, p "
        f"{test.p:.3g}) of {len(pooled.studies)} studies, each with the same weight",
        f"studies differ by a deviation of {pooled.deviation:.3g}; a further one would lie between "
        f"{further.low:+.4g} and {further.high:+.4g}",
    ]
    if len({study.budget for study in pooled.studies}) > 1:
        budgets = "; ".join(
            f"{study.name}: {study.budget or 'not known'}" for study in pooled.studies
        )
        lines.append(
            f"caution: the budgets differ ({budgets}): a difference at equal counts and one at "
            "free counts answer two questions, and this mean answers neither"
        )
    return lines


@dataclass(frozen=True)
class PooledQuestion:
    """The question to pool: names of ``arm`` and ``baseline`` in the archives, the metric's key.

    Only trials whose settings have the values of ``where`` count.
    """

    arm: tuple[str, ...]
    baseline: tuple[str, ...]
    metric: str
    where: Mapping[str, str] = field(default_factory=dict)


def pool_sources(
    sources: Sequence[Path], wanted: PooledQuestion, protocol: str | None = None
) -> tuple[Pooled, list[str], list[str]]:
    """Pool all studies in ``sources``.

    Returns their mean, notes on them, and a line for each source or study that is left out.
    Raises InputError if no study is left.
    """
    studies, notes, faults = [], list[str](), list[str]()
    seen: dict[str, Path] = {}
    stems = Counter(source.stem for source in sources)
    for source in sources:
        try:
            name = source.stem if stems[source.stem] == 1 else str(source)
            read, archive_notes, marks = read_studies(source, wanted, name)
        except InputError as error:
            faults.append(f"left out: {error}")
            continue
        # An archive under two names, or exported again with more trials, is no further study.
        if twice := marks & seen.keys():
            faults.append(
                f"left out: {source} has trials that {seen[min(twice)]} has, and they would count "
                "twice"
            )
            continue
        seen |= dict.fromkeys(marks, source)
        notes += archive_notes
        for study in read:
            if protocol is not None and study.protocol != protocol:
                notes.append(f"{study.name}: not asked for, it is by {study.protocol}")
            elif study.interval is None:
                faults.append(
                    f"left out: {study.name} has one pair of trials: nothing tells how sure it is"
                )
            else:
                studies.append(study)
    if not studies:
        raise InputError((faults or notes)[0].removeprefix("left out: "))
    return pool(studies), notes, faults


def read_studies(
    path: Path, question: PooledQuestion, name: str
) -> tuple[list[Study], list[str], set[str]]:
    """The studies in the archive ``path``, by protocol; their labels begin with ``name``.

    Also returns notes on them, and a mark of each trial (`_mark`), so that none is counted twice.
    Raises InputError, one line, if there is no study.
    """
    studies, notes = [], list[str]()
    with tempfile.TemporaryDirectory() as folder:
        archived = unpack_archive(path, Path(folder))
        if (archived.folder / TUNING).exists():
            raise InputError(
                f"{path} is of a search, whose points were chosen by their results: give the "
                "archive of the sweep that it was for"
            )
        notes += [f"{name}: left out, {line}" for line in archived.warnings]
        gone, declared = unfinished(archived), active_declaration(archived)
        gone += declared.missing(archived.trials) if declared is not None else []
        trials = with_variants(select_trials(archived.trials, question.where))
        by_protocol = sorted(group_by(trials, lambda trial: trial.record.protocol).items())
        for protocol, own in by_protocol:
            groups = _group_into_studies(own, _arm_pairs(own, question, path))
            for arms in groups:
                qualifiers = [protocol] if len(by_protocol) > 1 else []
                qualifiers += [arms[0][0].init] if len(groups) > 1 else []
                label = f"{name} ({', '.join(qualifiers)})" if qualifiers else name
                rows: list[ScenePairs] = []
                left_out: list[Note] = []
                for baseline, arm in arms:
                    asked = Question(metric=question.metric, baseline=baseline, arm=arm)
                    pairs = pair(own, asked)
                    count = sum(len(row.seeds) for row in pairs.rows)
                    notes.append(
                        f"{label}: {arm} against {baseline}, {count} pairs of trials on "
                        f"{', '.join(pairs.scenes)}; {_size(own)}"
                    )
                    notes += [f"{label}: left out, {line}" for line in pairs.left_out]
                    if lacking := [*itertools.chain(*one_sided(asked, own, gone))]:
                        notes.append(f"{label}: caution, {lacking_words(lacking)}")
                    unlike = between_scenes_notes(pairs.of_baseline, pairs.of_arm)
                    notes += [f"{label}: {line}" for line in unlike]
                    rows += pairs.rows
                    left_out += pairs.left_out
                if not rows:
                    reason = f" ({left_out[0]})" if left_out else ""
                    raise InputError(
                        f"{path}: no trials can be paired in {question.metric}{reason}"
                    )
                differences = Pairs(tuple(rows)).differences
                test = t_test(differences)
                interval = None if test is None else test.interval()
                budgets = _budgets(own, arms)
                studies.append(Study(label, float(differences.mean()), interval, protocol, budgets))
        return studies, notes, set(map(_mark, trials))


def _group_into_studies(
    trials: Sequence[TrialResult], pairs: Sequence[tuple[Arm, Arm]]
) -> list[list[tuple[Arm, Arm]]]:
    """All pairs of arms as one study if each scene has one initialiser, else each as its own."""
    scenes = [{trial.scene for trial in trials if trial.arm in pair} for pair in pairs]
    disjoint = sum(map(len, scenes)) == len(set().union(*scenes))
    return [list(pairs)] if disjoint else [[pair] for pair in pairs]


def _arm_pairs(
    trials: Sequence[TrialResult], question: PooledQuestion, path: Path
) -> list[tuple[Arm, Arm]]:
    """The pair (baseline, arm) of each initialiser that has both."""
    arms = sorted({trial.arm for trial in trials})

    def named(init: str, names: Sequence[str]) -> list[Arm]:
        return sorted(fitting([trial for trial in trials if trial.init == init], names))

    pairs = []
    for init in sorted({arm.init for arm in arms}):
        baselines, others = named(init, question.baseline), named(init, question.arm)
        if len(baselines) > 1 or len(others) > 1:
            several = baselines if len(baselines) > 1 else others
            raise InputError(
                f"{path}: the name fits {' and '.join(map(str, several))}: choose trials with "
                "--where KEY=VALUE, or give the whole name of one"
            )
        if baselines and others:
            pairs.append((baselines[0], others[0]))
    if not pairs:
        raise InputError(
            f"{path} has no pair of {' or '.join(question.arm)} and "
            f"{' or '.join(question.baseline)} (there are {', '.join(map(str, arms))})"
        )
    return pairs


def _budgets(trials: Sequence[TrialResult], pairs: Sequence[tuple[Arm, Arm]]) -> str:
    """``20,000 Gaussians (governor)``: the limits on growth in these pairs of arms."""
    of_arms = [trial for trial in trials if any(trial.arm in pair for pair in pairs)]
    return " or ".join(sorted({budget_words(trial) or "not known" for trial in of_arms}))


def _size(trials: Sequence[TrialResult]) -> str:
    """Iterations, view sizes and versions, in which pooled trials may differ, for the reader."""
    known = {trial.record.resolution for trial in trials} - {None}
    sizes = sorted("{}×{}".format(*size) for size in known if size)
    steps = sorted({f"{trial.record.iterations:,}" for trial in trials})
    versions = sorted({trial.record.versions.get("gsbench", "?") for trial in trials})
    return (
        f"{' or '.join(steps)} iterations, {' or '.join(sizes)} px, gsbench {' or '.join(versions)}"
    )


def _mark(trial: TrialResult) -> str:
    """A hash that distinguishes a trial even from its repetition, which takes other seconds."""
    record = trial.record
    facts = [trial.config_hash, trial.seed, record.hashes, record.seconds, dict(trial.metrics)]
    return sha256_of(facts)
