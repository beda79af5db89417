"""``gsbench sync``: mirror to MLflow what it missed, once."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from gsbench.analysis.results import experiment_home, list_experiments
from gsbench.errors import GsbenchError
from gsbench.runs.layout import TRIAL_GLOB
from gsbench.runs.trial_files import label_of, read_config, state_of
from gsbench.tracking.client import tracker_uri
from gsbench.tracking.process import MirrorError, MirrorProcess
from gsbench.verbs.arguments import ArgumentParser
from gsbench.words import counted


def main(argv: Sequence[str], runs: Path) -> int:
    """The verb: 1 if the tracker cannot be reached."""
    parser = ArgumentParser(prog="gsbench sync", description="Mirror finished and failed trials to MLflow, once.")
    parser.add_argument("experiment", nargs="?", help="its name; without one, all")
    parser.add_argument("--uri", help="the tracker, such as http://127.0.0.1:5000; without it, each trial's own")
    parser.add_argument("--rebuild", action="store_true", help="delete what MLflow shows of the trials, mirror anew")
    options = parser.parse_args(argv)
    homes = (
        [experiment_home(runs, options.experiment)]
        if options.experiment
        else [runs / n for n in list_experiments(runs)]
    )
    new = known = 0
    with MirrorProcess() as process:  # Ctrl-C ends it, whatever the tracker does
        for home in homes:
            for folder in sorted(home.glob(TRIAL_GLOB)):
                if state_of(folder) in ("done", "failed"):
                    if _sync_one(process, folder, runs, options.uri, options.rebuild):
                        new += 1
                        print(f"mirrored {label_of(folder)}")
                    else:
                        known += 1
    print(f"{counted(new, 'trial')} mirrored, {known} were")
    return 0


def _sync_one(process: MirrorProcess, folder: Path, runs: Path, uri: str | None, anew: bool) -> bool:
    """Whether something of the trial was missing. Raises GsbenchError where the tracker does not take it."""
    values = read_config(folder)
    tracking = values["tracking"] | {"uri": tracker_uri(uri or values["tracking"]["uri"], runs)}
    trial = {"options": tracking, "runs": str(runs), "folder": str(folder), "values": values}
    try:
        answer = process.ask("sync", None, anew=anew, **trial)
    except MirrorError as error:
        raise GsbenchError(f"{error}; the files are complete: try again") from error
    if answer["outcome"] == "failed":
        reason = f"MLflow does not take {label_of(folder)} ({answer['error']})"
        raise GsbenchError(f"{reason}; the files are complete: try again")
    if answer["outcome"] == "busy":
        print(f"{label_of(folder)} is being mirrored by another process", file=sys.stderr)
    return bool(answer["outcome"] == "mirrored")
