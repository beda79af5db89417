"""The photographs of a trial: the user's own, or the procedural courtyard, which a step renders first."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gsbench.logs import progress
from gsbench.pipeline.steps.code import step_of_code
from gsbench.runs.hashing import sha256_of
from gsbench.runs.stages import CAPTURE
from gsbench.runs.step import Step
from gsbench.scene.courtyard.render import render_courtyard
from gsbench.scene.images import image_size
from gsbench.scene.options import SceneConfig
from gsbench.scene.readers import read_colmap, read_photos
from gsbench.scene.sizes import check_final_size
from gsbench.scene.types import Capture


def capture_step(options: SceneConfig) -> Step | None:
    """The step that makes the photographs; None for a scene that is read from the user's folder."""
    if options.kind != "courtyard":
        return None
    inputs = {name: getattr(options, name) for name in ("views", "width", "height", "seed")}

    def build(folder: Path) -> None:
        with progress("scene") as report:
            render_courtyard(folder, progress=report, **inputs)

    return step_of_code(CAPTURE, inputs, build, __name__)


def read_capture(options: SceneConfig, made: Path | None) -> Capture:
    """The photographs of ``options``, selected and split; ``made`` is the folder that ``capture_step`` filled."""
    selection: dict[str, Any] = {"max_images": options.max_images, "split": options.split_rule}
    if made is not None:
        return read_colmap(options.name, made, exact_poses=True, **selection)
    path = Path(str(options.path)).expanduser()
    if options.kind == "photos":
        capture = read_photos(options.name, path, images=options.images, **selection)
    else:
        capture = read_colmap(options.name, path, images=options.images, sparse=options.sparse, **selection)
    for name in capture.image_names:
        file = capture.images / name
        check_final_size(image_size(file), options.downscale, options.max_size, str(file))
    return capture


def split_of(capture: Capture) -> str:
    """A hash of which views are held out."""
    return sha256_of(list(capture.test_names))
