"""Camera paths by geometry; videos read back; the verb."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsbench.cli import run
from gsbench.errors import InputError
from gsbench.scene.camera import Camera
from gsbench.view.trials import read_causes
from gsbench.view.video import check_file, ellipse, through, write_video
from tests.scene.cameras import looking


def ring(count: int = 12, radius: float = 4.0, height: float = 1.0, sweep: float = 2 * math.pi) -> list[Camera]:
    angles = sweep * np.arange(count) / count
    return [looking(np.array([radius * math.cos(a), radius * math.sin(a), height]), np.zeros(3)) for a in angles]


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 no zip", b"no zip at all"])
def test_a_record_of_causes_that_is_damaged_is_one_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "lineage.npz").write_bytes(content)
    with pytest.raises(InputError, match=r"lineage\.npz cannot be read"):
        read_causes(tmp_path / "lineage.npz", 1)


@pytest.mark.parametrize("make", [through, ellipse])
def test_made_paths_stay_where_the_cameras_are_and_look_where_they_look(make: Callable[..., list[Camera]]) -> None:
    rng = np.random.default_rng(0)
    cameras = [
        looking(camera.center + rng.normal(0, 0.05, 3), rng.normal(0, 0.05, 3))
        for camera in ring(40, sweep=1.8 * math.pi)
    ]
    path = make(cameras, cameras[0], 60)
    assert len(path) == 60
    centers = np.stack([camera.center for camera in path])
    assert np.abs(np.linalg.norm(centers[:, :2], axis=1) - 4).max() < 0.5
    assert np.abs(centers[:, 2] - 1).max() < 0.3
    for camera in path:
        seen = camera.rotation @ (-camera.center)
        assert seen[2] > 3, "the middle of the scene is ahead"
        assert np.hypot(seen[0], seen[1]) / seen[2] < 0.15
        assert camera.rotation[1][2] < -0.8, "upwards is upwards in the picture"
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert steps.max() < 2.5 * np.median(steps)


@pytest.mark.parametrize("make", [through, ellipse])
def test_cameras_that_look_one_way_are_filmed_too(make: Callable[..., list[Camera]]) -> None:
    """As of a wall: no common point is looked at."""
    cameras = [
        looking(np.array([x, 0.0, z]), np.array([x, 5.0, z])) for x in np.linspace(-1, 1, 6) for z in (0.0, 0.2, 0.4)
    ]
    for camera in make(cameras, cameras[0], 20):
        assert camera.rotation[2][1] > 0.99
        assert abs(camera.center[0]) < 1.2


def test_cameras_that_look_straight_down_say_so() -> None:
    cameras = [looking(np.array([x, y, 5.0]), np.array([x, y, 0.0]), up=(0, 1, 0)) for x in (0, 1, 2) for y in (0, 1)]
    assert len(through(cameras, cameras[0], 5)) == 5, "their up is y, which is not where they look"


def pictures(count: int = 8, size: tuple[int, int] = (50, 38)) -> list[np.ndarray]:
    """A bright square that walks over a ramp."""
    made = []
    for k in range(count):
        picture = np.zeros((size[1], size[0], 3), np.uint8)
        picture[..., 0] = np.linspace(0, 200, size[0], dtype=np.uint8)
        picture[10:20, 4 * k : 4 * k + 10] = (20, 240, 60)
        made.append(picture)
    return made


def test_an_animation_holds_the_pictures_in_order(tmp_path: Path) -> None:
    file = tmp_path / "deep" / "a.webp"
    write_video(file, iter(pictures()), 20)
    with Image.open(file) as animation:
        assert animation.n_frames == 8
        assert animation.info["loop"] == 0
        for place, picture in enumerate(pictures()):
            animation.seek(place)
            found = np.asarray(animation.convert("RGB")).astype(int)
            assert np.abs(found - picture).mean() < 6
            assert animation.info["duration"] == 50
    assert [path.name for path in file.parent.iterdir()] == [file.name]


@pytest.mark.skipif(importlib.util.find_spec("cv2") is None, reason="needs the extra video")
def test_an_mp4_holds_the_pictures_in_order(tmp_path: Path) -> None:
    import cv2

    write_video(tmp_path / "a.mp4", iter(pictures()), 12)
    film = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert film.get(cv2.CAP_PROP_FPS) == 12
    for picture in pictures():
        read, found = film.read()
        assert read
        assert np.abs(found[..., ::-1].astype(int) - picture).mean() < 8
    assert not film.read()[0]
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]


def test_files_that_cannot_be_written_are_refused_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"a video ends with \.mp4, \.webp"):
        check_file(tmp_path / "a.avi")
    monkeypatch.setattr("gsbench.view.video.has_mp4", lambda: False)
    with pytest.raises(InputError, match=r"MP4 needs OpenCV: pip install .*video.*; or name a file \.webp"):
        check_file(tmp_path / "a.mp4")
    (tmp_path / "d.webp").mkdir()
    with pytest.raises(InputError, match="is a folder"):
        check_file(tmp_path / "d.webp")


def test_a_film_of_a_trial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    runs, film = tmp_path / "runs", tmp_path / "film.webp"
    words = ["scene=courtyard", "scene.views=8", "scene.width=64", "scene.height=48", "init=random", "init.count=800"]
    words += ["densify=none", "train.iterations=30", "eval.lpips=[]", "eval.flip=false", "tracking=none", "device=cpu"]
    assert run([*words, f"runs={runs}", "name=film"]) == 0
    monkeypatch.setenv("GSBENCH_RUNS", str(runs))
    for words in ([], ["--along", "ellipse", "--size", "80x60"]):
        assert run(["video", "film:courtyard:none", *words, "--frames", "3", "--out", str(film)]) == 0
        with Image.open(film) as animation:
            assert animation.n_frames == 3
            assert animation.size == ((80, 60) if words else (64, 48))
    capsys.readouterr()
    for words, said in (
        (["--frames", "1"], "from 2 to"),
        (["--size", "64"], "must be like 640x480"),
        (["--fps", "0"], "must be a number from 1"),
        (["--out", str(tmp_path / "a.avi")], "a video ends with"),
    ):
        assert run(["video", "film:courtyard:none", *words]) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1, lines
        assert said in lines[0]
