"""COLMAP models fitted to files: sizes, subsets, names, poses."""

import shutil
import struct

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

from gsbench.scene.colmap import model_points, read_model, read_reference, write_model
from gsbench.scene.types import Camera
from tests.helpers import refusal
from tests.scene.cameras import cameras_of
from tests.scene.captures import read_colmap
from tests.scene.tables import TABLES

from .conftest import smooth_image


def reprojection_errors(model):
    """All distances in px between projected 3D and stored 2D points, by pycolmap's own cameras."""
    errors = []
    for point in model.points3D.values():
        for element in point.track.elements:
            image = model.images[element.image_id]
            seen = image.points2D[element.point2D_idx]
            assert seen.has_point3D()
            errors.append(np.linalg.norm(image.project_point(point.xyz) - seen.xy))
    return errors


@pytest.mark.parametrize("model, params", TABLES["cameras of larger photographs"])
def test_cameras_follow_smaller_files(make_scene, model, params):
    # 162/4 = 40.5, 121/4 = 30.25
    root = make_scene(size=(41, 30), camera_size=(162, 121), model=model, params=params)
    fitted = read_reference(read_colmap(root))
    camera = next(iter(fitted.cameras.values()))
    assert (camera.width, camera.height) == (41, 30)
    assert camera.focal_length_x == pytest.approx(160 * 41 / 162)
    assert camera.focal_length_y == pytest.approx(
        params[-3 if model == "SIMPLE_PINHOLE" else 1] * 30 / 121
    )
    assert fitted.num_points3D() == 9
    assert max(reprojection_errors(fitted)) < 1e-9
    original = read_model(root / "sparse/0")
    assert fitted.points3D[1].color.tolist() == original.points3D[1].color.tolist()


def test_subset_drops_images_and_their_observations(make_scene, tmp_path):
    fitted = read_reference(read_colmap(make_scene(), max_images=3))
    assert sorted(image.name for image in fitted.images.values()) == ["00.png", "02.png", "04.png"]
    assert {point.track.length() for point in fitted.points3D.values()} == {3}
    assert max(reprojection_errors(fitted)) < 1e-9
    (tmp_path / "out").mkdir()
    fitted.write_binary(tmp_path / "out")
    again = read_model(tmp_path / "out")
    assert again.num_reg_images() == 3
    assert_array_equal(model_points(again)[0], model_points(fitted)[0])


def test_points_that_fewer_than_two_kept_images_see_are_dropped(make_scene):
    root = make_scene()
    model = read_model(root / "sparse/0")
    # point 1, the first 2D point of every image, stays in 00.png and 01.png only
    for image_id in (3, 4, 5, 6):
        model.delete_observation(image_id, 0)
    model.write_binary(root / "sparse/0")
    fitted = read_reference(read_colmap(root, max_images=3))
    assert sorted(fitted.points3D) == list(range(2, 10))


def test_files_of_one_camera_get_a_camera_for_each_size(make_scene):
    root = make_scene(size=(40, 30))
    Image.fromarray(smooth_image(80, 60)).save(root / "images/02.png")
    cameras = cameras_of(read_reference(read_colmap(root)))
    assert (cameras["02.png"].width, cameras["02.png"].fx) == (80, 100.0)
    assert (cameras["03.png"].width, cameras["03.png"].fx) == (40, 50.0)


def test_an_image_of_another_shape_than_its_camera_is_refused(make_scene):
    root = make_scene(size=(40, 30))
    Image.fromarray(smooth_image(40, 26)).save(root / "images/01.png")
    with refusal(r"01\.png: the image is 40x26 px but its camera in the COLMAP model 40x30"):
        read_reference(read_colmap(root))
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(smooth_image(30, 40)).save(root / "images/01.png", exif=exif)
    with refusal(r"01\.png.*on its side, and COLMAP ignores EXIF"):
        read_reference(read_colmap(root))


