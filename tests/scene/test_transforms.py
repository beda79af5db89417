"""transforms.json: cameras by the documented formulas; missing, damaged and unusual files."""

import json
import math
import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image

from gsbench.init.base import read_cloud
from gsbench.pipeline.steps.scene import CaptureSource, masked_capture, masking_step
from gsbench.scene import transforms
from gsbench.scene.colmap import read_model, read_reference
from gsbench.scene.options import SceneConfig
from gsbench.scene.transforms import KEYS, read_transforms
from tests.helpers import change_json, read_json, refusal
from tests.scene.cameras import cameras_of
from tests.scene.captures import read_with_step
from tests.scene.tables import TABLES

SHARED = {"w": 40, "h": 30, "fl_x": 50.0, "fl_y": 51.0, "cx": 19.5, "cy": 15.5}


def looking_at_origin(eye):
    """Camera to world [4, 4] in OpenGL's axes: x right, y up, looking along -z; z is up."""
    back = eye / np.linalg.norm(eye)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([right, np.cross(back, right), back, eye])
    return matrix


EYES = [np.array([3 * math.cos(a), 3 * math.sin(a), 1.0]) for a in np.linspace(0, 5, 6)]


def write(folder, edit=None, **changes):
    """A folder with six photographs and a transforms.json with ``changes``, edited by ``edit``."""
    frames = []
    for k, eye in enumerate(EYES):
        path = folder / "images" / f"{k}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (40, 30), (40 * k, 100, 100)).save(path)
        matrix = looking_at_origin(eye).tolist()
        frames.append({"file_path": f"./images/{k}.png", "transform_matrix": matrix})
    document = SHARED | {"frames": frames} | changes
    if edit is not None:
        edit(document)
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder


def cameras(folder, edit=None, **changes):
    """The cameras by name of a `write` folder."""
    rows = read_transforms(write(folder, edit, **changes)).photographs
    return {row.name: row.camera for row in rows}


def in_each_frame(**keys):
    """An edit that gives all frames these keys."""
    return lambda document: [frame.update(keys) for frame in document["frames"]]


def in_frame(number, **keys):
    return lambda document: document["frames"][number].update(keys)


def capture_of(folder, **options):
    work = Path(tempfile.mkdtemp(dir=folder.parent))
    return read_with_step(folder, work, name="t", kind="transforms", **options)


def project(model, name, point):
    image = model.find_image_with_name(name)
    return model.cameras[image.camera_id].img_from_cam(image.cam_from_world() * point)


def test_points_are_projected_by_the_formulas_of_the_format(tmp_path):
    """x is right, y up, z towards the viewer: column cx + fl_x x/-z, row cy - fl_y y/-z."""
    model = read_model(capture_of(write(tmp_path)).model)
    for k, eye in enumerate(EYES):
        for point in (np.zeros(3), np.array([0.3, -0.2, 0.1])):
            x, y, z, _ = np.linalg.inv(looking_at_origin(eye)) @ [*point, 1]
            wanted = [19.5 + 50 * x / -z, 15.5 - 51 * y / -z]
            assert_allclose(project(model, f"images/{k}.png", point), wanted, atol=1e-9)
    above, origin = (project(model, "images/0.png", np.array([0, 0, z])) for z in (0.5, 0))
    assert above[1] < origin[1], "what is higher is further up in the picture"


def test_the_applied_transform_is_undone_for_cameras_and_points(tmp_path):
    """The file holds applied_scale (R p + t); cameras and the PLY get their original places."""
    plain = capture_of(write(tmp_path / "plain"))
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
    names = ["double x", "double y", "double z", "uchar red", "uchar green", "uchar blue"]
    header = ["ply", "format ascii 1.0", "element vertex 5", *(f"property {n}" for n in names)]
    (folder / "p.ply").write_text("\n".join([*header, "end_header", *lines, ""]))
    moved = capture_of(folder)
    one, other = (cameras_of(read_model(capture.model)) for capture in (plain, moved))
    for name, camera in one.items():
        assert_allclose(camera.rotation, other[name].rotation, atol=1e-9)
        assert_allclose(camera.translation, other[name].translation, atol=1e-9)
    for capture in (moved, capture_of(in_blenders_files(folder))):
        cloud = read_cloud(capture.model)
        assert_allclose(cloud.points, points, atol=1e-9)
        assert cloud.colors.tolist() == [[10, 20, k] for k in range(5)]


