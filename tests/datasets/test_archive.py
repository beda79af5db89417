"""Archives of scenes that are damaged, or were packed to do damage."""

from __future__ import annotations

import io
import struct
import zipfile
from pathlib import Path

import pytest

from gsbench.datasets.archive import DamagedError, extract, members_of, open_archive
from gsbench.errors import InputError


def packed(*names: str) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name in names:
            archive.writestr(name, b"content of it")
    return stream.getvalue()


def patched(data: bytes, signature: bytes, offset: int, layout: str, value: int) -> bytes:
    at = data.index(signature) + offset
    return data[:at] + struct.pack(layout, value) + data[at + struct.calcsize(layout) :]


DIRECTORY, LOCAL = b"PK\x01\x02", b"PK\x03\x04"


@pytest.mark.parametrize("version", [64, 99, 255])
def test_an_archive_of_a_later_version_is_refused(version: int, tmp_path: Path) -> None:
    data = patched(packed("s/images/a.jpg"), DIRECTORY, 6, "<H", version)
    with pytest.raises(InputError, match="is no whole zip archive"):
        open_archive(io.BytesIO(data), "x.zip")


@pytest.mark.parametrize(("offset", "layout", "value"), [(42, "<I", 5), (42, "<I", 10**9), (42, "<I", 2**32 - 2)])
def test_a_wrong_offset_is_damage(offset: int, layout: str, value: int, tmp_path: Path) -> None:
    data = patched(packed("s/images/a.jpg"), DIRECTORY, offset, layout, value)
    with open_archive(io.BytesIO(data), "x.zip") as archive:
        (member,) = members_of(archive, "s", ["images"], "x.zip")
        with pytest.raises(DamagedError):
            extract(archive, member, tmp_path / "a.jpg", lambda count: None)
    assert not (tmp_path / "a.jpg").exists()


def test_a_member_without_a_name_is_passed_over() -> None:
    data = packed("s/images/a.jpg", "x")
    data = patched(data, b"x" + data[data.rindex(b"x") + 1 :], 0, "<B", 0)  # zipfile takes a name up to the first NUL
    with open_archive(io.BytesIO(data), "x.zip") as archive:
        assert "" in archive.namelist()
        assert [member.name for member in members_of(archive, "s", ["images"], "x.zip")] == ["images/a.jpg"]


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (("s/images/a", "s/images/a/b.jpg"), "images/a is a file and a folder in one"),
        (("s/images/a/b/c.jpg", "s/images/a"), "images/a is a file and a folder in one"),
        (("s/images/" + "x" * 252 + ".jpg",), "a name that no file can have"),
        (("s/images/a\nb.jpg",), "a name that no file can have"),
    ],
)
def test_names_that_cannot_lie_side_by_side_are_refused(names: tuple[str, ...], said: str) -> None:
    with open_archive(io.BytesIO(packed(*names)), "x.zip") as archive, pytest.raises(InputError, match=said):
        members_of(archive, "s", ["images"], "x.zip")
