"""Trials: from a command line to a plan, from the plan to outcomes, and the exit code that they amount to."""

from __future__ import annotations

import json
import logging
import os
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from gsbench.compose import Composed, compose_trials
from gsbench.config import conf_dir, register_schemas
from gsbench.errors import GsbenchError, InputError
from gsbench.files import storage_errors
from gsbench.launch.outcome import Outcome, outcome_of_results
from gsbench.launch.plan import add_to_plan, describe_plan
from gsbench.launch.serial import run_serial
from gsbench.pipeline.stages import STAGES
from gsbench.pipeline.stopping import stop_on_signals
from gsbench.pipeline.store import Store
from gsbench.pipeline.trial_files import TrialPaths, find_finished

log = logging.getLogger(__name__)

READ = ("colmap", "photos")  # the kinds of scenes that are read from scene.path
HYDRA_QUERIES = (
    "--cfg",
    "-c",
    "--info",
    "-i",
    "--hydra-help",
    "--shell-completion",
    "-sc",
    "--resolve",
    "--package",
    "-p",
)


def launch(argv: list[str]) -> int:
    """Run the trials of the command line ``argv``; 0 if all are done, 1 if some failed.

    Raises InputError for a configuration that does not compose or hold together, and for a single trial's bad input.
    """
    sys.path.insert(0, os.getcwd())  # a user's own class lies beside the user
    if any(word.split("=")[0] in HYDRA_QUERIES for word in argv):
        return _ask_hydra(argv)
    overrides, multirun, dry_run = parse(argv)
    trials = compose_trials(overrides, multirun)
    if dry_run:
        print("\n".join(describe_plan(trials, trials[0].values["launch"]["parallel"]) + missing_folders(trials)))
        return 0
    return run_trials(trials)


def run_trials(trials: Sequence[Composed]) -> int:
    """Run what is not done among ``trials`` by the launcher that they name; the exit code."""
    runs = TrialPaths.of(trials[0].values).runs
    with storage_errors(runs), stop_on_signals():
        runs.mkdir(parents=True, exist_ok=True)
        Store(runs / "store").sweep(STAGES)
        outcomes, unfinished = _skip_finished(trials)
        # A node of a cluster may have folders that this machine lacks.
        here = [trial for trial in unfinished if trial.values["launch"]["name"] != "slurm"]
        if missing := missing_folders(here):
            raise InputError("; ".join(missing))
        add_to_plan(trials)
        if unfinished:
            if unfinished[0].values["launch"]["name"] == "serial":
                outcomes += run_serial(unfinished)
            else:
                from gsbench.launch.jobs import run_jobs

                outcomes += run_jobs(unfinished)
    return summarize(outcomes, trials)


def missing_folders(trials: Sequence[Composed]) -> list[str]:
    """A line for each scene of the trials whose folder of photographs is not there, and one that says the mend."""
    from gsbench.datasets.catalog import how_to_get
    from gsbench.scene.readers import missing_folder

    scenes = {(scene["name"], scene["path"]) for scene in (t.values["scene"] for t in trials) if scene["kind"] in READ}
    folders = [(name, Path(path).expanduser()) for name, path in sorted(scenes, key=str)]
    missing = [(name, folder) for name, folder in folders if not folder.is_dir()]
    if not missing:
        return []
    return [*(missing_folder(name, folder) for name, folder in missing), how_to_get(missing)]


def parse(argv: Sequence[str]) -> tuple[list[str], bool, bool]:
    """Overrides, whether to expand lists (``-m``), and whether to only list the trials (``--dry-run``)."""
    overrides: list[str] = []
    multirun = dry_run = False
    words = iter(argv)
    for word in words:
        if word in ("-m", "--multirun"):
            multirun = True
        elif word == "--dry-run":
            dry_run = True
        elif word.split("=")[0] in ("--config-dir", "-cd"):
            folder = word.partition("=")[2] or next(words, "")
            if not Path(folder).is_dir():
                raise InputError(f"--config-dir {folder}: no such folder")
            overrides.append(f"hydra.searchpath=['file://{Path(folder).resolve()}']")
        elif word.startswith("-"):
            raise InputError(
                f"{word} is not an option; there are -m, --dry-run, --config-dir FOLDER, --cfg job, --help"
            )
        else:
            overrides.append(word)
    return overrides, multirun, dry_run


def _skip_finished(trials: Sequence[Composed]) -> tuple[list[Outcome], list[Composed]]:
    outcomes: list[Outcome] = []
    unfinished: list[Composed] = []
    seen: set[Path] = set()
    for trial in trials:
        folder = TrialPaths.of(trial.values).folder
        if folder in seen:  # a sweep may list a value twice
            continue
        seen.add(folder)
        results = find_finished(trial.values, _unavailable_metrics)
        if results is None:
            unfinished.append(trial)
        else:
            outcomes.append(outcome_of_results(folder, results))
            log.info("%s: was done  %s", outcomes[-1].label, outcomes[-1].message)
    return outcomes, unfinished


def _unavailable_metrics(options: dict[str, Any]) -> frozenset[str]:
    return _unavailable(json.dumps(options, sort_keys=True))


@cache
def _unavailable(options: str) -> frozenset[str]:
    """The metrics that cannot be computed here and now; weights are looked for, and fetched, once for a sweep."""
    from gsbench.eval.protocol import Evaluator, get_protocol

    chosen = json.loads(options)
    weights = None if chosen["weights"] is None else Path(chosen["weights"]).expanduser()
    protocol, lpips = get_protocol(chosen["protocol"]), tuple(chosen["lpips"])
    return frozenset(Evaluator(protocol, "cpu", lpips, chosen["flip"], weights, chosen["download"]).unavailable)


def summarize(outcomes: Sequence[Outcome], trials: Sequence[Composed]) -> int:
    """Say how the trials ended; 0 if all are done, 1 if some failed, 2 if all failed for bad input.

    A single trial's failure is raised, so that it is the one line that the program prints.
    """
    failed = [outcome for outcome in outcomes if outcome.status == "failed"]
    fatal = next((outcome for outcome in failed if outcome.fatal), None)
    if failed and (fatal or len(outcomes) == 1):
        worst = fatal or failed[0]
        raise (InputError if worst.bad_input else GsbenchError)(worst.message)
    for outcome in failed:
        print(f"gsbench: failed: {outcome.label}: {outcome.message}", file=sys.stderr)
    name = trials[0].values["name"]
    advice = f"gsbench retry {name}" if failed else f"gsbench tables {name}"
    done = sum(outcome.status == "done" for outcome in outcomes)
    log.info("%d of %d trials done; %s: %s", done, len(outcomes), "again" if failed else "the table", advice)
    if failed and all(outcome.status == "failed" and outcome.bad_input for outcome in outcomes):
        return 2
    return 1 if failed else 0


def _ask_hydra(argv: list[str]) -> int:
    """Let Hydra answer about the configuration; no trial is run."""
    import hydra

    def task(config: Any) -> None:
        raise AssertionError("Hydra was asked a question, and ran the task instead")

    register_schemas()
    saved = sys.argv
    sys.argv = ["gsbench", *argv]
    try:
        hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name="config")(task)()
    finally:
        sys.argv = saved
    return 0
