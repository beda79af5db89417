"""COLMAP models: fitting them to image files, and writing them."""

from collections.abc import Mapping
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pycolmap

from gsbench.errors import InputError
from gsbench.normalization import Normalization
from gsbench.scene.colmap_read import read_model as read_model
from gsbench.scene.images import check_size, image_size
from gsbench.scene.names import match_anywhere
from gsbench.scene.types import Array, ByteArray, Camera, CameraModel, Capture, Posed, to_pinhole
from gsbench.scene.undistortion import as_colmap, as_values
from gsbench.scene.undistortion import plain_camera as plain_camera

Cloud = tuple[Array, ByteArray]  # positions [P, 3] in world units, colours [P, 3]
MIN_TRACK = 2  # images that must see a 3D point, as in COLMAP


def posed_images(model: pycolmap.Reconstruction) -> dict[str, pycolmap.Image]:
    """The images that have a pose, by name, in the order of their ids."""
    return {image.name: image for _, image in sorted(model.images.items()) if image.has_pose}


def posed_by_name(model: pycolmap.Reconstruction) -> dict[str, Posed]:
    """Camera, rotation [3, 3] and translation [3] of the images that have a pose, by name."""
    cameras = {number: as_values(camera) for number, camera in model.cameras.items()}
    found = {}
    for name, image in posed_images(model).items():
        pose = image.cam_from_world()
        found[name] = cameras[image.camera_id], pose.rotation.matrix(), np.array(pose.translation)
    return found


def camera_centers(model: pycolmap.Reconstruction) -> Array:
    """The centres [V, 3] of the images that have a pose, in the order of their ids."""
    return np.array(
        [image.projection_center() for image in posed_images(model).values()], dtype=np.float64
    ).reshape(-1, 3)


def normalize_capture(capture: Capture, folder: Path) -> None:
    """Move a capture's model to its advised normalisation, and write it to ``folder``."""
    assert capture.model is not None
    model = read_model(capture.model)
    normalize_model(model, capture.advised_normalization)
    save_model(model, folder)


def save_model(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write ``model`` in COLMAP's binary format."""
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder)


def normalize_model(
    model: pycolmap.Reconstruction, normalization: Normalization, undo: bool = False
) -> None:
    """Move ``model`` from given coordinates to those of the training; ``undo`` moves it back."""
    to_training = pycolmap.Sim3d(
        normalization.scale,
        pycolmap.Rotation3d(),
        -normalization.scale * np.array(normalization.center),
    )
    model.transform(to_training.inverse() if undo else to_training)


def read_reference(capture: Capture) -> pycolmap.Reconstruction:
    """The capture's reference model, fitted to its image files.

    Only images in ``capture.image_names`` that have a pose remain, under those names. Cameras and
    2D points are rescaled to the sizes of the files, so a model of the full size serves
    ``images_4``. 3D points that fewer than two of the images see are dropped, unless no point of
    the model has a track. The ids of cameras, images and points are kept; if the files of one
    camera have different sizes, each further size gets a new camera.

    Raises `InputError` if the aspect ratios of an image and its camera differ by more than
    rounding.
    """
    assert capture.model is not None
    model = read_model(capture.model)
    posed = posed_images(model)
    names = match_anywhere(sorted(posed), capture.image_names)
    fitted = pycolmap.Reconstruction()
    # The files of one camera may have several sizes, for example if some were shrunk. Then each
    # size gets a camera, and the first one keeps the id.
    further = count(max(model.cameras, default=0) + 1)
    camera_ids: dict[tuple[int, tuple[int, int]], int] = {}
    for model_name, image in posed.items():
        if model_name not in names:
            continue
        name, camera = names[model_name], model.cameras[image.camera_id]
        file_camera = camera_of_file(camera, capture.images / name)
        size = file_camera.width, file_camera.height
        key = image.camera_id, size
        if key not in camera_ids:
            is_taken = image.camera_id in camera_ids.values()
            camera_ids[key] = file_camera.camera_id = next(further) if is_taken else image.camera_id
            fitted.add_camera_with_trivial_rig(file_camera)
        scale = np.array(size) / (camera.width, camera.height)
        points = np.array([point.xy for point in image.points2D], dtype=np.float64).reshape(-1, 2)
        resized = pycolmap.Image(
            name=name, keypoints=points * scale, camera_id=camera_ids[key], image_id=image.image_id
        )
        fitted.add_image_with_trivial_frame(resized, image.cam_from_world())
    _copy_points(model, fitted)
    return fitted


