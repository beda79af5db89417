"""``gsbench view``: look at one trained model in the browser, or at two side by side."""

import importlib.util
import threading
from collections.abc import Sequence
from pathlib import Path

from gsbench.errors import InputError
from gsbench.system.install import install_command
from gsbench.system.stopping import stop_on_signals
from gsbench.verbs.arguments import ArgumentParser, port
from gsbench.view import ADDRESS

DEFAULT_PORT = 8080


def main(argv: Sequence[str], runs: Path) -> int:
    parser = ArgumentParser(
        prog="gsbench view", description="Look at trained models in the browser: one, or two side by side."
    )
    parser.add_argument("trial", nargs="+", metavar="TRIAL", help=ADDRESS)
    parser.add_argument("--port", type=port, default=DEFAULT_PORT, help=f"on this machine; 0: any ({DEFAULT_PORT})")
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda or cuda:1")
    options = parser.parse_args(argv)
    if len(options.trial) > 2:
        raise InputError(f"one or two trials can be viewed, not {len(options.trial)}")
    if importlib.util.find_spec("viser") is None:
        raise InputError(f"the viewer needs viser: {install_command('view')}")

    from gsbench.raster import create_rasterizer
    from gsbench.train.device import select_device
    from gsbench.view.picture import TrialPainter
    from gsbench.view.server import Viewer, check_port
    from gsbench.view.trials import find_trial, load_viewed

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
