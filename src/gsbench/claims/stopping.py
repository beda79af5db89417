"""Adding seeds in planned looks until every question is decided: checks, sweeps, gates, ledgers.

In a sweep, each compared pair of arms is a question about ``eval.primary``.
"""

import itertools
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import yaml

from gsbench.analysis.advice import equal_counts_settings
from gsbench.analysis.cells import with_variants
from gsbench.analysis.comparison import compare
from gsbench.analysis.fairness import counts_notes, limit_notes
from gsbench.analysis.judgement import Verdict, judge
from gsbench.analysis.looks import FIRST_LOOK, plan_looks
from gsbench.analysis.notes import texts
from gsbench.analysis.pairing import choose_pairs, controls_of
from gsbench.analysis.results import Arm, TrialResult, group_by, newest_code, read_experiment
from gsbench.analysis.trial_settings import GROUPS
from gsbench.config.compose import Trial
from gsbench.errors import InputError
from gsbench.eval.facts import MetricFacts, facts_of, find_metric
from gsbench.runs.experiments import Declaration, Question, declared_now, trial_key
from gsbench.runs.layout import LEDGER, SEED
from gsbench.runs.nested import flatten
from gsbench.words import counted

log = logging.getLogger(__name__)

# a trial's key (its folder within the experiment without the seed) and its seed
KeyAndSeed = tuple[str, int]


def trials_of_look(
    declaration: Declaration, indices: Sequence[int], seeds: int
) -> list[KeyAndSeed]:
    """The trials of the questions at ``indices`` for their first ``seeds`` seeds, seed by seed."""
    questions = [declaration.questions[k] for k in indices]
    needed: dict[KeyAndSeed, None] = {}  # in order, each once
    for rank in range(seeds):
        for question in questions:
            if rank < len(question.seeds):
                keys = itertools.chain(*question.scenes.values())
                needed |= {(key, question.seeds[rank]): None for key in keys}
    return list(needed)


@dataclass(frozen=True)
class SequentialTest:
    """The test of a declaration's questions by the trials so far, which ``read`` gives.

    ``ends`` tells if verdicts give a result although a question is undecided.
    """

    declaration: Declaration
    read: Callable[[], Iterable[TrialResult]]
    ends: Callable[[Sequence[Verdict]], bool] = lambda verdicts: False

    def verdicts(self) -> list[Verdict]:
        """The verdicts so far; all are final as soon as they give a result."""
        verdicts = judge(list(self.read()), self.declaration)
        ended = self.ends(verdicts)
        return [replace(verdict, final=verdict.final or ended) for verdict in verdicts]

    def answer(self, run: Callable[[list[KeyAndSeed]], object]) -> list[Verdict]:
        """Add seeds look by look until all questions are decided; returns the verdicts.

        ``run`` runs trials unless they are done. A question whose trials failed gets no further
        seeds; the others continue.
        """
        stuck: set[int] = set()
        verdicts = self.verdicts()
        for seeds in self.declaration.looks:
            undecided = [k for k, one in enumerate(verdicts) if not one.final and k not in stuck]
            if not undecided:
                break
            if needed := trials_of_look(self.declaration, undecided, seeds):
                trials = counted(len(needed), "trial")
                questions = counted(len(undecided), "question")
                log.info("seeds up to %d: %s for %s", seeds, trials, questions)
                run(needed)
            verdicts = self.verdicts()
            stuck |= {
                k for k in undecided if not verdicts[k].final and verdicts[k].pairs.seeds < seeds
            }
        return verdicts


class InExperiment(Protocol):
    """A declaration about the experiment in the folder ``home``."""

    @property
    def declaration(self) -> Declaration: ...
    @property
    def home(self) -> Path: ...


def sequential_test(asked: InExperiment) -> SequentialTest:
    """The test of a declaration's questions by all trials of its experiment."""
    return SequentialTest(asked.declaration, lambda: read_experiment(asked.home).trials)


@dataclass(frozen=True)
class SweepInLooks:
    """The trials of a sweep that stops when decided, with its declaration."""

    declaration: Declaration
    home: Path
    trials: Mapping[KeyAndSeed, Trial]

    def describe(self) -> str:
        """A line about the looks for a dry run."""
        questions, looks = self.declaration.questions, self.declaration.looks
        indices = range(len(questions))
        first = len(trials_of_look(self.declaration, indices, looks[0]))
        most = len(trials_of_look(self.declaration, indices, looks[-1]))
        return (
            f"stops when decided, by {questions[0].metric} and a least difference of "
            f"{questions[0].least:g}: {counted(len(questions), 'pair')} of arms, looks at "
            f"{', '.join(map(str, looks))} seeds, {first} trials until the first, {most} at most"
        )


