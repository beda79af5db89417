"""Writing and checking files: nothing is left half written, followed through a link, or waited for."""

import errno
import os
import socket
from collections import namedtuple
from contextlib import suppress
from shlex import split

import pytest

from gsbench import files
from gsbench.errors import InputError, TrainingError
from gsbench.files import (
    DiskFullError,
    atomic,
    checked_runs_folder,
    explain_storage,
    is_safe_member,
    link_or_copy,
    make_runs_folder,
    open_plain,
    remove_special_files,
    remove_temporaries,
    require_no_links,
    require_regular,
    storage_errors,
    sync_to_disk,
    writable_output,
    write_json,
    write_text,
)
from tests.helpers import refusal, write

Usage = namedtuple("Usage", "total used free")


def test_a_file_appears_whole_or_stays_as_it_was(tmp_path, monkeypatch):
    synced = []
    monkeypatch.setattr(os, "fsync", synced.append)
    path = tmp_path / "a.json"
    left = tmp_path / f".a.json.tmp-{os.getpid()}"
    left.write_text("of an earlier process with this number")
    write_json(path, {"a": [1, 2.5], "ö": None})
    assert path.read_text() == '{\n "a": [\n  1,\n  2.5\n ],\n "\\u00f6": null\n}\n'
    assert len(synced) == 1
    for wrong in (float("nan"), float("inf"), object()):
        with pytest.raises((ValueError, TypeError)):
            write_json(path, wrong)
    with suppress(KeyError), atomic(path) as temporary:
        temporary.write_text("half")
        raise KeyError
    assert path.read_text().startswith('{\n "a"')
    with atomic(path, sync=False) as temporary:
        assert temporary == left
        assert not temporary.exists()
        temporary.write_text("new")
    assert (path.read_text(), list(tmp_path.iterdir())) == ("new", [path])
    assert len(synced) == 1


def test_a_link_replaces_its_target_and_where_links_fail_a_copy_does(tmp_path, monkeypatch):
    source, target = tmp_path / "source", tmp_path / "target"
    source.write_text("new")
    target.write_text("old")
    for _ in range(2):  # the second time they are one file already
        link_or_copy(source, target)
        assert target.samefile(source)
    monkeypatch.setattr(os, "link", _refuse(errno.EXDEV))
    link_or_copy(source, target)
    assert target.read_text() == "new"
    assert not target.samefile(source)
    assert sorted(tmp_path.iterdir()) == [source, target]


def _refuse(number):
    def refuse(*arguments, **named):
        raise OSError(number, os.strerror(number))

    return refuse


def test_an_output_gets_its_folder_and_another_is_asked_for_if_it_cannot_be_written(tmp_path):
    out = tmp_path / "new/below/page.html"
    with writable_output(out):
        out.write_text("a")
    for place, said in (
        (out / "a", r"cannot write .*page.html/a \(.*\); give another --out"),
        (out.parent, r"cannot write .*below \(Is a directory\)"),
    ):
        with refusal(said), writable_output(place):
            place.write_text("a")


@pytest.fixture
def special(tmp_path):
    """A runs folder with a file, a folder, and below it what may not be there."""
    place = tmp_path / "runs/x"
    place.mkdir(parents=True)
    write(tmp_path / "outside/file", "kept")
    (place / "file").write_text("a")
    (place / "folder").mkdir()
    os.mkfifo(place / "folder/pipe")
    (place / "folder/link").symlink_to(tmp_path / "outside/file")
    (place / "folder/linked").symlink_to(tmp_path / "outside")
    (place / "folder/dangling").symlink_to(tmp_path / "nowhere")
    return {path.name: path for path in place.rglob("*")}


SPECIAL = ("pipe", "link", "linked", "dangling")


