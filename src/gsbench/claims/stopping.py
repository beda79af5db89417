"""A sweep that stops when decided: each pair of arms is a claim about ``eval.primary``, with seeds in planned looks.

The plan says which trials are held against which; it is written down before the first trial, and all that is said later
is read from it and from the trials' files. So the same command goes on after a kill, and the report says the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Generic

import yaml

from gsbench.analysis.cells import by_key, with_variants
from gsbench.analysis.configurations import Configurations
from gsbench.analysis.pairing import arm_name, choose_pairs
from gsbench.analysis.results import TrialResult, read_experiment
from gsbench.analysis.statistics import ALPHA
from gsbench.claims.file import Claim
from gsbench.claims.sequential import FIRST_LOOK, Design, plan_looks
from gsbench.claims.sweep import Question, T
from gsbench.claims.verdict import Pair, PairKey, Verdict, judge_claim
from gsbench.config.compose import TrialConfig
from gsbench.errors import InputError
from gsbench.eval.facts import MetricFacts, facts_of, find
from gsbench.runs.declaration import STOPPING, DeclaredPlan, read_plans
from gsbench.runs.hashing import flatten, sha256_of
from gsbench.runs.layout import SEED
from gsbench.runs.trial_folder import TrialFolder
from gsbench.runs.trial_record import TrialRecord
from gsbench.words import counted


@dataclass(frozen=True)
class PlannedPair:
    """Two arms, and for each scene the folders of their trials within the experiment, without the seed."""

    baseline: str
    arm: str
    scenes: Mapping[str, tuple[str, str]]


@dataclass(frozen=True)
class SweepPlan:
    """All that decides about the verdicts of a sweep. ``direction`` is the metric's own: 1, more is better; -1, less.

    ``least`` is the smallest difference that matters, ``seeds`` are all of the sweep in the order in which they are
    added; the pairs share ``error_rate`` equally.
    """

    metric: str
    direction: int
    least: float
    seeds: tuple[int, ...]
    pairs: tuple[PlannedPair, ...]
    error_rate: float = ALPHA

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> SweepPlan:
        """The plan that `to_record` gave; raises InputError for a record that is damaged."""
        try:
            values = dict(record[STOPPING])
            pairs = [
                PlannedPair(one["baseline"], one["arm"], {scene: (a, b) for scene, (a, b) in one["scenes"].items()})
                for one in values.pop("pairs")
            ]
            return cls(**(values | {"seeds": tuple(values["seeds"]), "pairs": tuple(pairs)}))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(f"the declared plan of looks is damaged ({error!r}): give the sweep's command") from None

    def to_record(self) -> dict[str, Any]:
        """Plain values, as they are written down and hashed."""
        values = asdict(self) | {"seeds": list(self.seeds)}
        pairs = [asdict(pair) | {"scenes": {k: list(v) for k, v in pair.scenes.items()}} for pair in self.pairs]
        return {STOPPING: values | {"pairs": pairs}}

    @property
    def looks(self) -> tuple[int, ...]:
        return plan_looks(len(self.seeds))

    def design(self, claim: Claim, scenes: int, sharing: int) -> Design:
        """The design of a pair's looks, as a file of claims has it."""
        return Design(scenes, self.looks, self.error_rate / sharing)

    def claim(self, pair: PlannedPair) -> Claim:
        """The question that the pair is asked: whether its arm is better."""
        return Claim(
            id=f"{pair.arm} against {pair.baseline}",
            says=f"{pair.arm} is better than {pair.baseline}",
            where=STOPPING,
            baseline=pair.baseline,
            arm=pair.arm,
            metric=self.metric,
            direction="higher" if self.direction > 0 else "lower",
            least=self.least,
            refuted_if="it is worse, or differs by less than the least",
        )

    def verdicts(self, home: Path, declared: DeclaredPlan) -> list[Verdict]:
        """Verdicts of every pair, from the trials of the experiment in ``home`` that are done."""
        by_folder = read_experiment(home).by_folder if home.is_dir() else {}
        return [
            judge_claim(
                self.claim(pair), self, self._pairs(pair, by_folder), list(pair.scenes), len(self.pairs), declared.time
            )
            for pair in self.pairs
        ]

    def _pairs(self, pair: PlannedPair, by_folder: Mapping[str, TrialResult]) -> dict[PairKey, Pair]:
        """The pairs of trials by scene and place of the seed."""
        found: dict[PairKey, Pair] = {}
        for scene, folders in pair.scenes.items():
            for place, seed in enumerate(self.seeds):
                one, other = (by_folder.get(f"{folder}{SEED}{seed}") for folder in folders)
                if one is not None and other is not None:
                    found[scene, place] = one, other
        return found


