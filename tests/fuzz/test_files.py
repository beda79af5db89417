"""Damaged COLMAP models and PLY files are refused in one line or read with right values.

They never cause a crash, a hang or nonsense.
"""

import struct
import sys
from shlex import split

import pytest
from PIL import Image

from tests.conftest import ROOT
from tests.fuzz.models import write_originals
from tests.processes import completed

pytestmark = pytest.mark.slow


# More are tried by `python -m tests.fuzz.models FOLDER 0 10000`.
@pytest.mark.parametrize("what, cases", [("models", 240), ("records", 300)])
def test_damaged_files_are_refused_or_read_with_right_values(what, cases, tmp_path):
    command = [sys.executable, "-m", f"tests.fuzz.{what}", tmp_path, 0, cases]
    done = completed(command, code=None, cwd=ROOT)
    case = (tmp_path / "current").read_text()
    assert done.returncode == 0, f"case {case}: {done.stderr[-2000:]}"
    assert done.stdout.startswith(f"{cases} cases: ")


def replaced(at, layout, *values):
    """A function that puts these values into data."""
    new = struct.pack(layout, *values)
    return lambda data: data[:at] + new + data[at + len(new) :]


NAN = float("nan")


@pytest.mark.parametrize(
    "file, harm, words",
    [
        ("images.bin", replaced(12, "<4d", 0, 0, 0, 0), "has no pose that can be used"),
        ("images.bin", replaced(12, "<d", NAN), "has no pose that can be used"),
        ("images.bin", replaced(44, "<d", NAN), "has no pose that can be used"),
        ("cameras.bin", replaced(32, "<d", -300.0), "is damaged"),
        ("cameras.bin", replaced(16, "<Q", 0), "is damaged"),
        ("points3D.bin", replaced(16, "<d", NAN), "has no finite position"),
        ("points3D.bin", replaced(0, "<Q", 2**60), "truncated or damaged"),
        ("images.bin", replaced(0, "<Q", 2**60), "truncated or damaged"),
        ("cameras.bin", lambda data: data[:-3], "truncated or damaged"),
        ("images.bin", lambda data: bytes(range(256)) * 20, "images.bin"),
        ("points3D.bin", lambda data: data + b"\0", "1 bytes too many"),
    ],
)
def test_the_program_names_the_damaged_file(file, harm, words, tmp_path, monkeypatch, refused):
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path / "runs"))
    write_originals(tmp_path)
    (tmp_path / "sparse").mkdir()
    model = (tmp_path / "colmap.bin").rename(tmp_path / "sparse" / "0")
    (tmp_path / "images").mkdir()
    Image.new("RGB", (32, 24)).save(tmp_path / "images" / "x.png")
    (model / file).write_bytes(harm((model / file).read_bytes()))
    words_given = split(f"scene=colmap scene.path={tmp_path} init=dataset tracking=none")
    lines = refused(*words_given).splitlines()
    assert len([line for line in lines if line.startswith("gsbench:")]) == 1
    assert file in lines[-1]
    assert words in lines[-1]
