"""The regions of a scene's test views (``eval.regions``): the same for all arms of the scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gsbench.errors import InputError
from gsbench.eval.options import DISTANCE
from gsbench.eval.regions import Depth, Regions, depths_of_points, regions_by_distance
from gsbench.init.base import MODEL_FOLDER
from gsbench.pipeline.steps.scene import Views
from gsbench.scene.beside import (
    DEPTH,
    digests,
    files_beside,
    find_masks,
    pixels_of_view,
    read_mask,
    view_of_file,
)
from gsbench.scene.colmap import model_points, posed_by_name, read_model
from gsbench.scene.colmap_files import require_subfolder
from gsbench.scene.load import lenses_of
from gsbench.scene.types import Array, CameraModel, Capture, View
from gsbench.scene.undistortion import flat_camera

if TYPE_CHECKING:
    from gsbench.pipeline.parts import Parts


def check_capture(views: Views, parts: Parts) -> None:
    """Raise InputError, before hours of work, if the capture lacks what settings ask for."""
    _ = views.inputs, region_inputs(views, parts)


def region_inputs(views: Views, parts: Parts) -> dict[str, Any] | None:
    """The inputs on which regions depend, besides the capture; None without regions.

    Raises InputError, before any training, if the scene cannot have them.
    """
    wanted = parts.eval.regions
    if not wanted:
        return None
    capture = views.capture
    if wanted != DISTANCE:
        return digests(region_masks(capture, parts))
    depths = _sensor_depths(capture)
    if not depths and not len(_own_model(capture.model, capture.fingerprint)[0]):
        raise InputError(
            f"eval.regions={DISTANCE}: the scene {capture.name} has no depth maps and no model "
            "with points of its own, which all arms would share: give a COLMAP model (gsbench "
            "export writes that of a trial), or masks (eval.regions={NAME: FOLDER})"
        )
    scale = {"depth_scale": parts.scene.depth_scale} if depths else {}
    return {"by": DISTANCE, **digests({DEPTH: depths}), **scale}


def regions_of(views: Views, parts: Parts) -> Mapping[str, Regions]:
    """The regions of each test view as masks [H, W]; empty without ``eval.regions``."""
    wanted = parts.eval.regions
    if not wanted:
        return {}
    capture, test = views.capture, views.scene.test
    files = _sensor_depths(capture)
    if wanted == DISTANCE and not files:
        return regions_by_distance(_depths_in_model(capture, test))
    lenses = lenses_of(views.store.path(views.init) / MODEL_FOLDER)
    if wanted != DISTANCE:
        masks = region_masks(capture, parts)
        return {
            view.name: {
                name: pixels_of_view(
                    read_mask(files[view.name], may_be_black=True),
                    lenses[view.name],
                    view.camera,
                    files[view.name],
                )
                for name, files in masks.items()
            }
            for view in test
        }

    def depth_of(view: View) -> Depth:
        if view.name not in files:
            return _unknown(view)
        scale = parts.scene.depth_scale
        return view_of_file(files[view.name], DEPTH, lenses[view.name], view.camera, scale)

    return regions_by_distance({view.name: depth_of(view) for view in test})


def files_read(capture: Capture, parts: Parts) -> list[Path]:
    """The user's files that regions and ``scene.beside`` read, besides photographs and model."""
    read = [*files_beside(capture, parts.scene.beside).values()]
    read += [*region_masks(capture, parts).values()]
    if parts.eval.regions == DISTANCE:
        read.append(_sensor_depths(capture))
    return [file for own in read for file in own.values()]


def region_masks(capture: Capture, parts: Parts) -> dict[str, dict[str, Path]]:
    """The mask file of each test view, by region; empty without masks."""
    folders, names = parts.eval.regions, capture.test_names
    if not isinstance(folders, dict):
        return {}
    root = Path(parts.scene.path or "").expanduser()
    return {
        region: find_masks(
            require_subfolder(root, folder, f"eval.regions.{region}"),
            names,
            f"eval.regions.{region}",
        )
        for region, folder in folders.items()
    }


def _sensor_depths(capture: Capture) -> dict[str, Path]:
    depths = capture.beside.get(DEPTH, {})
    return {name: depths[name] for name in capture.test_names if name in depths}


# Read before the training, to refuse a scene, and after it. The fingerprint covers its content.
@lru_cache(maxsize=1)
def _own_model(
    folder: Path | None, fingerprint: str
) -> tuple[Array, Mapping[str, tuple[CameraModel, Array, Array]]]:
    """The points [P, 3] of a scene's own model, and cameras and poses by photograph."""
    if folder is None:
        return np.empty((0, 3)), {}
    model = read_model(folder)
    return model_points(model)[0], posed_by_name(model)


def _unknown(view: View) -> Depth:
    return np.zeros((view.camera.height, view.camera.width), np.float32)


def _depths_in_model(capture: Capture, test: tuple[View, ...]) -> dict[str, Depth]:
    """The depth of the scene's own points in each test view, by the scene's own cameras."""
    # The cameras of the trial may come from another model, with another scale.
    points, placed = _own_model(capture.model, capture.fingerprint)

    def depth_of(view: View) -> Depth:
        if view.name not in placed:
            return _unknown(view)
        lens, rotation, translation = placed[view.name]
        camera = flat_camera(lens).resized(view.camera.width, view.camera.height)
        return depths_of_points(points, replace(camera, rotation=rotation, translation=translation))

    return {view.name: depth_of(view) for view in test}
