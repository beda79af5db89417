"""The views of a trial at their final size: no step of their own, since they are quick to prepare and large to keep."""

from __future__ import annotations

from functools import cache, cached_property
from typing import Any

from gsbench.init.base import MODEL_FOLDER
from gsbench.logs import progress
from gsbench.pipeline.steps.held_out import split_of
from gsbench.runs.code import edited, files_of
from gsbench.runs.layout import VIEWS
from gsbench.runs.made_of import PYCOLMAP, version_of
from gsbench.runs.step import Step
from gsbench.runs.store import Store
from gsbench.scene.load import load_scene
from gsbench.scene.options import SceneConfig
from gsbench.scene.types import Capture, Scene


class Views:
    """Views of a trial, loaded when first asked for, and what they depend on."""

    def __init__(self, store: Store, capture: Capture, init: Step, options: SceneConfig) -> None:
        self.store, self.capture, self.init, self.options = store, capture, init, options

    @property
    def inputs(self) -> dict[str, Any]:
        """The inputs that the views depend on besides the cameras, which are those of ``init``."""
        return {
            "capture": self.capture.fingerprint,
            "test": split_of(self.capture),
            "downscale": self.options.downscale,
            "max_size": self.options.max_size,
            "resample": self.options.resample,
            "principal_point": self.options.principal_point,
        }

    @cached_property
    def scene(self) -> Scene:
        """Undistorted and shrunk; ``init`` must be built. Prepared images are cached beside the store's stages."""
        with progress("scene") as report:
            return load_scene(
                self.capture,
                self.store.path(self.init) / MODEL_FOLDER,
                self.store.root / VIEWS,
                downscale=self.options.downscale,
                max_size=self.options.max_size,
                resample=self.options.resample,
                principal_point=self.options.principal_point,
                progress=report,
                made_by=makers_of_views(),
            )


@cache
def makers_of_views() -> dict[str, str | None]:
    """Versions of what makes pixels of photographs: gsbench's files that are not as released, and packages.

    Pillow reads and shrinks images, pycolmap undistorts them.
    """
    code = edited(files_of([(load_scene.__module__, None)]))
    return {**code, **{package: version_of(package) for package in (PYCOLMAP, "pillow")}}