IDENTITY = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]


@pytest.mark.parametrize("change, said", TABLES["files with other points"])
def test_two_files_must_name_the_same_points_under_one_transform(tmp_path, change, said):
    folder = in_blenders_files(write(tmp_path, ply_file_path="a.ply"))
    for name in ("a.ply", "b.ply"):
        (folder / name).write_text("ply")
    assert read_transforms(folder).points.path == folder / "a.ply"
    # the other file has no transform, which means the identity
    test = folder / "transforms_test.json"
    change_json(test, ply_file_path="a.ply", applied_transform=IDENTITY)
    assert read_transforms(folder).points.path == folder / "a.ply"
    change_json(test, **change)
    with refusal(said):
        read_transforms(folder)


def in_blenders_files(folder):
    """The same folder with a file of training views, and one of test views without a transform."""
    document = read_json(folder / "transforms.json")
    (folder / "transforms.json").rename(folder / "transforms_train.json")
    test = {"file_path": "images/test.png", "transform_matrix": looking_at_origin(EYES[0]).tolist()}
    (folder / "images" / "test.png").write_bytes((folder / "images" / "0.png").read_bytes())
    left_out = ("applied_transform", "applied_scale", "ply_file_path")
    without = {key: value for key, value in document.items() if key not in left_out}
    (folder / "transforms_test.json").write_text(json.dumps(without | {"frames": [test]}))
    return folder


@pytest.mark.parametrize("said, model, params", TABLES["intrinsics"])
def test_intrinsics_are_read_from_the_file_or_from_each_frame(tmp_path, said, model, params):
    def move_to_frames(document):
        in_each_frame(**{key: document.pop(key) for key in SHARED}, **said)(document)
        document["frames"][2]["fl_x"] = 60.0

    frames = cameras(tmp_path / "own", move_to_frames)
    for camera in (cameras(tmp_path / "shared", **said)["images/3.png"], frames["images/3.png"]):
        assert (camera.name, camera.width, camera.height) == (model, 40, 30)
        assert list(camera.params) == [50, 51, 19.5, 15.5, *params]
    assert frames["images/2.png"].params[0] == 60


def test_blender_scenes_with_their_angle_names_split_and_alpha_are_read(tmp_path):
    """NeRF's synthetic scenes: focal = .5 w / tan(.5 angle), test views in transforms_test.json."""
    angle = 0.6911112070083618
    for part, count in (("train", 5), ("test", 3), ("val", 2)):
        frames = []
        for k in range(count):
            path = tmp_path / part / f"r_{k}.png"
            path.parent.mkdir(exist_ok=True)
            pixels = np.zeros((40, 40, 4), np.uint8)
            pixels[10:30, 10:30] = (200, 40, 40, 255)
            pixels[5, 5] = (255, 0, 0, 128)
            pixels[21, 24] = (10 * count, 10 * k, 0, 255)  # makes all photographs different
            Image.fromarray(pixels).save(path)
            matrix = looking_at_origin(EYES[k]).tolist()
            frames.append({"file_path": f"./{part}/r_{k}", "transform_matrix": matrix})
        document = {"camera_angle_x": angle, "frames": frames}
        (tmp_path / f"transforms_{part}.json").write_text(json.dumps(document))
    capture = capture_of(tmp_path, split="list")
    assert capture.test_names == tuple(f"test/r_{k}.png" for k in range(3))
    assert capture.train_names == tuple(f"train/r_{k}.png" for k in range(5))
    camera = {row.name: row.camera for row in read_transforms(tmp_path).photographs}[
        "train/r_0.png"
    ]
    assert camera.params == pytest.approx((0.5 * 40 / math.tan(0.5 * angle),) * 2 + (20, 20))
    # held out by scene.split, not by the files
    assert capture_of(tmp_path).test_names == ("test/r_0.png",)
    assert not any(name.startswith("val/") for name in read_transforms(tmp_path).names)
    (tmp_path / "transforms_test.json").unlink()
    assert read_transforms(tmp_path).named("test") == ["val/r_0.png", "val/r_1.png"]
    assert masking_step(capture, "black") is None
    step = masking_step(capture, "white")
    (tmp_path / "white").mkdir()
    step.build(tmp_path / "white")
    white = masked_capture(capture, tmp_path / "white")
    with Image.open(white.images / "train/r_0.png") as picture:
        assert picture.mode == "RGB"
        assert picture.getpixel((0, 0)) == (255, 255, 255)
        assert picture.getpixel((20, 20)) == (200, 40, 40)
        assert picture.getpixel((5, 5))[1] == pytest.approx(127, abs=1)