def camera_of_file(camera: pycolmap.Camera, path: Path) -> pycolmap.Camera:
    """The camera at the size of the image ``path``; raises InputError for another shape."""
    size = image_size(path)
    check_size(path, size, (camera.width, camera.height))
    return rescaled_camera(camera, *size, camera.camera_id)


def rescaled_camera(
    camera: pycolmap.Camera, width: int, height: int, camera_id: int
) -> pycolmap.Camera:
    """The same camera for the same image at another size in px.

    SIMPLE_PINHOLE becomes PINHOLE, because rounded sides scale the focal length differently in x
    and y, and so does a camera without distortion. Other models with one focal length scale it by
    the mean of both scales, as COLMAP does.
    """
    values = plain_camera(camera)
    if values.name == "SIMPLE_PINHOLE":
        values = replace(values, name="PINHOLE", params=(values.params[0], *values.params))
    # Copied because a Camera object taken from a Reconstruction is a view into it.
    copy = as_colmap(values, camera_id)
    copy.has_prior_focal_length = camera.has_prior_focal_length
    if (width, height) != (camera.width, camera.height):
        copy.rescale(width, height)
    return copy


def pinhole_camera(camera: pycolmap.Camera, cam_from_world: pycolmap.Rigid3d) -> Camera:
    """Convert a COLMAP camera and pose to a `Camera`; raises `InputError` if it is distorted."""
    plain = plain_camera(camera)
    if plain.distorted:
        raise InputError(
            f"a camera of the model {plain.name} is distorted: undistort the images first"
        )
    rotation, translation = cam_from_world.rotation.matrix(), np.array(cam_from_world.translation)
    return replace(to_pinhole(plain), rotation=rotation, translation=translation)


def model_points(model: pycolmap.Reconstruction) -> Cloud:
    """The 3D points, sorted by id."""
    points = [point for _, point in sorted(model.points3D.items())]
    xyz = np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3)
    return xyz, np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3)


def write_model(folder: Path, cameras: Mapping[str, Camera], cloud: Cloud | None = None) -> None:
    """Write PINHOLE cameras with their poses as a COLMAP model; equal intrinsics share a camera.

    ``cloud``, positions [P, 3] and colours [P, 3], becomes the model's points, without tracks. By
    default the model has no points.
    """
    frames = {
        name: (
            CameraModel("PINHOLE", camera.width, camera.height, camera.params),
            camera.rotation,
            camera.translation,
        )
        for name, camera in cameras.items()
    }
    write_frames(folder, frames, cloud)


def write_frames(folder: Path, frames: Mapping[str, Posed], cloud: Cloud | None = None) -> None:
    """Write cameras of any model with world-to-camera rotations [3, 3] and translations [3].

    Images with equal intrinsics share one camera. ``cloud`` is as in `write_model`.
    """
    model = pycolmap.Reconstruction()
    ids: dict[CameraModel, int] = {}
    for image_id, name in enumerate(sorted(frames), start=1):
        camera, rotation, translation = frames[name]
        if camera not in ids:
            ids[camera] = len(ids) + 1
            model.add_camera_with_trivial_rig(as_colmap(camera, ids[camera]))
        image = pycolmap.Image(name=name, camera_id=ids[camera], image_id=image_id)
        pose = pycolmap.Rigid3d(np.column_stack([rotation, translation]))
        model.add_image_with_trivial_frame(image, pose)
    for point, color in zip(*cloud, strict=True) if cloud is not None else ():
        model.add_point3D(point, pycolmap.Track(), color)
    save_model(model, folder)


def _copy_points(model: pycolmap.Reconstruction, target: pycolmap.Reconstruction) -> None:
    """Copy the points, with the observations of the images that ``target`` has."""
    image_ids = set(target.images)
    # A model without any track, such as one that `write_model` wrote, keeps all its points.
    observed = any(point.track.elements for point in model.points3D.values())
    for point_id, point in sorted(model.points3D.items()):
        elements = [element for element in point.track.elements if element.image_id in image_ids]
        if observed and len(elements) < MIN_TRACK:
            continue
        copy = pycolmap.Point3D(
            xyz=point.xyz, color=point.color, error=point.error, track=pycolmap.Track(elements)
        )
        target.add_point3D_with_id(point_id, copy)
        for element in elements:
            target.images[element.image_id].set_point3D_for_point2D(element.point2D_idx, point_id)
