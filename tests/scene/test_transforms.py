"""transforms.json: cameras by the documented formulas, restated here; what is missing, damaged or
not understood."""

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
from gsbench.scene.transforms_keys import HARMLESS, REFUSED
from gsbench.scene.types import Capture

SHARED = {"w": 40, "h": 30, "fl_x": 50.0, "fl_y": 51.0, "cx": 19.5, "cy": 15.5}


def looking_at_origin(eye: np.ndarray) -> np.ndarray:
    """Camera to world [4, 4] in OpenGL's axes: x right, y up, looking along -z; the world's up is
    z."""
    back = eye / np.linalg.norm(eye)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([right, np.cross(back, right), back, eye])
    return matrix


EYES = [np.array([3 * math.cos(a), 3 * math.sin(a), 1.0]) for a in np.linspace(0, 5, 6)]


def write(
    folder: Path,
    document: dict[str, Any] | None = None,
    name: str = "transforms.json",
    **changes: Any,
) -> Path:
    """A folder with six photographs and the file; ``changes`` are its further keys."""
    frames = []
    for k, eye in enumerate(EYES):
        path = folder / "images" / f"{k}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (40, 30), (40 * k, 100, 100)).save(path)
        frames.append(
            {"file_path": f"./images/{k}.png", "transform_matrix": looking_at_origin(eye).tolist()}
        )
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
    """In the camera's axes x right, y up, z towards the viewer: column cx + fl_x x/-z, row cy -
    fl_y y/-z."""
    capture = capture_of(write(tmp_path / "in"), tmp_path / "made")
    model = read_model(capture.model)  # type: ignore[arg-type]
    for k, eye in enumerate(EYES):
        for point in (np.zeros(3), np.array([0.3, -0.2, 0.1])):
            x, y, z, _ = np.linalg.inv(looking_at_origin(eye)) @ [*point, 1]
            wanted = [19.5 + 50 * x / -z, 15.5 - 51 * y / -z]
            np.testing.assert_allclose(project(model, f"images/{k}.png", point), wanted, atol=1e-9)
    above = project(model, "images/0.png", np.array([0, 0, 0.5]))
    assert above[1] < project(model, "images/0.png", np.zeros(3))[1], (
        "what is higher is further up in the picture"
    )


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
    header = "ply\nformat ascii 1.0\nelement vertex 5\n" + "".join(
        f"property double {c}\n" for c in "xyz"
    )
    header += "".join(f"property uchar {c}\n" for c in ("red", "green", "blue")) + "end_header\n"
    (folder / "p.ply").write_text(header + "\n".join(lines) + "\n")
    moved = capture_of(folder, tmp_path / "two")
    models = [read_model(capture.model) for capture in (plain, moved)]  # type: ignore[arg-type]
    for k in range(6):
        one, other = (
            model.find_image_with_name(f"images/{k}.png").cam_from_world().matrix()
            for model in models
        )
        np.testing.assert_allclose(one, other, atol=1e-9)
    cloud = read_cloud(moved.model)  # type: ignore[arg-type]
    np.testing.assert_allclose(cloud.points, points, atol=1e-9)
    assert cloud.colors.tolist() == [[10, 20, k] for k in range(5)]