def test_a_line_says_which_of_both_forms_of_a_scene_is_read(tmp_path, caplog):
    folder = write(tmp_path)
    shutil.copy(folder / "transforms.json", folder / "transforms_train.json")
    read_transforms(folder)
    assert "transforms.json is read, and transforms_train.json not" in caplog.text


def test_masks_and_depth_maps_that_frames_name_are_columns_of_the_record(tmp_path):
    folder = write(tmp_path, in_frame(1, mask_path="masks/1.png", depth_file_path="d/1.npy"))
    (folder / "masks" / "images").mkdir(parents=True)
    Image.new("L", (40, 30), 255).save(folder / "masks/1.png")
    for k in range(6):
        Image.new("L", (40, 30), 255).save(folder / "masks" / "images" / f"{k}.png.png")
    found = capture_of(folder)
    assert found.masks == {"images/1.png": folder / "masks/1.png"}
    assert found.beside == {"depth": {"images/1.png": folder / "d/1.npy"}}
    found = capture_of(folder, masks="masks")
    assert found.masks["images/2.png"] == folder / "masks/images/2.png.png"


def test_the_file_is_read_once_and_changes_the_fingerprint(tmp_path, monkeypatch):
    read, files = transforms.read_bytes, []
    monkeypatch.setattr(transforms, "read_bytes", lambda path: files.append(path) or read(path))
    folder = write(tmp_path)
    capture = capture_of(folder)
    assert files == [*capture.read_from] == [folder / "transforms.json"]
    write(folder, fl_x=49.0)
    assert capture_of(folder).fingerprint != capture.fingerprint


REFUSED_ROWS = [(key, f"{key}: {reason}") for key, reason in KEYS["refused"].items()]
SIZE = {"w": 20, "h": 15}


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda d: d.pop("frames"), "lacks 'frames'"),
        (lambda d: d["frames"][1].pop("transform_matrix"), "lacks 'frames.1.transform_matrix'"),
        *((lambda d, keys=keys: d.update(keys), said) for keys, said in TABLES["wrong keys"]),
        *((lambda d, key=key: d.update({key: [0.0, 0.5]}), said) for key, said in REFUSED_ROWS),
        *((in_frame(1, **keys), said) for keys, said in TABLES["wrong frames"]),
    ],
)
def test_a_file_that_cannot_be_understood_is_named_in_one_line(tmp_path, change, said):
    folder = write(tmp_path, change)
    with refusal(said) as caught:
        read_transforms(folder)
    assert str(folder / "transforms.json") in str(caught.value)


def test_images_one_pixel_wide_are_accepted_and_a_missing_side_is_measured(tmp_path):
    write(tmp_path)
    for k in range(len(EYES)):
        Image.new("RGB", (1, 30)).save(tmp_path / f"images/{k}.png")
    change_json(tmp_path / "transforms.json", w=1)
    rows = read_transforms(tmp_path).photographs
    assert {row.camera.width for row in rows} == {1}
    for side in ("w", "h"):
        for camera in cameras(tmp_path, **{side: None}).values():
            assert (camera.width, camera.height) == (40, 30)


