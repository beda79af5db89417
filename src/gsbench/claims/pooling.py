"""Results of many laboratories in one: a mean of their effects, with an interval whose error rate is known.

A study is one archive's mean difference of two arms in one metric, over the pairs of trials of each scene, as every
difference here (docs/verdict.md). The units are studies, each with the same weight, by Student's t. Weights from the
studies' own standard errors would take as known what two or three seeds estimate: with the usual random-effects methods
7 to 10 % of intervals then miss the mean. A mean only where protocols agree.
"""

import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from gsbench.analysis.cells import select_trials, with_variants
from gsbench.analysis.fairness import budget_words
from gsbench.analysis.pairing import Pairs, find_pairs
from gsbench.analysis.results import Arm, TrialResult, group_by
from gsbench.analysis.statistics import Interval, StudentT, t_test
from gsbench.claims.archive import unpack_archive
from gsbench.errors import InputError
from gsbench.runs.declaration import Question
from gsbench.runs.keys import sha256_of

MIN_STUDIES = 2


@dataclass(frozen=True)
class Study:
    """One archive's difference of two arms in one metric, with its ``interval`` (None of a single pair).

    Studies must share a ``protocol`` before a mean of them means anything. ``budget`` says what limited the growth of
    its arms; "" where nobody knows.
    """

    name: str
    effect: float
    interval: Interval | None = None
    protocol: str = ""
    budget: str = ""


@dataclass(frozen=True)
class Pooled:
    """Studies with the ``test`` of their mean, None where ``refusal`` says why there is none."""

    studies: tuple[Study, ...]
    refusal: str = ""
    test: StudentT | None = None

    @property
    def deviation(self) -> float:
        """The deviation of the studies' effects."""
        return float(np.std([study.effect for study in self.studies], ddof=1))

    @property
    def prediction(self) -> Interval:
        """The interval in which the effect of a further study would lie."""
        assert self.test is not None
        reach = self.deviation * math.sqrt(1 + 1 / len(self.studies))
        return replace(self.test, error=reach).interval()


def pool(studies: Sequence[Study]) -> Pooled:
    """The mean of studies; without one, and with the reason, where they follow several protocols.

    Raises InputError for a study that stands twice.
    """
    names = [study.name for study in studies]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InputError(f"{twice[0]} is given twice: results that are counted twice look surer than they are")
    refusal = ""
    if len(studies) < MIN_STUDIES:
        refusal = f"a mean needs {MIN_STUDIES} studies, and there are {len(studies)}"
    elif len({study.protocol for study in studies}) > 1:
        shown = "; ".join(f"{study.name}: {study.protocol or 'unknown'}" for study in studies)
        refusal = f"the studies differ in protocol ({shown})"
    effects = np.array([[study.effect] for study in studies])  # [k, 1]
    return Pooled(tuple(studies), refusal, None if refusal else t_test(effects))


def describe(pooled: Pooled) -> list[str]:
    """The result in sentences."""
    test = pooled.test
    if test is None:
        return [f"no mean: {pooled.refusal}"]
    interval, further = test.interval(), pooled.prediction
    lines = [
        f"mean {test.mean:+.4g} (95 % interval {interval.low:+.4g} to {interval.high:+.4g}, p {test.p:.3g}) "
        f"of {len(pooled.studies)} studies, each with the same weight",
        f"studies differ by a deviation of {pooled.deviation:.3g}; a further one would lie between "
        f"{further.low:+.4g} and {further.high:+.4g}",
    ]
    if len({study.budget for study in pooled.studies}) > 1:
        budgets = "; ".join(f"{study.name}: {study.budget or 'not known'}" for study in pooled.studies)
        lines.append(
            f"caution: the budgets differ ({budgets}): a difference at equal counts and one at free counts answer two "
            "questions, and this mean answers neither"
        )
    return lines


@dataclass(frozen=True)
class Wanted:
    """The pooled question: names that ``arm`` and ``baseline`` go by in the sources, and our key of the metric.

    ``where``: only trials of archives with these values of settings count.
    """

    arm: tuple[str, ...]
    baseline: tuple[str, ...]
    metric: str
    where: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Found:
    """Studies of one source, what they say of themselves, and ``trials`` as marks: none is to be counted twice."""

    studies: tuple[Study, ...]
    notes: tuple[str, ...] = ()
    trials: frozenset[str] = frozenset()


