"""The test photographs as they are compared with, once for all trials that share them."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

from gsbench.pipeline.steps.code import step_of_code
from gsbench.pipeline.steps.views import Views
from gsbench.runs.layout import MASKS
from gsbench.runs.stages import GROUND_TRUTH
from gsbench.runs.step import Step
from gsbench.scene.masks import write_mask
from gsbench.scene.names import png_name


def ground_truth_step(views: Views) -> Step:
    """Keep the test views as PNG files, and the masks of those that ignore some pixels."""

    def build(folder: Path) -> None:
        for view in views.scene.test:
            Image.fromarray(view.image).save(folder / png_name(view.name))
            if view.mask is not None:
                (folder / MASKS).mkdir(exist_ok=True)
                write_mask(view.mask, folder / MASKS / png_name(view.name))

    return step_of_code(GROUND_TRUTH, {"scene": views.inputs, "init": views.init.key}, build, __name__)