def test_a_missing_file_and_a_name_that_fits_two_images_are_refused(tmp_path):
    with refusal(r"neither transforms\.json nor transforms_train\.json is here"):
        read_transforms(tmp_path)
    folder = write(tmp_path, in_frame(0, file_path="images/0"))
    Image.new("RGB", (40, 30)).save(folder / "images" / "0.jpg")
    with refusal(r"images/0 may be images/0\.jpg or images/0\.png: keep one"):
        read_transforms(folder)


def test_images_without_a_file_are_left_out(tmp_path, caplog):
    folder = write(tmp_path)
    (folder / "images" / "4.png").unlink()
    assert len(capture_of(folder).image_names) == 5
    assert "1 image with a camera but without a file: ./images/4.png" in caplog.text


def reduced(folder, name="images_2"):
    """Add the photographs of ``folder`` at .6 of their size."""
    for file in (folder / "images").iterdir():
        (folder / name).mkdir(exist_ok=True)
        Image.open(file).resize((24, 18)).save(folder / name / file.name)
    return folder


@pytest.mark.parametrize("keep", [True, False])
def test_scene_images_replaces_the_folder_that_the_file_names(tmp_path, keep):
    folder = reduced(write(tmp_path))
    if not keep:
        shutil.rmtree(folder / "images")
    capture = capture_of(folder, images="images_2")
    assert capture.image_names == tuple(f"images_2/{k}.png" for k in range(6))
    fitted = read_reference(capture)
    change_json(
        folder / "transforms.json",
        train_filenames=[f"images/{k}.png" for k in range(4)],
        test_filenames=["images/5"],
    )
    raw = read_transforms(folder, image_folder="images_2")
    assert (len(raw.named("train")), raw.named("test")) == (4, ["images_2/5.png"])
    for camera in fitted.cameras.values():
        assert (camera.width, camera.height) == (24, 18)
        assert camera.focal_length_x == pytest.approx(50 * 0.6)
    with refusal(r"nowhere: no such folder; set scene.images to one of"):
        capture_of(folder, images="nowhere")


def test_an_error_says_that_another_folder_may_have_the_named_files(tmp_path):
    folder = reduced(write(tmp_path))
    shutil.rmtree(folder / "images")
    with refusal(
        r"0 images with a file and a camera in transforms.json, while ./images/0.png, .* have no "
        r"file, but at least 3 are needed: set scene.images to the folder of the photographs"
    ):
        capture_of(folder)


def focal(side, angle):
    return 0.5 * side / math.tan(angle / 2)


@pytest.mark.parametrize("said, x, y", TABLES["fields of view"])
@pytest.mark.parametrize("edit", [in_each_frame, lambda **said: lambda d: d.update(said)])
def test_focal_lengths_follow_from_every_way_to_give_a_field_of_view(tmp_path, said, x, y, edit):
    wanted = [focal(*value) if isinstance(value, list) else value for value in (x, y)]
    for camera in cameras(tmp_path, edit(**said), fl_x=None, fl_y=None).values():
        assert camera.params[:2] == pytest.approx(tuple(wanted))


def test_a_frame_with_a_field_of_view_of_its_own_uses_no_focal_length_of_the_file(tmp_path):
    def edit(document):
        for number, keys in enumerate(({"camera_angle_x": 0.5}, {"x_fov": 70.0}, {"fl_x": 70.0})):
            document["frames"][number].update(keys)

    found = [camera.params[0] for camera in cameras(tmp_path, edit).values()]
    assert found == pytest.approx([focal(40, 0.5), focal(40, math.radians(70)), 70, 50, 50, 50])


def test_a_focal_length_that_contradicts_the_field_of_view_is_used_with_one_line(tmp_path, caplog):
    def read(edit=None, **changes):
        return capture_of(write(tmp_path, edit, **changes))

    read(camera_angle_x=2 * math.atan(20 / 50 * 1.02))
    own = SIZE | {"fl_x": 25, "fl_y": 25, "cx": 10, "cy": 7.5}
    read(in_frame(2, **own, **{"camera_angle_x": 2 * math.atan(10 / 25)}))
    assert not caplog.text
    read(camera_angle_x=0.3)
    assert caplog.text.count("its focal length is 50 px, but its field of view means 132.") == 1


