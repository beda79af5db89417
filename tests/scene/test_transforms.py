"""transforms.json: cameras by the documented formulas, restated here; what is missing, damaged or not understood."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from PIL import Image

from gsbench.errors import InputError
from gsbench.init.base import read_cloud
from gsbench.pipeline.steps.scene import CaptureSource
from gsbench.scene import transforms
from gsbench.scene.colmap import read_model
from gsbench.scene.options import SceneConfig
from gsbench.scene.transforms import read_transforms
from gsbench.scene.types import Capture

SHARED = {"w": 40, "h": 30, "fl_x": 50.0, "fl_y": 51.0, "cx": 19.5, "cy": 15.5}


def looking_at_origin(eye: np.ndarray) -> np.ndarray:
    """Camera to world [4, 4] in OpenGL's axes: x right, y up, looking along -z; the world's up is z."""
    back = eye / np.linalg.norm(eye)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([right, np.cross(back, right), back, eye])
    return matrix


EYES = [np.array([3 * math.cos(a), 3 * math.sin(a), 1.0]) for a in np.linspace(0, 5, 6)]


def write(folder: Path, document: dict[str, Any] | None = None, name: str = "transforms.json", **changes: Any) -> Path:
    """A folder with six photographs and the file; ``changes`` are its further keys."""
    frames = []
    for k, eye in enumerate(EYES):
        path = folder / "images" / f"{k}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (40, 30), (40 * k, 100, 100)).save(path)
        frames.append({"file_path": f"./images/{k}.png", "transform_matrix": looking_at_origin(eye).tolist()})
    whole = (SHARED | {"frames": frames} | changes) if document is None else document
    (folder / name).write_text(json.dumps(whole))
    return folder


def capture_of(folder: Path, work: Path, **options: Any) -> Capture:
    config = SceneConfig(name="t", kind="transforms", path=str(folder), **options)
    source = CaptureSource(config)
    assert source.step is not None
    work.mkdir(exist_ok=True)
    source.step.build(work)
    return source.read(work)


def project(model: pycolmap.Reconstruction, name: str, point: np.ndarray) -> np.ndarray:
    image = model.find_image_with_name(name)
    return model.cameras[image.camera_id].img_from_cam(image.cam_from_world() * point)


def test_a_point_falls_where_the_formulas_of_the_format_say(tmp_path: Path) -> None:
    """In the camera's axes x right, y up, z towards the viewer: column cx + fl_x x/-z, row cy - fl_y y/-z."""
    capture = capture_of(write(tmp_path / "in"), tmp_path / "made")
    model = read_model(capture.model)  # type: ignore[arg-type]
    for k, eye in enumerate(EYES):
        for point in (np.zeros(3), np.array([0.3, -0.2, 0.1])):
            x, y, z, _ = np.linalg.inv(looking_at_origin(eye)) @ [*point, 1]
            wanted = [19.5 + 50 * x / -z, 15.5 - 51 * y / -z]
            np.testing.assert_allclose(project(model, f"images/{k}.png", point), wanted, atol=1e-9)
    above = project(model, "images/0.png", np.array([0, 0, 0.5]))
    assert above[1] < project(model, "images/0.png", np.zeros(3))[1], "what is higher is further up in the picture"


def test_what_was_applied_is_undone_for_cameras_and_points(tmp_path: Path) -> None:
    """Saved = applied_scale (R p + t): cameras and the PLY come back to where they were."""
    plain = capture_of(write(tmp_path / "plain"), tmp_path / "one")
    applied = np.array([[0, 1, 0, 0.5], [1, 0, 0, -2], [0, 0, -1, 3.0]])
    scale = 2.5
    points = np.random.default_rng(0).normal(size=(5, 3))
    frames = []
    for k, eye in enumerate(EYES):
        matrix = np.vstack([applied, [0, 0, 0, 1]]) @ looking_at_origin(eye)
        matrix[:3, 3] *= scale
        frames.append({"file_path": f"images/{k}.png", "transform_matrix": matrix.tolist()})
    saved = scale * (points @ applied[:, :3].T + applied[:, 3])
    folder = write(
        tmp_path / "moved",
        frames=frames,
        applied_transform=[*applied.tolist(), [0, 0, 0, 1]],
        applied_scale=scale,
        ply_file_path="p.ply",
    )
    lines = [f"{x} {y} {z} 10 20 {k}" for k, (x, y, z) in enumerate(saved)]
    header = "ply\nformat ascii 1.0\nelement vertex 5\n" + "".join(f"property double {c}\n" for c in "xyz")
    header += "".join(f"property uchar {c}\n" for c in ("red", "green", "blue")) + "end_header\n"
    (folder / "p.ply").write_text(header + "\n".join(lines) + "\n")
    moved = capture_of(folder, tmp_path / "two")
    models = [read_model(capture.model) for capture in (plain, moved)]  # type: ignore[arg-type]
    for k in range(6):
        one, other = (model.find_image_with_name(f"images/{k}.png").cam_from_world().matrix() for model in models)
        np.testing.assert_allclose(one, other, atol=1e-9)
    cloud = read_cloud(moved.model)  # type: ignore[arg-type]
    np.testing.assert_allclose(cloud.points, points, atol=1e-9)
    assert cloud.colors.tolist() == [[10, 20, k] for k in range(5)]


