"""Captures with files that are not photographs: pipes, devices, circles of links, other formats."""

import os
import signal
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose
from PIL import Image

from gsbench.gaussians.ply import check_ply, read_ply
from gsbench.init.point_files import read_points
from gsbench.scene.colmap import read_model
from gsbench.scene.images import (
    IMAGE_SUFFIXES,
    check_picture_names,
    image_size,
    lens_of,
    list_images,
    read_image,
)
from gsbench.scene.pipe import fingerprint
from tests.helpers import refusal, write
from tests.scene.captures import read_photos
from tests.scene.tables import TABLES

pytestmark = pytest.mark.skipif(
    not hasattr(os, "mkfifo"), reason="pipes and links of a POSIX system"
)
SECONDS = 20


@pytest.fixture(autouse=True)
def limit():
    """A test that hangs fails."""

    def stop(signum, frame):
        raise AssertionError("it hangs")

    earlier = signal.signal(signal.SIGALRM, stop)
    signal.alarm(SECONDS)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, earlier)


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    for name in ("a.png", "b.png", "c.png"):
        Image.fromarray(np.full((18, 24, 3), ord(name[0]), np.uint8)).save(folder / name)
    return folder


def odd_files(folder, suffix):
    """A pipe, a link to the endless device /dev/zero, and a link to the pipe."""
    os.mkfifo(folder / f"pipe{suffix}")
    (folder / f"zero{suffix}").symlink_to("/dev/zero")
    (folder / f"link{suffix}").symlink_to(folder / f"pipe{suffix}")
    return [folder / f"{name}{suffix}" for name in ("pipe", "zero", "link")]


READERS = [
    (".png", read_image),
    (".jpg", image_size),
    (".tif", lens_of),
    (".png", lambda path: fingerprint(path.parent, [path.name])),
    (".ply", read_ply),
    (".ply", check_ply),
    (".ply", read_points),
    (".txt", lambda path: read_photos(path.parent, test_list=str(path))),
]


@pytest.mark.parametrize("suffix, read", READERS)
def test_pipes_and_devices_are_refused(suffix, read, tmp_path, photos):
    for path in odd_files(tmp_path, suffix):
        with refusal("is not a regular file"):
            read(path)


def test_a_pipe_among_photographs_is_named(photos, tmp_path):
    os.mkfifo(photos / "d.png")
    with refusal(r"d\.png is not a regular file"):
        read_photos(tmp_path)


def test_a_pipe_is_not_read_as_a_model_file(tmp_path):
    for stem in ("cameras", "images", "points3D"):
        os.mkfifo(tmp_path / f"{stem}.bin")
    with refusal("no COLMAP model here"):
        read_model(tmp_path)


def test_links_in_a_circle_are_followed_once(photos):
    for name in ("a", "b"):
        (photos / name).symlink_to(".")
    (photos / "inner").mkdir()
    (photos / "inner" / "up").symlink_to("../..")
    write(photos.parent / "private" / "own.png", b"")  # above the capture: not read
    assert list_images(photos) == ["a.png", "b.png", "c.png"]


def test_images_are_listed_by_real_folders_and_outside_ones_by_their_link(photos, tmp_path):
    (photos / "z").mkdir()
    (photos / "a.png").rename(photos / "z" / "a.png")
    (photos / "alias").symlink_to("z")
    (tmp_path / "outside").mkdir()
    (photos / "b.png").rename(tmp_path / "outside" / "b.png")
    (photos / "far").symlink_to(tmp_path / "outside")
    (photos / ".hidden").mkdir()
    (photos / ".hidden" / "d.png").touch()
    assert list_images(photos) == ["c.png", "far/b.png", "z/a.png"]


@pytest.mark.parametrize("names, said", TABLES["files that may be photographs"])
def test_files_that_may_be_photographs_are_counted_in_a_warning(photos, caplog, names, said):
    for name in names:
        (photos / name).touch()
    assert list_images(photos) == ["a.png", "b.png", "c.png"]
    assert said in caplog.text
    assert bool(caplog.text) is bool(said)


def test_a_pointer_of_git_lfs_is_named(photos):
    (photos / "a.png").write_text("version https://git-lfs.github.com/spec/v1\n")
    with refusal(r"a\.png: not a readable image, but a pointer of Git LFS \(git lfs pull\)"):
        read_image(photos / "a.png")


