"""Camera paths by the format of nerfstudio's viewer and by geometry; videos read back; the verb."""

from __future__ import annotations

import importlib.util
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gsbench.cli import run
from gsbench.errors import InputError
from gsbench.eval.evaluator import quantize
from gsbench.scene.camera import Camera
from gsbench.view.trials import find_trial, load_viewed, read_causes
from gsbench.view.video import check_file, ellipse, read_camera_path, through, write_video
from tests.scene.cameras import looking

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def ring(count: int = 12, radius: float = 4.0, height: float = 1.0, sweep: float = 2 * math.pi) -> list[Camera]:
    angles = sweep * np.arange(count) / count
    return [looking(np.array([radius * math.cos(a), radius * math.sin(a), height]), np.zeros(3)) for a in angles]


def camera_path_file(folder: Path, cameras: list[Camera], **changes: Any) -> Path:
    """As nerfstudio's viewer exports it: row-major camera-to-world in OpenGL's axes, the vertical angle in degrees."""
    frames = []
    for camera in cameras:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = camera.rotation.T, camera.center
        fov = math.degrees(2 * math.atan(camera.height / 2 / camera.fy))
        frames.append({"camera_to_world": (matrix @ OPENGL).ravel().tolist(), "fov": fov, "aspect": 1.33})
    document = {
        "camera_type": "perspective", "render_height": 48.0, "render_width": 64.0, "fps": 24, "seconds": 1,
        "keyframes": [], "is_cycle": False, "smoothness_value": 0.5, "camera_path": frames,
    }  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "path.json").write_text(json.dumps(document | changes))
    return folder / "path.json"


def test_a_path_of_nerfstudios_viewer_gives_its_cameras(tmp_path: Path) -> None:
    cameras = ring()
    found = read_camera_path(camera_path_file(tmp_path, cameras))
    assert found.fps == 24
    for one, other in zip(cameras, found.cameras, strict=True):
        assert (other.width, other.height) == (64, 48)
        assert (other.fx, other.fy, other.cx, other.cy) == pytest.approx((60, 60, 32, 24))
        np.testing.assert_allclose(one.rotation, other.rotation, atol=1e-12)
        np.testing.assert_allclose(one.translation, other.translation, atol=1e-12)
    larger = read_camera_path(camera_path_file(tmp_path, cameras), size=(128, 96)).cameras[0]
    assert (larger.width, larger.fy) == (128, pytest.approx(120))


