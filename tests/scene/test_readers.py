"""Readers: which files are found, kept and held out, and errors for bad folders."""

import codecs
import logging
import shutil
from pathlib import Path

import pycolmap
import pytest
from PIL import Image

from gsbench.scene.colmap import read_model, read_reference
from gsbench.scene.colmap_files import missing_model
from gsbench.scene.hold_out import select_images
from gsbench.scene.images import list_images
from gsbench.scene.names import match, match_anywhere
from gsbench.scene.options import SceneConfig
from tests.helpers import refusal, write
from tests.scene.captures import read_colmap, read_photos
from tests.scene.tables import TABLES


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("sparse", ["sparse/0", "sparse"])
def test_a_colmap_folder_gives_photographs_and_model(make_scene, text, sparse):
    root = make_scene(text=text, sparse=sparse)
    capture = read_colmap(root, test_every=3)
    assert capture.image_names == tuple(f"{k:02d}.png" for k in range(6))
    assert capture.test_names == ("00.png", "03.png")
    assert capture.train_names == ("01.png", "02.png", "04.png", "05.png")
    assert capture.model == root / sparse
    assert not capture.exact_poses
    for stem in ("rigs", "frames"):  # which older models lack
        next((root / sparse).glob(f"{stem}.*")).unlink()
    assert read_colmap(root).image_names == capture.image_names


def test_photos_are_found_in_images_or_in_the_folder_or_in_subfolders(make_scene):
    names = ("cam1/01.PNG", "cam1/02.png", "cam2/01.JPEG", "x.bmp", "y.webp", "z.tif")
    root = make_scene(names=names[::-1])
    (root / "images" / ".hidden.png").write_bytes(b"no image")
    (root / "images" / "notes.txt").write_text("no image")
    for path in (root, root / "images"):
        capture = read_photos(path)
        assert capture.image_names == names
        assert capture.model is None
    assert read_photos(root, images="images/cam1/..").images == root / "images/cam1/.."


def test_files_with_another_extension_are_used_and_missing_ones_left_out(make_scene, caplog):
    root = make_scene(names=tuple(f"cam/{k}.JPG" for k in range(6)))
    half = root / "images_2" / "cam"
    half.mkdir(parents=True)
    for k in range(5):
        Image.open(root / "images" / f"cam/{k}.JPG").resize((24, 18)).save(half / f"{k}.png")
    with caplog.at_level(logging.WARNING):
        capture = read_colmap(root, images="images_2")
    assert capture.image_names == tuple(f"cam/{k}.png" for k in range(5))
    assert "1 image with a camera but without a file: cam/5.JPG" in caplog.text


@pytest.mark.parametrize("wanted, files, matches", TABLES["names"])
def test_names_match_their_files_and_ambiguous_ones_are_refused(wanted, files, matches):
    with refusal(None if isinstance(matches, dict) else matches):
        assert match(wanted, files) == matches


@pytest.mark.parametrize("wanted, files, matches", TABLES["names in other folders"])
def test_names_in_other_folders_match_by_the_last_parts_of_their_paths(wanted, files, matches):
    with refusal(None if isinstance(matches, dict) else matches):
        assert match_anywhere(wanted, files) == matches
    assert set(match(wanted, files)) <= {"b.png"}


@pytest.mark.parametrize("prefix", ["images/", "/home/x/images/", "C:\\data\\images\\", "./"])
def test_a_model_whose_names_have_another_folder_gives_the_same_capture(make_scene, caplog, prefix):
    plain = read_colmap(make_scene(), max_images=4)
    root = make_scene(root="other")
    (root / "images/thumbs").mkdir()
    Image.new("RGB", (8, 6)).save(root / "images/thumbs/00.png")
    model = pycolmap.Reconstruction(root / "sparse/0")
    for image in model.images.values():
        image.name = f"{prefix}{image.name}"
    model.write_binary(root / "sparse/0")
    capture = read_colmap(root, max_images=4)
    assert (capture.image_names, capture.test_names) == (plain.image_names, plain.test_names)
    assert "found by the last part of their path" in caplog.text
    fitted = read_reference(capture)
    assert {image.name for image in fitted.images.values()} == set(capture.image_names)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("models, chosen", TABLES["models"])
