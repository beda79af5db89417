"""COLMAP's database: creating it, and adding keypoints and matches of any extractor."""

import math
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from gsbench.init.base import FIELD_OF_VIEW_DEG
from gsbench.init.colmap.pairs import select_pairs
from gsbench.init.options import ColmapOptions
from gsbench.scene.colmap import rescaled_camera
from gsbench.scene.images import image_size, lens_of, open_image, read_image, write_png
from gsbench.scene.types import Capture

DEFAULT_FOCAL_LENGTH = 1.2  # of the longest side, as in COLMAP
COLMAP_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp"})


# each camera with the names of its images
CameraGroups = Sequence[tuple[pycolmap.Camera, Sequence[str]]]


@dataclass(frozen=True)
class DatabaseTask:
    """A database with cameras and images, to be filled with matches of the ``pairs``.

    ``images`` is a folder with the names of the capture in which COLMAP can read every file.
    """

    database: Path
    images: Path
    names: list[str]
    pairs: list[tuple[str, str]]
    capture: Capture
    work_dir: Path


def create_task(
    options: ColmapOptions,
    capture: Capture,
    reference: pycolmap.Reconstruction | None,
    work_dir: Path,
) -> DatabaseTask:
    """Create a database of the capture's images, with the cameras that ``options`` choose."""
    ignored = options.ignores_test_photographs(reference)
    used = capture.train_names if ignored else capture.image_names
    images = readable_images(capture.images, used, work_dir)
    if reference is not None and options.uses_reference_cameras:
        groups = reference_camera_groups(reference)
    else:
        groups = unknown_camera_groups(
            images, capture.image_names, options.camera, options.camera_model, options.focal_length
        )
    database = work_dir / "database.db"
    names = [name for name in create_database(database, groups) if name in set(used)]
    return DatabaseTask(database, images, names, select_pairs(names, options), capture, work_dir)


def readable_images(images: Path, names: Sequence[str], work_dir: Path) -> Path:
    """A folder in which COLMAP can read every image, under the same ``names``.

    This is ``images`` if COLMAP can read all formats. Otherwise (WebP) it is a new folder below
    ``work_dir`` with links to the readable files and PNG copies of the others. COLMAP recognises
    PNG content under any file name.
    """
    unreadable = [name for name in names if Path(name).suffix.lower() not in COLMAP_SUFFIXES]
    if not unreadable:
        return images
    folder = work_dir / "images"
    shutil.rmtree(folder, ignore_errors=True)
    for name in names:
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if name in unreadable:
            with open_image(images / name) as original:
                exif = original.info.get("exif", b"")
            write_png(read_image(images / name), target, exif)
        else:
            target.symlink_to((images / name).resolve())
    return folder


def colmap_masks(masks: Mapping[str, Path], work_dir: Path) -> Path | None:
    """A folder below ``work_dir`` of links to the masks, named as COLMAP expects; None if none."""
    if not masks:
        return None
    folder = work_dir / "masks"
    shutil.rmtree(folder, ignore_errors=True)
    for name, file in masks.items():
        link = folder / f"{name}.png"
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(file.resolve())
    return folder


def reference_camera_groups(
    reference: pycolmap.Reconstruction,
) -> list[tuple[pycolmap.Camera, list[str]]]:
    """The reference's cameras, marked as known, each with the sorted names of its posed images."""
    groups: dict[int, list[str]] = {}
    for image in reference.images.values():
        if image.has_pose:
            groups.setdefault(image.camera_id, []).append(image.name)
    result = []
    for camera_id, names in sorted(groups.items(), key=lambda group: min(group[1])):
        original = reference.cameras[camera_id]
        # A copy, because the database gives it another id.
        camera = rescaled_camera(original, original.width, original.height, camera_id=0)
        camera.has_prior_focal_length = True
        result.append((camera, sorted(names)))
    return result


# Property that photographs of one size must have in common to share a camera.
SHARED_BY: dict[str, Callable[[Path, str], object]] = {
    "exif": lambda images, name: lens_of(images / name),
    "single": lambda images, name: None,
    "per_folder": lambda images, name: Path(name).parent,
    "per_image": lambda images, name: name,
}


def unknown_camera_groups(
    images: Path, names: Sequence[str], sharing: str, model: str, focal_length: float | None
) -> list[tuple[pycolmap.Camera, list[str]]]:
    """Cameras to be estimated, each with the names of its images.

    ``sharing`` is ``exif`` for one camera for all images of a size with the same lens and zoom
    (`lens_of`), ``single`` for one for all images of a size, ``per_folder`` for one for each size
    in each sub-folder, or ``per_image``. The initial focal length in px is
    ``focal_length``, else from the EXIF data of the group's first image if that means a plausible
    field of view, else `DEFAULT_FOCAL_LENGTH`.
    """
    groups: dict[tuple[object, ...], list[str]] = {}
    for name in names:
        key = (SHARED_BY[sharing](images, name), image_size(images / name))
        groups.setdefault(key, []).append(name)
    options = pycolmap.ImageReaderOptions()
    options.camera_model = model
    result = []
    for group in groups.values():
        camera = pycolmap.infer_camera_from_image(images / group[0], options)
        longest = max(camera.width, camera.height)
        most, least = (longest / 2 / math.tan(math.radians(view) / 2) for view in FIELD_OF_VIEW_DEG)
        inferred = camera.mean_focal_length()
        # EXIF data may be wrong or a division by zero: COLMAP would start from NaN.
        if focal_length is not None or not least < inferred < most:
            given = DEFAULT_FOCAL_LENGTH * longest if focal_length is None else focal_length
            camera = pycolmap.Camera.create_from_model_name(
                0, model, given, camera.width, camera.height
            )
            camera.has_prior_focal_length = focal_length is not None
        result.append((camera, group))
    return result


