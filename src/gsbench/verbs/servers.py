"""Verbs that serve pages on this machine: ``gsbench view`` and ``gsbench ui``."""

import importlib.util
import os
import shlex
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from gsbench.errors import InputError
from gsbench.runs.layout import DATABASE
from gsbench.system.install import install_command
from gsbench.system.isolate import end_descendants
from gsbench.system.stopping import stop_on_signals
from gsbench.tracking.mlflow_sink import SETTINGS, default_uri, tracker_uri
from gsbench.verbs.arguments import ArgumentParser, port
from gsbench.view import ADDRESS

VIEWER_PORT, DASHBOARD_PORT = 8080, 5000
LEAN = {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}  # MLflow's defaults take eight processes and 2 GB


def view(argv: Sequence[str], runs: Path) -> int:
    parser = ArgumentParser("view")
    parser.add_argument("trial", nargs="+", metavar="TRIAL", help=ADDRESS)
    parser.add_argument("--port", type=port, default=VIEWER_PORT, help=f"on this machine; 0: any ({VIEWER_PORT})")
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda or cuda:1")
    options = parser.parse_args(argv)
    if len(options.trial) > 2:
        raise InputError(f"one or two trials can be viewed, not {len(options.trial)}")
    if importlib.util.find_spec("viser") is None:
        raise InputError(f"the viewer needs viser: {install_command('view')}")

    from gsbench.raster import create_rasterizer
    from gsbench.system.device import select_device
    from gsbench.view.server import Viewer, check_port
    from gsbench.view.trials import TrialPainter, find_trial, load_viewed

    check_port(options.port)
    device = select_device(options.device)
    trials = [find_trial(address, runs) for address in options.trial]
    rasterizer = create_rasterizer("auto", device)
    viewer = Viewer([TrialPainter(load_viewed(trial, device), rasterizer) for trial in trials], options.port)
    with stop_on_signals():
        print(f"{viewer.url}  (Ctrl+C ends it)", flush=True)
        try:
            threading.Event().wait()
        except KeyboardInterrupt:
            print("stopped")
        finally:
            viewer.stop()
    return 0


def ui(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: serves the dashboard until Ctrl-C."""
    parser = ArgumentParser("ui")
    parser.add_argument("--uri", help="the tracker's database; default: $MLFLOW_TRACKING_URI, or the runs folder's")
    parser.add_argument("--port", type=port, default=DASHBOARD_PORT)
    options = parser.parse_args(argv)
    if options.uri is not None and "://" not in options.uri:
        raise InputError(f"--uri {options.uri} is not an address such as sqlite:///FILE")
    uri = tracker_uri(options.uri, runs)
    if uri.startswith("http"):
        raise InputError(f"{uri} is a server, which has its own page: open that in the browser")
    if uri == default_uri(runs) and not (runs / DATABASE).exists():
        raise InputError(f"no MLflow database in {runs}: run a trial first, or `gsbench sync`, or give --uri")
    print(f"http://127.0.0.1:{options.port}", flush=True)
    return serve(uri, options.port)


def serve(uri: str, port: int) -> int:
    """Run ``mlflow ui`` with one worker and no job runner, until a signal or Ctrl-C."""
    mlflow_spec = importlib.util.find_spec("mlflow")
    assert mlflow_spec is not None
    assert mlflow_spec.origin is not None
    command = [sys.executable, "-m", "mlflow", "ui", "--backend-store-uri", uri, "--host", "127.0.0.1"]
    command += ["--port", str(port), "--workers", "1"]
    # uvicorn imports modules from the current folder first, where a `yaml.py` may lie; MLflow's own folder is safe.
    command += ["--uvicorn-opts", f"--app-dir={shlex.quote(str(Path(mlflow_spec.origin).parents[1]))}"]
    with stop_on_signals():
        # Not `subprocess.run`: it would kill only `mlflow ui`, and its orphaned server would keep the port.
        server = subprocess.Popen(command, env=SETTINGS | LEAN | dict(os.environ))
        try:
            return server.wait()
        except KeyboardInterrupt:
            return 0
        finally:
            end_descendants()
