"""Triangulation under given cameras, the options handed to COLMAP, and the poses of two models, on
exact matches."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from gsbench.errors import InputError
from gsbench.init import Sfm
from gsbench.init.colmap import alignment, geometry, mapping, reconstruct
from gsbench.init.colmap import pairs as pairing
from gsbench.init.colmap.database import create_database, write_keypoints, write_matches
from gsbench.init.colmap.geometry import verify_pairs
from gsbench.logs import no_progress

WIDTH, HEIGHT, FOCAL = 320, 240, 260.0  # px
NAMES = [f"{letter}.png" for letter in "abcd"]
POINTS = np.random.default_rng(0).uniform((-2, -1.5, 4), (2, 1.5, 7), (120, 3))


def camera() -> pycolmap.Camera:
    return pycolmap.Camera(
        model="SIMPLE_PINHOLE",
        width=WIDTH,
        height=HEIGHT,
        params=[FOCAL, WIDTH / 2, HEIGHT / 2],
        camera_id=1,
    )


def poses() -> dict[str, pycolmap.Rigid3d]:
    """Four cameras on an arc, each turned towards the points."""
    made = {}
    for index, name in enumerate(NAMES):
        turn = Rotation.from_euler(
            "yx", [8.0 * (index - 1.5), 3.0 * index], degrees=True
        ).as_matrix()
        center = np.array([0.8 * (index - 1.5), 0.2 * index, 0.1])
        made[name] = pycolmap.Rigid3d(pycolmap.Rotation3d(turn), -turn @ center)
    return made


def model_of(poses: dict[str, pycolmap.Rigid3d], first_id: int = 40) -> pycolmap.Reconstruction:
    """A model of cameras alone, whose ids are not those of a database."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera())
    for index, (name, pose) in enumerate(poses.items()):
        image = pycolmap.Image(name=name, camera_id=1, image_id=first_id - index)
        model.add_image_with_trivial_frame(image, pose)
    return model


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The points as every camera sees them, matched and verified."""
    folder = tmp_path_factory.mktemp("exact")
    (folder / "images").mkdir()
    keypoints = {}
    for name, pose in poses().items():
        Image.new("RGB", (WIDTH, HEIGHT)).save(folder / "images" / name)
        local = POINTS @ pose.rotation.matrix().T + pose.translation
        keypoints[name] = (FOCAL * local[:, :2] / local[:, 2:] + (WIDTH / 2, HEIGHT / 2)).astype(
            np.float32
        )
    path = folder / "database.db"
    create_database(path, [(camera(), NAMES)])
    write_keypoints(path, keypoints)
    same = np.stack([np.arange(len(POINTS))] * 2, axis=1).astype(np.uint32)
    pairs = pairing.select_pairs(NAMES, Sfm())
    write_matches(path, dict.fromkeys(pairs, same))
    verify_pairs(path, pairs, geometry.verification_options(Sfm()), no_progress)
    return path


def test_points_come_from_the_named_images_under_cameras_that_do_not_change(
    database: Path, tmp_path: Path
) -> None:
    said: list[tuple[str, int, int | None]] = []
    model = mapping.triangulate(
        database,
        database.parent / "images",
        tmp_path / "out",
        model_of(poses()),
        NAMES[:3],
        Sfm(threads=1),
        lambda phase, done, total, note="": said.append((phase, done, total)),
    )
    assert said == [("triangulate", 0, 1), ("triangulate", 1, 1)]
    images = {image.name: image for image in model.images.values()}
    assert sorted(images) == NAMES  # an image without points has its camera, too
    for name, pose in poses().items():
        assert images[name].cam_from_world().matrix().tobytes() == pose.matrix().tobytes()
    assert model.num_points3D() > 100
    for point in model.points3D.values():
        seen = {model.images[element.image_id].name for element in point.track.elements}
        assert len(seen) >= 2
        assert seen <= set(NAMES[:3])
        index = next(element.point2D_idx for element in point.track.elements)
        np.testing.assert_allclose(point.xyz, POINTS[index], atol=1e-3)


def test_matches_that_contradict_the_cameras_triangulate_nothing(
    database: Path, tmp_path: Path
) -> None:
    reference, images = (
        model_of(dict(zip(NAMES, reversed(poses().values()), strict=True))),
        database.parent / "images",
    )
    with pytest.raises(
        InputError, match="no point could be triangulated under the reference cameras"
    ):
        mapping.triangulate(
            database,
            images,
            tmp_path / "out",
            reference,
            NAMES,
            Sfm(threads=1),
            lambda *args, **options: None,
        )


def test_the_poses_of_two_models_are_paired_by_name() -> None:
    scale, shift = 2.0, np.array([1.0, -2.0, 3.0])
    moved = {  # in the opposite order, and without the first
        name: pycolmap.Rigid3d(
            pose.rotation, scale * pose.translation - pose.rotation.matrix() @ shift
        )
        for name, pose in reversed(list(poses().items())[1:])
    }
    first, second = model_of(poses()), model_of(moved)
    centers, rotations, other_centers, other_rotations = reconstruct.common_poses(first, second)
    np.testing.assert_allclose(
        centers, [[0.8 * (k - 1.5), 0.2 * k, 0.1] for k in (1, 2, 3)], atol=1e-12
    )
    np.testing.assert_allclose(other_centers, scale * centers + shift, atol=1e-12)
    np.testing.assert_allclose(
        rotations, [poses()[name].rotation.matrix() for name in NAMES[1:]], atol=1e-12
    )
    np.testing.assert_allclose(other_rotations, rotations, atol=1e-12)
    found = alignment.similarity_to(first, second)
    assert found is not None
    assert found.scale == pytest.approx(scale)
    lonely = model_of({NAMES[0]: poses()[NAMES[0]]})
    assert alignment.similarity_to(first, lonely) is None


def test_options_reach_colmap() -> None:
    options = Sfm(
        seed=7,
        min_inliers=11,
        min_inlier_ratio=0.31,
        threads=2,
        two_view_tracks=True,
        min_model_size=5,
    )
    verification = geometry.verification_options(options)
    assert verification.ransac.random_seed == 7
    assert (verification.min_num_inliers, verification.min_inlier_ratio) == (11, 0.31)
    pipeline = mapping.pipeline_options(options)
    assert (
        pipeline.random_seed
        == pipeline.mapper.random_seed
        == pipeline.triangulation.random_seed
        == 7
    )
    assert pipeline.num_threads == pipeline.mapper.num_threads == options.mapper_threads
    assert not pipeline.triangulation.ignore_two_view_tracks
    assert mapping.pipeline_options(Sfm(two_view_tracks=False)).triangulation.ignore_two_view_tracks
    assert pipeline.multiple_models
    assert pipeline.min_model_size == 5
    for intrinsics, refined in (("estimate", True), ("reference", False)):
        pipeline = mapping.pipeline_options(Sfm(intrinsics=intrinsics))
        assert pipeline.ba_refine_focal_length == pipeline.ba_refine_extra_params == refined
        assert pipeline.mapper.abs_pose_refine_focal_length == refined
        assert pipeline.mapper.abs_pose_refine_extra_params == refined


def test_pairs_of_names() -> None:
    assert pairing.select_pairs("abc", Sfm()) == [("a", "b"), ("a", "c"), ("b", "c")]
    sequential = pairing.select_pairs("abcd", Sfm(pairs="sequential", overlap=1))
    assert {frozenset(pair) for pair in sequential} >= {
        frozenset("ab"),
        frozenset("bc"),
        frozenset("cd"),
    }
    assert len(sequential) < 6