def test_distorted_cameras_are_not_pinholes(make_scene):
    root = make_scene(model="SIMPLE_RADIAL", params=[50, 20, 15, 0.1])
    with refusal("SIMPLE_RADIAL is distorted"):
        cameras_of(read_model(root / "sparse/0"))


def test_written_cameras_project_points_to_the_same_pixels(tmp_path):
    rng = np.random.default_rng(5)
    cameras = {}
    for k in range(4):
        rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        rotation *= np.sign(np.linalg.det(rotation))
        intrinsics = (64, 48, 60.0 + (k > 1), 61.0, 31.0, 25.0)
        cameras[f"{k}.png"] = Camera(*intrinsics, rotation, rng.normal(size=3))
    write_model(tmp_path / "model", cameras)
    model = pycolmap.Reconstruction(tmp_path / "model")
    assert model.num_cameras() == 2
    for name, camera in cameras.items():
        point = camera.rotation.T @ (np.array([0.3, -0.2, 2.0]) - camera.translation)
        expected = [camera.fx * 0.15 + camera.cx, camera.fy * -0.1 + camera.cy]
        image, back = model.find_image_with_name(name), cameras_of(model)[name]
        assert_allclose(image.project_point(point), expected, atol=1e-9)
        assert_allclose(back.rotation, camera.rotation, atol=1e-12)
        assert_allclose(back.center, image.projection_center(), atol=1e-12)


PLAIN = {
    "cameras": "1 PINHOLE 40 30 50 50 20 15",
    "images": "1 1 0 0 0 0 0 5 1 a.png\n1 2 -1\n2 1 0 0 0 0 0 6 1 b c.png\n",
    "points3D": "1 0 0 5 0 255 0 0.1 1 0",
}


def write_text_model(folder, **files):
    """A small model as text, with ``files`` instead of some of its own."""
    for stem, text in (PLAIN | files).items():
        (folder / f"{stem}.txt").write_text(f"# a comment\n{text}\n\n")
    return folder


def test_names_with_blanks_and_empty_second_lines_are_read(tmp_path):
    model = read_model(write_text_model(tmp_path))
    assert sorted(image.name for image in model.images.values()) == ["a.png", "b c.png"]
    assert model.points3D[1].color.tolist() == [0, 255, 0]
    # a name and points that may be mixed up
    numbers = "1 1 0 0 0 0 0 5 1 1\n1 2 -1 3 4 -1 5 6 -1 7 8 -1"
    assert read_model(write_text_model(tmp_path, images=numbers)).images[1].name == "1"


POSED = "1 1 0 0 0 0 0 5 1"


@pytest.mark.parametrize("stem, text, said", TABLES["bad lines"])
def test_a_bad_line_of_a_text_model_is_named(tmp_path, stem, text, said):
    with refusal(rf"{tmp_path}.*{said}"):
        read_model(write_text_model(tmp_path, **({"points3D": ""} | {stem: text})))


@pytest.mark.parametrize("name", list(pycolmap.CameraModelId.__members__)[1:])
def test_cameras_of_all_models_are_read_and_need_a_focal_length(tmp_path, name):
    camera = pycolmap.Camera.create_from_model_name(1, name, 50.0, 40, 20)
    for change in (None, *camera.focal_length_idxs()):
        params = [0.0 if place == change else value for place, value in enumerate(camera.params)]
        line = " ".join(["1", name, "40 20", *map(str, params)])
        write_text_model(tmp_path, cameras=line)
        if change is None:
            assert read_model(tmp_path).cameras[1].model_name == name
        else:
            with refusal("camera 1 is damaged"):
                read_model(tmp_path)


@pytest.fixture(params=["bin", "txt"])
def rigs(request, tmp_path):
    """A model of two rigs with three cameras each, as COLMAP writes it."""
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=2, num_cameras_per_rig=3, num_frames_per_rig=2, num_points3D=9
    )
    model = pycolmap.synthesize_dataset(options)
    (model.write_binary if request.param == "bin" else model.write_text)(tmp_path)
    return tmp_path