@pytest.mark.parametrize("cx, cy, refused", TABLES["principal points"])
def test_a_principal_point_of_a_larger_photograph_asks_for_its_size(tmp_path, cx, cy, refused):
    with refusal("another size than 40x30 px: add w and h" if refused else None):
        found = cameras(tmp_path, w=None, h=None, cx=cx, cy=cy)
        assert found["images/2.png"].params[2:] == (cx, cy)


@pytest.mark.parametrize("said", TABLES["higher coefficients"])
def test_higher_coefficients_distort_as_in_opencv(tmp_path, said):
    """OpenCV: (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)."""
    capture = capture_of(write(tmp_path, k1=0.1, k2=-0.02, **said))
    model = read_model(capture.model)
    k = {key: said.get(key, 0.0) for key in ("k3", "k4", "k6")}
    for x, y in ((0.3, -0.2), (-0.6, 0.5)):
        r2 = x * x + y * y
        factor = 1 + 0.1 * r2 - 0.02 * r2**2 + k["k3"] * r2**3
        factor /= 1 + k["k4"] * r2 + k["k6"] * r2**3
        wanted = [19.5 + 50 * x * factor, 15.5 + 51 * y * factor]
        seen = next(iter(model.cameras.values())).img_from_cam(np.array([x, y, 1.0]))
        assert_allclose(seen, wanted, atol=1e-9)


def test_known_keys_without_effect_are_ignored_without_a_warning(tmp_path, caplog):
    wanted = cameras(tmp_path)
    known = [*KEYS["harmless"], *KEYS["refused"]]
    for value in (None, 0, False, [0.0, 0.0], 1.5, "text", [1.0]):
        keys = KEYS["harmless"] if value else known
        if value is not None:
            keys = [key for key in keys if not key.startswith("transform_matrix")]
        assert cameras(tmp_path, **dict.fromkeys(keys, value)) == wanted
    assert not caplog.text


def test_black_transparent_is_refused_where_transparent_pixels_become_white(tmp_path):
    folder = write(tmp_path, black_transparent=True)
    assert CaptureSource(SceneConfig(name="t", kind="transforms", path=str(folder))).step
    white = SceneConfig(name="t", kind="transforms", path=str(folder), transparent="white")
    with refusal(r"black_transparent: .*save the files so"):
        _ = CaptureSource(white).step


def test_unknown_keys_are_named_in_one_line(tmp_path, caplog):
    read_transforms(write(tmp_path, in_each_frame(lens="wide"), exporter="x", fl_X=3.0))
    (record,) = caplog.records
    assert record.getMessage().endswith("3 keys are not known and not used: exporter, fl_X, lens")


@pytest.mark.parametrize("lists, train, test", TABLES["lists of nerfstudio"])
def test_nerfstudios_lists_of_filenames_are_the_split(tmp_path, lists, train, test, caplog):
    def names(numbers):
        return tuple(f"images/{k}.png" for k in numbers)

    named = {f"{part}_filenames": names(numbers) for part, numbers in lists.items()}
    folder = write(tmp_path, **named)
    capture = capture_of(folder, split="list")
    assert (capture.train_names, capture.test_names) == (names(train), names(test))
    assert not caplog.text
    assert len(capture_of(folder).image_names) == 6
    assert "its own split: scene.split=list uses it" in caplog.text


@pytest.mark.parametrize("written", ["images/4.JPG", "images/4", "IMAGES/4.PNG", "images\\4.jpeg"])
def test_a_file_is_found_whatever_its_extension_and_capitals(tmp_path, written):
    folder = write(tmp_path, in_frame(4, file_path=written))
    assert read_transforms(folder).names == [f"images/{k}.png" for k in range(6)]


def test_a_byte_order_mark_of_utf8_is_skipped_and_other_encodings_are_named(tmp_path):
    file = write(tmp_path) / "transforms.json"
    text = file.read_text()
    file.write_text(text, encoding="utf-8-sig")
    assert len(read_transforms(tmp_path).names) == 6
    file.write_text(text.replace("images/3", "Küche/3"), encoding="cp1252")
    with refusal(r"line 1 is not UTF-8 .*: save it as UTF-8"):
        read_transforms(tmp_path)
