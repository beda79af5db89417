"""Checks of a file of claims: what can be tested here, the trials that it takes, and the verdicts so far.

The trials are ordinary ones of one experiment, found again by their folders, so a check that was killed goes on where
it stopped and ends with the same verdicts.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

from gsbench.analysis.origins import cloud_of
from gsbench.analysis.results import TrialResult, read_experiment
from gsbench.claims.file import Claim, ClaimsFile
from gsbench.claims.measures import is_measurable, same_in_pictures
from gsbench.claims.sequential import plan_looks
from gsbench.claims.shares import same_training
from gsbench.claims.verdict import Pair, PairKey, Verdict, judge_claim
from gsbench.config.compose import TrialConfig, compose_one
from gsbench.config.jobs import with_seed
from gsbench.errors import InputError
from gsbench.records import read_if_sound
from gsbench.runs.declaration import DeclaredPlan
from gsbench.runs.hashing import sha256_of
from gsbench.runs.layout import FAILED
from gsbench.runs.stages import INIT
from gsbench.runs.trial_folder import Failure, TrialFolder
from gsbench.words import closest, counted, some_of, without_places

log = logging.getLogger(__name__)

T = TypeVar("T", bound=TrialConfig)
Lacking = Callable[[TrialConfig, str], str]  # (trial, metric) -> why it cannot be had here, or ""
Find = Callable[[TrialConfig], TrialResult | None]  # the trial with these settings and seed, where it is done
HERE = "here"  # name of the runs folder among the sources of trials


@dataclass(frozen=True)
class Question:
    """A claim with the scenes that can be run here, and why others cannot."""

    claim: Claim
    scenes: tuple[str, ...]
    missing: tuple[str, ...]

    @property
    def testable(self) -> bool:
        return bool(self.scenes) and not self.claim.not_testable

    @property
    def why_not(self) -> str:
        """The reason why the question cannot be tested here at all; "" where it can."""
        return "" if self.testable else self.claim.not_testable or "; ".join(self.missing)


class PlannedPair(NamedTuple):
    """The trials of a claim's baseline and arm on a scene with a seed, as they are composed."""

    claim: str
    scene: str
    seed: int
    trials: tuple[TrialConfig, TrialConfig]