@pytest.mark.parametrize("stem", ["cameras", "images", "points3D", "rigs", "frames"])
def test_each_file_of_a_model_with_rigs_is_read_to_its_end(rigs, stem):
    read_model(rigs)
    (file,) = rigs.glob(f"{stem}.*")
    whole = file.read_bytes()
    many = struct.pack("<Q", 2**60) + whole[8:]  # a count that the file cannot hold
    binary = file.suffix == ".bin"
    torn = (
        (whole[:-1], whole[:-9], whole + b"\0", many, b"") if binary else (b"1 2", whole + b"\xff")
    )
    for content in torn:
        file.write_bytes(content)
        with refusal(f"{rigs}.*: (copy or export|a line must be|rename)"):
            read_model(rigs)


@pytest.mark.parametrize("stem, start, at, said", TABLES["quaternions of rigs"])
def test_a_zero_quaternion_of_a_rig_or_a_frame_is_refused(rigs, stem, start, at, said):
    """The quaternion at byte ``start``, or at word ``at`` of a text line, becomes zero."""
    (file,) = rigs.glob(f"{stem}.*")
    if file.suffix == ".bin":
        data = file.read_bytes()
        file.write_bytes(data[:start] + bytes(32) + data[start + 32 :])
    else:
        first, *rest = [line for line in file.read_text().splitlines() if not line.startswith("#")]
        words = first.split()
        words[at : at + 4] = ["0"] * 4
        file.write_text("\n".join([" ".join(words), *rest]))
    with refusal(f"{said} has no pose that can be used"):
        read_model(rigs)


@pytest.mark.parametrize("text", [False, True])
def test_a_name_in_a_code_page_is_named(make_scene, text):
    root = make_scene(names=[f"{k:04d}.png" for k in range(4)], text=text)
    file = root / "sparse/0" / ("images.txt" if text else "images.bin")
    file.write_bytes(file.read_bytes().replace(b"0003.png", "가나.png".encode("cp949")))
    with refusal(
        r"not UTF-8 .*\\xb0\\xa1\\xb3\\xaa.png.*: rename the photographs to ASCII"
    ) as caught:
        read_colmap(root)
    assert "export it again" not in str(caught.value)


@pytest.mark.parametrize("text", [False, True])
def test_points_of_files_that_disagree_are_read_without_tracks(make_scene, caplog, text):
    """images.* of one model beside points3D.* of another, in which each point has another id."""
    root = make_scene(text=text)
    whole = read_model(root / "sparse/0")
    lines = root / "images.txt"
    whole.write_text(root)
    rows = lines.read_text().splitlines()
    for at in range(rows.index(next(row for row in rows if row[0] != "#")) + 1, len(rows), 2):
        words = rows[at].split()
        words[2::3] = [str(int(word) % 9 + 1) for word in words[2::3]]
        rows[at] = " ".join(words)
    lines.write_text("\n".join(rows) + "\n")
    if text:
        shutil.copy(lines, root / "sparse/0/images.txt")
    else:
        with pytest.raises(Exception, match="Check failed"):
            pycolmap.Reconstruction(root)
        data = (root / "sparse/0/images.bin").read_bytes()
        swapped = bytearray(data)
        first = data.index(b"00.png\0") + 7 + 8 + 16
        struct.pack_into("<Q", swapped, first, 2)
        (root / "sparse/0/images.bin").write_bytes(bytes(swapped))
    model = read_model(root / "sparse/0")
    assert "points are read without the images that see them" in caplog.text
    assert len(model.points3D) == len(whole.points3D) == 9
    for image_id, image in whole.images.items():
        assert_allclose(
            model.images[image_id].cam_from_world().matrix(), image.cam_from_world().matrix()
        )
    assert not any(point.track.elements for point in model.points3D.values())


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_pointer_of_git_lfs_is_named(make_scene, name):
    folder = make_scene() / "sparse/0"
    (folder / name).write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:4e\n")
    with refusal(rf"{name}: a pointer of Git LFS \(git lfs pull\)"):
        read_model(folder)
