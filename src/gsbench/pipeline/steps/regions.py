"""The regions of a scene's test views (``eval.regions``): the same for all arms of the scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gsbench.errors import InputError
from gsbench.eval.regions import DISTANCE, Depth, Regions, depths_of_points, regions_by_distance
from gsbench.init.base import MODEL_FOLDER, read_cloud
from gsbench.pipeline.steps.scene import Views
from gsbench.scene.beside import DEPTH, digests, pixels_of_view, read_beside
from gsbench.scene.colmap import posed_by_name, read_model
from gsbench.scene.colmap_files import require_subfolder
from gsbench.scene.load import lenses_of
from gsbench.scene.masks import find_masks, read_mask
from gsbench.scene.types import Capture, View
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
    if not depths and (capture.model is None or not len(read_cloud(capture.model).points)):
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
    files, scale = _sensor_depths(capture), parts.scene.depth_scale

    def depth_of(view: View) -> Depth:
        if view.name not in files:
            return np.zeros((view.camera.height, view.camera.width), np.float32)
        picture = read_beside(files[view.name], DEPTH, scale)
        return pixels_of_view(picture, lenses[view.name], view.camera, files[view.name])

    if files:
        return regions_by_distance({view.name: depth_of(view) for view in test})
    return regions_by_distance(_depths_in_model(capture, test))


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
    return {name: capture.depths[name] for name in capture.test_names if name in capture.depths}


def _depths_in_model(capture: Capture, test: tuple[View, ...]) -> dict[str, Depth]:
    """The depth of the scene's own points in each test view, by the scene's own cameras."""
    # The cameras of the trial may come from another model, with another scale.
    assert capture.model is not None
    points = read_cloud(capture.model).points
    placed = posed_by_name(read_model(capture.model))
    depths = {}
    for view in test:
        height, width = view.camera.height, view.camera.width
        if view.name not in placed:
            depths[view.name] = np.zeros((height, width), np.float32)
            continue
        lens, rotation, translation = placed[view.name]
        camera = flat_camera(lens).resized(width, height)
        posed = replace(camera, rotation=rotation, translation=translation)
        depths[view.name] = depths_of_points(points, posed)
    return depths
