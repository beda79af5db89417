"""COLMAP's database: creating it, and adding keypoints and matches of any extractor."""

import math
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap
from numpy.typing import NDArray

from gsbench.init.base import FIELD_OF_VIEW_DEG
from gsbench.init.colmap.pairs import select_pairs
from gsbench.init.options import ColmapOptions
from gsbench.scene.colmap import posed_images, rescaled_camera
from gsbench.scene.images import image_size, lens_of, open_image, read_image, write_png
from gsbench.scene.names import grouped
from gsbench.scene.types import ByteArray, Capture

DEFAULT_FOCAL_LENGTH = 1.2  # of the longest side, as in COLMAP
COLMAP_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp"})


# a camera with the names of its images
CameraGroup = tuple[pycolmap.Camera, list[str]]


class DatabaseTask(NamedTuple):
    """A database with cameras and images, to be filled with matches of the ``pairs``.

    ``images`` is a folder with the names of the capture in which COLMAP can read every file.
    """

    database: Path
    images: Path
    names: list[str]
    pairs: list[tuple[str, str]]


def create_task(
    options: ColmapOptions,
    capture: Capture,
    reference: pycolmap.Reconstruction | None,
    work_dir: Path,
) -> DatabaseTask:
    """Create a database of the capture's images, with the cameras that ``options`` choose."""
    names = options.select_images(capture, reference)
    images = readable_images(capture.images, names, work_dir)
    if reference is not None and options.poses == "shared":
        groups = reference_camera_groups(reference)
    else:
        groups = unknown_camera_groups(images, names, options)
    database = work_dir / "database.db"
    create_database(database, groups)
    return DatabaseTask(database, images, names, select_pairs(names, options))


def readable_images(images: Path, names: Sequence[str], work_dir: Path) -> Path:
    """A folder in which COLMAP can read every image, under the same ``names``.

    This is ``images`` if COLMAP can read all formats. Otherwise (WebP) it is a new folder below
    ``work_dir`` with links to the readable files and PNG copies of the others. COLMAP recognises
    PNG content under any file name.
    """
    unreadable = {name for name in names if Path(name).suffix.lower() not in COLMAP_SUFFIXES}
    if not unreadable:
        return images
    folder = linked({name: images / name for name in names}, work_dir / "images")
    for name in unreadable:
        (folder / name).unlink()
        with open_image(images / name) as original:
            exif = original.info.get("exif", b"")
        write_png(read_image(images / name), folder / name, exif)
    return folder


def linked(files: Mapping[str, Path], folder: Path) -> Path:
    """A new ``folder`` of links to ``files`` by their names there."""
    shutil.rmtree(folder, ignore_errors=True)
    for name, file in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).symlink_to(file.resolve())
    return folder


def reference_camera_groups(reference: pycolmap.Reconstruction) -> list[CameraGroup]:
    """The reference's cameras, marked as known, each with the sorted names of its posed images."""
    images = posed_images(reference)
    groups = grouped(sorted(images), lambda name: images[name].camera_id)
    result = []
    for camera_id, names in groups.items():
        original = reference.cameras[camera_id]
        # A copy, because the database gives it another id.
        camera = rescaled_camera(original, original.width, original.height, camera_id=0)
        camera.has_prior_focal_length = True
        result.append((camera, names))
    return result


# Property that photographs of one size must have in common to share a camera.
SHARED_BY: dict[str, Callable[[Path, str], object]] = {
    "exif": lambda images, name: lens_of(images / name),
    "single": lambda images, name: None,
    "per_folder": lambda images, name: Path(name).parent,
    "per_image": lambda images, name: name,
}


def unknown_camera_groups(
    images: Path, names: Sequence[str], options: ColmapOptions
) -> list[CameraGroup]:
    """Cameras to be estimated, each with the names of its images (``init.camera``).

    The initial focal length in px is that of ``options``, else from the EXIF data of the group's
    first image if that means a plausible field of view, else `DEFAULT_FOCAL_LENGTH`.
    """
    shared_by = SHARED_BY[options.camera]
    groups = grouped(names, lambda name: (shared_by(images, name), image_size(images / name)))
    reading = pycolmap.ImageReaderOptions({"camera_model": options.camera_model})
    result = []
    for group in groups.values():
        camera = pycolmap.infer_camera_from_image(images / group[0], reading)
        longest = max(camera.width, camera.height)
        most, least = (longest / 2 / math.tan(math.radians(view) / 2) for view in FIELD_OF_VIEW_DEG)
        # EXIF data may be wrong or a division by zero: COLMAP would start from NaN.
        if options.focal_length is not None or not least < camera.mean_focal_length() < most:
            camera = pycolmap.Camera.create_from_model_name(
                0,
                options.camera_model,
                options.focal_length or DEFAULT_FOCAL_LENGTH * longest,
                camera.width,
                camera.height,
            )
            camera.has_prior_focal_length = options.focal_length is not None
        result.append((camera, group))
    return result


@contextmanager
def writable(path: Path) -> Iterator[pycolmap.Database]:
    """Open a database in one transaction: all changes within the context are kept, or none."""
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        yield database


def create_database(path: Path, groups: Sequence[CameraGroup]) -> None:
    """Create a database with cameras and images but no features.

    The ids follow the sorted names. Because they are fixed here, extraction and matching give the
    same database on any number of threads. Each camera gets its own rig.
    """
    # An interrupted run may have left a database whose ids belong to other images.
    remove_database(path)
    ids_of: dict[str, tuple[int, int]] = {}  # of camera and rig
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


def remove_database(path: Path) -> None:
    """Remove a database and the files of SQLite beside it, if there are any.

    SQLite would roll back a journal that a stranger left for a new database of this name.
    """
    for suffix in ("", "-journal", "-wal", "-shm"):
        path.with_name(f"{path.name}{suffix}").unlink(missing_ok=True)


def write_features(
    path: Path,
    keypoints: Mapping[str, NDArray[np.float32]],
    matches: Mapping[tuple[str, str], NDArray[np.uint32]],
) -> None:
    """Add ``keypoints`` [K, 2] by image, in px of the file, in COLMAP's convention, and matches.

    ``matches`` [M, 2] are indices of keypoints in both images, by pairs of their names.
    """
    ids = image_ids(path)
    with writable(path) as database:
        for name, points in keypoints.items():
            database.write_keypoints(ids[name], points)
        for (first, second), indices in matches.items():
            database.write_matches(ids[first], ids[second], indices)


def cameras_without_prior(path: Path) -> bool:
    """Return whether a camera's focal length is neither given nor in the EXIF data."""
    with pycolmap.Database.open(path) as database:
        return any(not camera.has_prior_focal_length for camera in database.read_all_cameras())


def assume_focal_lengths(path: Path, factor: float) -> None:
    """Set each unknown focal length to ``factor`` times the longest side, and mark it as known.

    Drops the geometries that were verified before.
    """
    with writable(path) as database:
        for camera in database.read_all_cameras():
            if not camera.has_prior_focal_length:
                for index in camera.focal_length_idxs():
                    camera.params[index] = factor * max(camera.width, camera.height)
                camera.has_prior_focal_length = True
                database.update_camera(camera)
        database.clear_two_view_geometries()


def image_ids(path: Path) -> dict[str, int]:
    """The ids of the database's images by their names."""
    with pycolmap.Database.open(path) as database:
        return {image.name: image.image_id for image in database.read_all_images()}


def strongest_descriptors(path: Path, name: str, count: int) -> ByteArray:
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
