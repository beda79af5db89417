"""A batch of trials: skip finished ones, check the others before any work, and run them."""

import logging
import re
from collections.abc import Sequence
from pathlib import Path

from gsbench.config.compose import Trial
from gsbench.config.groups import options
from gsbench.config.schema import COMPONENTS
from gsbench.errors import InputError
from gsbench.files import FORBIDDEN, checked_runs_folder, make_runs_folder, storage_errors
from gsbench.launch.estimates import unavailable_now
from gsbench.launch.jobs import Outcome, outcome_of_results, run_local, run_serial
from gsbench.launch.record import asked_metrics, record
from gsbench.launch.slurm import run_slurm
from gsbench.runs.code import PERMISSIONS
from gsbench.runs.keys import STAGES, VIEWS
from gsbench.runs.layout import STORE
from gsbench.runs.store import Store
from gsbench.system.stopping import stop_on_signals
from gsbench.tracking import Mirror
from gsbench.tracking.sync import make_sink

log = logging.getLogger(__name__)


def run_batch(trials: Sequence[Trial], asks: bool = True) -> list[Outcome]:
    """Run the unfinished trials by their launcher, and return the outcomes of all.

    With ``asks``, their questions are written down first.
    """
    launcher = trials[0].values["launch"]["name"]
    with storage_errors(checked_runs_folder(trials[0].values["runs"])), stop_on_signals():
        # A wrong folder of weights is an error even if all trials are done.
        if launcher != "slurm" and (missing := missing_weights(trials)):
            raise InputError("; ".join(missing))
        unfinished = begin(trials, asks)
        left = {trial.folder for trial in unfinished}
        done = {trial.folder: trial for trial in trials if trial.folder not in left}
        outcomes = [outcome_of_results(folder, one.files.record()) for folder, one in done.items()]
        for outcome in outcomes:
            log.info("%s: already done  %s", outcome.label, outcome.message)
        if unfinished and launcher == "slurm":
            outcomes += run_slurm(unfinished)
        elif unfinished:
            run = run_serial if launcher == "serial" else run_local
            with Mirror(unfinished):
                outcomes += run(unfinished)
        return outcomes


def begin(trials: Sequence[Trial], asks: bool = True) -> list[Trial]:
    """Check, plan and declare trials before they run; returns those that are not done.

    Raises InputError for trials that are known to fail.
    """
    asked_metrics(trials)  # raises for two metrics in one experiment, before anything is written
    runs = trials[0].files.runs
    by_folder = {trial.folder: trial for trial in trials}
    unfinished = [
        trial
        for trial in by_folder.values()
        if trial.files.why_not_done(trial.values, unavailable_now)
    ]
    # A node of a cluster may have folders and devices that this machine lacks.
    here = trials[0].values["launch"]["name"] != "slurm"
    if here and (missing := missing_folders(unfinished)):
        raise InputError("; ".join(missing))
    check_parts(unfinished, on_this_machine=here)
    if here:
        check_trackers(unfinished)
    try:
        make_runs_folder(runs)
    except OSError as error:
        if unfinished or error.errno not in FORBIDDEN:
            raise
        log.info("%s cannot be written to (%s), so its plan stays as it is", runs, error.strerror)
    else:
        Store(runs / STORE).sweep((*STAGES, VIEWS))
        record(trials, asks)
    return unfinished


# ---- checks before any trial starts: wrong options of components, missing folders and devices


def missing_folders(trials: Sequence[Trial]) -> list[str]:
    """A line for each missing folder of photographs, model or weights, and where to get them."""
    from gsbench.datasets.catalog import how_to_get
    from gsbench.scene.colmap_files import missing_model
    from gsbench.scene.readers import missing_folder

    missing: list[tuple[str, Path]] = []
    models: list[str] = []
    scenes = [trial.values["scene"] for trial in trials]
    known = {(scene["name"], scene["path"], scene["kind"], scene.get("sparse")) for scene in scenes}
    for name, path, kind, sparse in sorted(known, key=str):
        if kind == "courtyard":
            continue
        folder = Path(path).expanduser()
        if not folder.is_dir():
            missing.append((name, folder))
        elif kind == "colmap":
            models.append(missing_model(name, folder, sparse))
    missing = list(dict.fromkeys(missing))
    lines = [missing_folder(name, folder) for name, folder in missing] + list(filter(None, models))
    return lines + ([how_to_get(missing)] if missing else []) + missing_weights(trials)


def missing_weights(trials: Sequence[Trial]) -> list[str]:
    """A line for each missing folder of weights that the trials name."""
    named = {
        (group, str(folder))
        for trial in trials
        for group in ("eval", "init")
        if (folder := trial.values[group].get("weights"))
    }
    return [
        f"{group}.weights={folder}: no such folder; without it, weights are looked for where "
        "gsbench keeps them"
        for group, folder in sorted(named)
        if not Path(folder).expanduser().is_dir()
    ]


def check_parts(trials: Sequence[Trial], on_this_machine: bool) -> None:
    """Raise InputError that names the key of a setting that a part of the trials refuses.

    With ``on_this_machine`` the trials will run here, so devices and programs are checked too.
    """
    from gsbench.pipeline.parts import Parts

    for trial in trials:
        Parts(trial.values).check(on_this_machine)


def check_trackers(trials: Sequence[Trial]) -> None:
    """Raise InputError for a tracker that cannot be made, or needs a package that is missing."""
    for trial in trials:
        if (options := trial.values["tracking"])["enabled"]:
            make_sink(options, trial.values.get(PERMISSIONS) or ())


def need_no_check(trials: Sequence[Trial]) -> bool:
    """Return whether all components have shipped options, which gsbench's tests have checked.

    Then a dry run need not load torch.
    """
    for word in set().union(*(trial.overrides for trial in trials)):
        key, _, value = word.lstrip("+~").partition("=")
        group = re.split("[./@]", key)[0]
        # Hydra's own settings change no component, unless they bring files from elsewhere.
        if key == "hydra.searchpath" or (
            group in (*COMPONENTS, "raster", "train") and value not in options(key)
        ):
            return False
    return True
