"""Captures that COLMAP's defaults cannot place: exact matches between known cameras."""

import itertools

import numpy as np
import pycolmap
import pytest
from PIL import Image

from gsbench.init import Sfm
from gsbench.init.colmap import mapping
from gsbench.init.colmap.database import (
    DatabaseTask,
    create_database,
    unknown_camera_groups,
    write_features,
)
from gsbench.init.colmap.mapping import Geometry, map_images, measure_geometry
from gsbench.init.colmap.matches import verify_pairs
from gsbench.init.colmap.models import align_poses, common_poses
from gsbench.init.colmap.pairs import select_pairs
from gsbench.logs import no_progress
from tests.helpers import refusal
from tests.init.models import add_point, camera_at, model_with
from tests.init.tables import TABLES

WIDTH, HEIGHT, FOCAL = 640, 480, 520.0  # px; COLMAP's guess without EXIF is 1.2 x 640 = 768


def small_baseline(folder, spread=0.2):
    """Exact matches of nine parallel cameras side by side: the database and the true centres.

    ``spread`` is half the width of the rig, for points at distances from 3 to 9. At 0.2, all angles
    at points are below 11 degrees.
    """
    rng = np.random.default_rng(0)
    points = rng.uniform((-3, -2.2, 3), (3, 2.2, 9), (900, 3))
    names, centers, keypoints, seen = [], {}, {}, {}
    (folder / "images").mkdir(parents=True)
    for index in range(9):
        name = f"{index}.png"
        Image.new("RGB", (WIDTH, HEIGHT)).save(folder / "images" / name)
        center = np.array([(index % 3 - 1) * spread, (index // 3 - 1) * spread, 0.05 * (index % 2)])
        local = points - center
        pixels = FOCAL * local[:, :2] / local[:, 2:] + (WIDTH / 2, HEIGHT / 2)
        pixels = pixels + rng.normal(0, 0.3, (900, 2))
        inside = ((pixels > 0) & (pixels < (WIDTH, HEIGHT))).all(axis=1)
        names.append(name)
        centers[name], seen[name] = center, np.flatnonzero(inside)
        keypoints[name] = pixels[inside].astype(np.float32)
    database = folder / "database.db"
    images = folder / "images"
    create_database(database, unknown_camera_groups(images, names, Sfm(camera="single")))
    matches = {}
    for first, second in itertools.combinations(names, 2):
        _, a, b = np.intersect1d(seen[first], seen[second], return_indices=True)
        matches[first, second] = np.stack([a, b], axis=1).astype(np.uint32)
    write_features(database, keypoints, matches)
    verify_pairs(database, Sfm(), no_progress)
    return database, centers


def mapper_of(folder, options, progress=no_progress):
    """A mapper for three images; its database does not exist."""
    task = DatabaseTask(folder / "a.db", folder, [], [])
    return mapping._Mapper(task, folder / "out", options, progress, 3)


def mapped(database, mapper, **options):
    task = DatabaseTask(database, database.parent / "images", [], [])
    own = Sfm(mapper=mapper, **options)
    return map_images(task, database.parent / "out", own, no_progress)


@pytest.mark.slow
def test_a_small_baseline_without_a_focal_length_is_placed_by_another_strategy(tmp_path):
    database, truth = small_baseline(tmp_path)
    with refusal("placed only 0 of"):
        mapped(database, "incremental")
    result = mapped(database, "auto")
    assert result.model.num_reg_images() == 9
    assert result.strategy != "incremental"
    (warning,) = result.warnings
    assert f"{result.strategy!r}: COLMAP's defaults" in warning
    assert "(images: incremental 0, " in warning
    true = model_with({name: camera_at(center) for name, center in truth.items()})
    poses = common_poses(result.model, true)
    apart = align_poses(*poses) * poses[0] - poses[2]
    assert np.abs(apart).max() < 0.03  # the rig is 0.4 wide
    (camera,) = result.model.cameras.values()
    # such a small baseline determines the focal length weakly
    assert camera.mean_focal_length() == pytest.approx(FOCAL, rel=0.2)


@pytest.mark.slow
def test_the_global_mapper_places_all_images(tmp_path):
    database, _ = small_baseline(tmp_path)
    result = mapped(database, "global")
    assert (result.strategy, result.model.num_reg_images()) == ("global", 9)
    assert result.warnings == []


@pytest.mark.parametrize("mapper", [pytest.param("auto", marks=pytest.mark.slow), "global"])
def test_copies_of_one_view_are_refused(tmp_path, mapper):
    """Models without parallax are refused, whichever mapper made them."""
    database, _ = small_baseline(tmp_path, spread=0.0)
    with refusal("structure from motion"):
        mapped(database, mapper)


class Model:
    """A stand-in for a reconstruction, which has a size only."""

    def __init__(self, images, points=10, depth_spread=2.0):
        self.images, self.points = images, points
        self.geometry = Geometry(images, points, 10.0, depth_spread)

    def num_reg_images(self):
        return self.images

    def num_points3D(self):  # noqa: N802 - as pycolmap calls it
        return self.points


@pytest.fixture
def ten(tmp_path):
    """A database of ten images."""
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 30.0, 40, 30)
    create_database(tmp_path / "database.db", [(camera, [f"{k}.png" for k in range(10)])])
    return tmp_path / "database.db"


@pytest.fixture
def ways(monkeypatch):
    """The mapper's strategies, as names with the sizes of their models."""
    made = []

    def strategies(_):
        for name, sizes in made:
            yield name, [Model(*size) for size in sizes]

    monkeypatch.setattr(mapping, "measure_geometry", lambda model: model.geometry)
    monkeypatch.setattr(mapping._Mapper, "strategies", strategies)
    return made


@pytest.mark.parametrize("found, best, tried", TABLES["strategies"])
def test_strategies_are_tried_until_one_places_nine_of_ten_images(ten, ways, found, best, tried):
    ways[:] = [(f"way {k}", sizes) for k, sizes in enumerate(found)]
    result = mapped(ten, "auto")
    assert [result.model.num_reg_images(), result.model.num_points3D()] == best
    place = next(k for k, sizes in enumerate(found) if best in sizes)
    assert (result.strategy, result.models) == (f"way {place}", len(found[place]))
    most = [max(sizes, default=(0, 0))[0] for sizes in found[:tried]]
    tries = ", ".join(f"way {k} {count}" for k, count in enumerate(most))
    assert [f"images: {tries})" in line for line in result.warnings] == [True] * (tried > 1)
    for sizes, said in (
        ([], "placed only 0 of 10 images"),
        ([(2, 99)], "placed only 2 of 10 images"),
    ):
        ways[:] = [("only", sizes)]
        with refusal(said):
            mapped(ten, "auto")


@pytest.mark.parametrize("prior", [True, False])
@pytest.mark.parametrize("mapper", ["incremental", "global", "auto"])
def test_each_mapper_has_its_strategies_in_order(tmp_path, monkeypatch, mapper, prior):
    """Assumed focal lengths come last, and only if no focal length is known."""
    calls = []

    def note(name):
        return lambda _, *given: calls.append((name, *given)) or []

    monkeypatch.setattr(mapping.colmap_database, "cameras_without_prior", lambda _: not prior)
    for name in ("with_assumed_focal_lengths", "incremental", "global_mapping"):
        monkeypatch.setattr(mapping._Mapper, name, note(name))
    ways = list(mapper_of(tmp_path, Sfm(mapper=mapper)).strategies())
    small, factors = mapping.SMALL_ANGLE_DEG, () if prior else mapping.FOCAL_FACTORS
    first, together = ("incremental", tmp_path / "a.db"), ("global_mapping",)
    assumed = [("with_assumed_focal_lengths", factor) for factor in factors]
    expected = {
        "incremental": [first],
        "global": [together],
        "auto": [first, (*first, small), together, *assumed],
    }
    assert calls == expected[mapper]
    assert len({name for name, _ in ways}) == len(ways)
    assert small < 16  # COLMAP's default


def test_mapping_reports_progress_from_no_image_to_all(tmp_path, monkeypatch):
    """COLMAP may place an image in two models; the progress never exceeds the number of images."""
    told = []

    def place(*_, next_image_callback, options):
        for _ in range(4):
            next_image_callback()
        return {0: Model(2), 1: Model(2)}

    monkeypatch.setattr(pycolmap, "incremental_mapping", place)
    monkeypatch.setattr(pycolmap, "global_mapping", lambda *_, options: {0: Model(3)})
    mapper = mapper_of(tmp_path, Sfm(), lambda *at: told.append(at))
    assert [model.images for model in mapper.incremental(tmp_path / "a.db")] == [2, 2]
    assert told == [("map", done, 3) for done in (0, 1, 2, 3, 3, 3)]
    told.clear()
    assert [model.images for model in mapper.global_mapping()] == [3]
    assert told == [("map", 0, 3), ("map", 3, 3)]


@pytest.mark.parametrize("share, sound", [(0.9, False), (1.1, True)])
def test_a_model_needs_an_angle_at_half_of_its_points(share, sound):
    """Two cameras see points at distance one under an angle; a third is at the first one's place."""
    half = np.tan(np.radians(share * mapping.MIN_ANGLE_DEG) / 2)
    places = enumerate((-half, half, -half))
    model = model_with({f"{k}": camera_at([x, 5, 2]) for k, x in places}, 4)
    for index, images in enumerate([(1, 2, 3), (1, 2), (1, 3)]):
        add_point(model, [0, 5, 3], seen_by=dict.fromkeys(images, index))
    assert (measure_geometry(model).fault == "") == sound
    add_point(model, [0, 5, 3], seen_by={1: 3, 3: 3})  # now half of them have none
    assert "meet at less than" in measure_geometry(model).fault
    assert measure_geometry(pycolmap.Reconstruction()).fault == "no image sees a point"


def model_of(centers, targets, depths, rng):
    """Cameras that look from ``centers`` at ``targets``, with 40 points each at about its depth.

    Each point is seen by the camera itself and by the next one.
    """
    poses, points = {}, []
    for k, (center, target, depth) in enumerate(zip(centers, targets, depths, strict=True)):
        forward = (target - center) / np.linalg.norm(target - center)
        right = np.cross(forward, [0.3, 0.2, 0.93])
        right /= np.linalg.norm(right)
        turn = np.stack([right, np.cross(forward, right), forward])
        poses[f"{k:03d}.png"] = camera_at(center, turn)
        local = depth * rng.uniform((-0.4, -0.3, 0.8), (0.4, 0.3, 1.2), (40, 3))
        points.append(center + local @ turn)
    model = model_with(poses, 80)
    for k, own in enumerate(points):
        other = (k + 1) % len(points)
        for index, place in enumerate(own):
            add_point(model, place, seen_by={k + 1: index, other + 1: 40 + index})
    return model


def captured(kind):
    """Centres, targets and depths of thirty cameras of a capture, in metres."""
    rng, turn = np.random.default_rng(0), np.linspace(0, 2 * np.pi, 30, endpoint=False)
    ring = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    flat = rng.uniform(-1, 1, (30, 3)) * (1, 1, 0.05)
    few = np.arange(30) < 8
    if kind == "forward facing":
        return 0.2 * flat, 0.2 * flat + (0, 0, 6), rng.uniform(4, 9, 30)
    if kind == "panorama":  # turned by hand, in a room with windows
        return 0.3 * ring, 5 * ring, np.where(few, 200.0, 3.0)
    if kind == "tripod and walk":
        walk = np.linspace(0, 60, 30)[:, None] * (1, 0, 0)
        return np.where(few[:, None], 0.02 * flat, walk), walk + 5 * ring, rng.uniform(2, 15, 30)
    if kind == "macro and drone":  # a flower at 15 cm, and the garden from 60 m
        return (
            np.where(few[:, None], 0.1 * flat + (0, 0, 0.1), 40 * flat + (0, 0, 60)),
            0.0 * flat,
            np.where(few, 0.15, 60.0),
        )
    # a collapsed model: most in one point, others far away
    return (
        np.where(few[:, None], 1e4 * ring, 1e-3 * flat),
        10 * ring,
        np.where(few, 1e4, 0.01),
    )


KINDS = ("forward facing", "panorama", "tripod and walk", "macro and drone", "collapsed")


@pytest.mark.parametrize("kind", KINDS)
def test_only_a_collapsed_model_has_depths_that_differ_by_a_factor_of_thousands(kind):
    centers, targets, depths = captured(kind)
    model = model_of(centers, targets, depths, np.random.default_rng(1))
    geometry = measure_geometry(model)
    assert geometry.images == 30
    assert (geometry.fault != "") == (kind == "collapsed")
    medians = []
    for image in model.images.values():  # from its observations, in its own coordinates
        seen = [model.points3D[point.point3D_id].xyz for point in image.get_observation_points2D()]
        medians.append(np.median((image.cam_from_world() * np.array(seen))[:, 2]))
    low, high = np.percentile(medians, [5, 95])
    assert geometry.depth_spread == pytest.approx(high / low)


def test_a_smaller_sound_model_is_kept_and_the_setting_is_named(ten, ways):
    ways[:] = [("small", [(7,)]), ("large", [(10, 99, 4000.0)])]
    result = mapped(ten, "auto", pairs="sequential")
    assert (result.strategy, result.model.images) == ("small", 7)
    (line,) = result.warnings
    assert "small 7, large 10 (collapsed: depths of its images differ by a factor of 4,000)" in line
    assert "init.pairs=exhaustive may place more" in line
    assert "init.pairs" not in mapped(ten, "auto").warnings[0]
    ways[:] = ways[1:]
    with refusal("made no sound model of 10 images .large 10 .collapsed"):
        mapped(ten, "auto")


@pytest.mark.parametrize("tracks", [True, False])
def test_settings_reach_colmaps_mappers(tmp_path, monkeypatch, tracks):
    given = []
    for name in ("incremental_mapping", "global_mapping"):
        monkeypatch.setattr(pycolmap, name, lambda *_, options, **__: given.append(options) or {})
    own = {"seed": 7, "mapper_threads": 3, "two_view_tracks": tracks}
    mapper = mapper_of(tmp_path, Sfm(**own))
    mapper.incremental(mapper.task.database)
    mapper.incremental(mapper.task.database, 2.5)
    mapper.global_mapping()
    *incremental, together = given
    assert [options.mapper.init_min_tri_angle for options in incremental] == [16.0, 2.5]
    for options in incremental:
        own, triangulation = options.mapper, options.triangulation
        assert options.num_threads == own.num_threads == 3
        assert (options.min_model_size, options.multiple_models) == (3, True)
        assert options.random_seed == own.random_seed == triangulation.random_seed == 7
        assert triangulation.ignore_two_view_tracks == (not tracks)
        assert options.ba_refine_focal_length
        assert own.abs_pose_refine_focal_length
    assert (together.num_threads, together.random_seed, together.min_model_size) == (3, 7, 3)
    adjustment = together.mapper.bundle_adjustment
    assert adjustment.refine_focal_length
    assert adjustment.refine_extra_params


def test_focal_lengths_are_assumed_in_a_copy_whose_pairs_are_verified_again(tmp_path, monkeypatch):
    calls = []
    database = tmp_path / "a.db"
    database.write_text("cameras")
    journal = tmp_path / "assumed-1.4.db-journal"
    journal.write_text("a stranger's, which could tell SQLite to delete any file")

    def note(owner, name, result):
        monkeypatch.setattr(owner, name, lambda *given: calls.append(given) or result)

    note(mapping.colmap_database, "assume_focal_lengths", None)
    note(mapping.matches, "verify_pairs", None)
    note(mapping._Mapper, "incremental", ["model"])
    mapper = mapper_of(tmp_path, Sfm(seed=4))
    assert mapper.with_assumed_focal_lengths(1.4) == ["model"]
    assumed, (copy, *verified), (_, *mapped_from) = calls
    assert assumed == (tmp_path / "assumed-1.4.db", 1.4)
    assert (copy.read_text(), database.read_text()) == ("cameras", "cameras")
    assert verified == [mapper.options, no_progress]
    assert mapped_from == [copy, 2.0]
    assert not journal.exists()


def test_all_pairs_or_pairs_of_neighbours_are_selected():
    assert select_pairs("abcd", Sfm()) == list(itertools.combinations("abcd", 2))
    neighbours = select_pairs("abcd", Sfm(pairs="sequential", overlap=1))
    assert neighbours == [("a", "b"), ("b", "c"), ("c", "d")]