@pytest.mark.parametrize(
    ("said", "model", "params"),
    [
        ({}, "PINHOLE", [50, 51, 19.5, 15.5]),
        (
            {"k1": 0.1, "k2": -0.02, "p1": 0.001, "p2": 0.002},
            "OPENCV",
            [50, 51, 19.5, 15.5, 0.1, -0.02, 0.001, 0.002],
        ),
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
    """NeRF's synthetic scenes: focal = .5 w / tan(.5 angle), a centre in the middle,
    transforms_test.json held out."""
    angle = 0.6911112070083618
    for part, count in (("train", 5), ("test", 3), ("val", 2)):
        frames = []
        for k in range(count):
            path = tmp_path / part / f"r_{k}.png"
            path.parent.mkdir(exist_ok=True)
            pixels = np.zeros((40, 40, 4), np.uint8)
            pixels[10:30, 10:30] = (200, 40, 40, 255)
            pixels[5, 5] = (255, 0, 0, 128)
            pixels[21, 24] = (10 * count, 10 * k, 0, 255)  # no photograph twice
            Image.fromarray(pixels).save(path)
            matrix = looking_at_origin(EYES[k]).tolist()
            frames.append(
                {"file_path": f"./{part}/r_{k}", "rotation": 0.01, "transform_matrix": matrix}
            )
        (tmp_path / f"transforms_{part}.json").write_text(
            json.dumps({"camera_angle_x": angle, "frames": frames})
        )
    capture = capture_of(tmp_path, tmp_path / "made", split="list")
    assert capture.test_names == tuple(f"test/r_{k}.png" for k in range(3))
    assert capture.train_names == tuple(f"train/r_{k}.png" for k in range(5))
    camera = read_transforms(tmp_path).images["train/r_0.png"][0]
    assert camera.params == pytest.approx((0.5 * 40 / math.tan(0.5 * angle),) * 2 + (20, 20))
    # the rule, not the files
    assert capture_of(tmp_path, tmp_path / "every").test_names == ("test/r_0.png",)
    assert not any(name.startswith("val/") for name in read_transforms(tmp_path).images)
    (tmp_path / "transforms_test.json").unlink()
    assert read_transforms(tmp_path).split == (
        [f"train/r_{k}.png" for k in range(5)],
        ["val/r_0.png", "val/r_1.png"],
    )
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
        (
            lambda d: d["frames"][1].update(transform_matrix=[[1, 0, 0, 0]]),
            r"frames\.1\.transform_matrix is ",
        ),
        (
            lambda d: d["frames"][1]["transform_matrix"][0].pop(),
            r"frames\.1\.transform_matrix\.0 is ",
        ),
        (
            lambda d: d["frames"][1]["transform_matrix"][0].append(0),
            r"frames\.1\.transform_matrix\.0 is ",
        ),
        (
            lambda d: d["frames"][1]["transform_matrix"].append([0] * 4),
            r"frames\.1\.transform_matrix is ",
        ),
        (
            lambda d: d["frames"][1]["transform_matrix"].__setitem__(0, [2, 0, 0, 0]),
            "scales, shears or mirrors",
        ),
        (
            lambda d: d["frames"][1]["transform_matrix"].__setitem__(2, [0.0] * 4),
            "scales, shears or mirrors",
        ),
        (
            lambda d: d.update(applied_transform=[[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 1, 0]]),
            "applied_transform .*mirrors",
        ),
        (lambda d: d.update(applied_scale=0), "applied_scale must be positive"),
        (
            lambda d: d.update(camera_model="EQUIRECTANGULAR"),
            "camera_model EQUIRECTANGULAR is not known here",
        ),
        *(
            (
                lambda d, key=key: d.update({key: 0.1}),
                "k4, k5 and k6 are read of OPENCV_FISHEYE and FULL_OPENCV alone",
            )
            for key in ("k4", "k5", "k6")
        ),
        (lambda d: d.update(is_fisheye=True, p1=0.1), "OPENCV_FISHEYE has k1 to k4 alone"),
        (lambda d: (d.pop("fl_x"), d.pop("fl_y")), "no focal length"),
        (lambda d: (d.pop("fl_y"), d.update(y_fov=180)), "no focal length"),
        (lambda d: d.update(fl_y=0), "no focal length"),
        *(
            (lambda d, key=key, value=value: d.update({key: value}), f"{key}: {REFUSED[key]}")
            for key in REFUSED
            for value in ([0.0, 0.5],)
        ),
        (
            lambda d: d["frames"][2].update(rolling_shutter=[0, 0, 0.1, 0]),
            r"rolling_shutter \(frame 2\): ",
        ),
        (
            lambda d: d.update(train_filenames=["images/1.png"], test_filenames=["images/9.png"]),
            "held-out filenames",
        ),
        (
            lambda d: d.update(train_filenames=["images/1.png"], val_filenames=["images/1.png"]),
            "trained and tested on",
        ),
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
        (
            lambda d: d["frames"][1].update(file_path="images/0.png"),
            r"images/0\.png is there twice",
        ),
    ],
)
def test_what_cannot_be_understood_is_one_line_that_names_the_file(
    tmp_path: Path, change, said
) -> None:
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
    with pytest.raises(
        InputError, match=r"neither transforms\.json nor transforms_train\.json is here"
    ):
        read_transforms(tmp_path)
    folder = write(tmp_path / "in")
    Image.new("RGB", (40, 30)).save(folder / "images" / "0.jpg")
    document = json.loads((folder / "transforms.json").read_text())
    document["frames"][0]["file_path"] = "images/0"
    (folder / "transforms.json").write_text(json.dumps(document))
    with pytest.raises(
        InputError, match=r"images/0 may be images/0\.jpg or images/0\.png: keep one"
    ):
        read_transforms(folder)