@dataclass(frozen=True)
class Stopping(Generic[T]):
    """A sweep's trials with the plan by which they are run: what `claims.sweep.run_looks` goes through."""

    plan: SweepPlan
    home: Path
    by_folder: Mapping[str, T]

    @cached_property
    def questions(self) -> tuple[Question, ...]:
        return tuple(Question(self.plan.claim(pair), tuple(pair.scenes), ()) for pair in self.plan.pairs)

    @property
    def looks(self) -> tuple[int, ...]:
        return self.plan.looks

    @property
    def hash(self) -> str:
        return sha256_of(self.plan.to_record())

    def trials(self, questions: Sequence[Question], seeds: int) -> list[T]:
        """The trials that the questions need for their first ``seeds`` seeds, each once."""
        asked = {question.claim.id for question in questions}
        pairs = [pair for pair in self.plan.pairs if self.plan.claim(pair).id in asked]
        names = [
            f"{folder}{SEED}{seed}"
            for seed in self.plan.seeds[:seeds]
            for pair in pairs
            for folders in pair.scenes.values()
            for folder in folders
        ]
        return [self.by_folder[name] for name in dict.fromkeys(names)]

    def verdicts(self, declared: DeclaredPlan) -> list[Verdict]:
        return self.plan.verdicts(self.home, declared)

    def describe(self) -> str:
        """Lines that a dry run prints of the looks."""
        first, most = (len(self.trials(self.questions, seeds)) for seeds in (self.looks[0], self.looks[-1]))
        pairs, looks = counted(len(self.plan.pairs), "pair"), ", ".join(map(str, self.looks))
        return (
            f"stops when decided, by {self.plan.metric} and a least difference of {self.plan.least:g}: {pairs} of "
            f"arms, looks at {looks} seeds, {first} trials until the first, {most} at most"
        )


def plan_sweep(trials: Sequence[T]) -> Stopping[T]:
    """The plan of a sweep's trials; raises InputError, one line, where a sweep cannot be looked at seed by seed."""
    homes = {TrialFolder.of(trial.values).home for trial in trials}
    metrics = {trial.values["eval"].get("primary") for trial in trials}
    if len(homes) > 1 or len(metrics) > 1:
        raise InputError("launch.stop_when_decided: all trials of the sweep need one name and one eval.primary")
    (home,), (metric,) = homes, metrics
    if metric is None:
        raise InputError("launch.stop_when_decided needs the metric that decides, as eval.primary=psnr")
    values = trials[0].values
    facts = _facts(metric, values)
    least = values["launch"]["least_difference"] or facts.worthwhile
    if least is None:
        raise InputError(
            f"launch.stop_when_decided: what of {metric} matters is not known: give launch.least_difference"
        )
    expected = with_variants([_expected(trial) for trial in trials])
    seeds = _seeds(expected)
    chosen = choose_pairs(sorted({trial.arm for trial in expected}))
    if not chosen:
        raise InputError("launch.stop_when_decided compares arms, and this sweep has one: give two densifiers")
    pairs = [_planned(expected, home, *pair) for pair in chosen]
    if empty := next((pair for pair in pairs if not pair.scenes), None):
        raise InputError(f"launch.stop_when_decided: {empty.arm} and {empty.baseline} have no scene in common")
    plan = SweepPlan(metric, facts.direction, float(least), seeds, tuple(pairs))
    by_folder = {one.path.relative_to(home).as_posix(): trial for one, trial in zip(expected, trials, strict=True)}
    return Stopping(plan, home, by_folder)


