"""`gsbench fetch` brings the wanted files of an archive, complete or not at all."""

import logging
import shutil
import zipfile
from shlex import split

import pytest

from gsbench.cli import run
from gsbench.datasets.catalog import how_to_get, read_catalog, wanted_files
from gsbench.downloads import RetryPolicy
from gsbench.system.install import conf_dir
from tests.datasets.conftest import archive_content, write_archive
from tests.datasets.server import Manners
from tests.datasets.tables import TABLES

BAD_INPUT, FAILED = 2, 1


@pytest.fixture
def data(tmp_path, monkeypatch):
    monkeypatch.setenv("GSBENCH_DATA", str(tmp_path / "data"))
    monkeypatch.delenv("GSBENCH_MIRROR", raising=False)
    # handlers of other tests write to closed files
    monkeypatch.setattr(logging.getLogger("gsbench"), "handlers", [])
    return tmp_path / "data"


@pytest.fixture
def fetch(server, data, monkeypatch):
    patience = RetryPolicy(timeout=0.3, tries=3, pause=0.01)
    monkeypatch.setattr("gsbench.verbs.fetch.PATIENCE", patience)

    def call(*words):
        return run(["fetch", *words, "--mirror", server.url])

    return call


def files_below(folder):
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def wanted(place, images):
    parts = (f"{place}/{images}/IMG", f"{place}/sparse/0/")
    return {
        name.removeprefix(f"{place}/"): data
        for name, data in archive_content(place).items()
        if name.startswith(parts)
    }


def bring_garden(fetch, data):
    assert fetch("mipnerf360", "garden") == 0
    assert files_below(data / "garden") == wanted("garden", "images_4")


def test_every_scene_of_the_catalogue_has_a_scene_file_with_the_same_folder():
    known = {}
    for dataset in read_catalog().values():
        for archive in dataset.archives:
            known |= dict(archive.scenes)
    files = (conf_dir() / "scene").glob("*.yaml")
    assert set(known) == {path.stem for path in files if "GSBENCH_DATA" in path.read_text()}
    for scene, folder in known.items():
        assert wanted_files(scene).folder == folder


def test_fetch_brings_the_files_that_the_scene_file_needs_and_no_others(
    fetch, server, data, capsys
):
    assert fetch("mipnerf360", "garden", "room", "flowers") == 0
    images = {"garden": "images_4", "room": "images_2", "flowers": "images_4"}
    for scene, folder in images.items():
        assert files_below(data / scene) == wanted(scene, folder)
    assert {path.name for path in data.iterdir() if path.is_dir()} <= {*images, ".fetch"}
    text = capsys.readouterr().out
    assert "licence: none is stated" in text
    assert "please cite: Barron" in text
    archives = ("360_v2.zip", "360_extra_scenes.zip")
    whole = sum((server.folder / name).stat().st_size for name in archives)
    assert server.sent < 0.6 * whole  # the directory is a large share of a small archive

    assert fetch("tandt_db", "truck", "playroom") == 0
    assert files_below(data / "tandt" / "truck") == wanted("tandt/truck", "images")
    assert files_below(data / "db" / "playroom") == wanted("db/playroom", "images")


def test_a_second_fetch_makes_no_request(fetch, server, data, capsys):
    fetch("mipnerf360", "garden")
    asked = len(server.requests)
    assert fetch("mipnerf360", "garden") == 0
    assert len(server.requests) == asked
    assert "garden: is here" in capsys.readouterr().out
    shutil.rmtree(data / "garden" / "sparse")
    bring_garden(fetch, data)


def test_an_interrupted_fetch_continues(fetch, server, data):
    def die_after(path, _, body):
        if server.sent > 90_000:  # the directory is 64 kB
            server.manners.status = {path: 500}
        return body

    server.manners = Manners(damage=die_after)
    assert fetch("mipnerf360", "garden") == FAILED
    assert not (data / "garden").exists()  # half a scene would train on fewer photographs
    staged = files_below(data / ".fetch" / "garden")
    assert staged
    (data / ".fetch" / "garden" / "images_4" / "old.JPG").touch()  # of another archive
    server.manners = Manners()
    asked = len(server.requests)
    bring_garden(fetch, data)
    assert not (data / ".fetch" / "garden").exists()
    # what was staged is not fetched again; the directory is read once
    missing = len(wanted("garden", "images_4")) - len(staged)
    assert len(server.requests) - asked <= missing + 2


