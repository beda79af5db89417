"""Archives of scenes: on faulty servers, damaged, or malicious."""

import contextlib
import io
import os
import struct
import zipfile
import zlib

import numpy as np
import pytest

from gsbench.datasets.archive import (
    STAGING,
    DamagedMemberError,
    extract,
    fetch_scene,
    is_complete,
    open_archive,
    open_archive_at,
    wanted_members,
)
from gsbench.datasets.catalog import SceneFiles
from gsbench.downloads import FetchError, RetryPolicy, with_retries
from gsbench.errors import InputError
from tests.datasets.server import Manners, serve
from tests.datasets.tables import TABLES
from tests.helpers import refusal, write

PATIENT = RetryPolicy(timeout=0.3, tries=3, pause=0.01)


def packed(*names):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name in names:
            archive.writestr(name, b"content of it")
    return stream.getvalue()


def opened(data):
    return open_archive(io.BytesIO(data), "x.zip")


def patched(data, signature, offset, layout, value):
    at = data.index(signature) + offset
    return data[:at] + struct.pack(layout, value) + data[at + struct.calcsize(layout) :]


DIRECTORY, LOCAL = b"PK\x01\x02", b"PK\x03\x04"


@pytest.mark.parametrize("version", [64, 99, 255])
def test_an_archive_of_a_later_version_is_refused(version, tmp_path):
    data = patched(packed("s/images/a.jpg"), DIRECTORY, 6, "<H", version)
    with refusal("is not a complete zip archive"):
        opened(data)


def extract_only(archive, target, which=0):
    member = list(wanted_members(archive, "s", ["images"], "x.zip").values())[which]
    extract(archive, member, target, lambda count: None)


@pytest.mark.parametrize("value", [5, 10**9, 2**32 - 2])
def test_a_wrong_offset_counts_as_damage(value, tmp_path):
    data = patched(packed("s/images/a.jpg"), DIRECTORY, 42, "<I", value)
    with opened(data) as archive, pytest.raises(DamagedMemberError):
        extract_only(archive, tmp_path / "a.jpg")
    assert not (tmp_path / "a.jpg").exists()


def test_the_progress_of_a_damaged_member_is_taken_back(tmp_path):
    data = patched(packed("s/images/a.jpg"), DIRECTORY, 24, "<I", 14)  # bytes
    counts = []
    with (
        opened(data) as archive,
        pytest.raises(DamagedMemberError, match="13 bytes instead of 14"),
    ):
        extract(archive, archive.infolist()[0], tmp_path / "new" / "a.jpg", counts.append)
    assert counts == [13, -13]


def test_progress_counts_the_bytes_of_the_missing_files(tmp_path):
    files = SceneFiles("truck", "db/truck", ("images",))
    there = tmp_path / STAGING / "truck" / "images" / "b.jpg"
    write(there, b"content of it")  # by an earlier fetch that was interrupted
    told = []
    data = packed("s/images/a.jpg", "s/images/b.jpg", "s/images/c.jpg")
    with opened(data) as archive:
        line = fetch_scene(
            archive, "s", "x.zip", tmp_path, files, PATIENT, lambda *at: told.append(at)
        )
    assert told == [("truck", 13, 26), ("truck", 26, 26)]
    assert line == f"3 files, 39 bytes, in {tmp_path / 'db/truck'} (images)"


def test_a_packing_that_cannot_be_read_is_no_damage(tmp_path):
    data = patched(packed("s/images/a.jpg"), DIRECTORY, 8, "<H", 1)  # encrypted
    with (
        opened(data) as archive,
        refusal(r"a\.jpg is packed in a way that cannot be read here"),
    ):
        extract_only(archive, tmp_path / "a.jpg")


def test_a_member_without_a_name_is_skipped():
    data = packed("s/images/a.jpg", "x")
    # zipfile cuts a name at the first NUL
    data = patched(data, b"x" + data[data.rindex(b"x") + 1 :], 0, "<B", 0)
    with opened(data) as archive:
        assert "" in archive.namelist()
        assert list(wanted_members(archive, "s", ["images"], "x.zip")) == ["images/a.jpg"]


@pytest.mark.parametrize("names, said", TABLES["names that no files can have"])
def test_names_that_cannot_be_files_together_are_refused(names, said):
    with opened(packed(*names)) as archive, refusal(said):
        wanted_members(archive, "s", ["images"], "x.zip")