def read_studies(path: Path, wanted: Wanted, name: str) -> Found:
    """The studies in the archive ``path``, one for each protocol, called ``name``.

    Raises InputError, one line, where there is none.
    """
    studies, notes = [], list[str]()
    with tempfile.TemporaryDirectory() as folder:
        every = unpack_archive(path, Path(folder)).trials
        trials = with_variants(select_trials(every, wanted.where))
        by_protocol = sorted(group_by(trials, lambda trial: trial.record.protocol).items())
        for protocol, own in by_protocol:
            groups = _groups(own, _pairs(own, wanted, path))
            for pairs in groups:
                told_apart = [protocol] * (len(by_protocol) > 1) + [pairs[0][0].init] * (len(groups) > 1)
                label = f"{name} ({', '.join(told_apart)})" if told_apart else name
                found = [
                    find_pairs(own, Question(metric=wanted.metric, baseline=first, arm=second))
                    for first, second in pairs
                ]
                together = Pairs(tuple(row for one in found for row in one.rows))
                if not together.rows:
                    reason = next((f" ({line})" for one in found for line in one.left_out), "")
                    raise InputError(f"{path}: no trials can be paired in {wanted.metric}{reason}")
                test = t_test(together.differences)
                mean, interval = float(together.differences.mean()), None if test is None else test.interval()
                studies.append(Study(label, mean, interval, protocol, _budgets(own, pairs)))
                for (first, second), paired in zip(pairs, found, strict=True):
                    count = sum(len(row.seeds) for row in paired.rows)
                    notes.append(
                        f"{label}: {second} against {first}, {count} pairs of trials on "
                        f"{', '.join(paired.scenes)}; {_size(own)}"
                    )
                    notes += [f"{label}: left out, {line}" for line in paired.left_out]
        return Found(tuple(studies), tuple(notes), frozenset(map(_mark, trials)))


def _groups(trials: Sequence[TrialResult], pairs: Sequence[tuple[Arm, Arm]]) -> list[list[tuple[Arm, Arm]]]:
    """Group pairs into studies: all are one where each scene has one initialiser, else each is its own."""
    scenes = [{trial.scene for trial in trials if trial.arm in pair} for pair in pairs]
    disjoint = sum(map(len, scenes)) == len(set().union(*scenes))
    return [list(pairs)] if disjoint else [[pair] for pair in pairs]


def _pairs(trials: Sequence[TrialResult], wanted: Wanted, path: Path) -> list[tuple[Arm, Arm]]:
    """(baseline, arm) under each initialiser that has both; a name is that of a densifier, with its variant or not."""
    arms = sorted({trial.arm for trial in trials})

    def named(init: str, names: Sequence[str]) -> list[Arm]:
        own = [arm for arm in arms if arm.init == init]
        return [arm for arm in own if {str(replace(arm, init="")), arm.densify, str(arm)} & {*names}]

    found = []
    for init in sorted({arm.init for arm in arms}):
        ones, others = named(init, wanted.baseline), named(init, wanted.arm)
        if len(ones) > 1 or len(others) > 1:
            several = ones if len(ones) > 1 else others
            raise InputError(
                f"{path}: the name fits {' and '.join(map(str, several))}: choose trials with --where "
                "KEY=VALUE, or give the whole name of one"
            )
        if ones and others:
            found.append((ones[0], others[0]))
    if not found:
        raise InputError(
            f"{path} has no pair of {' or '.join(wanted.arm)} and {' or '.join(wanted.baseline)} (there are "
            f"{', '.join(map(str, arms))})"
        )
    return found


def _budgets(trials: Sequence[TrialResult], pairs: Sequence[tuple[Arm, Arm]]) -> str:
    """``20,000 Gaussians (governor)``: what limited the growth in these pairs of arms."""
    arms = {arm for pair in pairs for arm in pair}
    return " or ".join(sorted({budget_words(trial) or "not known" for trial in trials if trial.arm in arms}))


def _size(trials: Sequence[TrialResult]) -> str:
    """In which trials of archives may differ without being refused, for people to judge."""
    sizes = sorted({f"{size[0]}×{size[1]}" for trial in trials if (size := trial.record.resolution)})
    steps = sorted({f"{trial.record.iterations:,}" for trial in trials})
    versions = sorted({trial.record.versions.get("gsbench", "?") for trial in trials})
    return f"{' or '.join(steps)} iterations, {' or '.join(sizes)} px, gsbench {' or '.join(versions)}"


def _mark(trial: TrialResult) -> str:
    """Mark that tells a trial from every other: made again elsewhere, it has other seconds."""
    record = trial.record
    told = [trial.config_hash, trial.seed, record.hashes, record.seconds, dict(trial.metrics)]
    return sha256_of(told)
