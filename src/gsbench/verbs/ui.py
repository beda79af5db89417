"""``gsbench ui``: the MLflow dashboard on this machine, lean, with the address that compares an experiment's trials."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from gsbench.errors import InputError
from gsbench.runs.layout import DATABASE
from gsbench.system.isolate import end_descendants
from gsbench.system.stopping import stop_on_signals
from gsbench.verbs.arguments import ArgumentParser, port

DEFAULT_PORT = 5000
LEAN = {  # the default takes eight processes and 2 GB
    "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_LOGGING_LEVEL": "WARNING",
}


def main(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: it serves until Ctrl-C."""
    parser = ArgumentParser(prog="gsbench ui", description="The MLflow dashboard, on this machine only.")
    parser.add_argument("experiment", nargs="?", help="whose trials are compared; without one, the youngest")
    parser.add_argument(
        "--uri", help="the tracker's database or server; default: $MLFLOW_TRACKING_URI, or that of the runs folder"
    )
    parser.add_argument("--port", type=port, default=DEFAULT_PORT)
    parser.add_argument("--print-url", action="store_true", help="only print the address")
    options = parser.parse_args(argv)
    if options.uri is not None and "://" not in options.uri:
        raise InputError(f"--uri {options.uri} is not an address such as sqlite:///FILE or http://HOST:PORT")
    from gsbench.tracking import default_uri, tracker_uri

    uri = tracker_uri(options.uri, runs)
    if uri == default_uri(runs) and not (runs / DATABASE).exists():
        raise InputError(f"no MLflow database in {runs}: run a trial first, or `gsbench sync`, or give --uri")
    base = uri if uri.startswith("http") else f"http://127.0.0.1:{options.port}"
    print(address_of(base, uri, runs, options.experiment), flush=True)
    return 0 if options.print_url or uri.startswith("http") else serve(uri, options.port)


def address_of(base: str, uri: str, runs: Path, experiment: str | None) -> str:
    """The address of the page that compares the trials of an experiment: by default, of the one that changed last.

    Raises InputError where there is none of that name. Where there is none at all, it is the address of the list.
    """
    from gsbench.tracking.client import comparison_url, connect

    client = connect(uri, runs)
    known = {each.name: each for each in client.search_experiments(order_by=["last_update_time DESC"])}
    if experiment is None:
        own = [each for each in known.values() if "mlflow.experimentKind" in each.tags]
        return comparison_url(base, client, own[0].experiment_id) if own else f"{base}/#/experiments"
    if experiment not in known:
        raise InputError(
            f"MLflow has no experiment {experiment!r}; it has {', '.join(sorted(known))}; see `gsbench sync`"
        )
    return comparison_url(base, client, known[experiment].experiment_id)


def serve(uri: str, port: int) -> int:
    """Run ``mlflow ui`` with one worker and no job runner, until a signal or Ctrl-C."""
    place = find_spec("mlflow")
    assert place is not None
    assert place.origin is not None
    command = [sys.executable, "-m", "mlflow", "ui", "--backend-store-uri", uri, "--host", "127.0.0.1"]
    command += ["--port", str(port), "--workers", "1"]
    # uvicorn looks for modules in the current folder first, where a `yaml.py` may lie; MLflow's own place is safe.
    command += ["--uvicorn-opts", f"--app-dir={shlex.quote(str(Path(place.origin).parents[1]))}"]
    with stop_on_signals():
        # Not `subprocess.run`: it would kill `mlflow ui` alone, whose server then is nobody's child and keeps the port.
        server = subprocess.Popen(command, env=LEAN | dict(os.environ))
        try:
            return server.wait()
        except KeyboardInterrupt:
            return 0
        finally:
            end_descendants()
