"""Adding seeds in planned looks until every question is decided: sweeps, gates, ledgers."""

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from gsbench.analysis.comparison import compare
from gsbench.analysis.fairness import counts_notes
from gsbench.analysis.notes import texts
from gsbench.analysis.quantities import COSTS, NO_DIRECTION
from gsbench.analysis.questions import read_least
from gsbench.analysis.results import TrialResult, newest_code, read_experiment
from gsbench.analysis.verdicts import Verdict, judge
from gsbench.config.build import facts_for
from gsbench.config.compose import Trial
from gsbench.errors import InputError
from gsbench.eval.facts import known_keys
from gsbench.runs.commands import Digest, Question
from gsbench.words import counted, did_you_mean

log = logging.getLogger(__name__)

Needed = tuple[str, Digest, int]  # scene, digest and seed of a trial


def asked_difference(metric: str, least: str | None, values: Mapping[str, Any]) -> dict[str, Any]:
    """The terms of a question about ``metric``: ``metric``, ``sign``, ``least``, ``relative``.

    ``least`` is text such as ``0.1`` or ``10%``; None takes the metric's usual least difference.
    ``values`` is a trial's configuration, which may define the user's own metrics. Raises
    InputError, one line, for a metric that cannot be judged.
    """
    users_metrics = values["eval"].get("extra") or {}
    metrics = (*known_keys(), *COSTS, *users_metrics)
    if metric not in metrics:
        raise InputError(
            f"--metric {metric}: there is no such metric{did_you_mean(metric, metrics)}"
        )
    sign, usual = -1, None  # less is better of counts and times
    if metric not in COSTS:
        facts = facts_for(metric, values)
        sign, usual = facts.direction, facts.worthwhile
    if not sign:
        raise InputError(f"--metric {metric}: {NO_DIRECTION}")
    if least is None and usual is None:
        raise InputError(
            f"{metric} has no usual least difference that matters: give --least, such as 0.1 or 10%"
        )
    size = read_least(str(usual) if least is None else least, "--least", metric in COSTS)
    return {"metric": metric, "sign": sign, "least": size[0], "relative": size[1]}


def trials_of_look(questions: Sequence[Question], seeds: int) -> list[Needed]:
    """The trials of questions for their first ``seeds`` seeds, seed by seed, each once."""
    needed: dict[Needed, None] = {}
    for rank in range(seeds):
        for question in questions:
            for scene, own in question.seeds.items():
                if rank < len(own):
                    needed |= {(scene, one, own[rank]): None for one in question.digests[scene]}
    return list(needed)


@dataclass(frozen=True)
class SequentialTest:
    """The test of questions by the trials so far, which ``read`` gives."""

    questions: tuple[Question, ...]
    read: Callable[[], Iterable[TrialResult]]

    def verdicts(self) -> list[Verdict]:
        """The verdicts so far."""
        trials = list(self.read())
        return [judge(trials, question) for question in self.questions]

    def answer(self, run: Callable[[list[Needed]], object]) -> list[Verdict]:
        """Add seeds look by look until all questions are decided; returns the verdicts.

        ``run`` runs trials unless they are done. A question whose trials failed gets no further
        seeds; the others continue.
        """
        stuck: set[int] = set()
        verdicts = self.verdicts()
        for seeds in sorted(set().union(*(question.looks for question in self.questions))):
            undecided = [k for k, one in enumerate(verdicts) if not one.final and k not in stuck]
            if not undecided:
                break
            if needed := trials_of_look([self.questions[k] for k in undecided], seeds):
                trials = counted(len(needed), "trial")
                questions = counted(len(undecided), "question")
                log.info("seeds up to %d: %s for %s", seeds, trials, questions)
                run(needed)
            verdicts = self.verdicts()
            stuck |= {
                k for k in undecided if not verdicts[k].final and verdicts[k].pairs.seeds < seeds
            }
        return verdicts


def finished_trials(trials: Iterable[Trial]) -> list[TrialResult]:
    """The results of those ``trials`` that are done; results of earlier code do not count."""
    by_folder = {trial.folder: trial for trial in trials}

    def is_done(result: TrialResult) -> bool:
        trial, awaited = by_folder.get(result.path), result.record.awaited
        # A metric whose weights are missing does not make a trial unfinished.
        return trial is not None and not trial.files.why_not_done(
            trial.values, lambda options: awaited
        )

    homes = dict.fromkeys(trial.files.home for trial in by_folder.values())
    return [one for home in homes for one in read_experiment(home).trials if is_done(one)]


def log_verdicts(trials: Iterable[Trial]) -> None:
    """Log a line for each idea of the experiments of ``trials``, and what one must know beside it.

    These are unequal counts. A ledger says its own verdicts: what is said
    of a sweep does not fit its ideas.
    """
    for home in dict.fromkeys(trial.files.home for trial in trials):
        experiment = read_experiment(home)
        if experiment.history.ledger is not None:
            continue
        comparison = compare(newest_code(experiment))
        before = counts_notes(comparison.trials, comparison.pairs)
        headlines = [answer.headline for answer in comparison.answers]
        for line in [*texts(before), *headlines, *comparison.experiment.versions]:
            log.info("%s", line)
