"""``gsbench sync``: send to the tracker, once, what it missed."""

from collections.abc import Sequence
from pathlib import Path

from gsbench.errors import GsbenchError
from gsbench.runs.experiments import experiment_home, list_experiments, trial_folders
from gsbench.runs.trial_folder import TrialFolder
from gsbench.tracking.follower import sync
from gsbench.tracking.mirror import MirrorError
from gsbench.verbs.arguments import ArgumentParser


def main(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 1 if the tracker cannot be reached."""
    parser = ArgumentParser(prog="gsbench sync", description="Mirror ended trials to their tracker, once.")
    parser.add_argument("experiment", nargs="?", help="its name; without one, all")
    parser.add_argument(
        "--uri",
        help="the tracker, such as http://127.0.0.1:5000 (else $MLFLOW_TRACKING_URI, else the runs folder's own)",
    )
    options = parser.parse_args(argv)
    homes = (
        [experiment_home(runs, options.experiment)]
        if options.experiment
        else [runs / n for n in list_experiments(runs)]
    )
    try:
        folders = [TrialFolder(Path(place)) for home in homes for place in sorted(trial_folders(home))]
        for line in sync(folders, options.uri):
            print(line, flush=True)
    except (MirrorError, OSError) as error:
        raise GsbenchError(f"{error}; the files are complete: try again") from error
    return 0