def test_damaged_bytes_are_detected_and_not_kept(fetch, server, data, capsys):
    with zipfile.ZipFile(server.folder / "360_v2.zip") as archive:
        spoilt = archive.getinfo("garden/images_4/IMG_0002.JPG").header_offset + 4_000

    def damage(_, offset, body):
        place = spoilt - offset
        if not 0 <= place < len(body):
            return body
        return body[:place] + bytes([body[place] ^ 1]) + body[place + 1 :]

    server.manners = Manners(damage=damage)
    assert fetch("mipnerf360", "garden") == FAILED
    assert "garden/images_4/IMG_0002.JPG arrives damaged" in capsys.readouterr().err
    assert not (data / "garden").exists()
    server.manners = Manners()
    bring_garden(fetch, data)


def test_a_folder_can_be_the_mirror(archives, data, capsys):
    assert run(split(f"fetch mipnerf360 room --mirror {archives}")) == 0
    assert files_below(data / "room") == wanted("room", "images_2")
    (archives / "360_v2.zip").unlink()
    assert run(split(f"fetch mipnerf360 garden --mirror {archives}")) == BAD_INPUT
    assert "360_v2.zip cannot be read" in capsys.readouterr().err


def test_another_image_folder_is_added_to_the_first(fetch, data):
    assert fetch("mipnerf360", "garden", "--images", "images_8") == 0
    assert files_below(data / "garden") == wanted("garden", "images_8")
    assert fetch("mipnerf360", "garden") == 0
    both = wanted("garden", "images_8") | wanted("garden", "images_4")
    assert files_below(data / "garden") == both


def test_the_list_tells_which_scenes_are_here(fetch, data, capsys, said):
    fetch("mipnerf360", "garden")
    capsys.readouterr()
    lines = {line.split()[0]: line for line in said("fetch --list").splitlines()}
    assert lines["garden"].endswith(" here")
    assert lines["bicycle"].endswith("not here")
    assert "about 12.5 GB" in lines["https://storage.googleapis.com/gresearch/refraw360/360_v2.zip"]
    shutil.rmtree(data / "garden" / "images_4")
    run(split("fetch --list mipnerf360"))
    assert "images_4 is missing" in capsys.readouterr().out


@pytest.mark.parametrize("words, said", TABLES["unknown names and addresses"])
def test_unknown_names_and_addresses_are_refused(archives, data, capsys, words, said):
    mirror = [] if "--mirror" in words else ["--mirror", str(archives)]
    assert run(["fetch", *words, *mirror]) == BAD_INPUT
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("place", ["a-file", "a-file/below", "/proc/nosuch"])
def test_a_data_folder_that_cannot_be_made_is_refused(archives, data, capsys, monkeypatch, place):
    (data.parent / "a-file").touch()
    monkeypatch.setenv("GSBENCH_DATA", str(data.parent / place))
    assert run(split(f"fetch mipnerf360 room --mirror {archives}")) == BAD_INPUT
    error = capsys.readouterr().err
    assert "cannot be the data folder" in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("name", ["garden/images_4/up\\x.JPG", "garden/images_4//etc/x.JPG"])
def test_names_that_lead_out_of_the_folder_are_refused(fetch, server, data, capsys, name):
    content = archive_content("garden") | {name: b"x", "garden/images_4/../../../escaped.JPG": b"x"}
    write_archive(server.folder / "360_v2.zip", content)
    assert fetch("mipnerf360", "garden") == BAD_INPUT
    assert "unsafe name" in capsys.readouterr().err
    assert not [path for path in data.parent.rglob("*.JPG") if not path.name.startswith("IMG_")]


def test_a_file_that_is_no_zip_archive_is_refused(fetch, server, data, capsys):
    (server.folder / "360_v2.zip").write_text("<html>this file has moved</html>")
    assert fetch("mipnerf360", "garden") == BAD_INPUT
    assert "360_v2.zip is not a complete zip archive" in capsys.readouterr().err


def test_the_command_is_given_for_scenes_that_it_would_bring_to_the_missing_folder(data, tmp_path):
    missing = [("stump", data / "stump"), ("garden", data / "garden"), ("mine", data / "mine")]
    assert "`gsbench fetch mipnerf360 garden stump`" in how_to_get(missing)
    assert "mine" not in how_to_get(missing)
    assert "gsbench fetch mipnerf360 garden" not in how_to_get([("garden", tmp_path / "garden")])