def test_images_without_a_file_are_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = write(tmp_path / "in")
    (folder / "images" / "4.png").unlink()
    assert len(read_transforms(folder).images) == 5
    assert "1 of 6 images have no file: ./images/4.png" in caplog.text


def test_the_file_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = CaptureSource(
        SceneConfig(name="t", kind="transforms", path=str(write(tmp_path / "in")))
    )
    read, files = transforms.read_bytes, []
    monkeypatch.setattr(transforms, "read_bytes", lambda path: files.append(path) or read(path))
    assert source.step is not None
    source.step.build(tmp_path / "made")
    source.read(tmp_path / "made")
    assert files == [tmp_path / "in" / "transforms.json"]


def focal(side: float, degrees: float) -> float:
    return 0.5 * side / math.tan(math.radians(degrees) / 2)


@pytest.mark.parametrize(
    ("said", "focal_x", "focal_y"),
    [
        ({"x_fov": 70.0}, focal(40, 70), focal(40, 70)),
        ({"y_fov": 50.0}, focal(30, 50), focal(30, 50)),
        ({"x_fov": 70.0, "y_fov": 50.0}, focal(40, 70), focal(30, 50)),
        ({"camera_angle_x": 1.2}, focal(40, math.degrees(1.2)), focal(40, math.degrees(1.2))),
        ({"camera_angle_y": 0.9}, focal(30, math.degrees(0.9)), focal(30, math.degrees(0.9))),
        (
            {"camera_angle_x": 1.2, "camera_angle_y": 0.9},
            focal(40, math.degrees(1.2)),
            focal(30, math.degrees(0.9)),
        ),
        ({"fl_y": 51.0}, 51.0, 51.0),
        ({"fl_x": 50.0, "camera_angle_y": 0.9}, 50.0, focal(30, math.degrees(0.9))),
        ({"fl_x": 50.0, "fl_y": 51.0, "x_fov": 70.0, "camera_angle_y": 0.9}, 50.0, 51.0),
    ],
)
@pytest.mark.parametrize("of_each_frame", [False, True])
def test_every_way_to_give_a_field_of_view(
    tmp_path: Path, said, focal_x, focal_y, of_each_frame: bool
) -> None:
    folder = write(
        tmp_path / "in", **({"fl_x": None, "fl_y": None} | ({} if of_each_frame else said))
    )
    if of_each_frame:
        document = json.loads((folder / "transforms.json").read_text())
        document["frames"] = [frame | said for frame in document["frames"]]
        (folder / "transforms.json").write_text(json.dumps(document))
    for camera, *_ in read_transforms(folder).images.values():
        assert camera.params[:2] == pytest.approx((focal_x, focal_y))