def standing_verdicts(home: Path) -> list[Verdict]:
    """The verdicts by the plan of looks that was last declared for the experiment in ``home``; none without one.

    Raises InputError where the record of it is damaged.
    """
    plans = read_plans(home, STOPPING)
    return SweepPlan.from_record(plans[-1].plan).verdicts(home, plans[-1]) if plans else []


def headline(verdict: Verdict) -> str:
    """A pair's verdict in a sentence: ``better in LPIPS Squeeze: −0.0120 (97.5 % interval …), after 2 seeds``."""
    claim, decision = verdict.claim, verdict.decision
    against = f"{claim.arm} against {claim.baseline}"
    if decision is None or decision.mean is None or decision.interval is None or verdict.design is None:
        return f"{against}: no verdict yet, {verdict.reason}"
    word = {
        "for": "better",
        "against": "worse",
        "equivalent": f"no difference of {claim.effect} or more",
        "undecided": f"undecided after all {decision.seeds} seeds",
        "open": "not decided yet",
    }[decision.outcome]
    level, most = f"{100 * (1 - verdict.design.alpha):.3g} %", verdict.design.looks[-1]
    return (
        f"{against}: {word} in {verdict.measure.name}, {verdict.shown(decision.mean)} ({level} interval "
        f"{verdict.shown_interval(decision.interval)}) with {decision.seeds} of at most {most} seeds"
        + "".join(f"; {note}" for note in verdict.notes)
    )


def _expected(trial: TrialConfig) -> TrialResult:
    """The trial as if it had run: it has a configuration and no results."""
    values, folder = trial.values, TrialFolder.of(trial.values).path
    record = TrialRecord(
        status="complete",  # as the type has it: no file says so
        experiment=values["name"],
        scene=values["scene"]["name"],
        init=values["init"]["name"],
        densify=values["densify"]["name"],
        seed=values["seed"],
        raster="",
        protocol="",
        iterations=0,
        metrics={},
        unavailable={},
        seconds={},
        num_init_points=None,
        num_gaussians=0,
        peak_memory_mb=None,
        hashes={},
        versions={},
    )
    found = TrialResult(folder, folder.name.partition(SEED)[0], record)
    return replace(found, settings=Configurations({found.kind: flatten(yaml.safe_load(trial.yaml))}))


def _facts(metric: str, values: Mapping[str, Any]) -> MetricFacts:
    known = find(metric)
    if known is not None:
        return known
    from gsbench.pipeline.components import build_metrics  # a user's own, whose class must be made

    return facts_of(metric, build_metrics(values["eval"], values["allow_targets"])[metric])


def _seeds(trials: Sequence[TrialResult]) -> tuple[int, ...]:
    """The seeds that all scenes and arms have, in the order of the sweep; raises InputError where they differ."""
    groups = by_key(trials, lambda trial: (trial.scene, trial.arm))
    seeds = {key: tuple(dict.fromkeys(trial.seed for trial in group)) for key, group in groups.items()}
    first = next(iter(seeds.values()))
    for (scene, arm), own in seeds.items():
        if own != first:
            raise InputError(
                f"launch.stop_when_decided needs the same seeds everywhere: {arm_name(arm)} on {scene} has "
                f"{', '.join(map(str, own))}, others {', '.join(map(str, first))}"
            )
    if len(first) < FIRST_LOOK:
        raise InputError(
            f"launch.stop_when_decided needs at least {FIRST_LOOK} seeds, as seed=0,1,2,3: the most it adds"
        )
    return first


def _planned(trials: Sequence[TrialResult], home: Path, first: tuple[str, str], second: tuple[str, str]) -> PlannedPair:
    by_scene = by_key(trials, lambda trial: trial.scene)
    scenes = {}
    for scene, group in by_scene.items():
        folders = [
            {one.path.relative_to(home).as_posix().rpartition(SEED)[0] for one in group if one.arm == arm}
            for arm in (first, second)
        ]
        if all(len(found) == 1 for found in folders):
            scenes[scene] = (folders[0].pop(), folders[1].pop())
    return PlannedPair(arm_name(first), arm_name(second), scenes)
