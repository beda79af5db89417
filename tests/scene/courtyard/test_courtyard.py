"""The procedural courtyard: repeatable, consistent between views, and not blank."""

import filecmp
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from gsbench.scene.colmap import read_model
from gsbench.scene.courtyard.layout import build_layout
from gsbench.scene.courtyard.render import (
    courtyard_cameras,
    render_courtyard,
    render_view,
    ring_camera,
)
from tests.scene.cameras import cameras_of
from tests.scene.captures import loaded, read_colmap
from tests.scene.courtyard.surfaces import fingerprint, surface_distance
from tests.scene.tables import TABLES


@pytest.fixture(scope="module")
def capture_dir(tmp_path_factory):
    folder = tmp_path_factory.mktemp("courtyard")
    render_courtyard(folder, views=4, width=160, height=120)
    return folder


@pytest.mark.parametrize("threads", [1, 5])
def test_same_arguments_give_the_same_bytes_on_any_number_of_threads(
    capture_dir, tmp_path, monkeypatch, threads
):
    monkeypatch.setattr("gsbench.system.resources.available_threads", lambda: threads)
    told = []
    render_courtyard(
        tmp_path, views=4, width=160, height=120, progress=lambda *state: told.append(state)
    )
    assert told == [("courtyard", done, 4) for done in range(1, 5)]
    files = [path for path in capture_dir.rglob("*") if path.is_file()]
    names = [path.relative_to(capture_dir).as_posix() for path in files]
    same, _, _ = filecmp.cmpfiles(capture_dir, tmp_path, names, shallow=False)
    assert len(same) == len(names) >= 7


def test_the_colmap_model_has_the_exact_cameras(capture_dir, tmp_path):
    written = cameras_of(read_model(capture_dir / "sparse/0"))
    for name, camera in courtyard_cameras(4, 160, 120).items():
        assert_allclose(written[name].rotation, camera.rotation, atol=1e-12)
        assert_allclose(written[name].translation, camera.translation, atol=1e-12)
        assert (written[name].fx, written[name].cx, written[name].cy) == (camera.fx, 80, 60)
    capture = replace(read_colmap(capture_dir), exact_poses=True)
    assert len(loaded(capture, tmp_path).train) == 3


@pytest.mark.parametrize("views", [12, 48, 60])
def test_neighbouring_views_are_close(views):
    centers = np.array([camera.center for camera in courtyard_cameras(views, 40, 30).values()])
    azimuth = np.degrees(np.unwrap(np.arctan2(centers[:, 1], centers[:, 0])))
    assert np.abs(np.diff(azimuth)).max() <= 7.5 + 1e-9
    radii = np.linalg.norm(centers[:, :2], axis=1)
    assert 4.0 < radii.min() < radii.max() < 5.0
    assert surface_distance(centers).min() > 0.5  # no camera is in or near an object


def test_the_images_change_only_with_the_version():
    """Eight views around the centre; if this test fails, raise the courtyard's VERSION."""
    made = []
    for angle in np.arange(8) * np.pi / 4:
        picture = render_view(build_layout(1), ring_camera(angle, 80, 60), 1)
        made.append([fingerprint(picture[..., channel]) for channel in range(3)])
    assert_allclose(made, TABLES["courtyard"], atol=0.02, err_msg=str(np.round(made, 3).tolist()))