@pytest.mark.parametrize(
    ("said", "model", "params"),
    [
        ({}, "PINHOLE", [50, 51, 19.5, 15.5]),
        ({"k1": 0.1, "k2": -0.02, "p1": 0.001, "p2": 0.002}, "OPENCV", [50, 51, 19.5, 15.5, 0.1, -0.02, 0.001, 0.002]),
        (
            {"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4},
            "OPENCV_FISHEYE",
            [50, 51, 19.5, 15.5, 0.1, 0.2, 0.3, 0.4],
        ),
        ({"is_fisheye": True}, "OPENCV_FISHEYE", [50, 51, 19.5, 15.5, 0, 0, 0, 0]),
    ],
)
def test_intrinsics_of_the_file_or_of_each_frame(tmp_path: Path, said, model, params) -> None:
    shared = read_transforms(write(tmp_path / "shared", **said)).images["images/3.png"][0]
    folder = write(tmp_path / "own")
    document = json.loads((folder / "transforms.json").read_text())
    own = {key: document.pop(key) for key in SHARED} | said
    document["frames"] = [frame | own for frame in document["frames"]]
    document["frames"][2]["fl_x"] = 60.0
    (folder / "transforms.json").write_text(json.dumps(document))
    frames = read_transforms(folder).images
    for camera in (shared, frames["images/3.png"][0]):
        assert (camera.name, camera.width, camera.height) == (model, 40, 30)
        assert list(camera.params) == params
    assert frames["images/2.png"][0].params[0] == 60


def test_blenders_angle_its_missing_extension_its_parts_and_its_alpha(tmp_path: Path) -> None:
    """NeRF's synthetic scenes: focal = .5 w / tan(.5 angle), a centre in the middle, transforms_test.json held out."""
    angle = 0.6911112070083618
    for part, count in (("train", 5), ("test", 3), ("val", 2)):
        frames = []
        for k in range(count):
            path = tmp_path / part / f"r_{k}.png"
            path.parent.mkdir(exist_ok=True)
            pixels = np.zeros((40, 40, 4), np.uint8)
            pixels[10:30, 10:30] = (200, 40, 40, 255)
            pixels[5, 5] = (255, 0, 0, 128)
            Image.fromarray(pixels).save(path)
            matrix = looking_at_origin(EYES[k]).tolist()
            frames.append({"file_path": f"./{part}/r_{k}", "rotation": 0.01, "transform_matrix": matrix})
        (tmp_path / f"transforms_{part}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    capture = capture_of(tmp_path, tmp_path / "made", split="list")
    assert capture.test_names == tuple(f"test/r_{k}.png" for k in range(3))
    assert capture.train_names == tuple(f"train/r_{k}.png" for k in range(5))
    camera = read_transforms(tmp_path).images["train/r_0.png"][0]
    assert camera.params == pytest.approx((0.5 * 40 / math.tan(0.5 * angle),) * 2 + (20, 20))
    assert capture_of(tmp_path, tmp_path / "every").test_names == ("test/r_0.png",)  # the rule, not the files
    assert not any(name.startswith("val/") for name in read_transforms(tmp_path).images)
    (tmp_path / "transforms_test.json").unlink()
    assert read_transforms(tmp_path).split == ([f"train/r_{k}.png" for k in range(5)], ["val/r_0.png", "val/r_1.png"])
    from gsbench.pipeline.steps.scene import masked_capture, masking_step

    assert masking_step(capture, "black") is None
    step = masking_step(capture, "white")
    assert step is not None
    (tmp_path / "white").mkdir()
    step.build(tmp_path / "white")
    white = masked_capture(capture, tmp_path / "white")
    with Image.open(white.images / "train/r_0.png") as picture:
        assert picture.mode == "RGB"
        assert picture.getpixel((0, 0)) == (255, 255, 255)
        assert picture.getpixel((20, 20)) == (200, 40, 40)
        assert picture.getpixel((5, 5))[1] == pytest.approx(127, abs=1)


def test_a_file_that_names_masks_asks_for_their_folder(tmp_path: Path) -> None:
    folder = write(tmp_path / "in")
    document = json.loads((folder / "transforms.json").read_text())
    (folder / "masks" / "images").mkdir(parents=True)
    for k in range(6):
        Image.new("L", (40, 30), 255).save(folder / "masks" / "images" / f"{k}.png.png")
    document["frames"][1]["mask_path"] = "masks/1.png"
    (folder / "transforms.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"mask_path is not read: .*scene\.masks"):
        capture_of(folder, tmp_path / "a")
    found = capture_of(folder, tmp_path / "b", masks="masks")
    assert found.masks["images/2.png"] == folder / "masks/images/2.png.png"


def test_the_file_is_among_what_a_trial_is_made_of(tmp_path: Path) -> None:
    folder = write(tmp_path / "in")
    capture = capture_of(folder, tmp_path / "a")
    assert capture.read_from == (folder / "transforms.json",)
    document = json.loads((folder / "transforms.json").read_text())
    document["fl_x"] = 49.0
    (folder / "transforms.json").write_text(json.dumps(document))
    assert capture_of(folder, tmp_path / "b").fingerprint != capture.fingerprint


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: d.pop("frames"), "lacks 'frames'"),
        (lambda d: d["frames"][1].pop("transform_matrix"), "lacks 'frames.1.transform_matrix'"),
        (lambda d: d["frames"][1].update(transform_matrix=[[1, 0, 0, 0]]), r"frames\.1\.transform_matrix is "),
        (lambda d: d["frames"][1]["transform_matrix"][0].pop(), r"frames\.1\.transform_matrix\.0 is "),
        (lambda d: d["frames"][1]["transform_matrix"][0].append(0), r"frames\.1\.transform_matrix\.0 is "),
        (lambda d: d["frames"][1]["transform_matrix"].append([0] * 4), r"frames\.1\.transform_matrix is "),
        (lambda d: d["frames"][1]["transform_matrix"].__setitem__(0, [2, 0, 0, 0]), "scales, shears or mirrors"),
        (lambda d: d["frames"][1]["transform_matrix"].__setitem__(2, [0.0] * 4), "scales, shears or mirrors"),
        (
            lambda d: d.update(applied_transform=[[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 1, 0]]),
            "applied_transform .*mirrors",
        ),
        (lambda d: d.update(applied_scale=0), "applied_scale must be positive"),
        (lambda d: d.update(camera_model="EQUIRECTANGULAR"), "camera_model EQUIRECTANGULAR is not known here"),
        (lambda d: d.update(k4=0.1), "k3 and k4 are read of OPENCV_FISHEYE alone"),
        (lambda d: d.pop("fl_x"), "no focal length"),
        (lambda d: (d.pop("fl_x"), d.update(camera_angle_x=4.0)), "no focal length"),
        (lambda d: (d.pop("fl_x"), d.update(camera_angle_x=0)), "no focal length"),
        (lambda d: d.update(fl_x=0), "no focal length"),
        (lambda d: d.update(h=0), "w and h must be whole numbers"),
        (lambda d: d.update(w=40.5), "w and h must be whole numbers"),
        (lambda d: d.update(fl_x="50"), "fl_x is '50'"),
        (lambda d: d["frames"][1].update(file_path="../secret.png"), "lies outside the folder"),
        (lambda d: d["frames"][1].update(file_path="/etc/passwd"), "lies outside the folder"),
        (lambda d: d.update(ply_file_path="/etc/passwd"), "lies outside the folder"),
        (lambda d: d.update(ply_file_path="p.ply"), "names p.ply, which is not there"),
        (lambda d: d["frames"][1].update(file_path="images/0.png"), r"images/0\.png is there twice"),
    ],
)
def test_what_cannot_be_understood_is_one_line_that_names_the_file(tmp_path: Path, change, said) -> None:
    folder = write(tmp_path / "in")
    document = json.loads((folder / "transforms.json").read_text())
    change(document)
    (folder / "transforms.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=said) as caught:
        read_transforms(folder)
    assert str(folder / "transforms.json") in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_line_of_pixels_is_a_picture(tmp_path: Path) -> None:
    folder = write(tmp_path / "in", w=1)
    for k in range(len(EYES)):
        Image.new("RGB", (1, 30)).save(folder / "images" / f"{k}.png")
    assert {camera.width for camera, *_ in read_transforms(folder).images.values()} == {1}
    for one_side in ({"w": None}, {"h": None}):
        images = read_transforms(write(tmp_path / "in", **one_side)).images
        assert {(camera.width, camera.height) for camera, *_ in images.values()} == {(40, 30)}


def test_no_file_and_a_name_without_a_decision(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"neither transforms\.json nor transforms_train\.json is here"):
        read_transforms(tmp_path)
    folder = write(tmp_path / "in")
    Image.new("RGB", (40, 30)).save(folder / "images" / "0.jpg")
    document = json.loads((folder / "transforms.json").read_text())
    document["frames"][0]["file_path"] = "images/0"
    (folder / "transforms.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"images/0 may be images/0\.jpg or images/0\.png: add the extension"):
        read_transforms(folder)


def test_images_without_a_file_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = write(tmp_path / "in")
    (folder / "images" / "4.png").unlink()
    assert len(read_transforms(folder).images) == 5
    assert "1 of 6 images have no file: ./images/4.png" in caplog.text


def test_the_file_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = CaptureSource(SceneConfig(name="t", kind="transforms", path=str(write(tmp_path / "in"))))
    read, files = transforms.read_typed, []
    monkeypatch.setattr(transforms, "read_typed", lambda path, kind: files.append(path) or read(path, kind))
    assert source.step is not None
    source.step.build(tmp_path / "made")
    source.read(tmp_path / "made")
    assert files == [tmp_path / "in" / "transforms.json"]
