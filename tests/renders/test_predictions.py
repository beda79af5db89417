"""Predictions of nerfbaselines 1.2.12: folder, .tar.gz, and published zip."""

import io
import json
import tarfile
import zipfile
import zlib

import numpy as np
import pytest
from PIL import Image

from gsbench.renders.sources import opened_renders
from tests.helpers import refusal, write

VIEWS = ("DSC001", "sub/DSC002")
SIZE, PLACES = (24, 32), ("color", "gt-color")


def png(values):
    stream = io.BytesIO()
    Image.fromarray(values).save(stream, format="png")
    return stream.getvalue()


@pytest.fixture
def members():
    """The files of predictions by name: each render is 10 levels darker than its photograph."""
    rng = np.random.default_rng(0)
    files = {"info.json": b"{}", "color/notes.txt": b"no picture", "overview.png": b"neither"}
    for view in VIEWS:
        photograph = rng.integers(20, 255, (*SIZE, 3)).astype(np.uint8)
        files[f"color/{view}.png"] = png(photograph - 10)
        for other in ("gt-color", "depth-rgb"):
            files[f"{other}/{view}.png"] = png(photograph)
    return files


def as_folder(files, place):
    for name, content in files.items():
        write(place / name, content)
    return place


def as_zip(files, place, home="predictions/"):
    with zipfile.ZipFile(place.with_suffix(".zip"), "w") as archive:
        archive.writestr("results.json", "{}")
        for name, content in files.items():
            archive.writestr(f"{home}{name}", content)
    return place.with_suffix(".zip")


def as_tar(files, place):
    with tarfile.open(place.with_suffix(".tar.gz"), "w:gz") as archive:
        for name, content in files.items():
            info = tarfile.TarInfo("renamed")
            info.pax_headers = {"path": name}  # which may have a NUL
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
    return place.with_suffix(".tar.gz")


FORMS = {
    "folder": as_folder,
    "tar": as_tar,
    "zip": as_zip,
    "zip without a folder": lambda files, place: as_zip(files, place, ""),
}


def test_predictions_are_measured_with_their_photographs_or_others(members, tmp_path, said):
    place = as_zip(members, tmp_path / "predictions")
    quick = ["eval.lpips=[]", "eval.flip=false"]
    measured = json.loads(said("evaluate", place, *quick, "--json"))
    assert set(measured["views"]) == {f"{view}.png" for view in VIEWS}
    assert measured["metrics"]["psnr"] == pytest.approx(20 * np.log10(255 / 10))
    photographs = tmp_path / "photos"
    for view in VIEWS:
        write(photographs / f"{view}.JPG", members[f"gt-color/{view}.png"])
    assert "names matched" in said("evaluate", place, "--truth", photographs, *quick)


@pytest.mark.parametrize("form", FORMS)
def test_only_renders_and_photographs_are_unpacked_and_only_for_a_while(form, members, tmp_path):
    with opened_renders(FORMS[form](members, tmp_path / "predictions")) as (renders, photographs):
        assert photographs is not None
        home = renders.parent
        assert (renders.name, photographs) == ("color", home / "gt-color")
        for name, content in members.items():
            is_wanted = name.endswith(".png") and name.startswith(("color/", "gt-color/"))
            assert (home / name).is_file() == (is_wanted or form == "folder")
            assert not is_wanted or (home / name).read_bytes() == content
    assert home.exists() == (form == "folder")
    (tmp_path / "mine").mkdir()
    with opened_renders(tmp_path / "mine") as folders:
        assert folders == (tmp_path / "mine", None)
    as_folder(members, tmp_path / "result" / "predictions")
    with opened_renders(tmp_path / "result") as folders:
        assert folders[0] == tmp_path / "result" / "predictions" / "color"


@pytest.mark.parametrize("pack", [as_tar, as_zip])
@pytest.mark.parametrize(
    "change, message",
    [
        ({"color/../../evil.png": b"x"}, "leads out of the archive"),
        ({"color/a\nb.png": b"x"}, "is no file's name"),
        ({"other/color/a.png": b"x", "other/gt-color/a.png": b"x"}, "and has 2"),
        (None, "and has none"),
    ],
)
def test_strange_archives_are_refused(pack, change, message, members, tmp_path):
    files = {"color/a.txt": b"x", "gt-color/a.txt": b"x"} if change is None else members | change
    archive = pack(files, tmp_path / "predictions")
    with refusal(message), opened_renders(archive):
        pass
    assert not list(tmp_path.rglob("evil.png"))


