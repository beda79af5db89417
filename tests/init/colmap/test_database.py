"""COLMAP's database as pycolmap reads it back: shared cameras, strongest features, counts."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_array_equal
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from gsbench.init import Sfm
from gsbench.init.colmap import database as made
from gsbench.init.colmap import matches
from gsbench.init.sfm import report_lenses, report_unused
from gsbench.scene.images import (
    DIGITAL_ZOOM,
    EXIF_IFD,
    FOCAL_LENGTH,
    FOCAL_LENGTH_35MM,
    LENS,
    MAKE,
    MODEL,
)
from gsbench.scene.types import Capture
from tests.init.tables import TABLES

SIZES = dict.fromkeys(("a.png", "b.png", "c.png", "left/a.png", "left/b.png"), (40, 30))
SIZES["c.png"] = (40, 32)


def groups_of(images, names=tuple(SIZES), sharing="exif", focal=None):
    options = Sfm(camera=sharing, focal_length=focal)
    return made.unknown_camera_groups(images, list(names), options)


@pytest.fixture
def images(tmp_path):
    for name, size in SIZES.items():
        (tmp_path / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", size).save(tmp_path / "images" / name)
    return tmp_path / "images"


@pytest.fixture
def database(images, tmp_path):
    """Cameras and images without features; the names are given unsorted."""
    path = tmp_path / "database.db"
    made.create_database(path, groups_of(images, list(SIZES)[::-1], "single"))
    return path


@pytest.mark.parametrize("sharing, expected", TABLES["shared cameras"])
def test_images_share_a_camera_by_size_folder_or_not_at_all(images, sharing, expected):
    groups = groups_of(images, sharing=sharing)
    assert [sorted(names) for _, names in groups] == expected
    for camera, names in groups:
        assert (camera.width, camera.height) == SIZES[names[0]]
        assert (camera.focal_length, camera.has_prior_focal_length) == (1.2 * 40, False)
    for camera, _ in groups_of(images, sharing=sharing, focal=51.0):
        assert (camera.focal_length, camera.has_prior_focal_length) == (51.0, True)


def with_exif(path, size=(40, 30), **tags):
    """Write a photograph with EXIF data."""
    exif = Image.Exif()
    own = exif.get_ifd(EXIF_IFD)
    places = {"make": (exif, MAKE), "model": (exif, MODEL), "mm": (own, FOCAL_LENGTH)}
    places |= {"film": (own, FOCAL_LENGTH_35MM), "zoom": (own, DIGITAL_ZOOM), "lens": (own, LENS)}
    for name, value in tags.items():
        ifd, number = places[name]
        ifd[number] = value
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size).save(path, exif=exif)


TELEPHONE = {"make": "X", "model": "X 7", "mm": 6.8, "film": 26}


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
@pytest.mark.parametrize("change, cameras", TABLES["lenses by EXIF"])
def test_photographs_share_a_camera_by_their_exif_data(tmp_path, suffix, change, cameras):
    names = [f"{k}{suffix}" for k in range(6)]
    for k, name in enumerate(names):
        with_exif(tmp_path / "images" / name, **TELEPHONE | (change if k % 3 == 2 else {}))
    images = made.readable_images(tmp_path / "images", names, tmp_path / "work")
    groups = groups_of(images, names)
    assert [len(group) for _, group in groups] == ([6] if cameras == 1 else [4, 2])
    assert groups[0][0].has_prior_focal_length
    assert len(groups_of(images, names, "single")) == (2 if "size" in change else 1)


@pytest.mark.parametrize(
    "tags, wanted",
    [
        (TELEPHONE, 26 * 40 / 36),  # COLMAP: by the longest side of 36 mm
        ({"mm": IFDRational(0, 0), "film": 0}, 1.2 * 40),  # COLMAP alone: NaN, as if known
        *((tags, 1.2 * 40) for tags in ({}, {"film": 65535}, {"film": 1})),
    ],
)
def test_a_focal_length_of_exif_that_no_lens_has_is_not_used(tmp_path, tags, wanted):
    with_exif(tmp_path / "a.jpg", **tags)
    ((camera, _),) = groups_of(tmp_path, ["a.jpg"])
    assert camera.focal_length == pytest.approx(wanted, rel=0.1)
    assert camera.has_prior_focal_length is (tags == TELEPHONE)


def test_a_line_names_the_lenses_of_the_photographs(tmp_path, caplog):
    names = tuple(f"{k}.jpg" for k in range(5))
    for k, name in enumerate(names):
        with_exif(tmp_path / name, **TELEPHONE | ({"film": 52} if k == 0 else {}))
    capture = Capture("a", tmp_path, names, (), None, False, "")
    report_lenses(capture)
    assert "X 7 6.8 mm (26 mm on 35 mm film): 4, X 7 6.8 mm (52 mm on 35 mm film): 1" in caplog.text
    caplog.clear()
    report_lenses(replace(capture, image_names=names[1:]))
    assert not caplog.records


def test_settings_of_cameras_that_are_given_are_named(caplog):
    report_unused(Sfm())
    assert not caplog.records
    report_unused(Sfm(camera="single", focal_length=300.0))
    assert "init.camera=single is not used, since the cameras are given" in caplog.text
    assert "init.focal_length=300.0 is not used" in caplog.text


def test_ids_follow_the_names_and_each_camera_has_a_rig(database):
    with pycolmap.Database.open(database) as opened:
        stored = sorted(opened.read_all_images(), key=lambda image: image.image_id)
        assert [image.name for image in stored] == sorted(SIZES)
        assert made.image_ids(database) == {image.name: image.image_id for image in stored}
        assert len(opened.read_all_rigs()) == len(opened.read_all_cameras()) == 2
        by_id = {camera.camera_id: camera for camera in opened.read_all_cameras()}
        for image in stored:
            camera = by_id[image.camera_id]
            assert (camera.width, camera.height) == SIZES[image.name]


def test_the_strongest_features_are_those_of_the_largest_area(database):
    rng = np.random.default_rng(0)
    keypoints = rng.normal(size=(12, 6)).astype(np.float32)
    descriptors = rng.integers(0, 256, (12, 128), dtype=np.uint8)
    ids, sift = made.image_ids(database), pycolmap.FeatureExtractorType.SIFT
    with pycolmap.Database.open(database) as opened:
        for name, count in (("b.png", 12), ("a.png", 1), ("c.png", 0)):
            opened.write_keypoints(ids[name], keypoints[:count])
            found = pycolmap.FeatureDescriptors(sift, descriptors[:count])
            opened.write_descriptors(ids[name], found)
    areas = [abs(np.linalg.det(row[2:].reshape(2, 2))) for row in keypoints.astype(float)]
    order = sorted(range(12), key=lambda row: -areas[row])
    for name, rows in (("b.png", order[:5]), ("a.png", [0]), ("c.png", [])):
        strongest = made.strongest_descriptors(database, name, 5)
        assert_array_equal(strongest, descriptors[rows].reshape(-1, 128))


def write_geometries(database, inliers):
    ids = made.image_ids(database)
    with pycolmap.Database.open(database) as opened:
        for pair, matches in inliers.items():
            verified = pycolmap.TwoViewGeometry()
            verified.config = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
            verified.inlier_matches = matches.astype(np.uint32)
            opened.write_two_view_geometry(*(ids[name] for name in pair), verified)


def test_verified_pairs_are_counted_only_with_inliers(database):
    keypoints = {name: np.ones((10 + place, 2)) for place, name in enumerate(SIZES)}
    matches, inliers = np.stack([np.arange(9)] * 2, axis=1), {"ab": 1, "bc": 7, "ac": 0}
    pairs = {(f"{a}.png", f"{b}.png"): count for (a, b), count in inliers.items()}
    made.write_features(database, keypoints, dict.fromkeys(pairs, matches))
    write_geometries(database, {pair: matches[:count] for pair, count in pairs.items()})
    counts = {"features": 60, "pairs_matched": 3, "pairs_verified": 2, "inlier_matches": 8}
    assert made.database_counts(database) == counts


def test_assumed_focal_lengths_count_as_known(database):
    some = np.zeros((1, 2))
    keypoints = dict.fromkeys(SIZES, np.ones((3, 2)))
    made.write_features(database, keypoints, {("a.png", "b.png"): some})
    write_geometries(database, {("a.png", "b.png"): some})
    assert made.cameras_without_prior(database)
    for factor in (0.9, 5.0):  # at the second factor no focal length is unknown
        made.assume_focal_lengths(database, factor)
        assert not made.cameras_without_prior(database)
        with pycolmap.Database.open(database) as opened:
            assert [camera.focal_length for camera in opened.read_all_cameras()] == [36.0, 36.0]
            # they were verified with other focal lengths
            assert opened.num_verified_image_pairs() == 0


@pytest.mark.parametrize("threads, each", [(1, 8), (4, 8), (9, 18)])
def test_features_are_extracted_from_eight_images_at_a_time_or_two_per_thread(
    images, monkeypatch, threads, each
):
    calls, told, names = [], [], [f"{number}.png" for number in range(40)]
    monkeypatch.setattr(pycolmap, "extract_features", lambda *_, **options: calls.append(options))
    masks = images if threads == 4 else None
    own = {"max_num_features": 70, "peak_threshold": 0.01, "edge_threshold": 9.0, "first_octave": 1}
    settings = Sfm(max_image_size=500, threads=threads, **own)
    task = made.DatabaseTask(Path("x.db"), images, names, [])
    matches.extract_sift(task, settings, lambda *state: told.append(state), masks)
    assert [name for call in calls for name in call["image_names"]] == names
    assert told == [("extract", done, 40) for done in (*range(0, 40, each), 40)]
    for call in calls:
        options = call["extraction_options"]
        assert (options.num_threads, options.max_image_size) == (threads, 500)
        assert not options.use_gpu
        assert {name: getattr(options.sift, name) for name in own} == own
        assert Path(call["reader_options"].mask_path) == (masks or Path())


def test_images_that_colmap_cannot_read_become_png_under_the_same_name(images, tmp_path):
    assert made.readable_images(images, list(SIZES), tmp_path / "work") == images
    Image.new("RGB", (40, 30), (1, 2, 3)).save(images / "left" / "c.WEBP", lossless=True)
    names = ["a.png", "left/c.WEBP"]
    folder = made.readable_images(images, names, tmp_path / "work")
    assert folder != images
    assert {path.relative_to(folder).as_posix() for path in folder.rglob("*.*")} == set(names)
    assert (folder / "a.png").resolve() == images / "a.png"
    with Image.open(folder / "left" / "c.WEBP") as copy:
        assert (copy.format, copy.getpixel((3, 4))) == ("PNG", (1, 2, 3))
    assert made.readable_images(images, names, tmp_path / "work") == folder  # made again


def test_reference_cameras_are_marked_as_known_and_grouped_with_their_images():
    model = pycolmap.Reconstruction()
    for number, focal in ((1, 50.0), (2, 60.0)):
        settings = (number, "PINHOLE", focal, 40 * number, 30)
        model.add_camera_with_trivial_rig(pycolmap.Camera.create_from_model_name(*settings))
    for number, (name, camera) in enumerate([("d", 1), ("c", 2), ("b", 1), ("a", 2)], start=1):
        image = pycolmap.Image(name=name, camera_id=camera, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    groups = made.reference_camera_groups(model)
    assert [names for _, names in groups] == [["a", "c"], ["b", "d"]]
    known = [(camera.mean_focal_length(), camera.width) for camera, _ in groups]
    assert known == [(60.0, 80), (50.0, 40)]
    assert all(camera.has_prior_focal_length for camera, _ in groups)
    assert not any(camera.has_prior_focal_length for camera in model.cameras.values())  # copies
