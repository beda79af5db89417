"""Initialisation: cameras and the first cloud as a COLMAP model, shared by all trials with the same options."""

from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path

from gsbench.init.base import MODEL_FOLDER, Initializer
from gsbench.logs import Progress, progress
from gsbench.pipeline.steps.inputs import NO_USER_CODE, UserCode, options_of, split_hash, step_of
from gsbench.runs.keys import INIT, Step
from gsbench.runs.store import Store
from gsbench.scene.images import read_image
from gsbench.scene.types import Capture
from gsbench.system.resources import available_threads


def init_step(
    store: Store,
    capture: Capture,
    initializer: Initializer,
    reference: Step | None = None,
    user: UserCode = NO_USER_CODE,
) -> Step:
    """The initialiser's step. ``reference`` is the step that reconstructs cameras for a capture without them."""
    inputs = {
        "capture": capture.fingerprint,
        "test": split_hash(capture),
        "exact_poses": capture.exact_poses,
        "options": options_of("init", initializer, user),
        "content": initializer.content(),
        "reference": None if reference is None else reference.key,
        "pycolmap": version("pycolmap"),
    }

    def build(folder: Path) -> None:
        with progress("init") as report:
            check_readable(capture, report)
            cameras = None if reference is None else store.path(reference) / MODEL_FOLDER
            initializer.run(capture, folder, report, reference=cameras)

    return step_of(INIT, inputs, build, user, in_processes=True)


def check_readable(capture: Capture, report: Progress) -> None:
    """Decode every photograph once, so that a damaged file is named before hours of work. Raises InputError."""
    with ThreadPoolExecutor(max_workers=available_threads()) as pool:
        for done, _ in enumerate(pool.map(lambda name: read_image(capture.images / name).shape, capture.image_names)):
            report("photographs", done + 1, len(capture.image_names))
