"""The version of a user's own code: the file as it was imported, not as it has become since."""

from __future__ import annotations

import hashlib
import importlib
import sys
from pathlib import Path

import pytest

from gsbench.runs.source import has_changed_since_import, source_of, source_on_disk, sources_of


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A module of the user's that is not imported yet."""
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "own_code", raising=False)
    (tmp_path / "own_code.py").write_text("class Mine: ...\n")
    yield tmp_path / "own_code.py"
    sys.modules.pop("own_code", None)


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_file_that_is_not_imported_is_taken_as_it_is(own: Path) -> None:
    for text in ("A = 1\n", "A = 2\n"):
        own.write_text(text)
        assert source_of("own_code.Mine") == {"source": digest(own)}
        assert not has_changed_since_import("own_code.Mine")


def test_an_imported_file_is_taken_as_it_was_until_it_is_loaded_again(own: Path) -> None:
    module = importlib.import_module("own_code")
    first = source_of("own_code.Mine")
    own.write_text("class Mine:\n    other = True\n")
    assert source_of("own_code.Mine") == first != {"source": digest(own)}
    assert has_changed_since_import("own_code.Mine")
    importlib.reload(module)
    assert source_of("own_code.Mine") == {"source": digest(own)}
    assert not has_changed_since_import("own_code.Mine")


def test_own_classes_are_found_at_any_depth(own: Path) -> None:
    values = {
        "seed": 0,
        "init": {"_target_": "gsbench.init.Random", "count": 3},
        "densify": {"_target_": "own_code.Mine", "inner": [{"_target_": "own_code.Other"}]},
        "eval": {"extra": {"sharp": {"_target_": "nowhere_to_be_found.X"}}},
    }
    assert sources_of(values) == {"own_code.Mine": digest(own), "own_code.Other": digest(own)}


def test_the_file_of_another_folder_is_found_whatever_this_process_has_imported(own: Path, tmp_path: Path) -> None:
    importlib.import_module("own_code")
    sys.path.remove(str(tmp_path))  # what Python itself finds is found first
    other = tmp_path / "elsewhere"
    (other / "inner").mkdir(parents=True)
    for place in (other / "own_code.py", other / "inner" / "own_code.py"):
        place.write_text(f"# {place}\nclass Mine: ...\n")
        (place.parent / "__init__.py").touch()
    assert source_on_disk("own_code.Mine", str(other)) == digest(other / "own_code.py")
    assert source_on_disk("inner.own_code.Mine", str(other)) == digest(other / "inner" / "own_code.py")
    assert source_on_disk("own_code.Mine", str(tmp_path)) == digest(own)
    own.unlink()
    assert source_on_disk("own_code.Mine", str(tmp_path)) is None
    assert source_on_disk("inner.nosuch.Mine", str(other)) is None
