"""Verbs for what is shown in a browser: ``view`` and ``ui`` serve it, ``sync`` sends to it."""

import importlib.util
import itertools
import shlex
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

import requests

from gsbench.config.command_words import typed_permissions
from gsbench.config.overrides import key_of
from gsbench.errors import GsbenchError, InputError
from gsbench.files import require_no_links
from gsbench.runs.code import PERMISSIONS
from gsbench.runs.experiments import experiment_home, list_experiments, trial_folders
from gsbench.runs.layout import DATABASE
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.install import require_package
from gsbench.system.isolate import end_descendants
from gsbench.system.programs import allow_modules, own_folder, safe_environment
from gsbench.system.stopping import stop_on_signals
from gsbench.tracking.beside import send_beside
from gsbench.tracking.ideas import addresses, show_ideas
from gsbench.tracking.mlflow_sink import (
    SETTINGS,
    absolute_address,
    default_uri,
    require_own_journal,
    tracker_uri,
)
from gsbench.tracking.sync import MirrorError
from gsbench.tracking.sync import sync as send_missing
from gsbench.verbs.arguments import options_of

SECONDS_TO_ANSWER = 5.0
# MLflow's defaults take eight processes and 2 GB
LEAN = {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}


def view(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: serves the viewer until Ctrl-C."""
    options = options_of("view", argv)
    if len(options.trial) > 2:
        raise InputError(f"one or two trials can be viewed, not {len(options.trial)}")
    require_package("viser", "view", "the viewer")

    from gsbench.system.resources import select_device
    from gsbench.train.proof import create_proven
    from gsbench.view.server import Viewer, check_port
    from gsbench.view.trials import find_trial, load_viewed

    check_port(options.port)
    device = select_device(options.device)
    trials = [find_trial(address, runs) for address in options.trial]
    rasterizer = create_proven("auto", device).rasterizer
    viewer = Viewer([load_viewed(trial, rasterizer, device) for trial in trials], options.port)
    with stop_on_signals():
        try:
            print(f"{viewer.url}  (Ctrl+C ends it)", flush=True)
            threading.Event().wait()
        except KeyboardInterrupt:
            print("stopped")
        finally:
            viewer.stop()
    return 0


def ui(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: serves the dashboard until Ctrl-C, if no server does already."""
    options = options_of("ui", argv)
    if options.uri is not None and "://" not in options.uri:
        raise InputError(f"--uri {options.uri} is not an address such as sqlite:///FILE")
    uri = tracker_uri(options.uri, runs)
    home = None if options.experiment is None else experiment_home(runs, options.experiment)
    if home is None and len(names := list_experiments(runs)) == 1:
        home = experiment_home(runs, names[0])
    require_no_links(runs, runs / DATABASE)
    if home is None and uri == default_uri(runs) and not (runs / DATABASE).exists():
        raise InputError(
            f"no MLflow database in {runs}: run a trial first, or `gsbench sync`, or give --uri"
        )
    is_served = uri.startswith(("http://", "https://"))
    server = uri if is_served else f"http://127.0.0.1:{options.port}"
    pages, sent = {"dashboard": server}, list[str]()
    if home is not None:
        try:  # a runs folder may be another's, and a trial's tracker another one
            sent.extend(send_missing(_trials_in(home), options.uri))
        except (MirrorError, OSError) as error:
            sent.append(f"left out: {error}")
        try:
            pages = addresses(server, show_ideas(home, uri))
        except Exception as error:  # any error of the tracker's client
            raise InputError(
                f"{home.name} could not be sent to {uri} ({type(error).__name__}: {error})"
            ) from error
    for name, address in pages.items():
        print(f"{name:<10} {address}", flush=True)
    for line in sent:
        print(line, flush=True)
    if is_served or (home is not None and _serves(server, home.name, next(iter(pages.values())))):
        return 0
    print("served in some seconds, until Ctrl+C", flush=True)
    return serve(uri, options.port)


def _serves(server: str, experiment: str, page: str) -> bool:
    """Return whether the MLflow server has the experiment under the id that is in ``page``."""
    place = f"{server}/api/2.0/mlflow/experiments/get-by-name"
    try:
        answer = requests.get(
            place, params={"experiment_name": experiment}, timeout=SECONDS_TO_ANSWER
        )
        found = answer.json()["experiment"]["experiment_id"]
    except (requests.RequestException, ValueError, KeyError, TypeError):
        return False
    return f"/experiments/{found}/" in f"{page}/"  # 1 is not the experiment 12


def serve(uri: str, port: int) -> int:
    """Run ``mlflow ui`` with one worker and no job runner, until a signal or Ctrl-C."""
    require_own_journal(uri)
    mlflow_spec = importlib.util.find_spec("mlflow")
    assert mlflow_spec is not None
    assert mlflow_spec.origin is not None
    # uvicorn imports modules from the current folder first, where a `yaml.py` may lie; MLflow's own
    # folder is safe.
    mlflow_folder = shlex.quote(str(Path(mlflow_spec.origin).parents[1]))
    options = {
        "--backend-store-uri": absolute_address(uri),
        "--host": "127.0.0.1",
        "--port": str(port),
        "--workers": "1",
        "--uvicorn-opts": f"--app-dir={mlflow_folder}",
    }
    words = itertools.chain(*options.items())
    with own_folder() as folder, stop_on_signals():
        # Not `subprocess.run`: it would kill only `mlflow ui`, and its orphaned server would keep
        # the port.
        command = [sys.executable, "-P", "-m", "mlflow", "ui", *words]
        environment = SETTINGS | LEAN | safe_environment()
        server = subprocess.Popen(command, cwd=folder, env=environment)
        try:
            return server.wait()
        except KeyboardInterrupt:
            return 0
        finally:
            end_descendants()


def sync(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 1 if the tracker cannot be reached."""
    options = options_of("sync", argv)
    words = [options.experiment or "", *options.permissions]
    experiment = "" if "=" in words[0] else words.pop(0)
    if unread := [word for word in words if key_of(word) != PERMISSIONS]:
        raise InputError(f"sync reads only {PERMISSIONS}, not {unread[0]}")
    allow_modules(allowed := typed_permissions(words))
    try:
        if options.beside is not None:
            send_beside(options.beside, sys.stdin)
            return 0
        names = [experiment] if experiment else list_experiments(runs)
        folders = [trial for name in names for trial in _trials_in(experiment_home(runs, name))]
        for line in send_missing(folders, options.uri, allowed):
            print(line, flush=True)
    except (MirrorError, OSError) as error:
        raise GsbenchError(f"{error}; the files are complete: try again") from error
    return 0


def _trials_in(home: Path) -> list[TrialFolder]:
    """The folders of an experiment's trials."""
    return [TrialFolder(Path(place)) for place in sorted(trial_folders(home))]
