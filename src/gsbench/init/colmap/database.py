"""COLMAP's database: cameras first, then images with keypoints and matches from whatever extractor."""

import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray
from PIL import Image

from gsbench.logs import Progress
from gsbench.scene.colmap import rescaled_camera
from gsbench.scene.images import image_size, read_image
from gsbench.scene.types import Capture

COLMAP_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp"})
VERIFY_CALLS = 20  # COLMAP reports no progress within a call, so it is called for a twentieth of the pairs
MIN_PAIRS_PER_CALL = 50


Groups = Sequence[tuple[pycolmap.Camera, Sequence[str]]]  # each camera with the names of its images


@dataclass(frozen=True)
class DatabaseTask:
    """Database to be filled, with cameras and images in it, and the pairs of images to be matched.

    ``images`` is a folder with the same names as the capture's in which COLMAP can read every file.
    """

    database: Path
    images: Path
    names: list[str]
    pairs: list[tuple[str, str]]
    capture: Capture
    work_dir: Path


def readable_images(images: Path, names: Sequence[str], work_dir: Path) -> Path:
    """A folder with the same ``names`` in which COLMAP can read every image.

    It is ``images`` itself unless some have a format that COLMAP lacks (WebP). Else it is made below ``work_dir``:
    links to the files, and for those PNG content, which COLMAP recognises whatever the name says.
    """
    unreadable = [name for name in names if Path(name).suffix.lower() not in COLMAP_SUFFIXES]
    if not unreadable:
        return images
    folder = work_dir / "images"
    shutil.rmtree(folder, ignore_errors=True)
    for name in names:
        copy = folder / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        if name in unreadable:
            Image.fromarray(read_image(images / name)).save(copy, format="PNG")
        else:
            copy.symlink_to((images / name).resolve())
    return folder


def colmap_masks(masks: Mapping[str, Path], work_dir: Path) -> Path | None:
    """A folder below ``work_dir`` of links to the masks of images by name, as COLMAP names them; None for no masks."""
    if not masks:
        return None
    folder = work_dir / "masks"
    shutil.rmtree(folder, ignore_errors=True)
    for name, file in masks.items():
        link = folder / f"{name}.png"
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(file.resolve())
    return folder


def reference_groups(reference: pycolmap.Reconstruction) -> list[tuple[pycolmap.Camera, list[str]]]:
    """The reference's cameras, taken as known, each with the images that have a pose, in order of their names."""
    groups: dict[int, list[str]] = {}
    for image in reference.images.values():
        if image.has_pose:
            groups.setdefault(image.camera_id, []).append(image.name)
    result = []
    for camera_id, names in sorted(groups.items(), key=lambda group: min(group[1])):
        known = reference.cameras[camera_id]
        camera = rescaled_camera(known, known.width, known.height, camera_id=0)  # a copy, as the database renumbers it
        camera.has_prior_focal_length = True
        result.append((camera, sorted(names)))
    return result


def guessed_groups(
    images: Path, names: Sequence[str], sharing: str, model: str, focal_length: float | None
) -> list[tuple[pycolmap.Camera, list[str]]]:
    """Cameras to be estimated, each with its images.

    ``sharing``: ``single`` is one camera for all images of a size, ``per_folder`` the same within each sub-folder,
    ``per_image`` one for each. The focal length in pixels is ``focal_length``, else EXIF's of the group's first image,
    else 1.2 x the longest side (COLMAP's guess).
    """
    groups: dict[tuple[object, ...], list[str]] = {}
    for name in names:
        size = image_size(images / name)
        folder = str(Path(name).parent)
        key = {"single": size, "per_folder": (folder, *size), "per_image": (name,)}[sharing]
        groups.setdefault(key, []).append(name)
    options = pycolmap.ImageReaderOptions()
    options.camera_model = model
    result = []
    for group in groups.values():
        camera = pycolmap.infer_camera_from_image(images / group[0], options)
        if focal_length is not None:
            camera = pycolmap.Camera.create_from_model_name(0, model, focal_length, camera.width, camera.height)
            camera.has_prior_focal_length = True
        result.append((camera, group))
    return result


def create_database(path: Path, groups: Groups) -> dict[str, int]:
    """A new database with cameras and images but no features; returns the image ids, which follow the sorted names.

    With the ids fixed here, extraction and matching give the same database on any number of threads. Each camera is in
    a rig of its own.
    """
    path.unlink(missing_ok=True)
    camera_ids: dict[str, int] = {}
    rig_ids: dict[str, int] = {}
    image_ids: dict[str, int] = {}
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        for camera, names in groups:
            camera.camera_id = database.write_camera(camera)
            rig = pycolmap.Rig()
            rig.add_ref_sensor(camera.sensor_id)
            rig_id = database.write_rig(rig)
            camera_ids |= dict.fromkeys(names, camera.camera_id)
            rig_ids |= dict.fromkeys(names, rig_id)
        for name in sorted(camera_ids):
            image = pycolmap.Image(name=name, camera_id=camera_ids[name])
            image.image_id = database.write_image(image)
            frame = pycolmap.Frame()
            frame.rig_id = rig_ids[name]
            frame.add_data_id(image.data_id)
            database.write_frame(frame)
            image_ids[name] = image.image_id
    return image_ids