@pytest.mark.parametrize(
    "said", [{"k3": 0.05}, {"camera_model": "FULL_OPENCV", "k3": 0.05, "k4": 0.02, "k6": 0.01}]
)
def test_higher_coefficients_distort_as_in_opencv(tmp_path: Path, said: dict[str, Any]) -> None:
    """OpenCV's documented formula: (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6
    r^6)."""
    capture = capture_of(write(tmp_path / "in", k1=0.1, k2=-0.02, **said), tmp_path / "made")
    model = read_model(capture.model)  # type: ignore[arg-type]
    k = {key: said.get(key, 0.0) for key in ("k3", "k4", "k6")}
    for x, y in ((0.3, -0.2), (-0.6, 0.5)):
        r2 = x * x + y * y
        factor = (1 + 0.1 * r2 - 0.02 * r2**2 + k["k3"] * r2**3) / (
            1 + k["k4"] * r2 + k["k6"] * r2**3
        )
        seen = next(iter(model.cameras.values())).img_from_cam(np.array([x, y, 1.0]))
        np.testing.assert_allclose(
            seen, [19.5 + 50 * x * factor, 15.5 + 51 * y * factor], atol=1e-9
        )


@pytest.mark.parametrize("key", sorted(HARMLESS | set(REFUSED)))
def test_what_says_nothing_changes_nothing_in_silence(tmp_path: Path, key: str, caplog) -> None:
    wanted = read_transforms(write(tmp_path / "in")).images
    values = (None,) if key.startswith("transform_matrix") else (None, 0, False, [0.0, 0.0])
    for value in (*values, *([1.5, "text", [1.0]] if key in HARMLESS else [])):
        found = read_transforms(write(tmp_path / "in", **{key: value})).images
        assert [camera for camera, *_ in found.values()] == [
            camera for camera, *_ in wanted.values()
        ]
    assert not caplog.text


def test_unknown_keys_are_named_in_one_line(tmp_path: Path, caplog) -> None:
    folder = write(tmp_path / "in", exporter="x", fl_X=3.0)
    document = json.loads((folder / "transforms.json").read_text())
    for frame in document["frames"]:
        frame["lens"] = "wide"
    (folder / "transforms.json").write_text(json.dumps(document))
    read_transforms(folder)
    (record,) = caplog.records
    assert record.getMessage().endswith("3 keys are not known and not used: exporter, fl_X, lens")


@pytest.mark.parametrize(
    ("lists", "train", "test"),
    [
        (
            {"train_filenames": [0, 1, 2], "val_filenames": [3], "test_filenames": [4, 5]},
            (0, 1, 2),
            (4, 5),
        ),
        ({"train_filenames": [0, 1, 2], "val_filenames": [3]}, (0, 1, 2), (3,)),
        ({"test_filenames": [4]}, (0, 1, 2, 3, 5), (4,)),
    ],
)
def test_nerfstudios_lists_of_names_are_the_split(
    tmp_path: Path, lists, train, test, caplog
) -> None:
    named = {key: [f"./images/{k}.png" for k in numbers] for key, numbers in lists.items()}
    folder = write(tmp_path / "in", **named)
    capture = capture_of(folder, tmp_path / "made", split="list")
    assert capture.train_names == tuple(f"images/{k}.png" for k in train)
    assert capture.test_names == tuple(f"images/{k}.png" for k in test)
    assert not caplog.text
    assert len(capture_of(folder, tmp_path / "other").image_names) == 6
    assert "a split of its own, which scene.split=list takes" in caplog.text


@pytest.mark.parametrize("written", ["images/4.JPG", "images/4", "IMAGES/4.PNG", "images\\4.jpeg"])
def test_a_file_is_found_whatever_its_extension_and_capitals(tmp_path: Path, written: str) -> None:
    folder = write(tmp_path / "in")
    document = json.loads((folder / "transforms.json").read_text())
    document["frames"][4]["file_path"] = written
    (folder / "transforms.json").write_text(json.dumps(document))
    assert sorted(read_transforms(folder).images) == [f"images/{k}.png" for k in range(6)]


def test_byte_order_marks(tmp_path: Path) -> None:
    folder = write(tmp_path / "in")
    text = (folder / "transforms.json").read_text()
    (folder / "transforms.json").write_text(text, encoding="utf-8-sig")
    assert len(read_transforms(folder).images) == 6
    for encoding in ("utf-16", "utf-32"):
        (folder / "transforms.json").write_text(text, encoding=encoding)
        with pytest.raises(
            InputError, match=r"json cannot be read: it is UTF-16 or UTF-32: save it as UTF-8"
        ):
            read_transforms(folder)