def test_only_regular_files_are_opened(special):
    with os.fdopen(open_plain(special["file"])) as stream:
        assert stream.read() == "a"
    for name in (*SPECIAL, "folder"):
        with refusal(f"{name} is a link or not a regular file"):
            open_plain(special[name])
    with pytest.raises(InputError):  # nobody reads the pipe
        open_plain(special["pipe"], os.O_WRONLY)
    with pytest.raises(FileNotFoundError):
        open_plain(special["file"].with_name("none"))
    made = special["file"].with_name("made")
    os.close(open_plain(made, os.O_WRONLY | os.O_CREAT | os.O_EXCL))
    assert made.stat().st_mode & 0o111 == 0
    with pytest.raises(FileExistsError):
        open_plain(made, os.O_WRONLY | os.O_CREAT | os.O_EXCL)


def test_links_are_found_on_the_way_and_only_if_asked_below(special):
    runs = special["file"].parents[1]
    for place in (runs / "x", runs / "x/none/a", runs / "x/file/a"):
        require_no_links(runs, place)
    require_no_links(runs, runs / "x/none", below=True)
    require_no_links(runs, special["file"], below=True)
    for name in SPECIAL:
        with refusal(f"{name} is a link"):
            require_no_links(runs, special[name])
        with refusal(f"{name} is a link"):
            require_no_links(runs, special[name] / "below")
    with refusal("is a link"):
        require_no_links(runs, runs / "x", below=True)
    outside = runs.parent / "outside"
    linked = runs.parent / "link to runs"  # the way to the runs folder is the user's own
    linked.symlink_to(runs)
    require_no_links(linked, linked / "x")
    remove_special_files(runs)
    assert sorted(path.name for path in runs.rglob("*")) == ["file", "folder", "x"]
    assert (outside / "file").read_text() == "kept"
    require_no_links(runs, runs / "x", below=True)


def test_a_users_pipe_or_socket_is_refused_and_a_link_is_not(special):
    for name in split("file folder link linked dangling"):
        require_regular(special[name])
    with socket.socket(socket.AF_UNIX) as server:
        address = special["file"].with_name("s")
        server.bind(os.path.relpath(address))
        for path in (address, special["pipe"]):
            with refusal("is not a regular file: put a copy"):
                require_regular(path)


def test_the_remains_of_killed_writers_are_removed_and_no_other_files(tmp_path):
    kept = split(".a.tmp- .a.tmp-1x a.tmp-1 .tmp .hidden a")
    for name in (".a.json.tmp-17", ".a.tmp", *kept):
        (tmp_path / name).touch()
    write(tmp_path / "below/.b.tmp-1", b"")
    (tmp_path / ".c.tmp-1").mkdir()
    remove_temporaries(tmp_path)
    assert {path.name for path in tmp_path.rglob("*")} == {"below", ".c.tmp-1", *kept}


def test_syncing_reaches_the_disk_and_is_left_out_where_it_is_not_supported(tmp_path, monkeypatch):
    synced = []
    monkeypatch.setattr(os, "fsync", synced.append)
    before = len(os.listdir("/dev/fd"))
    sync_to_disk(tmp_path)
    assert len(synced) == 1
    monkeypatch.setattr(os, "fsync", _refuse(errno.EINVAL))
    sync_to_disk(tmp_path)
    sync_to_disk(tmp_path / "none")
    assert len(os.listdir("/dev/fd")) == before


# ---- the runs folder


def test_the_runs_folder_is_absolute_and_can_be_made(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert checked_runs_folder("a/../b/c") == tmp_path / "b/c"
    assert checked_runs_folder("~/runs") == tmp_path / "home/runs"
    (tmp_path / "file").touch()
    for name, said in (
        ("file", r"cannot be made, because .*/file is a file: set runs=FOLDER"),
        ("file/below", r"folder .*/file/below cannot be made, because .*/file is a file"),
        (" ", "the runs folder has no name"),
        ("a\0b", "cannot be the runs folder"),
        ("~nosuchuser/x", "cannot be the runs folder"),
    ):
        with refusal(said):
            checked_runs_folder(name)


def test_a_runs_folder_is_made_and_tried(tmp_path, monkeypatch):
    folder = tmp_path / "a/runs"
    for _ in range(2):
        make_runs_folder(folder)
        assert list(folder.iterdir()) == []
    for number in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM):
        monkeypatch.setattr(files, "TemporaryDirectory", _refuse(number))
        with pytest.raises(OSError, match=os.strerror(number)):
            make_runs_folder(folder)
    monkeypatch.setattr(files, "TemporaryDirectory", _refuse(errno.ENAMETOOLONG))
    with refusal(r"cannot be the runs folder \(File name too long\)"):
        make_runs_folder(folder)


