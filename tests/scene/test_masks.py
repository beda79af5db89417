"""Masks: to which image they belong, which files are refused, and how ignored pixels are filled."""

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

from gsbench.scene.beside import (
    fill_ignored,
    find_masks,
    prepare_photograph,
    prepared_mask,
    read_mask,
    resize_mask,
)
from gsbench.scene.types import Capture
from tests.helpers import refusal
from tests.scene.captures import loaded, read_colmap, read_photos
from tests.scene.tables import TABLES


def save(path, pixels, **options):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **options)
    return path


def half(width=40, height=30):
    """A mask [H, W] that ignores the left half."""
    mask = np.full((height, width), 255, dtype=np.uint8)
    mask[:, : width // 2] = 0
    return mask


def noise(*shape):
    return np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)


def with_masks(root):
    for path in sorted((root / "images").rglob("*.*")):
        name = path.relative_to(root / "images").as_posix()
        save(root / "masks" / f"{name}.png", half(*Image.open(path).size))
    return root


@pytest.mark.parametrize("read", [read_colmap, read_photos])
def test_masks_are_found_by_the_names_of_colmap(make_scene, read):
    names = tuple(f"cam/{k}.jpg" for k in range(4))
    capture = read(with_masks(make_scene(names=names)), masks="masks")
    root = capture.images.parent
    assert capture.masks == {name: root / "masks" / f"{name}.png" for name in names}
    assert capture.image_names == names


def test_colmaps_name_of_a_mask_comes_before_that_of_its_photograph(tmp_path):
    for name in ("a.jpg.png", "a.png", "b.png"):
        save(tmp_path / name, half())
    found = find_masks(tmp_path, ["a.jpg", "b.jpg"])
    assert found == {"a.jpg": tmp_path / "a.jpg.png", "b.jpg": tmp_path / "b.png"}
    with refusal(r"no mask of c\.jpg in .*: add c\.jpg\.png"):
        find_masks(tmp_path, ["a.jpg", "c.jpg"])


def test_masks_in_the_folder_of_bare_photographs_are_not_read_as_photographs(make_scene):
    root = with_masks(make_scene()) / "images"
    (root.parent / "masks").rename(root / "masks")
    capture = read_photos(root, masks="masks")
    assert capture.image_names == tuple(f"{k:02d}.png" for k in range(6))
    with refusal("is the folder of the images"):
        read_photos(root, images=".", masks=".")


def test_a_missing_mask_and_a_missing_folder_are_named(make_scene):
    root = with_masks(make_scene())
    (root / "masks" / "03.png.png").unlink()
    with refusal(r"^[^\n]*no mask of 03\.png in .*masks: add 03\.png\.png \(all white[^\n]*$"):
        read_colmap(root, masks="masks")
    with refusal(r"no such folder; set scene\.masks to one of: images, masks$"):
        read_colmap(root, masks="mask")


def test_a_mask_of_another_size_is_refused(make_scene):
    root = with_masks(make_scene())
    path = save(root / "masks" / "02.png.png", half(20, 15))
    with refusal(rf"{path}: the mask is 20x15 px and its image 02\.png 40x30"):
        read_colmap(root, masks="masks")


@pytest.mark.parametrize(
    "pixels",
    [
        half(),
        half() // 255,  # labels 0 and 1
        half() > 0,  # one bit
        np.repeat(half()[..., None], 3, axis=2),
        half().astype(np.uint16) * 257,
        np.full((5, 7), 255, np.uint8),
        np.full((5, 7), 1, np.uint8),
    ],
)
def test_black_is_ignored_and_all_else_counts(tmp_path, pixels):
    counts = pixels.reshape(*pixels.shape[:2], -1).max(axis=2) > 0
    assert_array_equal(read_mask(save(tmp_path / "m.png", pixels)), counts)


def test_a_mask_in_a_palette_or_with_opaque_alpha_is_read(tmp_path):
    for mode in ("P", "RGBA"):
        Image.fromarray(half()).convert(mode).save(tmp_path / "m.png")
        assert_array_equal(read_mask(tmp_path / "m.png"), half() > 0)


@pytest.mark.parametrize(
    "pixels, said",
    [
        (np.zeros((5, 7), np.uint8), "black all over"),
        (noise(20, 30, 3), "in colours, and no mask"),
        (noise(20, 30), "% of its pixels are grey"),
        (np.stack([half()] * 4, -1), "not by transparency"),
    ],
)
def test_a_file_that_is_no_mask_is_refused_in_one_line(tmp_path, pixels, said):
    path = save(tmp_path / "m.png", pixels)
    with refusal(said) as caught:
        read_mask(path)
    assert str(caught.value).startswith(f"{path}: ")


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 23), st.integers(1, 23), st.integers(0, 2**32 - 1))
def test_an_ignored_pixel_is_filled_with_the_nearest_that_counts(height, width, seed):
    rng = np.random.default_rng(seed)
    counts = rng.random((height, width)) < rng.random()
    counts[rng.integers(height), rng.integers(width)] = True
    image = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    filled, places = fill_ignored(image, counts), np.argwhere(counts)
    for place in np.ndindex(height, width):
        apart = np.linalg.norm(places - place, axis=1)
        nearest = image[tuple(places[apart == apart.min()].T)]
        assert (filled[place] == nearest).all(axis=1).any()


