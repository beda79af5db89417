"""``gsbench ui``: the MLflow dashboard on this machine, lean, with the address that compares an experiment's trials."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from gsbench.errors import InputError
from gsbench.runs.layout import DATABASE
from gsbench.verbs.arguments import ArgumentParser, port

DEFAULT_PORT = 5000


def main(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: it serves until Ctrl-C."""
    parser = ArgumentParser(prog="gsbench ui", description="The MLflow dashboard, on this machine only.")
    parser.add_argument("experiment", nargs="?", help="print the address that compares its trials")
    parser.add_argument(
        "--uri", help="the tracker's database or server; default: $MLFLOW_TRACKING_URI, or that of the runs folder"
    )
    parser.add_argument("--port", type=port, default=DEFAULT_PORT)
    parser.add_argument("--print-url", action="store_true", help="only print the address")
    options = parser.parse_args(argv)
    if options.uri is not None and "://" not in options.uri:
        raise InputError(f"--uri {options.uri} is no address such as sqlite:///FILE or http://HOST:PORT")
    from gsbench.tracking import connect, default_uri, tracker_uri

    uri = tracker_uri(options.uri, runs)
    if uri == default_uri(runs):
        if not (runs / DATABASE).exists():
            raise InputError(f"no MLflow database in {runs}: run a trial first, or `gsbench sync`, or give --uri")
        connect(uri, runs)  # which follows a runs folder that was moved
    base = uri if uri.startswith("http") else f"http://127.0.0.1:{options.port}"
    print(base if options.experiment is None else address_of(base, uri, runs, options.experiment), flush=True)
    if options.print_url or uri.startswith("http"):
        return 0
    return serve(uri, options.port)


def address_of(base: str, uri: str, runs: Path, experiment: str) -> str:
    """The address of the page that compares the trials of ``experiment``. Raises InputError where there is none."""
    from gsbench.tracking import connect
    from gsbench.tracking.comparison import comparison_url

    client = connect(uri, runs)
    found = client.get_experiment_by_name(experiment)
    if found is None:
        names = sorted(e.name for e in client.search_experiments())
        raise InputError(f"MLflow has no experiment {experiment!r}; it has {', '.join(names)}; see `gsbench sync`")
    return comparison_url(base, client, found.experiment_id)


def serve(uri: str, port: int) -> int:
    """Run ``mlflow ui`` with one worker and no job runner (its default takes eight processes and 2 GB)."""
    command = [
        sys.executable,
        "-m",
        "mlflow",
        "ui",
        "--backend-store-uri",
        uri,
        "--host",
        "127.0.0.1",
        "--port",
        str(port),
    ]
    lean = {
        "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",
        "MLFLOW_DISABLE_TELEMETRY": "true",
        "MLFLOW_LOGGING_LEVEL": "WARNING",
    }
    try:
        return subprocess.run([*command, "--workers", "1"], env=lean | dict(os.environ), check=False).returncode
    except KeyboardInterrupt:
        return 0
