"""A COLMAP scene that other code wrote as transforms.json has the same cameras and training."""

import math
from shlex import split

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

from gsbench.pipeline.steps.scene import CaptureSource
from gsbench.runs.store import Store
from gsbench.scene.load import load_scene
from gsbench.scene.options import SceneConfig
from tests.end_to_end.conftest import render_with_points, trial_of
from tests.helpers import read_json, write
from tests.scene.captures import read_colmap

pytestmark = pytest.mark.slow

# What `ns-process-data` does to COLMAP's coordinates: x and y exchanged, z turned round.
APPLIED = np.array([[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]])
QUICK = split(
    "init=dataset train.iterations=40 train.densify_start=10 train.densify_interval=10 "
    "train.densify_stop=30 eval.download=false eval.lpips=[] tracking=none device=cpu"
)


def as_nerfstudio(model, folder):
    """Write the model's cameras and points to ``folder`` as nerfstudio's documents describe."""
    frames = []
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        focal, cx, cy, *radial = (
            camera.params if camera.model_name == "SIMPLE_RADIAL" else camera.params[[0, 2, 3]]
        )
        world_from_camera = np.vstack([image.cam_from_world().inverse().matrix(), [0, 0, 0, 1]])
        world_from_camera[:, 1:3] *= -1  # OpenCV to OpenGL: y and z turn round
        matrix = np.vstack([APPLIED, [0, 0, 0, 1]]) @ world_from_camera
        own = {"w": camera.width, "h": camera.height, "cx": cx, "cy": cy}
        own |= {"fl_x": focal, "fl_y": focal}
        own |= {"k1": radial[0], "k2": 0.0, "p1": 0.0, "p2": 0.0} if radial else {}
        frames.append(
            {"file_path": f"images/{image.name}", "transform_matrix": matrix.tolist()} | own
        )
    points = [point for _, point in sorted(model.points3D.items())]
    rows = [[*(APPLIED[:, :3] @ point.xyz), *point.color] for point in points]
    kinds = [*(f"double {c}" for c in "xyz"), "uchar red", "uchar green", "uchar blue"]
    header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    header += "".join(f"property {kind}\n" for kind in kinds) + "end_header\n"
    lines = [
        " ".join([*map(repr, map(float, row[:3])), *map(str, map(int, row[3:]))]) for row in rows
    ]
    (folder / "sparse_pc.ply").write_text(header + "\n".join(lines) + "\n")
    document = {"camera_model": "OPENCV", "frames": frames, "applied_transform": APPLIED.tolist()}
    write(folder / "transforms.json", document | {"ply_file_path": "sparse_pc.ply"})


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A folder with a COLMAP model with points, and the same as transforms.json."""
    folder = tmp_path_factory.mktemp("transforms") / "yard"
    render_with_points(folder, views=10)
    as_nerfstudio(pycolmap.Reconstruction(folder / "sparse/0"), folder)
    return folder


def test_a_training_from_transforms_json_equals_that_from_colmap(scene, tmp_path):
    colmap, read = (
        trial_of(QUICK, tmp_path / kind, scene, f"scene={kind}")
        for kind in ("colmap", "transforms")
    )
    first, second = (read_json(folder / "results.json") for folder in (colmap, read))
    assert first["num_init_points"] == second["num_init_points"] > 100
    assert first["scene_extent"] == pytest.approx(second["scene_extent"], rel=1e-9)
    assert first["metrics"]["psnr"] == pytest.approx(second["metrics"]["psnr"], abs=0.02)
    for view in (colmap / "ground_truth").iterdir():
        stem = f"images__{view.name}"
        same = [np.asarray(Image.open(path)) for path in (view, read / f"ground_truth/{stem}")]
        assert_array_equal(*same)
        pair = [
            np.asarray(Image.open(path)).astype(int)
            for path in (colmap / f"renders/{view.name}", read / f"renders/{stem}")
        ]
        assert np.abs(pair[0] - pair[1]).mean() < 0.5  # levels


def _scene(capture, cache):
    return load_scene(capture, capture.model, Store(cache), max_size=300)


def test_distorted_photographs_give_the_same_scene(shared, tmp_path):
    """Real photographs: COLMAP's SIMPLE_RADIAL as nerfstudio's OPENCV with k1."""
    source = shared / "data/herz_jesus_p25"
    folder = tmp_path / "church"
    folder.mkdir()
    (folder / "images").symlink_to(source / "images")
    model = pycolmap.Reconstruction(source / "sparse/0")
    assert {camera.model_name for camera in model.cameras.values()} == {"SIMPLE_RADIAL"}
    as_nerfstudio(model, folder)
    config = SceneConfig(name="church", kind="transforms", path=str(folder), max_images=6)
    captured = CaptureSource(config)
    (tmp_path / "made").mkdir()
    captured.step.build(tmp_path / "made")
    read = _scene(captured.read(tmp_path / "made"), tmp_path / "cache")
    first = _scene(read_colmap(source, max_images=6), tmp_path / "cache")
    assert len(read.train) == len(first.train) == 5
    for one, other in zip(first.train, read.train, strict=True):
        assert other.name == f"images/{one.name}"
        assert_allclose(one.camera.rotation, other.camera.rotation, atol=1e-12)
        assert_allclose(one.camera.translation, other.camera.translation, atol=1e-11)
        for key in split("width height fx fy cx cy"):
            assert math.isclose(getattr(one.camera, key), getattr(other.camera, key), rel_tol=1e-12)
        assert np.abs(one.image.astype(int) - other.image).max() <= 1