@pytest.mark.parametrize(
    "error, kind, words",
    [
        (OSError(errno.ENOSPC, "x"), DiskFullError, "is full"),
        (OSError(errno.EDQUOT, "x"), DiskFullError, "is full"),
        (RuntimeError("[Errno 28] No space left on device"), DiskFullError, "is full"),
        (ValueError("1200 requested and 304 written"), DiskFullError, "is full"),
        (RuntimeError("PytorchStreamWriter failed writing file"), DiskFullError, "is full"),
        (PermissionError(errno.EACCES, "x", "/f"), InputError, "/f cannot be written to"),
        (OSError(errno.EROFS, "x"), InputError, "cannot be written to"),
        (OSError(errno.EIO, "x", "/f"), InputError, "/f cannot be opened"),
        (OSError(errno.ELOOP, "x", "/f"), InputError, "/f cannot be opened"),
        (OSError(errno.EFBIG, "x", "/f"), InputError, "/f may not grow any more"),
        (OSError(errno.ENOLCK, "x", "/f"), InputError, "the file system of /f has no locks"),
        (RuntimeError("shape mismatch"), None, ""),
        (FileNotFoundError(errno.ENOENT, "x"), None, ""),
    ],
)
def test_storage_errors_are_recognised(tmp_path, error, kind, words):
    found = explain_storage(error, tmp_path)
    assert type(found) is (kind or type(None))
    assert kind is None or (words in str(found) and str(error) not in str(found))
    with pytest.raises(kind or type(error)) as raised, storage_errors(tmp_path):
        raise error
    assert raised.value is error or raised.value.__cause__ is error


def test_on_a_disk_without_free_space_any_failed_write_counts_as_a_full_disk(tmp_path, monkeypatch):
    asked = []
    usage = Usage(10**9, 0, 65_535)
    monkeypatch.setattr(files.shutil, "disk_usage", lambda path: asked.append(path) or usage)
    error, missing = RuntimeError("a library's text"), tmp_path / "not/there"
    assert isinstance(explain_storage(error, missing), DiskFullError)
    assert isinstance(explain_storage(OSError(errno.ENOENT, "x"), missing), DiskFullError)
    assert asked == [tmp_path, tmp_path]
    assert explain_storage(ValueError("wrong"), missing) is None  # no failed write
    usage = Usage(10**9, 0, 65_536)
    assert explain_storage(error, missing) is None
    usage = Usage(0, 0, 0)  # as of /proc
    assert explain_storage(error, missing) is None
    monkeypatch.setattr(files.shutil, "disk_usage", _refuse(errno.EIO))
    assert explain_storage(error, missing) is None
    for own in (TrainingError("disk is full"), InputError("disk is full")):
        with pytest.raises(type(own), match=r"^disk is full$"), storage_errors(tmp_path):
            raise own


def test_a_text_with_a_name_that_is_not_utf_8_is_written(tmp_path):
    write_text(tmp_path / "a.txt", "a \udcff b")
    assert (tmp_path / "a.txt").read_text() == "a \\udcff b"


def test_only_a_member_that_stays_below_its_folder_is_safe():
    assert is_safe_member("color/a.png")
    for name in ("/a", "../a", "a/../../b", "C:/a", "a\\b", "a\0b", "a\nb", ""):
        assert not is_safe_member(name), name


@pytest.mark.parametrize("given", ["relative", "", None])
def test_the_users_cache_is_never_below_the_current_folder(given, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    if given is not None:
        monkeypatch.setenv("XDG_CACHE_HOME", given)
    assert files.user_cache("code") == tmp_path / ".cache/gsbench/code"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "own"))
    assert files.user_cache("code") == tmp_path / "own/gsbench/code"