def test_the_model_with_the_most_images_is_read(make_scene, caplog, models, chosen, text):
    for sparse, count in models.items():
        root = make_scene(names=[f"{k}.png" for k in range(count)], sparse=sparse, text=text)
    capture = read_colmap(root)
    assert capture.model == root / chosen
    assert len(capture.image_names) == models[chosen]
    beside = [sparse for sparse in models if sparse.split("/")[0] == chosen.split("/")[0]]
    others = [sparse for sparse in beside if sparse != chosen]
    assert ("scene.sparse chooses another" in caplog.text) is bool(others)
    assert (f"has {len(beside)} COLMAP models" in caplog.text) is bool(others)
    assert all(f"{other}: {models[other]} image" in caplog.text for other in others)
    assert read_colmap(root, sparse=chosen).model == root / chosen
    assert missing_model("toy", root, None) == ""


def test_a_model_beside_others_whose_images_cannot_be_counted_is_named(make_scene):
    root = make_scene()
    make_scene(sparse="sparse/1")
    (root / "sparse/0/images.bin").write_bytes(b"\1")
    with refusal(r"sparse/0/images\.bin: its images cannot be counted.*scene\.sparse"):
        read_colmap(root)
    assert read_colmap(root, sparse="sparse/1").model == root / "sparse/1"


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("mark", [b"", codecs.BOM_UTF8])
@pytest.mark.parametrize("line_end", [b"\n", b"\r\n"])
def test_names_with_blanks_are_read_whole_with_any_byte_order_mark_and_line_end(
    make_scene, text, mark, line_end
):
    names = [f"my  photo {k}.png" for k in range(6)]
    root = make_scene(names=names, text=text)
    for file in (root / "sparse/0").glob("*.txt"):
        file.write_bytes(mark + file.read_bytes().replace(b"\n", line_end))
    assert list(read_colmap(root).image_names) == names
    model = read_model(root / "sparse/0")
    assert sorted(image.name for image in model.images.values()) == names
    (root / "tests.txt").write_bytes(mark + names[3].encode() + line_end)
    assert read_colmap(root, test_list="tests.txt").test_names == (names[3],)


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda text: text.encode("utf-16"), "UTF-16 or UTF-32: save it as UTF-8"),
        (lambda text: text.encode("utf-32"), "UTF-16 or UTF-32: save it as UTF-8"),
        (
            lambda text: text.replace(".", ",").encode(),
            "with decimal points, not",
        ),
    ],
)
@pytest.mark.parametrize("stem", ["cameras", "images", "points3D"])
def test_wrong_encodings_and_decimal_commas_of_a_text_model_are_named(
    make_scene, change, said, stem
):
    root = make_scene(text=True, params=[50.5, 50.5, 20, 15])
    file = root / f"sparse/0/{stem}.txt"
    file.write_bytes(change(file.read_text().replace(" 5 ", " 5.5 ")))
    with refusal(rf"{stem}\.txt: .*{said}"):
        read_colmap(root)


def test_selection_is_even_and_comes_before_the_split(make_scene):
    assert select_images(list("abcdefghij"), 4) == ["a", "c", "f", "h"]
    for count, most in ((292, 98), (7, 3), (200, 200), (201, 200)):
        chosen = [int(name) for name in select_images([str(k) for k in range(count)], most)]
        # closed ring: back to the first
        gaps = {b - a for a, b in zip(chosen, [*chosen[1:], count], strict=True)}
        assert len(chosen) == most
        assert max(gaps) - min(gaps) <= 1
    capture = read_colmap(make_scene(), max_images=3, test_every=2)
    assert capture.image_names == ("00.png", "02.png", "04.png")
    assert capture.test_names == ("00.png", "04.png")


LISTS = {  # name of a file: what it lists
    "test": "01.JPG\n\n# a comment\n03\n",
    "train": "00.png\n02.png\n",
    "last": "05.png\n",
    "bad": "00.png\n99.png\n",
    "first": "00.png\n",
}