@dataclass(frozen=True)
class Check:
    """A file of claims in a runs folder: its questions, and the first trial of each scene and arm.

    ``run_here`` are the claims' scenes whose trials are run here, as (claim, scene); ``elsewhere`` are others' shares
    (`gsbench.claims.shares`) by name, each finding its trials; pairs that one of them holds whole are not run again.
    """

    file: ClaimsFile
    runs: Path
    questions: tuple[Question, ...]
    first: dict[tuple[str, str, str], TrialConfig]  # by claim, scene, arm
    run_here: frozenset[tuple[str, str]]
    elsewhere: tuple[tuple[str, Find], ...] = ()

    @property
    def home(self) -> Path:
        return self.runs / self.file.name

    @property
    def looks(self) -> tuple[int, ...]:
        return plan_looks(self.file.seeds)

    @property
    def sharing(self) -> int:
        """The number of tests that share the error rate."""
        return max(1, sum(question.testable for question in self.questions))

    @cached_property
    def plan(self) -> dict[str, Any]:
        """The declared plan: the file's, with what of it can be tested here; written down before trials run."""
        tested = {question.claim.id: list(question.scenes) for question in self.questions if question.testable}
        return self.file.plan() | {"tested": tested}

    @property
    def plan_hash(self) -> str:
        return sha256_of(self.plan)

    @property
    def missing(self) -> dict[str, list[str]]:
        """Scenes that cannot be tested here with the reasons, by claim; to be published, so without places."""
        return {
            question.claim.id: list(map(without_places, question.missing))
            for question in self.questions
            if question.missing
        }

    @property
    def is_all_here(self) -> bool:
        """True where every scene of every claim is run here."""
        asked = {(question.claim.id, scene) for question in self.questions for scene in question.scenes}
        return asked <= self.run_here

    def trials(self, questions: Sequence[Question], seeds: int) -> list[TrialConfig]:
        """The trials to be run here that the questions need for their first ``seeds`` seeds; one that several need
        stands once.
        """
        found: dict[Path, TrialConfig] = {}
        for pair in sorted(self._planned_pairs(questions, seeds), key=lambda pair: pair.seed):
            if (pair.claim, pair.scene) in self.run_here and not self._is_shared(pair):
                for trial in pair.trials:
                    found.setdefault(TrialFolder.of(trial.values).path, trial)
        return list(found.values())

    def verdicts(self, declared: DeclaredPlan) -> list[Verdict]:
        """The verdicts from the trials that are done, in the runs folder or elsewhere.

        Raises InputError for a pair that two sources hold with unlike results.
        """
        find = self.find_here()
        found = []
        for question in self.questions:
            pairs = self.pairs(question, find)
            verdict = judge_claim(question.claim, self.file, pairs, question.scenes, self.sharing, declared.time)
            if not question.testable:
                verdict = replace(verdict, reason=question.why_not)
            elif question.missing:
                verdict = replace(verdict, notes=(*question.missing, *verdict.notes))
            if question.testable and not _is_final(verdict) and (failed := self._failed(question, find)):
                verdict = replace(verdict, reason=f"{verdict.reason}; failed: {some_of(failed)}")
            found.append(verdict)
        return found

    def shared_pairs(self) -> int:
        """The number of pairs of trials that others' shares hold whole."""
        return sum(map(self._is_shared, self._planned_pairs(self.questions, self.looks[-1])))

    def planned(self) -> Iterator[tuple[str, str, TrialConfig]]:
        """(claim, scene, trial) for all that the plan may come to need, here or elsewhere."""
        for pair in self._planned_pairs(self.questions, self.looks[-1]):
            for trial in pair.trials:
                yield pair.claim, pair.scene, trial

    def _planned_pairs(self, questions: Sequence[Question], seeds: int) -> Iterator[PlannedPair]:
        """The pairs of trials that the ``questions`` need for their first ``seeds`` seeds, a scene after the other."""
        for question in questions:
            claim = question.claim
            for scene in question.scenes if question.testable else ():
                baseline, arm = (self.first[claim.id, scene, name] for name in (claim.baseline, claim.arm))
                for seed in range(seeds):
                    yield PlannedPair(claim.id, scene, seed, (with_seed(baseline, seed), with_seed(arm, seed)))

    def _is_shared(self, pair: PlannedPair) -> bool:
        """Return whether one share has both trials of a pair."""
        return any(all(map(find, pair.trials)) for _, find in self.elsewhere)

    def _failed(self, question: Question, find: Find) -> list[str]:
        """The trials of a question that failed, each with the reason; of several with one reason the first."""
        found: dict[str, str] = {}
        for trial in self.trials([question], self.looks[-1]):
            folder = TrialFolder.of(trial.values).path
            failure = None if find(trial) is not None else read_if_sound(folder / FAILED, Failure)
            if failure is not None:
                found.setdefault(failure.reason, TrialFolder(folder).label)
        return [f"{label}: {reason}" for reason, label in found.items()]

    def find_here(self) -> Find:
        """Find trials in the runs folder, as it is now."""
        trials = read_experiment(self.home).trials if self.home.is_dir() else ()
        by_folder = {trial.path: trial for trial in trials}
        return lambda trial: by_folder.get(TrialFolder.of(trial.values).path)

    def pairs(self, question: Question, here: Find) -> dict[PairKey, Pair]:
        """The pairs by scene and seed, each from the source with most metrics, then with pictures or their measures.

        ``here`` finds the trials of the runs folder, which of equals is taken.
        Two machines' clouds of one capture differ, so that a trial of one is no partner for that of another. Raises
        InputError for a pair that two sources hold with unlike results.
        """
        sources = ((HERE, here), *self.elsewhere)
        found: dict[PairKey, Pair] = {}
        for pair in self._planned_pairs([question], self.looks[-1]):
            places: dict[str, Pair] = {}
            for name, find in sources:
                baseline, arm = map(find, pair.trials)
                if baseline is not None and arm is not None and _of_one_cloud(baseline, arm):
                    places[name] = baseline, arm
            if places:
                found[pair.scene, pair.seed] = _one_of(places)
        return found


