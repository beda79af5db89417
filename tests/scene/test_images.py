"""Reading and shrinking images."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image

from gsbench.scene.images import read_image, resize_image, same_up_to_rounding
from gsbench.scene.options import downscaled_size
from tests.helpers import refusal
from tests.scene.tables import TABLES

from .conftest import smooth_image


def test_all_pixel_modes_become_rgb(tmp_path):
    path = tmp_path / "a.png"
    Image.fromarray(np.array([[[200, 100, 50, 255], [200, 100, 50, 0]]], dtype=np.uint8)).save(path)
    # transparent pixels are blended over black
    assert read_image(path).tolist() == [[[200, 100, 50], [0, 0, 0]]]
    Image.fromarray(np.array([[7, 250]], dtype=np.uint8)).save(path)
    assert read_image(path).tolist() == [[[7, 7, 7], [250, 250, 250]]]
    Image.fromarray(np.array([[0x1234, 0xFFFF]], dtype=np.uint16)).save(path)
    assert read_image(path).tolist() == [[[0x12] * 3, [0xFF] * 3]]
    Image.fromarray(np.zeros((2, 2), dtype=np.float32)).save(tmp_path / "f.tif")
    with refusal("convert it to 8-bit"):
        read_image(tmp_path / "f.tif")


def test_exif_orientation_is_ignored(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(smooth_image(20, 14)).save(tmp_path / "a.jpg", exif=exif)
    assert read_image(tmp_path / "a.jpg").shape == (14, 20, 3)


@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_damaged_files_are_named(tmp_path, suffix):
    path = tmp_path / f"broken.{suffix}"
    Image.fromarray(smooth_image(200, 150)).save(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with refusal(rf"broken\.{suffix}: the image is damaged"):
        read_image(path)
    path.write_text("no image at all")
    with refusal(rf"broken\.{suffix}: not a readable image"):
        read_image(path)
    with refusal("no such image"):
        read_image(tmp_path / "absent.png")


# the sizes of Mip-NeRF 360's own images_4 and images_2
@pytest.mark.parametrize("native, factor, expected", TABLES["sizes of Mip-NeRF 360"])
def test_downscaled_sizes_are_those_of_mipnerf360(native, factor, expected):
    assert downscaled_size(*native, expected[0]) == tuple(expected)
    assert same_up_to_rounding(expected, native)


def test_sizes_never_grow_and_the_longest_side_is_exact():
    assert downscaled_size(900, 600, max_size=1600) == (900, 600)
    assert all(max(downscaled_size(side, 777, max_size=640)) == 640 for side in range(800, 1500))
    assert downscaled_size(3, 3000, max_size=30) == (1, 30)
    assert downscaled_size(9, 6, max_size=1) == (1, 1)


@pytest.mark.parametrize("size, same", TABLES["rounded sides"])
def test_sides_may_be_rounded_by_one_pixel(size, same):
    assert same_up_to_rounding(size, (40, 30)) == same


def test_shrinking_keeps_a_ramp():
    ramp = np.repeat(np.arange(0, 200, 2, dtype=np.uint8)[None, :, None], 30, 0).repeat(3, 2)
    small = resize_image(ramp, 50, 15)
    assert_allclose(small[7, 5:-5, 0], np.arange(1, 200, 4)[5:-5], atol=1.01)
