"""``gsbench sync``: mirror to MLflow what it missed, once."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from gsbench.errors import GsbenchError
from gsbench.launch.plan import TRIAL_GLOB
from gsbench.pipeline.locks import BusyError
from gsbench.pipeline.trial_files import label_of, read_config, state_of
from gsbench.verbs.status import experiment_home
from gsbench.words import counted


def main(argv: list[str]) -> int:
    """The verb: 1 if the tracker cannot be reached."""
    from gsbench.analysis.results import list_experiments
    from gsbench.cli import runs_dir

    parser = argparse.ArgumentParser(
        prog="gsbench sync", description="Mirror finished and failed trials to MLflow, once."
    )
    parser.add_argument("experiment", nargs="?", help="its name; without one, all")
    parser.add_argument("--uri", help="the tracker, such as http://127.0.0.1:5000; without it, each trial's own")
    options = parser.parse_args(argv)
    runs = runs_dir()
    homes = (
        [experiment_home(runs, options.experiment)]
        if options.experiment
        else [runs / n for n in list_experiments(runs)]
    )
    new = known = 0
    for home in homes:
        for folder in sorted(home.glob(TRIAL_GLOB)):
            if state_of(folder) in ("done", "failed"):
                if _sync_one(folder, runs, options.uri):
                    new += 1
                    print(f"mirrored {label_of(folder)}")
                else:
                    known += 1
    print(f"{counted(new, 'trial')} mirrored, {known} were")
    return 0


def _sync_one(folder: Path, runs: Path, uri: str | None) -> bool:
    from gsbench.tracking import mirror_trial

    values = read_config(folder)
    tracking = values["tracking"] | ({} if uri is None else {"uri": uri})
    try:
        return mirror_trial(tracking, runs, folder, values)
    except BusyError:
        print(f"{label_of(folder)} is being mirrored by another process", file=sys.stderr)
        return False
    except GsbenchError:
        raise
    except Exception as error:
        text = " ".join(f"{type(error).__name__}: {error}".split())[:300]
        raise GsbenchError(
            f"MLflow does not take {label_of(folder)} ({text}); the files are complete: try again"
        ) from error