@pytest.mark.parametrize("compression", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_damaged_bytes_of_a_member_are_detected(compression, tmp_path):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", compression) as archive:
        archive.writestr("s/images/a.jpg", content := np.random.default_rng(0).bytes(300))
    data = stream.getvalue()
    begin = data.index(b"a.jpg") + 5
    for place in range(begin, begin + 200):
        damaged = data[:place] + bytes([data[place] ^ 0xFF]) + data[place + 1 :]
        damage = contextlib.suppress(DamagedMemberError, InputError)
        with opened(damaged) as archive, damage:
            extract_only(archive, tmp_path / "a.jpg")
            # no reader uses this byte
            assert (tmp_path / "a.jpg").read_bytes() == content
            (tmp_path / "a.jpg").unlink()
    assert not (tmp_path / "a.jpg").exists()


def test_a_file_is_complete_by_its_size_and_checksum(tmp_path):
    file = tmp_path / "a.jpg"
    checksum = zlib.crc32(b"content")
    assert not is_complete(file, 7, checksum)
    for content, complete in ((b"content", True), (b"contenu", False), (b"content2", False)):
        file.write_bytes(content)
        assert is_complete(file, 7, checksum) is complete


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_as_an_archive_is_refused_and_not_awaited(tmp_path):
    os.mkfifo(tmp_path / "x.zip")
    with refusal(r"x\.zip"), open_archive_at(str(tmp_path / "x.zip"), PATIENT):
        pass


@pytest.fixture
def served(tmp_path):
    with zipfile.ZipFile(tmp_path / "file.zip", "w") as archive:
        for name in ("first", "second"):
            content = np.random.default_rng(len(name)).bytes(300_000)
            archive.writestr(f"s/images/{name}.jpg", content)
    with serve(tmp_path) as running:
        yield running


def fetched(server, target):
    """The bytes of the second member."""
    url = f"{server.url}/file.zip"
    with open_archive_at(url, PATIENT) as archive:
        with_retries(lambda: extract_only(archive, target, 1), url, PATIENT)
    return target.read_bytes()


@pytest.mark.parametrize("manners", TABLES["manners of a server"])
def test_a_member_is_fetched_whole_and_alone(served, tmp_path, manners):
    served.manners = Manners(**manners)
    assert fetched(served, tmp_path / "out") == np.random.default_rng(6).bytes(300_000)
    if "cuts" not in manners:
        assert served.sent < 400_000  # the other member is not sent


ERRORS = {error.__name__: error for error in (FetchError, InputError, DamagedMemberError)}


@pytest.mark.parametrize("manners, kinds, said", TABLES["faults of a server"])
def test_faults_of_the_server_are_reported(served, tmp_path, manners, kinds, said):
    served.manners = Manners(**manners)
    with pytest.raises(tuple(map(ERRORS.get, kinds)), match=said):
        fetched(served, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_missing_server_is_reported():
    with (
        pytest.raises(FetchError, match="Connection refused"),
        open_archive_at("http://127.0.0.1:9/file.zip", PATIENT),
    ):
        pass


def test_a_file_that_changes_between_requests_is_detected(served, tmp_path):
    url = f"{served.url}/file.zip"
    with open_archive_at(url, PATIENT) as archive:
        content = bytearray((served.folder / "file.zip").read_bytes())
        content[400_000:400_010] = bytes(10)
        (served.folder / "file.zip").write_bytes(content)
        with pytest.raises(DamagedMemberError, match="CRC-32"):
            extract_only(archive, tmp_path / "out", 1)
        os.truncate(served.folder / "file.zip", 1000)
        with refusal("416"):
            with_retries(lambda: extract_only(archive, tmp_path / "out", 1), url, PATIENT)


def test_offsets_beyond_four_gigabytes_are_read(tmp_path):
    """The real archive has 12.5 GB and needs zip64; a sparse file takes no space."""
    file = tmp_path / "large.zip"
    with file.open("wb") as stream:
        stream.truncate(5 << 30)
        stream.seek(5 << 30)
        with zipfile.ZipFile(stream, "w") as archive:
            archive.writestr("garden/a.JPG", b"far out")
    with serve(tmp_path) as server, open_archive_at(f"{server.url}/large.zip", PATIENT) as remote:
        assert remote.getinfo("garden/a.JPG").header_offset == 5 << 30
        assert remote.read("garden/a.JPG") == b"far out"
        assert server.sent < 1_000_000
    with open_archive_at(str(file), PATIENT) as local:
        assert local.read("garden/a.JPG") == b"far out"
