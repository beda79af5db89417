"""Files beside photographs: masks, thumbnails, smaller copies and other results."""

import pytest
from PIL import Image

from tests.helpers import refusal, write
from tests.scene.captures import read_photos
from tests.scene.conftest import smooth_image
from tests.scene.tables import TABLES

COUNT = 5


def photographs(folder, pattern="{}.jpg", scale=1, seed=0, change=lambda picture: picture):
    for k in range(COUNT):
        file = folder / pattern.format(k)
        file.parent.mkdir(parents=True, exist_ok=True)
        picture = Image.fromarray(smooth_image(80 // scale, 64 // scale, seed + k))
        change(picture).save(file)
    return folder


@pytest.mark.parametrize("pattern, scale, named", TABLES["other files"])
def test_other_files_beside_photographs_change_no_capture(tmp_path, caplog, pattern, scale, named):
    alone = read_photos(photographs(tmp_path / "alone"))
    caplog.clear()
    beside = read_photos(photographs(photographs(tmp_path / "beside"), pattern, scale))
    assert (beside.image_names, beside.fingerprint) == (alone.image_names, alone.fingerprint)
    assert named in caplog.text
    assert len(caplog.records) == bool(named)


@pytest.mark.parametrize("patterns, kept", TABLES["folders of several sizes"])
def test_of_folders_of_several_sizes_the_largest_is_read(tmp_path, caplog, patterns, kept):
    for pattern, scale in patterns.items():
        photographs(tmp_path, pattern, scale)
    assert read_photos(tmp_path).image_names == tuple(kept.format(k) for k in range(COUNT))
    assert "left out, no photographs" in caplog.text


@pytest.mark.parametrize("patterns", TABLES["folders of photographs"])
def test_photographs_in_folders_of_other_names_are_all_read(tmp_path, caplog, patterns):
    for number, pattern in enumerate(patterns):
        photographs(tmp_path, pattern, seed=COUNT * number)
    assert len(read_photos(tmp_path).image_names) == COUNT * len(patterns)
    assert not caplog.records


def test_files_of_the_photographs_names_in_folders_beside_them_are_columns(tmp_path):
    photographs(tmp_path, "images/cam/{}.jpg")
    for place, ending in (("depth/cam", "npy"), ("normals/cam", "png"), ("masks", "png")):
        for k in range(3):
            write(tmp_path / place / f"{k}.{ending}", b"any")
    capture = read_photos(tmp_path)
    names = [f"cam/{k}.jpg" for k in range(3)]
    assert capture.beside == {
        "depth": {name: tmp_path / f"depth/{name[:-3]}npy" for name in names},
        "normals": {name: tmp_path / f"normals/{name[:-3]}png" for name in names},
    }
    alone = read_photos(photographs(tmp_path / "alone", "images/cam/{}.jpg"))
    assert alone.fingerprint == capture.fingerprint


def test_a_folder_that_is_named_is_read_whatever_its_name(tmp_path):
    photographs(tmp_path, "thumbs/{}.jpg")
    with refusal(
        r"all 5 files are masks, thumbnails or the like: thumbs/ \(5\): scene.images=FOLDER"
    ):
        read_photos(tmp_path)
    assert len(read_photos(tmp_path, images="thumbs").image_names) == COUNT
