"""A remote file gives the bytes of the file, whatever the server does to them on the way, or an error."""

from __future__ import annotations

import io
import os
import zipfile
from pathlib import Path

import numpy as np
import pytest

from gsbench.datasets.remote import FetchError, Patience, RangesRefusedError, RemoteFile, download
from gsbench.errors import InputError
from tests.datasets.server import Manners, Server, serve

PATIENT = Patience(timeout=0.3, tries=3, pause=0.01)


@pytest.fixture
def served(tmp_path: Path):
    (tmp_path / "file.bin").write_bytes(np.random.default_rng(0).bytes(1_000_000))
    with serve(tmp_path) as running:
        yield running


def content(server: Server) -> bytes:
    return (server.folder / "file.bin").read_bytes()


def opened(server: Server) -> RemoteFile:
    return RemoteFile(f"{server.url}/file.bin", PATIENT)


def test_reads_like_a_local_file(served: Server) -> None:
    rng = np.random.default_rng(1)
    with opened(served) as remote, (served.folder / "file.bin").open("rb") as local:
        assert remote.size == 1_000_000
        for _ in range(40):
            whence = int(rng.integers(0, 3))
            offset = int(rng.integers(0, 900_000)) if whence == io.SEEK_SET else int(rng.integers(-90_000, 1))
            if whence == io.SEEK_CUR and local.tell() + offset < 0:
                continue
            assert remote.seek(offset, whence) == local.seek(offset, whence)
            count = int(rng.integers(0, 60_000))
            assert remote.read(count) == local.read(count)
            assert remote.tell() == local.tell()
        assert remote.seek(0) == 0
        assert remote.read() == content(served)
        assert remote.read(5) == b""
        with pytest.raises(OSError, match="before the start"):
            remote.seek(-1)


def test_reads_in_a_row_share_a_request_up_to_where_they_are_expected_to_go(served: Server) -> None:
    with opened(served) as remote:
        before = len(served.requests)
        remote.seek(1000)
        remote.expect(400_000)
        pieces = [remote.read(10_000) for _ in range(30)]
    assert b"".join(pieces) == content(served)[1000:301_000]
    assert served.requests[before:] == [("/file.bin", "bytes=1000-399999")]


@pytest.mark.parametrize(
    "manners",
    [
        Manners(cut_every=70_000),
        Manners(stall_every=300_000, cuts=2),
        Manners(fail_first=2),
        Manners(redirect=True),
        Manners(validator=False),
        Manners(redirect=True, cut_every=150_000, cuts=3),
    ],
    ids=["cuts", "stalls", "503 at first", "redirect", "no validator", "redirect and cuts"],
)
def test_survives(served: Server, manners: Manners) -> None:
    served.manners = manners
    with opened(served) as remote:
        remote.expect(remote.size)
        assert remote.read() == content(served)


def test_gives_up_on_a_server_that_only_ever_sends_a_little(served: Server) -> None:
    served.manners.cut_every = 100  # each time some bytes, never enough to get anywhere
    with pytest.raises(FetchError, match=r"3 failures in a row .*cut.*the same command goes on"):
        opened(served)


def test_gives_up_on_silence(served: Server) -> None:
    remote = opened(served)
    served.manners.stall_every = 1
    with pytest.raises(FetchError, match="no answer in time"):
        remote.read(1000)


def test_says_what_the_server_says(served: Server) -> None:
    served.manners.status["/file.bin"] = 403
    with pytest.raises(InputError, match=r"403 Forbidden.*--mirror"):
        opened(served)
    with pytest.raises(InputError, match="404 Not Found"):
        RemoteFile(f"{served.url}/other.bin", PATIENT)


def test_no_server_at_all() -> None:
    with pytest.raises(FetchError, match="Connection refused"):
        RemoteFile("http://127.0.0.1:9/file.bin", PATIENT)


def test_a_file_that_changes_in_between_is_an_error(served: Server) -> None:
    remote = opened(served)
    remote.read(10)
    (served.folder / "file.bin").write_bytes(np.random.default_rng(2).bytes(1_000_000))
    remote.seek(500_000)
    with pytest.raises(FetchError, match="changed while it was being fetched"):
        remote.read(10)


def test_a_shorter_file_is_noticed_without_a_validator(served: Server) -> None:
    served.manners.validator = False
    remote = opened(served)
    os.truncate(served.folder / "file.bin", 600_000)
    with pytest.raises(FetchError, match="changed while"):
        remote.read(10)


def test_a_range_that_begins_elsewhere_is_an_error(served: Server) -> None:
    remote = opened(served)
    served.manners.shift = 7
    remote.seek(1000)
    with pytest.raises(FetchError, match="from 1007 on, not from 1000"):
        remote.read(10)


def test_a_lie_about_the_length_is_no_zip_archive(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "file.zip", "w") as archive:
        archive.writestr("a", b"x" * 300_000)
    for lie in (-20_000, 40_000):
        with serve(tmp_path) as server:
            server.manners.claimed_size = (tmp_path / "file.zip").stat().st_size + lie
            with pytest.raises((FetchError, InputError, zipfile.BadZipFile)):
                zipfile.ZipFile(RemoteFile(f"{server.url}/file.zip", PATIENT)).read("a")  # type: ignore[arg-type]


def test_ranges_refused(served: Server, tmp_path: Path) -> None:
    served.manners.ranges = False
    with pytest.raises(RangesRefusedError):
        opened(served)
    served.manners.cut_every, served.manners.cuts = 300_000, 2
    seen: list[tuple[int, int | None]] = []
    download(f"{served.url}/file.bin", tmp_path / "copy", PATIENT, lambda done, total: seen.append((done, total)))
    assert (tmp_path / "copy").read_bytes() == content(served)
    assert seen[-1] == (1_000_000, 1_000_000)
    assert served.manners.cuts == 0


def test_a_whole_download_that_is_always_cut_fails(served: Server, tmp_path: Path) -> None:
    served.manners = Manners(ranges=False, cut_every=300_000)
    with pytest.raises(FetchError, match="cut"):
        download(f"{served.url}/file.bin", tmp_path / "copy", PATIENT, lambda *_: None)


def test_offsets_beyond_four_gigabytes(tmp_path: Path) -> None:
    """The real archive has 12.5 GB: its entries need zip64. A sparse file of the same kind takes no space."""
    file = tmp_path / "large.zip"
    with file.open("wb") as stream:
        stream.truncate(5 << 30)
        stream.seek(5 << 30)
        with zipfile.ZipFile(stream, "w") as archive:
            archive.writestr("garden/a.JPG", b"far out")
    with serve(tmp_path) as server, RemoteFile(f"{server.url}/large.zip", PATIENT) as remote:
        with zipfile.ZipFile(remote) as archive:  # type: ignore[arg-type]
            assert archive.getinfo("garden/a.JPG").header_offset == 5 << 30
            assert archive.read("garden/a.JPG") == b"far out"
        assert server.sent < 1_000_000
