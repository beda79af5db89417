"""Damaged COLMAP models and PLY files are refused in one line or read with right values.

They never cause a crash, a hang or nonsense.
"""

import sys

import pytest

from tests.conftest import ROOT
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
