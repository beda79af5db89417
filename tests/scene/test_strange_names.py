"""Names of photographs, masks and folders that are not UTF-8: one line, and no traceback."""

import os
import sys
from shlex import split

import pytest

from gsbench.cli import run
from gsbench.errors import InputError
from gsbench.scene.images import list_images
from tests.helpers import write
from tests.processes import completed

BAD = os.fsdecode(b"a\xff")


@pytest.mark.parametrize("place", [f"{BAD}.png", f"{BAD}/a.png", f"b/{BAD}/a.jpg", "a\nb.png"])
def test_a_name_that_is_not_utf8_is_named_in_one_line(place, tmp_path, monkeypatch):
    file = tmp_path / place
    file.parent.mkdir(parents=True, exist_ok=True)
    file.touch()
    (tmp_path / "good.png").touch()
    with pytest.raises(
        InputError, match=r"(?s)names that are not UTF-8, or have line breaks: .*: rename them$"
    ):
        list_images(tmp_path)
    monkeypatch.setattr(sys, "getfilesystemencoding", lambda: "ascii")
    with pytest.raises(InputError, match="set PYTHONUTF8=1: Python reads names as ascii"):
        list_images(tmp_path)


@pytest.mark.parametrize("words", [["tables"], ["status"], ["sync"], ["scene=courtyard"]])
@pytest.mark.parametrize("where", ["runs", "current"])
def test_runs_and_current_folder_have_utf8_names(where, words, tmp_path, monkeypatch, refused):
    folder = tmp_path / BAD
    folder.mkdir()
    monkeypatch.chdir(folder if where == "current" else tmp_path)
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path / "runs" if where == "current" else folder))
    assert "not UTF-8, or has a line break: rename it" in refused(*words) or where == "runs"
    assert not (folder / "runs").exists()


@pytest.mark.slow
def test_where_python_reads_names_as_ascii_the_line_says_so(tmp_path):
    for number in range(3):
        write(tmp_path / "photos" / f"ü{number}.png", b"")
    ascii_only = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    words = split("scene=photos scene.path=photos init=sfm tracking=none")
    environment = os.environ | ascii_only | {"GSBENCH_RUNS": str(tmp_path / "runs")}
    environment["PYTHONPATH"] = os.pathsep.join(filter(os.path.isabs, sys.path))
    command = [sys.executable, "-P", "-m", "gsbench", *words]
    done = completed(command, code=2, cwd=tmp_path, env=environment)
    assert "set PYTHONUTF8=1: Python reads names as ascii" in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("level", range(4))
def test_a_folders_name_cannot_write_lines_of_its_own(level, tmp_path, monkeypatch, capfd):
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path))
    parts = ["x", "scene", "a-b", "00000000-seed0"]
    parts[level] += "\nFORGED"
    folder = tmp_path.joinpath(*parts)
    folder.mkdir(parents=True)
    (folder / "failed.json").write_text('{"message": "bad\\nFORGED"}')
    for words in (["status"], ["status", "x"], ["tables"], ["tables", "x"], ["sync"]):
        run(words)
    said = capfd.readouterr()
    assert not [line for line in (said.out + said.err).splitlines() if line.startswith("FORGED")]


def test_a_photograph_may_have_the_spaces_of_screenshots(tmp_path):
    (tmp_path / "Screenshot 3.15\u202fPM.png").touch()
    assert len(list_images(tmp_path)) == 1