@pytest.mark.parametrize("train, test, trained_on, tested_on", TABLES["split lists"])
def test_lists_choose_the_training_and_test_views(make_scene, train, test, trained_on, tested_on):
    root = make_scene()
    for name, text in LISTS.items():
        (root / f"{name}.txt").write_text(text)
    train, test = (None if name is None else f"{name}.txt" for name in (train, test))
    lists = {"train_list": train, "test_list": test}
    if tested_on is None:
        with refusal(trained_on):
            read_colmap(root, **lists)
        return
    capture = read_colmap(root, **lists)
    assert capture.train_names == tuple(f"{k:02d}.png" for k in trained_on)
    assert capture.test_names == tuple(f"{k:02d}.png" for k in tested_on)


def test_fingerprint_depends_on_content_not_on_place(make_scene, tmp_path):
    root = make_scene()
    copy = Path(shutil.copytree(root, tmp_path / "elsewhere"))
    first = read_colmap(root)
    assert read_colmap(copy).fingerprint == first.fingerprint
    assert read_photos(root).fingerprint != first.fingerprint
    assert read_colmap(root, max_images=5).fingerprint != first.fingerprint
    with (copy / "images" / "03.png").open("ab") as stream:
        stream.write(b"x")
    assert read_colmap(copy).fingerprint != first.fingerprint


def test_missing_folders_images_and_models_are_named(make_scene, tmp_path):
    with refusal("does not exist"):
        read_photos(tmp_path / "nowhere")
    with refusal(r"scene\.path must be a path"):
        read_photos("")
    empty = tmp_path / "empty"
    empty.mkdir()
    with refusal("0 images"):
        read_photos(empty)
    root = make_scene()
    with refusal(r"images_8: no such folder; set scene\.images to one of: images$"):
        read_colmap(root, images="images_8")
    for name in list_images(root / "images")[2:]:
        (root / "images" / name).unlink()
    with refusal("2 images that the model"):
        read_colmap(root)
    shutil.rmtree(root / "sparse")
    with refusal("no COLMAP model in sparse/0 or sparse"):
        read_colmap(root)


@pytest.mark.parametrize("place, given, remedy", TABLES["places of models"])
def test_an_error_says_where_a_model_lies(make_scene, place, given, remedy):
    root = make_scene(sparse=place)
    if place.startswith("dense"):
        (root / "images").rename((root / place).parent / "images")
    with refusal(f"no COLMAP model in .*: .*{remedy.format(root)}$"):
        read_colmap(root / given)


def test_what_is_not_read_of_a_folder_is_named(make_scene, caplog):
    """Photographs without a pose; but no masks, and no text model beside the binary one."""
    root = make_scene()
    plain = read_colmap(root)
    assert not caplog.records
    make_scene(names=[f"{k:02d}.png" for k in (0, 2, 4)], text=True)
    for name in ("00.jpg", "00.png.png", "00_mask.png", "thumbs/00.png", "new.png"):
        write(root / "images" / name, (root / "images/00.png").read_bytes())
    capture = read_colmap(root)
    assert (capture.image_names, capture.test_names) == (plain.image_names, plain.test_names)
    assert "1 photograph without a pose in the model: new.png" in caplog.text


def test_a_scene_is_named_after_its_folder_and_a_missing_model_is_reported(make_scene, tmp_path):
    assert SceneConfig(name=None, kind="photos", path=str(tmp_path / "my fern")).name == "my fern"
    assert SceneConfig(name=None, kind="photos", path="/").name == "scene"
    said = missing_model("fern", tmp_path, None)
    assert said.startswith(f"scene fern: {tmp_path}: no COLMAP model in")
    root = make_scene(sparse="model")
    assert missing_model("fern", root, "model") == ""
    said = missing_model("fern", root, "other")
    assert said.startswith(f"scene fern: {root / 'other'}: no COLMAP model here")


@pytest.mark.parametrize("lacking, file, settings, said", TABLES["what is lacking"])
def test_what_a_folder_lacks_is_named(make_scene, lacking, file, settings, said):
    root = make_scene(text=True)
    (root / lacking).rename(root.parent / "elsewhere")
    (root / file).write_bytes(b"a.png\nK\xfcche.png\n")
    with refusal(said):
        read_colmap(root, **settings)
