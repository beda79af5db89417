"""``scripts/captures.py`` on made-up captures: kept points, commands, and files that stay."""

import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from gsbench.app.command import compose_trials
from gsbench.scene.colmap import write_frames
from gsbench.scene.load import CameraModel

sys.path.append(str(Path(__file__).parents[1] / "scripts"))
import captures

pytestmark = pytest.mark.slow

CAMERA = CameraModel("PINHOLE", 8, 6, (5.0, 5.0, 4.0, 3.0))
COUNT = 6300  # above the most that are kept


def write_capture(folder, points=COUNT, model=True):
    """Write a capture with a photograph and a model of random points [P, 3]; return the points."""
    positions = np.random.default_rng(1).normal(size=(points, 3))
    (folder / "images").mkdir(parents=True)
    (folder / "images" / "0.png").touch()
    if model:
        write_model(folder / "sparse" / "0", positions)
    return positions


def write_model(folder, positions):
    frames = {f"{k}.png": (CAMERA, np.eye(3), np.array([k, 0.0, 1.0])) for k in range(3)}
    write_frames(folder, frames, cloud=(positions, np.full(positions.shape, 7, dtype=np.uint8)))


def points_of(capture):
    """The positions [P, 3] of a capture's points, sorted."""
    model = pycolmap.Reconstruction(capture / "sparse" / "0")
    return np.unique([point.xyz for point in model.points3D.values()], axis=0)


def test_a_prepared_capture_has_fewer_points_and_the_same_cameras_and_photographs(tmp_path):
    given = write_capture(tmp_path / "data" / "fox")
    few = write_capture(tmp_path / "data" / "bonsai", points=10)
    for name in ("out", "again"):
        captures.prepare(tmp_path / "data", tmp_path / name)
    kept = points_of(tmp_path / "out" / "fox")
    assert len(kept) == captures.MOST_POINTS < COUNT
    assert {tuple(row) for row in kept} <= {tuple(row) for row in given}
    np.testing.assert_array_equal(kept, points_of(tmp_path / "again" / "fox"))
    np.testing.assert_array_equal(points_of(tmp_path / "out" / "bonsai"), np.unique(few, axis=0))
    model = pycolmap.Reconstruction(tmp_path / "out" / "fox" / "sparse" / "0")
    assert sorted(image.name for image in model.images.values()) == ["0.png", "1.png", "2.png"]
    assert model.find_image_with_name("2.png").cam_from_world().translation.tolist() == [2, 0, 1]
    assert (tmp_path / "out" / "fox" / "images" / "0.png").is_file()
    assert len(points_of(tmp_path / "data" / "fox")) == COUNT, "the capture itself stays as it is"


def test_prepared_captures_are_kept_and_missing_ones_are_named(tmp_path, capsys):
    write_capture(tmp_path / "data" / "fox", points=20)
    captures.prepare(tmp_path / "data", tmp_path / "out")
    files = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("*")}
    capsys.readouterr()
    captures.prepare(tmp_path / "data", tmp_path / "out")
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("*")} == files
    lines = capsys.readouterr().out.splitlines()
    assert "fox: is there" in lines
    assert f"bonsai: nothing in {tmp_path / 'data'}" in lines
    assert len(lines) == len(captures.CAPTURES)


def test_a_killed_run_is_continued(tmp_path, monkeypatch):
    """A capture counts as ready only if it is complete; the linked photographs never change."""
    write_capture(tmp_path / "data" / "fox", points=20)

    def killed(self, folder):
        (Path(folder) / "cameras.bin").touch()
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(pycolmap.Reconstruction, "write", killed)
        with pytest.raises(KeyboardInterrupt):
            captures.prepare(tmp_path / "data", tmp_path / "out")
    assert not (tmp_path / "out" / "fox" / "sparse" / "0").exists()
    captures.prepare(tmp_path / "data", tmp_path / "out")
    assert len(points_of(tmp_path / "out" / "fox")) == 20
    assert (tmp_path / "out" / "fox" / "images" / "0.png").is_file()
    assert (tmp_path / "data" / "fox" / "images" / "0.png").is_file()


def test_a_capture_without_a_model_gets_the_estimated_one(tmp_path, monkeypatch):
    """gsbench understands both commands.

    The second one exports the trial that the first one ran.
    """
    write_capture(tmp_path / "data" / "monstree", model=False)
    asked = []

    def answer(command, check):
        assert check
        assert Path(command[0]).name == "gsbench"
        asked.append(command[1])
        if command[1:3] == ["export", "init"]:
            assert (Path(command[3]) / "here").is_file()
            write_model(Path(command[command.index("--out") + 1]) / "sparse" / "0", np.eye(3))
            return
        (trial,) = compose_trials(command[1:])
        assert trial.values["init"]["name"] == "sfm"
        assert Path(trial.values["scene"]["path"]) == tmp_path / "data" / "monstree"
        trial.folder.mkdir(parents=True)
        (trial.folder / "here").touch()

    monkeypatch.setattr(captures.subprocess, "run", answer)
    captures.prepare(tmp_path / "data", tmp_path / "out")
    assert len(asked) == 2
    np.testing.assert_array_equal(
        points_of(tmp_path / "out" / "monstree"), np.unique(np.eye(3), axis=0)
    )
    (tmp_path / "out" / "monstree" / "sparse" / "0").rename(tmp_path / "moved")
    (tmp_path / "out" / "monstree" / "images").unlink()
    captures.prepare(tmp_path / "data", tmp_path / "out")
    assert len(asked) == 2, "an estimate that is there is not made again"
