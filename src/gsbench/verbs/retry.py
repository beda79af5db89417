"""``gsbench retry``: run an experiment's failed, stopped and missing trials again, with their own settings."""

import logging
import os
from collections.abc import Sequence
from pathlib import Path

from gsbench.config.command_words import key_of, makes_other_trials, typed_permissions
from gsbench.config.compose import Trial, compose_one
from gsbench.config.trust import PERMISSIONS
from gsbench.errors import InputError
from gsbench.launch.dry_run import describe_plan
from gsbench.launch.record import PlannedTrial, forget, read_plan
from gsbench.launch.states import states_of_experiment
from gsbench.runs.experiments import experiment_home
from gsbench.runs.trial_folder import TrialFolder
from gsbench.runs.trial_record import FROM_RENDERS
from gsbench.system.own_modules import allow_modules
from gsbench.tracking.mlflow_sink import VARIABLE, untyped_address
from gsbench.verbs.arguments import ArgumentParser

TRACKER = "tracking.uri"

log = logging.getLogger(__name__)


def main(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: the exit code says, as a sweep's does, whether a trial failed."""
    from gsbench.app.command import run_trials

    parser = ArgumentParser(
        prog="gsbench retry", description="Run the failed, stopped, damaged and missing trials of an experiment again."
    )
    parser.add_argument("experiment")
    parser.add_argument(
        "changes",
        nargs="*",
        default=[],
        metavar="KEY=VALUE",
        help="settings that do not make a different trial: launch=slurm …; allow_targets=[mine] for your own code",
    )
    parser.add_argument("--dry-run", action="store_true", help="only list them")
    options = parser.parse_args(argv)
    home = experiment_home(runs, options.experiment)
    if refused := [change for change in options.changes if makes_other_trials(key_of(change))]:
        raise InputError(f"{refused[0]} would make other trials than those of the plan: give the sweep's own command")
    unfinished = [
        trial.folder
        for trial in states_of_experiment(home)
        if trial.state in ("failed", "partial", "damaged", "missing")
    ]
    if not unfinished:
        print(f"nothing to retry: all trials of {options.experiment} are done, running or queued")
        return 0
    planned = read_plan(home)
    modules = os.getcwd()  # noted now, since `recompose` changes the current folder
    trials = [recompose(folder, planned.get(folder), runs, options.changes, modules) for folder in unfinished]
    _check_trackers(trials, options.changes)
    if options.dry_run:
        print("\n".join(describe_plan(trials, trials[0].values["launch"]["parallel"])))
        return 0
    replaced = [old for old, trial in zip(unfinished, trials, strict=True) if trial.folder != old]
    for old in replaced:
        log.info("%s: its configuration has changed since; the new one is run", TrialFolder(old).label)
    code = run_trials(trials)
    forget(home, [old for old in replaced if old in planned])
    return code


def _check_trackers(trials: Sequence[Trial], changes: Sequence[str]) -> None:
    """Raise InputError for a trial that would send its results to a tracker which only a file names.

    The runs folder may be somebody else's, and its address theirs.
    """
    typed_uri = next((word.partition("=")[2] for word in changes if key_of(word) == TRACKER), None)
    for trial in trials:
        if address := untyped_address(trial.values["tracking"], typed_uri):
            raise InputError(
                f"{trial.files.label} would send its results to {address}, an address from a file: to allow it, type "
                f"{TRACKER}={address} (for a trial in no plan: set {VARIABLE}={address}); tracking=none sends nothing"
            )


def recompose(folder: Path, planned: PlannedTrial | None, runs: Path, changes: list[str], modules: str) -> Trial:
    """The trial in ``folder``: from its planned overrides, else from the configuration that it wrote.

    Neither gives permission to run code: ``changes`` must give it again. ``modules`` is the folder of the user's
    modules.
    """
    if planned is not None:
        if Path(planned.cwd).is_dir():
            os.chdir(planned.cwd)  # relative paths were meant from there, and the trials are run from there
        replaced = {PERMISSIONS, *map(key_of, changes)}
        kept = [word for word in planned.overrides if key_of(word) not in replaced]
        if any(change.startswith("launch=") and change not in planned.overrides for change in changes):
            kept = [word for word in kept if not word.startswith("launch.")]  # they were meant for the other launcher
        # Modules are not taken from planned.cwd: somebody else's plan would name a folder of theirs.
        trial = compose_one([*kept, *changes], modules=modules)
        return Trial(trial.values | {"runs": str(runs)}, trial.overrides)
    files, allowed = TrialFolder(folder), typed_permissions(changes)
    if any(key_of(change) != PERMISSIONS for change in changes):
        raise InputError(f"{files.label} is in no plan, so no setting of it can be changed: run it by its own command")
    allow_modules(allowed, modules)
    values = files.configuration() | {"runs": str(runs), PERMISSIONS: list(allowed)}
    if values["densify"].get("evaluated_from") == FROM_RENDERS:
        raise InputError(f"{files.label} was entered from renders: give the command of `gsbench evaluate` again")
    return Trial(values, ())
