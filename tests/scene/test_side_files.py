"""Files beside photographs: masks, thumbnails, smaller copies and other results."""

import numpy as np
import pytest
from PIL import Image, ImageOps

from gsbench.scene.images import list_images
from gsbench.scene.readers import read_photos
from gsbench.scene.side_files import photographs_among
from tests.helpers import refusal
from tests.scene.conftest import smooth_image

COUNT = 5


def photographs(folder, pattern="{}.jpg", scale=1, seed=0, change=lambda picture: picture):
    for k in range(COUNT):
        file = folder / pattern.format(k)
        file.parent.mkdir(parents=True, exist_ok=True)
        picture = Image.fromarray(smooth_image(80 // scale, 64 // scale, seed + k))
        change(picture).save(file)
    return folder


def normals(picture):
    vectors = np.asarray(picture) / 127.5 - 1
    vectors /= np.maximum(np.linalg.norm(vectors, axis=2, keepdims=True), 0.01)
    return Image.fromarray(np.rint(127.5 * (vectors + 1)).astype(np.uint8))


@pytest.mark.parametrize(
    "pattern, scale, named",
    [
        ("masks/{}.jpg.png", 1, "masks/ (5)"),
        ("Mask/{}.png", 1, "Mask/ (5)"),
        ("image_masks_v2/{}.png", 1, "image_masks_v2/"),
        ("maskImages/{}.png", 1, "maskImages/"),
        ("@eaDir/{}.jpg/SYNOPHOTO_THUMB_M.jpg", 4, "@eaDir/ (5)"),
        ("#recycle/old/{}.jpg", 1, "#recycle/"),
        ("__MACOSX/{}.jpg", 1, "__MACOSX/"),
        ("previews/{}.webp", 2, "previews/"),
        ("depth/{}.png", 1, "depth/"),
        ("depthMaps/cam/{}.png", 1, "depthMaps/"),
        ("normals/{}.png", 1, "normals/"),
        ("a/thumbs/{}.jpg", 4, "a/thumbs/"),
        ("runs/store/scene/x/{}.png", 1, "runs/"),
        ("labels/{}.png", 1, "labels/"),
        ("{}_mask.png", 1, "…mask.png (5)"),
        ("{}.jpg.mask.png", 1, "…mask.png (5)"),
        ("{}_mask.jpg.png", 1, "…mask.png (5)"),
        ("mask{}.png", 1, "…mask.png (5)"),
        ("{}_mask0.png", 1, "…mask.png (5)"),
        ("{}(Mask).png", 1, "…mask.png (5)"),
        ("{}_depth_0001.png", 1, "…depth.png (5)"),
        ("img_{}_depth.png", 1, "…depth.png (5)"),
        ("{}.jpg.png", 1, "….*.png (5)"),
        ("depth_{}.png", 1, "…depth.png"),
        ("SYNOPHOTO_THUMB_{}.jpg", 4, "SYNO….jpg"),
        (".thumbnails/{}.jpg", 4, ""),
    ],
)
def test_other_files_beside_photographs_change_no_capture(tmp_path, caplog, pattern, scale, named):
    alone = read_photos("a", photographs(tmp_path / "alone"))
    caplog.clear()
    beside = read_photos("a", photographs(photographs(tmp_path / "beside"), pattern, scale))
    assert (beside.image_names, beside.fingerprint) == (alone.image_names, alone.fingerprint)
    assert named in caplog.text
    assert len(caplog.records) == bool(named)


@pytest.mark.parametrize(
    "own, pattern, change",
    [
        ("frame-{}.color.jpg", "frame-{}.depth.png", ImageOps.grayscale),
        ("rgb_{}.jpg", "depth_{}.png", lambda picture: picture),
        ("{}.jpg", "sam/{}.png", ImageOps.grayscale),
        ("{}.jpg", "x/000{}_7.png", lambda picture: picture.convert("I;16")),
        ("{}.jpg", "{}_b.png", lambda picture: ImageOps.posterize(picture, 1)),
        ("{}.jpg", "normal/{}.png", normals),
        ("{}.jpg", "tn_{}.jpg", lambda picture: picture.resize((30, 24))),
        ("{}.jpg", "lowres/{}.png", lambda picture: picture.resize((33, 27))),
        ("a{}.png", "a{}@half.png", lambda picture: picture.resize((40, 32))),
    ],
)
def test_pictures_made_from_photographs_are_told_by_their_pixels(tmp_path, own, pattern, change):
    folder = photographs(photographs(tmp_path, own), pattern, change=change)
    assert read_photos("a", folder).image_names == tuple(own.format(k) for k in range(COUNT))


@pytest.mark.parametrize(
    "change",
    [
        ImageOps.flip,  # of one size, with other content
        lambda picture: ImageOps.flip(picture).resize((40, 32)),  # the smaller camera of a pair
        lambda picture: ImageOps.grayscale(picture).resize((64, 64)),  # of a thermal camera
    ],
)
def test_photographs_of_two_cameras_with_the_same_numbers_are_all_read(tmp_path, caplog, change):
    folder = photographs(photographs(tmp_path, "one/{}.png"), "two/{}.png", change=change)
    assert len(read_photos("a", folder).image_names) == 2 * COUNT
    assert not caplog.records


@pytest.mark.parametrize(
    "patterns, kept",
    [
        ({"images_2/{}.jpg": 2, "images_4/{}.jpg": 4}, "images_2/{}.jpg"),
        ({"images_8/{}.png": 4, "images_4/{}.jpg": 2}, "images_4/{}.jpg"),
        ({"rgb/{}.jpg": 1, "rgb_2/{}.jpg": 2, "rgb_4/{}.jpg": 4}, "rgb/{}.jpg"),
        ({"a/photos/{}.jpg": 1, "a/photos-4/{}.jpg": 4}, "a/photos/{}.jpg"),
    ],
)
def test_of_folders_of_several_sizes_the_largest_is_read(tmp_path, caplog, patterns, kept):
    for pattern, scale in patterns.items():
        photographs(tmp_path, pattern, scale)
    assert read_photos("a", tmp_path).image_names == tuple(kept.format(k) for k in range(COUNT))
    assert "smaller copies" in caplog.text


@pytest.mark.parametrize(
    "patterns",
    [
        ["cam_2/{}.jpg", "cam_4/{}.jpg"],  # two cameras
        ["unmasked/{}.jpg"],
        ["left/{}.jpg", "right/{}.jpg"],
        ["deep/{}.jpg", "abnormal/{}.jpg"],
        ["normal/{}.jpg", "wide/{}.jpg"],
        ["mask_{}.jpg"],  # photographs of a mask: nothing has the rest of the name
    ],
)
def test_photographs_in_folders_of_other_names_are_all_read(tmp_path, caplog, patterns):
    for number, pattern in enumerate(patterns):
        photographs(tmp_path, pattern, seed=COUNT * number)
    assert len(read_photos("a", tmp_path).image_names) == COUNT * len(patterns)
    assert not caplog.records


def test_names_without_a_common_number_belong_to_no_series(tmp_path):
    """church and garden are two photographs, and 1 and 01 one series, whatever their formats."""
    for name in ("church.jpg", "church.png", "x/1.jpg", "x/1.png", "x/02.jpg"):
        photographs(tmp_path, name, change=ImageOps.grayscale)
    for name in ("garden.jpg", "garden.png", "y_5/2.jpg", "1.jpg"):
        photographs(tmp_path, name, seed=5)
    names = photographs_among(tmp_path, list_images(tmp_path))
    assert {name for name in list_images(tmp_path) if name not in names} == set()
    photographs(tmp_path, "02.jpg", seed=9)
    names = photographs_among(tmp_path, list_images(tmp_path))
    left_out = {name for name in list_images(tmp_path) if name not in names}
    assert left_out == {"x/1.jpg", "x/1.png", "x/02.jpg"}


def test_a_folder_that_is_named_is_read_whatever_its_name(tmp_path):
    photographs(tmp_path, "thumbs/{}.jpg")
    with refusal(
        r"all 5 files are masks, thumbnails or the like: thumbs/ \(5\): scene.images=FOLDER"
    ):
        read_photos("a", tmp_path)
    assert len(read_photos("a", tmp_path, images="thumbs").image_names) == COUNT