def test_what_nerfstudio_did_to_the_scene_is_undone(tmp_path: Path) -> None:
    """Its dataparser: trained = scale (R original + t), for places; R alone for directions."""
    cameras = ring()
    angle = 0.7
    turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    move, scale = np.array([0.3, -1.0, 2.0]), 0.25
    moved = []
    for camera in cameras:
        rotation = camera.rotation @ turn.T
        center = scale * (turn @ camera.center + move)
        moved.append(Camera(64, 48, 60.0, 60.0, 32.0, 24.0, rotation, -rotation @ center))
    transforms = tmp_path / "dataparser_transforms.json"
    transforms.write_text(json.dumps({"transform": np.column_stack([turn, move]).tolist(), "scale": scale}))
    found = read_camera_path(camera_path_file(tmp_path, moved), transforms)
    for one, other in zip(cameras, found.cameras, strict=True):
        np.testing.assert_allclose(one.rotation, other.rotation, atol=1e-12)
        np.testing.assert_allclose(one.center, other.center, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"camera_path": []}, "camera_path is"),
        ({"camera_path": [{"camera_to_world": [1.0] * 15, "fov": 50}]}, "camera_path.0.camera_to_world"),
        ({"camera_path": [{"camera_to_world": [1.0] * 16, "fov": 50}]}, "scales, shears or mirrors"),
        ({"camera_path": [{"camera_to_world": np.eye(4).ravel().tolist(), "fov": 180}]}, "between 0 and 180"),
        ({"camera_type": "equirectangular"}, "equirectangular is not rendered here"),
        ({"render_width": 0}, "render_width and render_height must be whole"),
        ({"render_height": 1e9}, "render_width and render_height must be whole"),
        ({"render_width": "64"}, "render_width is '64'"),
        ({"fps": 1e-300}, "fps must be from 1 to 240"),
        ({"fps": 0}, "fps must be from 1 to 240"),
    ],
)
def test_a_path_that_cannot_be_filmed_is_one_line(tmp_path: Path, change: dict[str, Any], said: str) -> None:
    path = camera_path_file(tmp_path, ring(), **change)
    with pytest.raises(InputError, match=said) as caught:
        read_camera_path(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


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


@pytest.mark.parametrize(("suffix", "loss"), [(".webp", 6.0), (".gif", 8.0)])
def test_animations_hold_the_pictures_in_order(tmp_path: Path, suffix: str, loss: float) -> None:
    file = tmp_path / "deep" / f"a{suffix}"
    write_video(file, iter(pictures()), 20)
    with Image.open(file) as animation:
        assert animation.n_frames == 8
        assert animation.info["loop"] == 0
        for place, picture in enumerate(pictures()):
            animation.seek(place)
            found = np.asarray(animation.convert("RGB")).astype(int)
            assert np.abs(found - picture).mean() < loss
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
    with pytest.raises(InputError, match=r"a video ends with \.mp4, \.webp, \.gif"):
        check_file(tmp_path / "a.avi")
    monkeypatch.setattr("gsbench.view.video.has_mp4", lambda: False)
    with pytest.raises(InputError, match=r"MP4 needs OpenCV: pip install .*video.*; or name a file \.webp or \.gif"):
        check_file(tmp_path / "a.mp4")
    (tmp_path / "d.gif").mkdir()
    with pytest.raises(InputError, match="is a folder"):
        check_file(tmp_path / "d.gif")


def test_a_film_of_a_trial_shows_what_the_evaluation_rendered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The verb on a tiny trial; a path of one test view's camera gives that view's render."""
    import torch

    from gsbench.raster import create_rasterizer

    runs = tmp_path / "runs"
    words = ["scene=courtyard", "scene.views=8", "scene.width=64", "scene.height=48", "init=random", "init.count=800"]
    words += ["densify=none", "train.iterations=30", "eval.lpips=[]", "eval.flip=false", "tracking=none", "device=cpu"]
    assert run([*words, f"runs={runs}", "name=film"]) == 0
    monkeypatch.setenv("GSBENCH_RUNS", str(runs))
    trial = find_trial("film:courtyard:none", runs)
    viewed = load_viewed(trial, torch.device("cpu"))
    path = camera_path_file(tmp_path, [viewed.views[0].camera, *ring(3)])
    camera = read_camera_path(path).cameras[0]
    rasterizer = create_rasterizer("cpu", torch.device("cpu"), 1)
    image = quantize(rasterizer.render(viewed.gaussians, camera, 3, torch.zeros(3)).image.detach()).numpy()
    render = np.asarray(Image.open(sorted((trial.path / "renders").iterdir())[0]))
    assert np.abs(image.astype(int) - render).max() <= 1
    film = tmp_path / "film.webp"
    assert run(["video", "film:courtyard:none", "--path", str(path), "--out", str(film)]) == 0
    with Image.open(film) as animation:
        assert animation.n_frames == 4
        assert np.abs(np.asarray(animation.convert("RGB")).astype(int) - render).mean() < 8
    for words in (["--along", "cameras"], ["--along", "ellipse", "--size", "80x60"]):
        assert run(["video", "film:courtyard:none", *words, "--frames", "3", "--out", str(film)]) == 0
        with Image.open(film) as animation:
            assert animation.n_frames == 3
            assert animation.size == ((80, 60) if "--size" in words else (64, 48))
    capsys.readouterr()
    for words, said in (
        (["--frames", "1"], "from 2 to"),
        (["--size", "64"], "must be like 640x480"),
        (["--fps", "0"], "must be a number from 1"),
        (["--path", str(path), "--frames", "3"], "of a made path"),
        (["--path", str(path), "--along", "ellipse"], "give one"),
        (["--transforms", str(path)], "give --path"),
        (["--out", str(tmp_path / "a.avi")], "a video ends with"),
        (["--path", str(tmp_path / "none.json")], "none.json"),
    ):
        assert run(["video", "film:courtyard:none", *words]) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1, lines
        assert said in lines[0]
