"""The work of gsbench's sweeper: all points of its grids at once, or seed by seed until their question is decided.

Either may begin by tuning its arms (`gsbench.app.tuning`).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hydra.core.utils import JobReturn

from gsbench.app.sweep import Sweep, checked_grids, grid, intervals_of, is_interval, words_of_grids
from gsbench.app.tuning import tuned_jobs
from gsbench.claims.looks import Planned, run_looks
from gsbench.claims.stopping import headline, plan_sweep
from gsbench.files import checked_runs_folder, make_runs_folder
from gsbench.launch.declare import declare_questions
from gsbench.launch.trial import Trial
from gsbench.runs.layout import RESULTS

log = logging.getLogger(__name__)


def sweep(
    begun: Sweep, params: Mapping[str, Any], tune: Mapping[str, Any], words: Sequence[str]
) -> Sequence[JobReturn]:
    """Run all points that the words of a sweep span; ``params`` are the settings and values of
    ``hydra.sweeper.params``, ``tune`` says what of the arms is tuned before (`gsbench.app.tuning`).
    """
    grids = checked_grids(begun.task.grids or [])
    jobs: list[list[str]] = []
    searched: list[dict[str, str]] = []  # the intervals among the words of each job, which its arm is tuned in
    for of_grid in words_of_grids(params, grids, words):
        given = begun.parse(of_grid)
        points = grid([override for override in given if not is_interval(override)])
        jobs += points
        searched += [intervals_of(given)] * len(points)
    if any(searched) or any(value not in (None, {}) for key, value in tune.items() if key in ("points", "ranges")):
        jobs = tuned_jobs(begun, tune, jobs, searched)
    trials = begun.trials(jobs)
    until_decided = any(trial.values["launch"]["stop_when_decided"] for trial in trials)
    return run_until_decided(begun, trials) if until_decided else begun.launch(trials)


def run_until_decided(begun: Sweep, trials: Sequence[Trial]) -> Sequence[JobReturn]:
    """Run the trials of a sweep in planned looks, and no further ones of pairs of arms that are decided.

    The launcher must wait for what it runs. Raises InputError for a sweep that cannot be looked at so.
    """
    stopping = plan_sweep(trials)
    if begun.task.look_only:
        print(stopping.describe())
        return begun.launch(trials)
    make_runs_folder(checked_runs_folder(trials[0].values["runs"]))
    stopping = replace(stopping, declaration=declare_questions(stopping.home, stopping.declaration))
    returned: list[JobReturn] = []
    launched: set[Path] = set()

    def run(planned: Sequence[Planned]) -> None:
        batch = [trial for key in planned if (trial := stopping.trials[key]).folder not in launched]
        launched.update(trial.folder for trial in batch)
        if batch:
            returned.extend(begun.launch(batch, first=len(returned)))

    for verdict in run_looks(stopping.declaration, stopping.judged, run):
        log.info("%s", headline(verdict))
    spared = [trial for trial in trials if trial.folder not in launched and not (trial.folder / RESULTS).exists()]
    log.info("%d of %d trials were not needed", len(spared), len(trials))
    return returned