@pytest.mark.parametrize("mask, alpha, backdrop, copied", TABLES["photographs copied"])
def test_a_photograph_without_changes_is_copied(tmp_path, mask, alpha, backdrop, copied):
    pixels = np.full((6, 8, 4), (200, 100, 50, alpha), np.uint8)
    original = save(tmp_path / "in" / "a.png", pixels if alpha < 255 else pixels[..., :3])
    own = {"half": half(8, 6), "white": np.full((6, 8), 255, np.uint8)}
    masks = {"a.png": save(tmp_path / "a.png", own[mask])} if mask else {}
    prepare_photograph(tmp_path / "out", tmp_path / "in", masks, "a.png", backdrop)
    made = tmp_path / "out" / "images" / "a.png"
    assert (made.read_bytes() == original.read_bytes()) == copied
    assert prepared_mask(tmp_path / "out", "a.png").is_file() == (mask is not None)
    if not copied:
        shade = 255 if alpha == 9 else 0
        expected = np.rint((alpha * pixels[0, 0, :3].astype(float) + (255 - alpha) * shade) / 255)
        with Image.open(made) as picture:
            assert_allclose(picture, np.broadcast_to(expected, (6, 8, 3)), atol=1)


@pytest.mark.parametrize("width, height", TABLES["sizes of masks"])
def test_a_resized_pixel_counts_if_all_pixels_in_its_area_count(width, height):
    """A pixel belongs to the area that its centre is in; on an edge, to either side."""
    counts = np.random.default_rng(1).random((36, 50)) > 0.05
    found = resize_mask(counts, width, height)

    def centres(place, sides, of, slack):
        low, high = place * of / sides - slack, (place + 1) * of / sides + slack
        return [k for k in range(of) if low < k + 0.5 < high]

    for row in range(height):
        for column in range(width):
            inner, outer = (
                (centres(row, height, 36, slack), centres(column, width, 50, slack))
                for slack in (-1e-6, 1e-6)
            )
            at_most, at_least = counts[np.ix_(*inner)].all(), counts[np.ix_(*outer)].all()
            assert at_least <= found[row, column] <= at_most


def prepared(root, folder, **options):
    """The capture with photographs and masks prepared as in the pipeline."""
    capture = read_colmap(root, masks="masks", **options)
    for name in capture.image_names:
        prepare_photograph(folder, capture.images, capture.masks, name)
    masks = {name: prepared_mask(folder, name) for name in capture.masks}
    return Capture(**(vars(capture) | {"images": folder / "images", "masks": masks}))


def test_views_have_their_masks_at_the_final_size(make_scene, tmp_path):
    capture = prepared(with_masks(make_scene()), tmp_path / "made")
    for max_size, mask in (
        (None, half()),
        (20, half(20, 15)),
        (20, half(20, 15)),
    ):  # the second time from the cache
        scene = loaded(capture, tmp_path, max_size)
        assert_array_equal(scene.train[0].mask, mask > 0)
        assert scene.train[0].counted == 0.5


def test_a_mask_is_undistorted_with_its_photograph(make_scene, tmp_path):
    """The photograph equals its mask, so after undistortion exactly its white pixels count."""
    root = make_scene(size=(120, 90), model="SIMPLE_RADIAL", params=(100, 60, 45, 0.15))
    for k, path in enumerate((root / "images").iterdir()):
        disc = np.hypot(*np.mgrid[-45:45, -60:60]) > 20 + k
        save(path, np.repeat(disc[..., None] * np.uint8(255), 3, axis=2))
        save(root / "masks" / f"{path.name}.png", disc * np.uint8(255))
    raw = read_colmap(root, masks="masks")
    view = loaded(raw, tmp_path).train[0]
    assert view.mask.shape != (90, 120), "undistorting changes the size"
    assert_array_equal(view.mask, view.image[..., 0] == 255)


def test_a_mask_without_counted_pixels_at_the_final_size_is_named(make_scene, tmp_path):
    root = with_masks(make_scene(size=(320, 240)))
    mask = np.zeros((240, 320), np.uint8)
    mask[100:103, 100:103] = 255
    save(root / "masks" / "04.png.png", mask)
    capture = read_colmap(root, masks="masks")
    with refusal(r"04\.png\.png: no pixel is left that counts at 32x24 px"):
        loaded(capture, tmp_path, max_size=32)


def test_masks_change_the_fingerprint_only_if_they_are_used(make_scene):
    root = make_scene()
    before = read_colmap(root).fingerprint
    with_masks(root)
    first = read_colmap(root, masks="masks").fingerprint
    save(root / "masks" / "01.png.png", 255 - half())
    assert len({before, first, read_colmap(root, masks="masks").fingerprint}) == 3
    assert read_colmap(root).fingerprint == before


def test_colmap_reads_the_same_focal_length_from_a_prepared_photograph(tmp_path):
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "Canon", "Canon EOS"
    exif.get_ifd(0x8769)[0xA405] = 35  # focal length in 35 mm film
    image = Image.fromarray(np.full((30, 45, 3), 90, np.uint8))
    (tmp_path / "in").mkdir()
    image.save(tmp_path / "in" / "a.jpg", exif=exif.tobytes())
    save(tmp_path / "m.png", half(45, 30))
    prepare_photograph(tmp_path / "out", tmp_path / "in", {"a.jpg": tmp_path / "m.png"}, "a.jpg")
    cameras = [
        pycolmap.infer_camera_from_image(tmp_path / place / "a.jpg")
        for place in ("in", "out/images")
    ]
    assert all(camera.has_prior_focal_length for camera in cameras)
    assert cameras[0].params.tolist() == cameras[1].params.tolist()
