"""`gsbench fetch`: what arrives is what the archive has, only what is wanted, whole or not at all."""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import zipfile
from collections import namedtuple
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

import gsbench.datasets.fetch as fetching
from gsbench.cli import run
from gsbench.datasets.catalog import Archive, Dataset, read_catalog, wanted_files
from gsbench.system.install import conf_dir
from tests.datasets.conftest import archive_content, write_archive
from tests.datasets.server import Manners, Server

Fetch = Callable[..., int]
BAD_INPUT, FAILED = 2, 1


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("GSBENCH_DATA", str(tmp_path / "data"))
    monkeypatch.delenv("GSBENCH_MIRROR", raising=False)
    monkeypatch.setattr(logging.getLogger("gsbench"), "handlers", [])  # those of other tests write to closed files
    return tmp_path / "data"


@pytest.fixture
def fetch(server: Server, data: Path, monkeypatch: pytest.MonkeyPatch) -> Fetch:
    monkeypatch.setattr("gsbench.downloads.MAX_PAUSE_SECONDS", 0.01)

    def call(*words: str) -> int:
        return run(["fetch", *words, "--mirror", server.url, "--timeout", "0.3", "--tries", "3"])

    return call


def files_below(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def wanted(place: str, images: str) -> dict[str, bytes]:
    parts = (f"{place}/{images}/IMG", f"{place}/sparse/0/")
    return {
        name.removeprefix(f"{place}/"): data for name, data in archive_content(place).items() if name.startswith(parts)
    }


def test_every_scene_of_the_catalogue_is_a_scene_file_at_the_same_place() -> None:
    known = {}
    for dataset in read_catalog().values():
        for archive in dataset.archives:
            known |= dict(archive.scenes)
    public = {path.stem for path in (conf_dir() / "scene").glob("*.yaml") if "GSBENCH_DATA" in path.read_text()}
    assert set(known) == public
    for scene, folder in known.items():
        assert wanted_files(scene).folder == folder


def test_brings_what_the_scene_file_wants_and_nothing_else(
    fetch: Fetch, server: Server, data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fetch("mipnerf360", "garden", "room", "flowers") == 0
    assert files_below(data / "garden") == wanted("garden", "images_4")
    assert files_below(data / "room") == wanted("room", "images_2")
    assert files_below(data / "flowers") == wanted("flowers", "images_4")
    assert {path.name for path in data.iterdir() if path.is_dir()} <= {"garden", "room", "flowers", ".fetch"}
    text = capsys.readouterr().out
    assert "licence: none is stated" in text
    assert "please cite: Barron" in text
    assert "recorded in fetched.json (none is published)" in text
    whole = sum((server.folder / name).stat().st_size for name in ("360_v2.zip", "360_extra_scenes.zip"))
    assert server.sent < 0.6 * whole  # the tails of small archives count much

    assert fetch("tandt_db", "truck", "playroom") == 0
    assert files_below(data / "tandt" / "truck") == wanted("tandt/truck", "images")
    assert files_below(data / "db" / "playroom") == wanted("db/playroom", "images")


def test_a_second_fetch_asks_nothing_of_the_network(
    fetch: Fetch, server: Server, data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fetch("mipnerf360", "garden")
    asked = len(server.requests)
    assert fetch("mipnerf360", "garden") == 0
    assert len(server.requests) == asked
    assert "garden: 7 files" in capsys.readouterr().out
    (data / "garden" / "images_4" / "IMG_0001.JPG").write_bytes(b"spoilt")
    assert fetch("mipnerf360", "garden") == BAD_INPUT
    assert "1 file there differ from the archive's (images_4/IMG_0001.JPG): move this folder" in capsys.readouterr().err
    (data / "garden" / "images_4" / "IMG_0001.JPG").unlink()
    assert fetch("mipnerf360", "garden") == 0
    assert files_below(data / "garden") == wanted("garden", "images_4")


def test_goes_on_where_it_was_stopped(fetch: Fetch, server: Server, data: Path) -> None:
    fetch("mipnerf360", "garden", "--dry-run")
    before = server.sent

    def die_after(path: str, _: int, body: bytes) -> bytes:
        if server.sent - before > 90_000:  # the directory is 64 kB
            server.manners.status = {path: 500}
        return body

    server.manners = Manners(damage=die_after)
    assert fetch("mipnerf360", "garden") == FAILED
    assert not (data / "garden").exists()  # half a scene would train on fewer photographs
    staged = files_below(data / ".fetch" / "garden")
    assert staged
    server.manners = Manners()
    assert fetch("mipnerf360", "garden") == 0
    assert files_below(data / "garden") == wanted("garden", "images_4")
    assert not (data / ".fetch" / "garden").exists()


@pytest.mark.parametrize(
    "manners",
    [
        Manners(cut_every=6_000, cuts=2),
        Manners(stall_every=6_000, cuts=2),
        Manners(fail_first=2),
        Manners(redirect=True),
        Manners(ranges=False),
        Manners(ranges=False, cut_every=90_000, cuts=2),
    ],
    ids=["cuts", "stalls", "503", "redirect", "no ranges", "no ranges and cuts"],
)
def test_bad_manners_leave_the_same_files(fetch: Fetch, server: Server, data: Path, manners: Manners) -> None:
    server.manners = manners
    assert fetch("mipnerf360", "garden", "stump") == 0
    assert files_below(data / "garden") == wanted("garden", "images_4")
    assert files_below(data / "stump") == wanted("stump", "images_4")
    assert not list((data / ".fetch").rglob("*.zip"))


@pytest.mark.parametrize("ranges", [True, False], ids=["ranges", "no ranges"])
def test_damaged_bytes_are_found_and_not_kept(
    fetch: Fetch, server: Server, data: Path, capsys: pytest.CaptureFixture[str], ranges: bool
) -> None:
    with zipfile.ZipFile(server.folder / "360_v2.zip") as archive:
        spoilt = archive.getinfo("garden/images_4/IMG_0002.JPG").header_offset + 4_000

    def damage(_: str, offset: int, body: bytes) -> bytes:
        place = spoilt - offset
        if not 0 <= place < len(body):
            return body
        return body[:place] + bytes([body[place] ^ 1]) + body[place + 1 :]

    server.manners = Manners(damage=damage, ranges=ranges)
    assert fetch("mipnerf360", "garden") == FAILED
    assert "garden/images_4/IMG_0002.JPG arrives damaged" in capsys.readouterr().err
    assert not (data / "garden").exists()
    server.manners = Manners(ranges=ranges)
    assert fetch("mipnerf360", "garden") == 0
    assert files_below(data / "garden") == wanted("garden", "images_4")


def test_an_archive_that_changed_since_is_refused_until_it_is_accepted(
    fetch: Fetch, server: Server, data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fetch("tandt_db", "truck")
    shutil.rmtree(data / "tandt")
    write_archive(server.folder / "tandt_db.zip", archive_content("tandt/truck", seed=1))
    assert fetch("tandt_db", "truck") == BAD_INPUT
    assert "7 files of truck differ from what was fetched on" in capsys.readouterr().err
    assert not (data / "tandt").exists()
    assert fetch("tandt_db", "truck", "--accept-changes") == 0
    assert fetch("tandt_db", "truck") == 0


def test_the_record_is_of_sha256(fetch: Fetch, data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fetch("tandt_db", "truck")
    lines = [
        f"{hashlib.sha256(content).hexdigest()}  {name}\n"
        for name, content in sorted(wanted("tandt/truck", "images").items())
    ]
    expected = hashlib.sha256("".join(lines).encode()).hexdigest()
    records = json.loads((data / "fetched.json").read_text())
    assert f"sha256 {expected} recorded" in capsys.readouterr().out
    # a file of the same size and CRC-32 with other bytes: only sha256 can tell
    records["scenes"]["truck/images+sparse/0"]["files"]["images/IMG_0000.JPG"]["sha256"] = "0" * 64
    (data / "fetched.json").write_text(json.dumps(records))
    shutil.rmtree(data / "tandt")
    assert fetch("tandt_db", "truck") == BAD_INPUT
    assert "images/IMG_0000.JPG have another sha256 than on" in capsys.readouterr().err
    assert not (data / "tandt").exists()
    for content, said in (("{", "is not JSON"), ("[" * 200_000, "is not JSON"), ('{"scenes": []}', "is damaged")):
        (data / "fetched.json").write_text(content)
        assert fetch("tandt_db", "truck") == BAD_INPUT
        error = capsys.readouterr().err
        assert f"fetched.json {said}" in error
        assert error.count("\n") == 1


def test_published_checksums_are_compared(
    fetch: Fetch, server: Server, data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    archive = read_catalog()["tandt_db"].archives[0]
    whole = hashlib.sha256((server.folder / "tandt_db.zip").read_bytes()).hexdigest()
    for pins, ranges, code, words in (
        ({"archive": whole}, False, 0, "recorded in"),
        ({"archive": "0" * 64}, False, BAD_INPUT, f"has sha256 {whole}, not 000"),
        ({"truck/images+sparse/0": "0" * 64}, True, BAD_INPUT, "truck: sha256"),
    ):
        monkeypatch.setattr("gsbench.verbs.fetch.read_catalog", lambda pins=pins: _pinned(archive, pins))
        server.manners = Manners(ranges=ranges)
        shutil.rmtree(data, ignore_errors=True)
        assert fetch("tandt_db", "truck") == code
        captured = capsys.readouterr()
        assert words in captured.out + captured.err
        assert (data / "tandt").exists() == (code == 0)


def _pinned(archive: Archive, pins: dict[str, str]) -> dict[str, Dataset]:
    dataset = read_catalog()["tandt_db"]
    return {"tandt_db": replace(dataset, archives=(replace(archive, sha256=pins),))}


def test_files_that_were_put_there_by_hand_are_checked_and_recorded(
    fetch: Fetch, data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, content in wanted("garden", "images_4").items():
        path = data / "garden" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    (data / "garden" / "images_8").mkdir()
    assert run(["fetch", "--list"]) == 0
    assert "here, not by fetch" in capsys.readouterr().out
    assert fetch("mipnerf360", "garden") == 0
    assert "was there, as in the archive; sha256" in capsys.readouterr().out
    assert (data / "garden" / "images_8").is_dir()


def test_a_folder_may_be_the_mirror(archives: Path, data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["fetch", "mipnerf360", "room", "--mirror", str(archives)]) == 0
    assert files_below(data / "room") == wanted("room", "images_2")
    (archives / "360_v2.zip").unlink()
    assert run(["fetch", "mipnerf360", "garden", "--mirror", str(archives)]) == BAD_INPUT
    assert "360_v2.zip cannot be read" in capsys.readouterr().err


def test_another_image_folder(fetch: Fetch, data: Path) -> None:
    assert fetch("mipnerf360", "garden", "--images", "images_8") == 0
    assert files_below(data / "garden") == wanted("garden", "images_8")
    assert fetch("mipnerf360", "garden") == 0
    assert files_below(data / "garden") == wanted("garden", "images_8") | wanted("garden", "images_4")


def test_the_list(fetch: Fetch, data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fetch("mipnerf360", "garden")
    capsys.readouterr()
    assert run(["fetch", "--list"]) == 0
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    assert "here, 111 kB, fetched on" in lines["garden"]
    assert "not here" in lines["bicycle"]
    assert "about 12.5 GB" in lines["https://storage.googleapis.com/gresearch/refraw360/360_v2.zip"]
    next((data / "garden" / "images_4").iterdir()).unlink()
    run(["fetch", "--list", "mipnerf360"])
    assert "6 of 7 files here" in capsys.readouterr().out


def test_a_dry_run_fetches_nothing(
    fetch: Fetch, server: Server, data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fetch("mipnerf360", "garden", "--dry-run") == 0
    assert "garden: 111 kB, of which 111 kB are to be fetched" in capsys.readouterr().out
    assert not (data / "garden").exists()
    server.manners.ranges = False
    assert fetch("mipnerf360", "garden", "--dry-run") == 0
    assert "garden: the server serves no ranges, so the whole archive comes" in capsys.readouterr().out
    assert not list(data.rglob("*.zip"))


def test_a_full_disk_is_seen_before(
    fetch: Fetch, data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(fetching.shutil, "disk_usage", lambda _: usage(10**9, 10**9, 10**6))
    assert fetch("mipnerf360", "garden") == BAD_INPUT
    assert "111 kB are to be fetched into" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["mipnerf"], "no data set 'mipnerf'; did you mean mipnerf360?"),
        (["garden"], "garden is a scene: gsbench fetch mipnerf360 garden"),
        (["mipnerf360", "gardn"], "has no scene 'gardn'; did you mean garden?"),
        (["mipnerf360", "garden", "--mirror", "ftp://x"], "neither an http(s) address nor a folder"),
        (["mipnerf360", "garden", "--images", "images_16"], "no files below garden/images_16"),
        (["mipnerf360", "garden", "--mirror", "http://[::1"], "neither an http(s) address nor a folder"),
        (["mipnerf360", "garden", "--mirror", "a\0b"], "neither an http(s) address nor a folder"),
        (["mipnerf360", "garden", "--tries", "-1"], "must be a whole number from 1 to"),
        (["mipnerf360", "garden", "--timeout", "0"], "must be a number of seconds above 0"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_bad_requests(
    archives: Path, data: Path, capsys: pytest.CaptureFixture[str], words: list[str], said: str
) -> None:
    mirror = [] if "--mirror" in words else ["--mirror", str(archives)]
    assert run(["fetch", *words, *mirror]) == BAD_INPUT
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("place", ["a-file", "a-file/below", "/proc/nosuch"])
def test_a_data_folder_that_cannot_be_made(
    archives: Path, data: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    (data.parent / "a-file").touch()
    monkeypatch.setenv("GSBENCH_DATA", str(data.parent / place))
    assert run(["fetch", "mipnerf360", "room", "--mirror", str(archives)]) == BAD_INPUT
    error = capsys.readouterr().err
    assert "cannot be the data folder" in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("name", "said"),
    [("garden/images_4/up\\x.JPG", "unsafe name"), ("garden/images_4//etc/x.JPG", "unsafe name")],
)
def test_names_that_lead_elsewhere_are_refused(
    fetch: Fetch, server: Server, data: Path, capsys: pytest.CaptureFixture[str], name: str, said: str
) -> None:
    content = archive_content("garden") | {name: b"x", "garden/images_4/../../../escaped.JPG": b"x"}
    write_archive(server.folder / "360_v2.zip", content)
    assert fetch("mipnerf360", "garden") == BAD_INPUT
    assert said in capsys.readouterr().err
    assert not list(data.parent.rglob("*x.JPG"))
    assert not list(data.parent.rglob("escaped.JPG"))


def test_not_a_zip(fetch: Fetch, server: Server, data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (server.folder / "360_v2.zip").write_text("<html>this file has moved</html>")
    for ranges in (True, False):
        server.manners = Manners(ranges=ranges)
        assert fetch("mipnerf360", "garden") == BAD_INPUT
        assert "360_v2.zip is no whole zip archive" in capsys.readouterr().err
    assert not list(data.rglob("*.zip"))