def test_a_dangling_link_is_named(photos, tmp_path):
    (photos / "d.png").symlink_to("nowhere.png")
    with refusal(r"d\.png"):
        read_photos(tmp_path)


@pytest.mark.parametrize("form", TABLES["formats refused"])
def test_other_formats_are_refused_whatever_their_name(form, tmp_path):
    Image.new("RGB", (16, 16)).save(tmp_path / "a.bin", format=form)
    for suffix in IMAGE_SUFFIXES:
        path = tmp_path / f"a{suffix}"
        path.write_bytes((tmp_path / "a.bin").read_bytes())
        with refusal("not a readable image"):
            read_image(path)


@pytest.mark.parametrize("form", ["JPEG", "PNG", "WEBP", "TIFF", "BMP", "MPO"])
def test_the_formats_of_photographs_are_read_whatever_their_name(form, tmp_path):
    Image.new("RGB", (16, 12)).save(tmp_path / "a.jpg", format=form)
    assert read_image(tmp_path / "a.jpg").shape == (12, 16, 3)


@pytest.mark.parametrize(
    "exif",
    [b"Exif\0\0" + bytes(range(200)), b"Exif\0\0MM\0*\0\0\0\x08\xff\xff" + bytes(20), b"Exif"],
)
def test_damaged_exif_data_count_as_none(exif, tmp_path):
    Image.new("RGB", (16, 12)).save(tmp_path / "a.jpg", exif=exif)
    assert lens_of(tmp_path / "a.jpg") == "unknown camera"
    assert read_image(tmp_path / "a.jpg").shape == (12, 16, 3)


def test_names_too_long_or_equal_as_pictures_are_refused(photos, tmp_path):
    long = "ä" * 120 + ".png"  # 244 bytes
    (photos / "a.png").rename(photos / long)
    with refusal("a name of more than 220 bytes"):
        read_photos(tmp_path, test_every=2)
    with refusal(r"the pictures of a/b\.png and a__b\.jpg would both be a__b\.png"):
        check_picture_names(["a/b.png", "a__b.jpg"], photos)
    check_picture_names(["a/b.png", "a/c.png"], photos)


def synthetic(cameras):
    """A synthetic model; each of its rigs has ``cameras`` cameras."""
    options = pycolmap.SyntheticDatasetOptions(num_frames_per_rig=3, num_points3D=12)
    options.num_cameras_per_rig, options.sensor_from_rig_rotation_stddev = cameras, 5.0
    return pycolmap.synthesize_dataset(options)


@pytest.mark.parametrize("kind", ["binary", "text"])
@pytest.mark.parametrize("file", ["frames", "rigs", "images"])
@pytest.mark.parametrize("length", [1.001, 2.0, 0.01])
def test_quaternions_of_any_length_are_normalised(kind, file, length, tmp_path):
    model = synthetic(2)
    model.write_text(tmp_path)
    lines = (tmp_path / f"{file}.txt").read_text().split("\n")
    first = next(number for number, line in enumerate(lines) if line and not line.startswith("#"))
    words, at = lines[first].split(), {"frames": 2, "rigs": 7, "images": 1}[file]
    words[at : at + 4] = [repr(float(word) * length) for word in words[at : at + 4]]
    lines[first] = " ".join(words)
    (tmp_path / f"{file}.txt").write_text("\n".join(lines))
    if kind == "binary":
        scaled = pycolmap.Reconstruction(tmp_path)
        for path in tmp_path.iterdir():
            path.unlink()
        scaled.write_binary(tmp_path)
    read = read_model(tmp_path)
    for image_id, image in model.images.items():
        found = read.images[image_id].cam_from_world().matrix()
        assert_allclose(found, image.cam_from_world().matrix(), atol=1e-9)


def test_a_folder_that_cannot_be_read_to_its_end_is_no_smaller_capture(tmp_path, monkeypatch):
    (tmp_path / "broken").mkdir()

    def scan(folder):
        if Path(folder).name == "broken":
            raise OSError(5, "Input/output error")
        return scandir(folder)

    scandir = os.scandir
    monkeypatch.setattr(os, "scandir", scan)
    with pytest.raises(OSError, match="Input/output error"):
        list_images(tmp_path)