def test_files_that_are_no_archive_of_predictions_are_refused(
    members, tmp_path, monkeypatch, refused
):
    (tmp_path / "text.zip").write_text("no archive")
    whole = as_tar(members, tmp_path / "whole").read_bytes()
    (tmp_path / "part.tar.gz").write_bytes(whole[: len(whole) // 2])
    renders = {name: content for name, content in members.items() if name.startswith("color/")}
    half = as_zip(renders, tmp_path / "renders")
    for place, message in (
        (tmp_path / "text.zip", "cannot be unpacked"),
        (tmp_path / "part.tar.gz", "cannot be unpacked"),
        (half, "has none"),
        (as_folder(renders, tmp_path / "plain"), "--truth PLACE is needed"),
        (tmp_path / "nowhere", "nowhere is not a folder of renders"),
    ):
        assert message in refused("evaluate", place)
    wanted = [content for name, content in members.items() if name.split("/")[0] in PLACES]
    total = sum(len(content) for content in wanted) - len(members["color/notes.txt"])
    big = as_zip(members, tmp_path / "big")
    monkeypatch.setattr("gsbench.renders.sources.MAX_TOTAL_BYTES", total)
    with opened_renders(big):
        pass
    monkeypatch.setattr("gsbench.renders.sources.MAX_TOTAL_BYTES", total - 1)
    with refusal(r"unpacks to .* kB, more than"), opened_renders(big):
        pass


@pytest.mark.parametrize("name", ["color/a\0.png", "/color/a.png", "C:/color/a.png"])
def test_archives_without_a_usable_name_are_refused(name, tmp_path, refused):
    files = {name: b"x", name.replace("color", "gt-color"): b"x"}
    assert "leads out of the archive" in refused("evaluate", as_tar(files, tmp_path / "names"))


@pytest.mark.parametrize(
    "name, content, said",
    [
        ("a.ply", b"ply\nformat ascii 1.0\n", "is a model: gsbench scene=SCENE init=ply"),
        ("a.png", png(np.zeros((4, 4, 3), np.uint8)), "is one picture: give its folder"),
        ("a.zip", b"version https://git-lfs.github.com/spec/v1\n", "is a pointer of Git LFS"),
        ("renders/a.npy", b"NUMPY", "holds no pictures that gsbench reads, only a.npy: write PNG"),
        ("renders/.a.png", b"", "holds no pictures that gsbench reads, only .a.png"),
    ],
)
def test_renders_of_other_kinds_are_named_with_the_remedy(name, content, said, tmp_path, refused):
    place = write(tmp_path / name, content)
    photographs = as_folder({"a.png": png(np.zeros((4, 4, 3), np.uint8))}, tmp_path / "truth")
    renders = place.parent if "/" in name else place
    assert said in refused("evaluate", renders, "--truth", photographs)


@pytest.mark.parametrize("true_checksum", [True, False])
def test_no_more_is_unpacked_than_an_archive_says(true_checksum, tmp_path):
    """The directory of an archive may say ten bytes of a member that unpacks to gigabytes."""
    place = as_zip({"color/a.png": b"x", "gt-color/a.png": bytes(1000)}, tmp_path / "bomb", "")
    content = bytearray(place.read_bytes())
    for head, at in ((b"PK\x03\x04", 14), (b"PK\x01\x02", 16)):
        start = content.rindex(head) + at
        if true_checksum:
            content[start : start + 4] = zlib.crc32(bytes(10)).to_bytes(4, "little")
        content[start + 8 : start + 12] = (10).to_bytes(4, "little")
    place.write_bytes(content)
    if true_checksum:
        with opened_renders(place) as (_, photographs):
            assert (photographs / "a.png").read_bytes() == bytes(10)
    else:
        with refusal("cannot be unpacked .*CRC"), opened_renders(place):
            pass
