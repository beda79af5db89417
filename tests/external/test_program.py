"""Another program as a trainer: its command, its input folders, and its process."""

import sys

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

from gsbench.errors import TrainingError
from gsbench.external.exchange import collect_model, write_training_views
from gsbench.external.run import run_program
from gsbench.external.settings import fill_placeholders, split_command
from gsbench.gaussians.ply import read_ply, write_ply
from gsbench.init.base import PointCloud
from gsbench.normalization import IDENTITY, Normalization
from gsbench.runs.code import config_hash
from gsbench.scene.types import Camera, View
from tests.config.test_schema import composed
from tests.gaussians.helpers import differences, random_gaussians
from tests.helpers import refusal


@pytest.fixture
def views():
    """Three views with different cameras and sizes, one of them in a sub-folder."""
    rng = np.random.default_rng(0)
    found = []
    for index, name in enumerate(("a.JPG", "left/b.png", "c.jpeg")):
        rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        rotation *= np.sign(np.linalg.det(rotation))
        width, height = 40 + index, 30 - index
        camera = Camera(width, height, 50.0, 51.0 + index, 19.5, 16.0, rotation, rng.normal(size=3))
        found.append(View(name, camera, rng.integers(0, 256, (height, width, 3), dtype=np.uint8)))
    return found


def project(camera, points):
    local = points @ camera.rotation.T + camera.translation
    return local[:, :2] / local[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)


MOVED = Normalization((10.0, 20.0, 30.0), 2.0)


@pytest.mark.parametrize("normalization", [IDENTITY, MOVED], ids=["as it is", "moved"])
def test_pycolmap_reads_the_training_folder(normalization, views, tmp_path):
    """Its points and cameras are in the coordinates in which the scene was given."""
    rng = np.random.default_rng(1)
    cloud = PointCloud(rng.normal(size=(50, 3)), rng.integers(0, 256, (50, 3), dtype=np.uint8))
    write_training_views(tmp_path, views, cloud, normalization)
    center, scale = np.array(normalization.center), normalization.scale
    twice = [views[0], View("a.png", views[0].camera, views[0].image)]
    with refusal(r"a\.JPG and a\.png would both be a\.png: rename one"):
        write_training_views(tmp_path / "twice", twice, cloud)
    model = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    points = [point for _, point in sorted(model.points3D.items())]
    assert_array_equal([point.xyz for point in points], cloud.points / scale + center)
    assert_array_equal([point.color for point in points], cloud.colors)
    assert not any(point.track.elements for point in points)
    assert not any(len(image.points2D) for image in model.images.values())
    named = {image.name: image for image in model.images.values()}
    assert sorted(named) == ["a.png", "c.png", "left__b.png"]
    for view, name in zip(views, ("a.png", "left__b.png", "c.png"), strict=True):
        image = named[name]
        assert_array_equal(Image.open(tmp_path / "images" / name), view.image)
        assert model.cameras[image.camera_id].model_name == "PINHOLE"
        ahead = image.cam_from_world().inverse() * np.array([0.3, -0.2, 5.0])
        wanted = project(view.camera, scale * (ahead - center)[None])[0]
        assert_allclose(image.project_point(ahead), wanted, atol=1e-6)