def write_keypoints(path: Path, keypoints: Mapping[str, NDArray[np.float32]]) -> None:
    """Add ``keypoints`` [K, 2] by image name.

    They are in pixels of the image file in COLMAP's convention: the centre of the first pixel is (0.5, 0.5).
    """
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        image_ids = {image.name: image.image_id for image in database.read_all_images()}
        for name, points in keypoints.items():
            if points.ndim != 2 or points.shape[1] != 2:
                raise ValueError(f"keypoints of {name} must be [K, 2], got {points.shape}")
            database.write_keypoints(image_ids[name], np.ascontiguousarray(points, dtype=np.float32))


def write_matches(path: Path, matches: Mapping[tuple[str, str], NDArray[np.uint32]]) -> None:
    """Add ``matches`` [M, 2], indices of keypoints of the first and second image, by pairs of image names."""
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        image_ids = {image.name: image.image_id for image in database.read_all_images()}
        for (first, second), indices in matches.items():
            database.write_matches(
                image_ids[first], image_ids[second], np.ascontiguousarray(indices, dtype=np.uint32).reshape(-1, 2)
            )


def verify_pairs(
    path: Path, pairs: Sequence[tuple[str, str]], options: pycolmap.TwoViewGeometryOptions, progress: Progress
) -> None:
    """COLMAP's geometric verification of the matches of ``pairs``, which are in the database."""
    list_file = path.with_suffix(".pairs.txt")
    size = max(len(pairs) // VERIFY_CALLS, MIN_PAIRS_PER_CALL)
    progress("verify", 0, len(pairs))
    with image_ids_as_names(path) as new_names:
        for start in range(0, len(pairs), size):
            part = pairs[start : start + size]
            write_pairs(list_file, [(new_names[first], new_names[second]) for first, second in part])
            pycolmap.verify_matches(path, list_file, options)
            progress("verify", start + len(part), len(pairs))
    list_file.unlink(missing_ok=True)


def cameras_without_prior(path: Path) -> bool:
    """Return whether some camera's focal length is a guess, neither given nor in the EXIF data."""
    with pycolmap.Database.open(path) as database:
        return any(not camera.has_prior_focal_length for camera in database.read_all_cameras())


def assume_focal_lengths(path: Path, factor: float) -> list[tuple[str, str]]:
    """Set each guessed focal length to ``factor`` times the longest side, as one that is known.

    Drops what was verified under the guess, and returns the pairs of names that have matches.
    """
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        for camera in database.read_all_cameras():
            if not camera.has_prior_focal_length:
                for index in camera.focal_length_idxs():
                    camera.params[index] = factor * max(camera.width, camera.height)
                camera.has_prior_focal_length = True
                database.update_camera(camera)
        names = {image.image_id: image.name for image in database.read_all_images()}
        pair_ids, matches = database.read_all_matches()
        database.clear_two_view_geometries()
        ids = [
            pycolmap.pair_id_to_image_pair(pair) for pair, found in zip(pair_ids, matches, strict=True) if len(found)
        ]
    return sorted((names[first], names[second]) for first, second in ids)


def write_pairs(path: Path, pairs: Sequence[tuple[str, str]]) -> None:
    """COLMAP's list of image pairs, one pair of names on a line; they hold no spaces (`image_ids_as_names`)."""
    path.write_text("".join(f"{first} {second}\n" for first, second in pairs), encoding="utf-8")


@contextmanager
def image_ids_as_names(path: Path) -> Iterator[dict[str, str]]:
    """Name the images by their ids within the context; gives the new names by the old ones.

    COLMAP's pair lists are divided at spaces, which the names of photographs often contain.
    """
    ids = image_ids(path)
    rename_images(path, {image_id: str(image_id) for image_id in ids.values()})
    try:
        yield {name: str(image_id) for name, image_id in ids.items()}
    finally:
        rename_images(path, {image_id: name for name, image_id in ids.items()})


def image_ids(path: Path) -> dict[str, int]:
    """The ids of the database's images by their names."""
    with pycolmap.Database.open(path) as database:
        return {image.name: image.image_id for image in database.read_all_images()}


def rename_images(path: Path, names: Mapping[int, str]) -> None:
    """Give the database's images other names, by their ids."""
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        for image in database.read_all_images():
            image.name = names[image.image_id]
            database.update_image(image)


def strongest_descriptors(path: Path, name: str, count: int) -> NDArray[np.uint8]:
    """The descriptors [K, 128] of an image's ``count`` features of the largest scales, largest first."""
    image_id = image_ids(path)[name]
    with pycolmap.Database.open(path) as database:
        keypoints, descriptors = database.read_keypoints(image_id), database.read_descriptors(image_id).data
    if len(keypoints) == 0:
        return np.zeros((0, descriptors.shape[1]), dtype=np.uint8)
    scales = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])  # of the affine shape
    return np.asarray(descriptors)[np.argsort(-scales, kind="stable")[:count]]


def database_counts(path: Path) -> dict[str, int]:
    """Count the features, matched and verified pairs and inlier matches of the database."""
    with pycolmap.Database.open(path) as database:
        _, inliers = database.read_two_view_geometry_num_inliers()  # pairs that failed are there too, with 0
        return {
            "features": database.num_keypoints(),
            "pairs_matched": database.num_matched_image_pairs(),
            "pairs_verified": sum(count > 0 for count in inliers),
            "inlier_matches": sum(inliers),
        }