def plan_sweep(trials: Sequence[Trial]) -> SweepInLooks:
    """Plan the looks of a sweep's trials.

    Raises InputError, one line, if the sweep cannot be run in looks.
    """
    homes = {trial.files.home for trial in trials}
    metrics = {trial.values["eval"].get("primary") for trial in trials}
    if len(homes) > 1 or len(metrics) > 1:
        raise InputError(
            "launch.stop_when_decided: all trials of the sweep need one name and one eval.primary"
        )
    (home,), (metric,) = homes, metrics
    if metric is None:
        raise InputError(
            "launch.stop_when_decided needs the metric that decides, as eval.primary=psnr"
        )
    values = trials[0].values
    facts = facts_for(metric, values)
    least = values["launch"]["least_difference"] or facts.worthwhile
    if least is None:
        raise InputError(
            f"launch.stop_when_decided: {metric} has no usual least difference that matters: give "
            "launch.least_difference"
        )
    expected = with_variants([_planned(trial) for trial in trials])
    seeds = _seeds(expected)
    settings = {trial.arm: trial.config for trial in expected}
    chosen = choose_pairs(sorted(settings), controls=controls_of(expected), settings=settings)
    if not chosen:
        raise InputError(
            "launch.stop_when_decided compares arms, and this sweep has one: give two densifiers"
        )
    questions = []
    for baseline, arm in chosen:
        scenes = _scenes(expected, baseline, arm)
        if not scenes:
            raise InputError(
                f"launch.stop_when_decided: {arm} and {baseline} have no scene in common"
            )
        questions.append(
            Question(
                metric=metric,
                sign=facts.direction,
                least=float(least),
                baseline=baseline,
                arm=arm,
                scenes=scenes,
                seeds=seeds,
            )
        )
    declaration = declared_now(questions=tuple(questions), looks=plan_looks(len(seeds)))
    by_key = {(one.key, one.seed): trial for one, trial in zip(expected, trials, strict=True)}
    return SweepInLooks(declaration, home, by_key)


def finished_trials(home: Path, trials: Iterable[Trial]) -> list[TrialResult]:
    """The results of those ``trials`` that are done; results of earlier code do not count."""
    by_folder = {trial.folder: trial for trial in trials}

    def is_done(result: TrialResult) -> bool:
        trial, awaited = by_folder.get(result.path), result.record.awaited
        # A metric whose weights are missing does not make a trial unfinished.
        return trial is not None and not trial.files.why_not_done(
            trial.values, lambda options: awaited
        )

    return list(filter(is_done, read_experiment(home).trials))


def log_verdicts(trials: Iterable[Trial]) -> None:
    """Log the verdicts of the experiments of ``trials``, and what one must know beside them.

    These are unequal counts and limits without effect, said first, trials in no verdict, and
    earlier code. A ledger says its own verdicts: what is said of a sweep does not fit its ideas.
    """
    for home in dict.fromkeys(trial.files.home for trial in trials):
        if (home / LEDGER).exists():
            continue
        comparison = compare(newest_code(read_experiment(home)))
        both = comparison.trials, comparison.pairs
        before = [*counts_notes(*both, equal_counts_settings), *limit_notes(*both)]
        said = [*texts(before), *comparison.sentences, *texts(comparison.remarks)]
        said += comparison.experiment.versions
        for line in said:
            log.info("%s", line)


@dataclass(frozen=True)
class PlannedTrial:
    """A trial that has not run: what is known of a `TrialResult` beforehand."""

    scene: str
    init: str
    densify: str
    seed: int
    config_hash: str
    config: Mapping[str, Any]
    variant: tuple[tuple[str, str], ...] = ()

    @property
    def arm(self) -> Arm:
        return Arm(self.init, self.densify, self.variant)

    @property
    def key(self) -> str:
        return trial_key(self.scene, f"{self.init}-{self.densify}", self.config_hash)


def _planned(trial: Trial) -> PlannedTrial:
    names = {group: trial.values[group]["name"] for group in GROUPS}
    config_hash = trial.folder.name.partition(SEED)[0]
    config = flatten(yaml.safe_load(trial.yaml))
    return PlannedTrial(**names, seed=trial.values["seed"], config_hash=config_hash, config=config)


def facts_for(metric: str, values: Mapping[str, Any]) -> MetricFacts:
    """The facts of a metric of trials with the configuration ``values``.

    Raises InputError for an unknown metric.
    """
    shipped = find_metric(metric)
    if shipped is not None:
        return shipped
    # here, since only a user's own metric needs it
    from gsbench.pipeline.parts import build_metrics

    return facts_of(metric, build_metrics(values["eval"], values["allow_targets"])[metric])


def _seeds(trials: Sequence[PlannedTrial]) -> tuple[int, ...]:
    """The seeds of all scenes and arms, in the order of the sweep.

    Raises InputError if they differ.
    """
    first: tuple[int, ...] = ()
    for (scene, arm), group in group_by(trials, lambda trial: (trial.scene, trial.arm)).items():
        of_group = tuple(dict.fromkeys(trial.seed for trial in group))
        first = first or of_group
        if of_group != first:
            raise InputError(
                f"launch.stop_when_decided needs the same seeds everywhere: {arm} on {scene} has "
                f"{', '.join(map(str, of_group))}, others {', '.join(map(str, first))}"
            )
    if len(first) < FIRST_LOOK:
        raise InputError(
            f"launch.stop_when_decided needs at least {FIRST_LOOK} seeds, as seed=0,1,2,3: the "
            "most it adds"
        )
    return first


def _scenes(trials: Sequence[PlannedTrial], baseline: Arm, arm: Arm) -> dict[str, tuple[str, str]]:
    """The keys of both arms' trials on each scene that has both."""
    scenes = {}
    for scene, group in group_by(trials, lambda trial: trial.scene).items():
        baseline_keys = {trial.key for trial in group if trial.arm == baseline}
        arm_keys = {trial.key for trial in group if trial.arm == arm}
        if len(baseline_keys) == len(arm_keys) == 1:
            scenes[scene] = baseline_keys.pop(), arm_keys.pop()
    return scenes
