"""A trained model as one HTML page that turns in any browser without a network.

The page is the SuperSplat viewer, written by ``@playcanvas/splat-transform`` (MIT), which npx
downloads and starts. Its settings, in the viewer's version 2, hold each test view as an annotation
(its buttons lead from one to the next).
"""

import math
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbench.analysis.results import TrialResult
from gsbench.errors import GsbenchError
from gsbench.files import atomic, write_json
from gsbench.normalization import Normalization
from gsbench.parsing import read_json
from gsbench.scene.colmap import model_points, read_model
from gsbench.scene.types import View
from gsbench.system.programs import find_program, own_folder, safe_environment
from gsbench.view.trials import background_of, model_file, model_folder, read_test_views

PACKAGE = "@playcanvas/splat-transform@2.7.1"
# Without a GPU, the colours' spherical harmonics are sorted into groups by one step instead of ten:
# each takes ten seconds of a core for 20,000 Gaussians.
WITHOUT_GPU = ("-g", "cpu", "-i", "1")
# The page may run its own script, and load nothing from anywhere.
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval' blob: data:; "
    "worker-src blob: data:; style-src 'unsafe-inline'; img-src blob: data:; font-src data:; "
    "connect-src blob: data:"
)
MIN_DEPTH = 0.2  # units: 3DGS's near plane


def write_page(trial: TrialResult, out: Path) -> None:
    """Write the page of ``trial`` to the file ``out``.

    Raises GsbenchError with the commands to type elsewhere if npx is missing or fails.
    """
    # First, so that an error in the trial is raised before anything is downloaded.
    settings, model = page_settings(trial), model_file(trial)
    npx, said = find_program("npx"), "Node.js (npx) is not installed"
    with own_folder("node_modules", "package.json", ".npmrc") as scratch:
        page, extras = scratch / "page.html", scratch / "settings.json"
        write_json(scratch / "package.json", {})  # npm looks for the project's folder no higher
        shutil.copyfile(model, scratch / "model.ply")
        write_json(extras, settings)
        files = [str(scratch / "model.ply"), "-E", str(extras), str(page)]
        for device in ((), WITHOUT_GPU) if npx else ():
            done = subprocess.run(
                [str(npx), "--yes", PACKAGE, "--overwrite", *device, *files],
                cwd=scratch,
                env=safe_environment(),
                stdin=subprocess.DEVNULL,
                capture_output=True,
                encoding="utf-8",
                errors="replace",
                check=False,
            )
            if done.returncode == 0 and page.is_file():
                text = with_policy(page.read_text(encoding="utf-8"))
                with atomic(out, sync=False) as temporary:
                    temporary.write_text(text, encoding="utf-8")
                return
            last = (done.stderr or done.stdout).strip().rpartition("\n")[2]
            said = f"npx {PACKAGE} failed ({last})"
    raise GsbenchError(
        f"{said}: export --out model.ply, and where it works, type in a folder of your own: npx "
        f"{PACKAGE} model.ply {out.name}"
    )


def with_policy(page: str) -> str:
    """The page with `POLICY` as the first words of its head."""
    meta = f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
    text, count = re.subn(r"(<head[^>]*>)", lambda head: head[0] + meta, page, count=1)
    if not count:
        raise GsbenchError(f"{PACKAGE} wrote a page without a head: please report it")
    return text


def page_settings(trial: TrialResult) -> dict[str, Any]:
    """The viewer's settings: the training's background, and a camera for each test view."""
    folder = model_folder(trial)
    points, _ = model_points(read_model(folder))
    views = [
        _annotation(view.name, _camera(view, points, trial.record.to_training))
        for view in read_test_views(trial, folder)
    ]
    settings: dict[str, Any] = read_json(Path(__file__).with_name("page_settings.json"))
    background = {"color": list(background_of(trial))}
    return settings | {
        "background": background,
        "cameras": [views[0]["camera"]],
        "annotations": views,
    }


def _annotation(name: str, camera: dict[str, Any]) -> dict[str, Any]:
    # splat-transform writes the settings into a script of the page as they are, where the name of a
    # stranger's photograph must not end the script.
    text = {"title": re.sub(r"[<>&]", "_", name), "text": "a test view", "extras": None}
    return {"position": camera["target"], **text, "camera": {"initial": camera}}


def _camera(
    view: View, points: NDArray[np.floating], normalization: Normalization
) -> dict[str, Any]:
    """The place of a test view, its target, and the field of view of its longer side in degrees.

    The target lies at the median depth of the initial ``points`` [P, 3] before the camera. The
    viewer turns models by half a turn about z, since its y points up.
    """
    camera = view.camera
    forward = camera.rotation[2]
    depths = points @ forward + camera.translation[2]  # [P]
    before = depths[depths > MIN_DEPTH]
    depth = float(np.median(before)) if len(before) else 1.0
    ends = normalization.undo(np.stack([camera.center, camera.center + depth * forward]))  # [2, 3]
    position, target = (ends * (-1, -1, 1)).tolist()
    if camera.width >= camera.height:
        longer = camera.width / camera.fx
    else:
        longer = camera.height / camera.fy
    return {"position": position, "target": target, "fov": math.degrees(2 * math.atan(longer / 2))}