def test_the_one_model_of_a_program_is_taken_in_the_coordinates_of_the_training(tmp_path):
    gaussians = random_gaussians(9)
    (tmp_path / "out" / "7").mkdir(parents=True)
    for words in (r"it left no \*/p.ply \(densify.result\); it wrote no file", "it wrote 7/x.txt"):
        with pytest.raises(TrainingError, match=words):
            collect_model(tmp_path / "out", "*/p.ply", tmp_path / "a.ply")
        (tmp_path / "out" / "7" / "x.txt").touch()
    model = tmp_path / "out" / "7" / "p.ply"
    write_ply(gaussians, model)
    taken = collect_model(tmp_path / "out", "*/p.ply", tmp_path / "a.ply")
    assert (tmp_path / "a.ply").read_bytes() == model.read_bytes()
    assert not differences(taken, read_ply(model))
    moved = collect_model(tmp_path / "out", "*/p.ply", tmp_path / "b.ply", MOVED)
    assert_allclose(moved.means, 2 * (taken.means.numpy() - MOVED.center), atol=1e-5)
    assert not differences(moved, read_ply(tmp_path / "b.ply"))
    (tmp_path / "out" / "8" / "p.ply").mkdir(parents=True)  # a folder is no file
    collect_model(tmp_path / "out", "*/p.ply", tmp_path / "a.ply")
    write_ply(gaussians, tmp_path / "out" / "p.ply")
    with pytest.raises(TrainingError, match=r"2 files fit densify.result \(7/p.ply, p.ply\)"):
        collect_model(tmp_path / "out", "**/p.ply", tmp_path / "a.ply")
    model.write_text("no model")
    with pytest.raises(TrainingError, match=r"7/p\.ply"):
        collect_model(tmp_path / "out", "*/p.ply", tmp_path / "a.ply")


def test_a_command_is_split_and_its_placeholders_are_filled_once():
    assert split_command("a 'b c' {d}", "x") == ["a", "b c", "{d}"]
    # a replaced value is not replaced again
    assert fill_placeholders("{a}-{b}-{a}", {"a": "{b}", "b": 2}, "x") == "{b}-2-{b}"
    for command, said in (("", "x is empty"), (["", "b"], "x is empty"), ("'a", "cannot be split")):
        with refusal(said):
            split_command(command, "x")
    with refusal(r"x: unknown placeholder \{tset\}; did you mean test\?"):
        fill_placeholders("{tset}", {"test": 1}, "x")


def test_the_yaml_of_the_original_code_passes_our_schedule_on():
    words = [
        "densify=external/3dgs",
        "densify.options.code=/code",
        "densify.version='1'",
        "allow_targets=[python,git]",
    ]
    command = composed(*words, "train=paper", "train.densify_stop=9000")["densify"]["command"]
    assert str(command[command.index("--densify_until_iter") + 1]) == "9000"
    assert str(command[command.index("--opacity_lr") + 1]) == "0.05"


def test_an_option_changes_the_hash_of_a_trial_and_a_time_limit_does_not():
    words = ["densify=external/opensplat", "densify.version='1'", "allow_targets=[opensplat]"]
    base = config_hash(composed(*words))
    assert config_hash(composed(*words, "densify.time_limit_minutes=5")) == base
    assert config_hash(composed(*words, "densify.options.num_downscales=2")) != base
    assert config_hash(composed(*words, "densify.version='2'")) != base


def run(tmp_path, code, limit=None):
    environment = {"PATH": "/usr/bin:/bin", "MINE": "here"}
    command = [sys.executable, "-c", code]
    return run_program(command, tmp_path / "log", tmp_path, environment, limit).peak_memory_mb


def test_a_program_runs_in_its_folder_with_its_environment(tmp_path):
    run(tmp_path, "import os; open('mark', 'w').write(os.environ['MINE']); print('said')")
    assert (tmp_path / "mark").read_text() == "here"
    assert "said" in (tmp_path / "log").read_text()


@pytest.mark.parametrize(
    "code, limit, said",
    [
        ("sys.exit(3)", None, r"ended early \(exit code 3\); its last lines: oh; log: "),
        ("os.kill(os.getpid(), 9)", None, r"crashed \(SIGKILL, perhaps out of memory\); .*: oh"),
        (
            "time.sleep(60)",
            1.0,
            r"still ran after 1 s \(densify.time_limit_minutes\); .*: oh; log: ",
        ),
    ],
)
def test_a_program_that_fails_is_reported_with_its_log(code, limit, said, tmp_path):
    with pytest.raises(TrainingError, match=said) as caught:
        run(tmp_path, f"import os, sys, time; print('oh', flush=True); {code}", limit)
    assert str(caught.value).endswith(f"log: {tmp_path / 'log'}")


def test_memory_of_child_processes_counts(tmp_path):
    child = "x = bytearray(300 << 20); import time; time.sleep(2)"
    code = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])"
    assert run(tmp_path, code) > 290
