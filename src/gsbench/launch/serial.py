"""One trial after the other, in this process."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from gsbench.config.compose import Trial
from gsbench.launch.outcome import Outcome, outcome_of_error, outcome_of_results
from gsbench.runs.trial_record import TrialRecord
from gsbench.system.locks import BusyError
from gsbench.tracking import Mirror

log = logging.getLogger(__name__)


def run_serial(trials: Sequence[Trial], mirror: Mirror) -> list[Outcome]:
    """Run the trials; one that another process is at comes last, so that two sweeps share the work."""
    outcomes: list[Outcome] = []
    busy: list[Trial] = []
    for number, trial in enumerate(trials, 1):
        if len(trials) > 1:
            log.info("%d of %d: %s", number, len(trials), trial.files.label)
        try:
            outcomes.append(run_one(trial, mirror, wait=len(trials) == 1))
        except BusyError as error:
            log.info("%s; later", error)
            busy.append(trial)
            continue
        if outcomes[-1].fatal:
            return outcomes
    return outcomes + [run_one(trial, mirror, wait=True) for trial in busy]


def run_one(trial: Trial, mirror: Mirror, wait: bool) -> Outcome:
    """Run one trial; only BusyError, and what ends the program, is raised."""
    try:
        return outcome_of_results(trial.folder, _run(trial, mirror, wait))
    except BusyError:
        raise
    except Exception as error:  # noqa: BLE001 - a failed trial does not stop the others
        return outcome_of_error(trial.folder, error)


def _run(trial: Trial, mirror: Mirror, wait: bool) -> TrialRecord:
    from gsbench.pipeline.trial import run_trial  # here, because a sweep that is done needs no torch

    return run_trial(trial, mirror, wait)