def prepare(
    file: ClaimsFile, runs: Path, lacking: Lacking, permissions: Sequence[str] = (), only: Sequence[str] = ()
) -> Check:
    """Compose the first trial of every scene and arm of every claim; ``lacking`` says what cannot be had here.

    ``permissions`` are words such as ``allow_targets=[mine]`` that were typed: a file of claims can give none. Trials
    of ``only`` these scenes, where some are named, are run here, and nobody asks whether the others could be.

    Raises InputError, naming claim, scene and arm, for settings that do not compose, for an unknown scene, and for one
    of ``only`` that cannot be run here: the plan would be another one than that of the other machines.
    """
    for scene in only:
        if scene not in file.scenes:
            near = closest(scene, file.scenes)
            raise InputError(f"{file.name} has no scene {scene}{near} (it has {', '.join(file.scenes)})")
    here: set[tuple[str, str]] = set()
    questions: list[Question] = []
    first: dict[tuple[str, str, str], TrialConfig] = {}
    known: dict[tuple[str, ...], TrialConfig] = {}
    for claim in file.claims:
        scenes: list[str] = []
        missing: dict[str, list[str]] = {}  # scenes by reason
        for scene in () if claim.not_testable else file.scenes_of(claim):
            is_run_here = scene in (only or (scene,))
            reason = ""
            for arm in (claim.baseline, claim.arm):
                words = (*file.words(claim, scene, arm), f"name={file.name}", "seed=0", *permissions)
                if words not in known:
                    known[words] = _composed(words, runs, f"claim {claim.id}, scene {scene}, arm {arm}")
                first[claim.id, scene, arm] = known[words]
                if is_run_here:
                    reason = reason or lacking(known[words], claim.metric)
                if reason and only:
                    raise InputError(
                        f"claim {claim.id} cannot be tested here on {scene}, which --scene names: {reason}; mend that, "
                        "or give the claim the reason on all machines (not_testable)"
                    )
            if reason:
                missing.setdefault(reason, []).append(scene)
                continue
            scenes.append(scene)
            if is_run_here:
                here.add((claim.id, scene))
        _check_different(claim, scenes, first)
        reasons = tuple(f"{some_of(names)}: {reason}" for reason, names in missing.items())
        questions.append(Question(claim, tuple(scenes), reasons))
    return Check(file, runs, tuple(questions), first, frozenset(here))


class Looked(Protocol[T]):
    """The subject of a look: questions, each with a claim, with their trials and verdicts at a number of seeds."""

    @property
    def questions(self) -> Sequence[Question]: ...

    @property
    def looks(self) -> Sequence[int]: ...

    def trials(self, questions: Sequence[Question], seeds: int) -> list[T]: ...

    def verdicts(self, declared: DeclaredPlan) -> list[Verdict]: ...


def run_looks(
    check: Looked[T],
    declared: DeclaredPlan,
    run: Callable[[Sequence[T]], object],
    ready: Callable[[T], bool] = lambda trial: False,
) -> list[Verdict]:
    """Add seeds in the planned looks until every claim is decided; ``run`` runs what is not ``ready`` yet.

    A claim whose trials failed waits; the others go on.
    """
    waiting: set[str] = set()
    verdicts = check.verdicts(declared)
    for seeds in check.looks:
        left = [
            question
            for question, verdict in zip(check.questions, verdicts, strict=True)
            if question.testable and not _is_final(verdict) and question.claim.id not in waiting
        ]
        if not left:
            break
        trials = [trial for trial in check.trials(left, seeds) if not ready(trial)]
        if trials:
            names = ", ".join(question.claim.id for question in left)
            log.info("seeds up to %d: %s to be run for %s", seeds, counted(len(trials), "trial"), names)
            run(trials)
        verdicts = check.verdicts(declared)
        for question, verdict in zip(check.questions, verdicts, strict=True):
            reached = verdict.decision is not None and verdict.decision.seeds >= seeds
            if question in left and not reached and not _is_final(verdict):
                waiting.add(question.claim.id)
    return verdicts


def _of_one_cloud(one: TrialResult, other: TrialResult) -> bool:
    """Return whether arms with one initialiser began with one cloud, as two machines' trials may not have."""
    keys, clouds = ({read(trial) for trial in (one, other)} for read in (_init_key, cloud_of))
    return len(keys) > 1 or len(clouds) == 1 or None in keys | clouds


def _init_key(trial: TrialResult) -> str | None:
    return trial.record.hashes.get(INIT.name)


def _one_of(places: Mapping[str, Pair]) -> Pair:
    """The pair that several sources hold. Raises InputError where they hold unlike results."""
    (first, pair), *others = places.items()
    for name, other in others:
        for one, two in zip(pair, other, strict=True):
            if not (same_training(one, two) and same_in_pictures(one, two)):
                raise InputError(
                    f"{one.label} has other results in {name} than {first}: it was trained twice, and nobody is to "
                    "choose the better; leave one of the two out"
                )
    return max(places.values(), key=lambda both: (sum(len(one.metrics) for one in both), all(map(is_measurable, both))))


def _is_final(verdict: Verdict) -> bool:
    return verdict.decision is not None and verdict.decision.final


def _composed(words: Sequence[str], runs: Path, where: str) -> TrialConfig:
    try:
        trial = compose_one(words)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    return TrialConfig(trial.values | {"runs": str(runs.resolve())}, trial.overrides)


def _check_different(claim: Claim, scenes: Sequence[str], first: dict[tuple[str, str, str], TrialConfig]) -> None:
    """Raise InputError where both arms are one and the same trial."""
    for scene in scenes:
        one, other = (TrialFolder.of(first[claim.id, scene, arm].values).path for arm in (claim.baseline, claim.arm))
        if one == other:
            raise InputError(f"claim {claim.id}: {claim.baseline} and {claim.arm} are the same trial on {scene}")
