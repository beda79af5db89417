"""Adding seeds in planned looks until every question is decided, of a check and of a sweep that stops when decided.

In such a sweep every two arms are a question about ``eval.primary``.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

import yaml

from gsbench.analysis.cells import with_variants
from gsbench.analysis.configurations import Configurations
from gsbench.analysis.judgement import Verdict, judge
from gsbench.analysis.pairing import choose_pairs
from gsbench.analysis.results import Arm, TrialResult, group_by, read_experiment
from gsbench.analysis.statistics import FIRST_LOOK, plan_looks
from gsbench.analysis.verdicts import in_words
from gsbench.config.compose import Trial
from gsbench.errors import InputError
from gsbench.eval.facts import MetricFacts, facts_of, find
from gsbench.runs.declaration import Declaration, Question, declared_now
from gsbench.runs.keys import flatten
from gsbench.runs.layout import SEED
from gsbench.runs.trial_folder import TrialFolder
from gsbench.runs.trial_record import TrialRecord
from gsbench.words import counted

log = logging.getLogger(__name__)

T = TypeVar("T", bound=Trial)
Planned = tuple[str, int]  # folder of a trial within its experiment, without the seed; and the seed


def trials_of_look(declaration: Declaration, places: Sequence[int], seeds: int) -> list[Planned]:
    """The trials that the questions at ``places`` need for their first ``seeds`` seeds, a seed after the other."""
    questions = [declaration.questions[k] for k in places]
    needed = [
        (question.seeds[rank], rank, key)
        for question in questions
        for rank in range(min(seeds, len(question.seeds)))
        for both in question.scenes.values()
        for key in both
    ]
    return list(dict.fromkeys((key, seed) for seed, _, key in sorted(needed, key=lambda one: one[1])))


def run_looks(
    declaration: Declaration,
    judged: Callable[[], list[Verdict]],
    run: Callable[[list[Planned]], object],
) -> list[Verdict]:
    """The verdicts, with seeds added look by look; ``judged`` gives those so far, ``run`` runs trials that are not
    done.

    A question whose trials failed waits; the others go on.
    """
    waiting: set[int] = set()
    verdicts = judged()
    for seeds in declaration.looks:
        left = [k for k, verdict in enumerate(verdicts) if not verdict.final and k not in waiting]
        if not left:
            break
        if needed := trials_of_look(declaration, left, seeds):
            log.info("seeds up to %d: %s for %s", seeds, counted(len(needed), "trial"), counted(len(left), "question"))
            run(needed)
        verdicts = judged()
        waiting |= {k for k in left if not verdicts[k].final and verdicts[k].pairs.seeds < seeds}
    return verdicts


@dataclass(frozen=True)
class Stopping(Generic[T]):
    """A sweep's trials by folder and seed, with the declaration by which they are run."""

    declaration: Declaration
    home: Path
    trials: Mapping[Planned, T]

    def judged(self) -> list[Verdict]:
        """The verdicts of every two arms, from the trials that are done."""
        return judge(read_experiment(self.home).trials if self.home.is_dir() else (), self.declaration)

    def describe(self) -> str:
        """Lines that a dry run prints of the looks."""
        every, looks = range(len(self.declaration.questions)), self.declaration.looks
        first, most = (len(trials_of_look(self.declaration, every, seeds)) for seeds in (looks[0], looks[-1]))
        one = self.declaration.questions[0]
        return (
            f"stops when decided, by {one.metric} and a least difference of {one.least:g}: "
            f"{counted(len(every), 'pair')} of "
            f"arms, looks at {', '.join(map(str, looks))} seeds, {first} trials until the first, {most} at most"
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
    facts = facts_for(metric, values)
    least = values["launch"]["least_difference"] or facts.worthwhile
    if least is None:
        raise InputError(
            f"launch.stop_when_decided: {metric} has no usual least difference that matters: give "
            "launch.least_difference"
        )
    expected = with_variants([_expected(trial) for trial in trials])
    seeds = _seeds(expected)
    chosen = choose_pairs(sorted({trial.arm for trial in expected}))
    if not chosen:
        raise InputError("launch.stop_when_decided compares arms, and this sweep has one: give two densifiers")
    questions = []
    for baseline, arm in chosen:
        scenes = _scenes(expected, baseline, arm)
        if not scenes:
            raise InputError(f"launch.stop_when_decided: {arm} and {baseline} have no scene in common")
        sign, least = facts.direction, float(least)
        questions.append(
            Question(metric=metric, sign=sign, least=least, baseline=baseline, arm=arm, scenes=scenes, seeds=seeds)
        )
    declaration = declared_now(questions=tuple(questions), looks=plan_looks(len(seeds)))
    by_folder = {(one.key, one.seed): trial for one, trial in zip(expected, trials, strict=True)}
    return Stopping(declaration, home, by_folder)


def headline(verdict: Verdict) -> str:
    """A pair's verdict in a sentence: ``better in PSNR on this scene: +0.120 (…), with 2 of at most 6 seeds``"""
    question = verdict.question
    against = f"{question.arm} against {question.baseline}"
    if verdict.interval is None:
        return f"{against}: no verdict yet, {verdict.untestable or 'trials are missing'}"
    waits = "" if verdict.final else "not decided yet, "
    seeds = f"with {verdict.pairs.seeds} of at most {len(question.seeds)} seeds"
    return "; ".join([f"{against}: {waits}{in_words(verdict)}, {seeds}", *verdict.notes])


def _expected(trial: Trial) -> TrialResult:
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
    return replace(found, settings=Configurations({found.key: flatten(yaml.safe_load(trial.yaml))}))


def facts_for(metric: str, values: Mapping[str, Any]) -> MetricFacts:
    """Facts of a metric that trials with the configuration ``values`` have; raises InputError for an unknown one."""
    known = find(metric)
    if known is not None:
        return known
    from gsbench.pipeline.parts import build_metrics  # a user's own, whose class must be made

    return facts_of(metric, build_metrics(values["eval"], values["allow_targets"])[metric])


def _seeds(trials: Sequence[TrialResult]) -> tuple[int, ...]:
    """The seeds that all scenes and arms have, in the order of the sweep; raises InputError where they differ."""
    groups = group_by(trials, lambda trial: (trial.scene, trial.arm))
    seeds = {key: tuple(dict.fromkeys(trial.seed for trial in group)) for key, group in groups.items()}
    first = next(iter(seeds.values()))
    for (scene, arm), own in seeds.items():
        if own != first:
            raise InputError(
                f"launch.stop_when_decided needs the same seeds everywhere: {arm} on {scene} has "
                f"{', '.join(map(str, own))}, others {', '.join(map(str, first))}"
            )
    if len(first) < FIRST_LOOK:
        raise InputError(
            f"launch.stop_when_decided needs at least {FIRST_LOOK} seeds, as seed=0,1,2,3: the most it adds"
        )
    return first


def _scenes(trials: Sequence[TrialResult], baseline: Arm, arm: Arm) -> dict[str, tuple[str, str]]:
    """The folders of both arms' trials on each scene that has both."""
    scenes = {}
    for scene, group in group_by(trials, lambda trial: trial.scene).items():
        one, other = ({trial.key for trial in group if trial.arm == side} for side in (baseline, arm))
        if len(one) == len(other) == 1:
            scenes[scene] = one.pop(), other.pop()
    return scenes