@contextmanager
def writable(path: Path) -> Iterator[pycolmap.Database]:
    """Open a database in one transaction: all changes within the context are kept, or none."""
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        yield database


def create_database(path: Path, groups: CameraGroups) -> dict[str, int]:
    """Create a database with cameras and images but no features; returns the image ids by name.

    The ids follow the sorted names. Because they are fixed here, extraction and matching give the
    same database on any number of threads. Each camera gets its own rig.
    """
    # An interrupted run may have left a database whose ids belong to other images.
    remove_database(path)
    ids_of: dict[str, tuple[int, int]] = {}  # of camera and rig
    image_ids: dict[str, int] = {}
    with writable(path) as database:
        for camera, names in groups:
            camera.camera_id = database.write_camera(camera)
            rig = pycolmap.Rig()
            rig.add_ref_sensor(camera.sensor_id)
            ids_of |= dict.fromkeys(names, (camera.camera_id, database.write_rig(rig)))
        for name, (camera_id, rig_id) in sorted(ids_of.items()):
            image = pycolmap.Image(name=name, camera_id=camera_id)
            image.image_id = database.write_image(image)
            frame = pycolmap.Frame()
            frame.rig_id = rig_id
            frame.add_data_id(image.data_id)
            database.write_frame(frame)
            image_ids[name] = image.image_id
    return image_ids


def remove_database(path: Path) -> None:
    """Remove a database and the files of SQLite beside it, if there are any.

    SQLite would roll back a journal that a stranger left for a new database of this name.
    """
    for suffix in ("", "-journal", "-wal", "-shm"):
        path.with_name(f"{path.name}{suffix}").unlink(missing_ok=True)


def write_keypoints(path: Path, keypoints: Mapping[str, NDArray[np.float32]]) -> None:
    """Add ``keypoints`` [K, 2] by image name, in px of the image file, in COLMAP's convention."""
    ids = image_ids(path)
    with writable(path) as database:
        for name, points in keypoints.items():
            database.write_keypoints(ids[name], points)


def write_matches(path: Path, matches: Mapping[tuple[str, str], NDArray[np.uint32]]) -> None:
    """Add ``matches`` [M, 2] by pairs of names: indices of keypoints in both images."""
    ids = image_ids(path)
    with writable(path) as database:
        for (first, second), indices in matches.items():
            database.write_matches(ids[first], ids[second], indices)


def cameras_without_prior(path: Path) -> bool:
    """Return whether a camera's focal length is neither given nor in the EXIF data."""
    with pycolmap.Database.open(path) as database:
        return any(not camera.has_prior_focal_length for camera in database.read_all_cameras())


def assume_focal_lengths(path: Path, factor: float) -> list[tuple[str, str]]:
    """Set each unknown focal length to ``factor`` times the longest side, and mark it as known.

    Drops the geometries that were verified before, and returns the pairs of image names that have
    matches.
    """
    with writable(path) as database:
        for camera in database.read_all_cameras():
            if not camera.has_prior_focal_length:
                for index in camera.focal_length_idxs():
                    camera.params[index] = factor * max(camera.width, camera.height)
                camera.has_prior_focal_length = True
                database.update_camera(camera)
        names = {image.image_id: image.name for image in database.read_all_images()}
        pair_ids, matches = database.read_all_matches()
        database.clear_two_view_geometries()
        matched = [pair for pair, indices in zip(pair_ids, matches, strict=True) if len(indices)]
    ids = map(pycolmap.pair_id_to_image_pair, matched)
    return sorted((names[first], names[second]) for first, second in ids)


def write_pairs(path: Path, pairs: Sequence[tuple[str, str]]) -> None:
    """Write COLMAP's list of pairs of names without spaces (see `image_ids_as_names`)."""
    path.write_text("".join(f"{first} {second}\n" for first, second in pairs), encoding="utf-8")


@contextmanager
def image_ids_as_names(path: Path) -> Iterator[dict[str, str]]:
    """Rename the images to their ids within the context; yields the new names by the old ones.

    COLMAP splits the lines of its pair lists at spaces, and names of photographs often contain
    spaces.
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
    """Rename the database's images; ``names`` are the new names by image id."""
    with writable(path) as database:
        for image in database.read_all_images():
            image.name = names[image.image_id]
            database.update_image(image)


def strongest_descriptors(path: Path, name: str, count: int) -> NDArray[np.uint8]:
    """The descriptors [K, 128] of an image's ``count`` features of the largest scales, in order."""
    image_id = image_ids(path)[name]
    with pycolmap.Database.open(path) as database:
        keypoints = database.read_keypoints(image_id)
        descriptors = database.read_descriptors(image_id).data
    if len(keypoints) == 0:
        return np.zeros((0, descriptors.shape[1]), dtype=np.uint8)
    # The determinant of a keypoint's affine shape orders keypoints as their scales do.
    scales = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])  # [K]
    return np.asarray(descriptors)[np.argsort(-scales, kind="stable")[:count]]


def database_counts(path: Path) -> dict[str, int]:
    """Count the features, matched and verified pairs and inlier matches of the database."""
    with pycolmap.Database.open(path) as database:
        # includes rejected pairs, with 0 inliers
        _, inliers = database.read_two_view_geometry_num_inliers()
        return {
            "features": database.num_keypoints(),
            "pairs_matched": database.num_matched_image_pairs(),
            "pairs_verified": sum(count > 0 for count in inliers),
            "inlier_matches": sum(inliers),
        }
