"""What a user's class needs: every way to import a helper, each found without running anything."""

from __future__ import annotations

import importlib
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from gsbench.runs.source import _installed_names, source_of, source_on_disk, unseen_imports
from gsbench.system.own_modules import PATH_AT_START, allow_modules, allowed_modules

CLASS = "\nclass Mine: ...\n"
CASES = {  # the file of the class, the file that it needs, and how; what else lies there does not count
    "plain name": ("mine.py", "helper.py", "import helper"),
    "a name of it": ("mine.py", "helper.py", "from helper import value"),
    "two away": ("mine.py", "helper.py", "import between"),
    "within a function": ("mine.py", "helper.py", "def late():\n    import helper"),
    "where it may be missing": ("mine.py", "helper.py", "try:\n    import helper\nexcept ImportError:\n    pass"),
    "from dot": ("pack/mine.py", "pack/helper.py", "from . import helper"),
    "from dot name": ("pack/mine.py", "pack/helper.py", "from .helper import value"),
    "from dot dot": ("pack/inner/mine.py", "pack/helper.py", "from .. import helper"),
    "from dot dot name": ("pack/inner/mine.py", "pack/other/helper.py", "from ..other.helper import value"),
    "by its full name": ("pack/mine.py", "pack/inner/helper.py", "import pack.inner.helper"),
    "from the package": ("pack/mine.py", "pack/helper.py", "from pack import helper"),
    "a package's own file": ("pack/mine.py", "pack/__init__.py", ""),
    "by an attribute of the package": ("mine.py", "pack/helper.py", "import pack\nx = lambda: pack.helper.value"),
    "by an attribute of another name": (
        "mine.py", "pack/inner/helper.py", "from pack import inner as i\ndef late():\n    return i.helper.value",
    ),
    "all of a package": ("pack/mine.py", "pack/inner/helper.py", "from .inner import *"),
    "a package": ("mine.py", "helper/__init__.py", "import helper"),
    "a module of a package": ("mine.py", "helper/deep.py", "import helper.deep"),
    "a module of a package by from": ("mine.py", "helper/deep.py", "from helper import deep"),
    "a namespace": ("mine.py", "spaced/deep.py", "from spaced import deep"),
    "within a namespace": ("spaced/mine.py", "spaced/helper.py", "from . import helper"),
    "import_module": ("mine.py", "helper.py", "import importlib\nhelper = importlib.import_module('helper')"),
    "import_module of a dot": (
        "pack/mine.py", "pack/helper.py", "from importlib import import_module as get\nget('.helper', __package__)",
    ),
    "__import__": ("mine.py", "helper.py", "helper = __import__('helper')"),
    "a computed name": (
        "pack/mine.py", "pack/helper.py",
        "import importlib as i\nn = 'helper'\ni.import_module(f'.{n}', __package__)",
    ),
    "a computed name, deep": ("pack/inner/mine.py", "pack/helper.py", "import importlib as i\nget = i.import_module"),
    "a file by its path": ("mine.py", "helper.py", "from importlib.util import spec_from_file_location as s\nf = s"),
    "beside, by sys.path": (
        "pack/mine.py", "pack/helper.py",
        "import os, sys\nsys.path.insert(0, os.path.dirname(__file__))\nimport helper\nsys.path.pop(0)",
    ),
    "a folder beside, by sys.path": (
        "mine.py", "lib/helper.py",
        "import sys\nfrom pathlib import Path\nsys.path.append(str(Path(__file__).parent / 'lib'))\nimport helper",
    ),
}  # fmt: skip
HIDDEN = {  # in what no text tells, or what is not run
    "for type checkers alone": ("mine.py", "helper.py", "TYPE_CHECKING = False\nif TYPE_CHECKING:\n    import helper"),
    "in a string": ("mine.py", "helper.py", "'import helper'"),
    "of the same name elsewhere": ("mine.py", "pack/helper.py", "import helper"),
}


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder in which somebody types, whose modules are allowed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    names = ["mine", "pack", "helper", "spaced", "between"]
    allow_modules(names)
    _forget(names)  # other tests have modules of these names
    yield tmp_path
    _forget(names)
    allowed_modules().clear()


def _forget(names: list[str]) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] in names]:
        del sys.modules[name]


def write(home: Path, file: str, helper: str, text: str) -> str:
    """Lay out the case; the name of its class."""
    places = {"between.py": "import helper\n", "helper.py": "", "pack/unrelated.py": "", "unrelated.py": ""}
    for place in (*places, file, helper):
        path = home / place
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(places.get(place, ""))
        for folder in path.relative_to(home).parents:
            if folder.parts and folder.parts[0] != "spaced":
                (home / folder / "__init__.py").touch()
    (home / helper).write_text("value = 1\n")
    (home / file).write_text(text + CLASS)
    return file.removesuffix(".py").replace("/", ".") + ".Mine"


@pytest.mark.parametrize(("file", "helper", "text"), CASES.values(), ids=CASES)
def test_an_edited_helper_changes_the_hash_and_an_unrelated_file_does_not(
    home: Path, file: str, helper: str, text: str
) -> None:
    target = write(home, file, helper, text)
    first, on_disk = source_of(target), source_on_disk(target, str(home))
    assert first == {"source": on_disk}
    if not any(word in text for word in ("import *", "f'.{n}'", "get = ", "as s\n")):  # else all of the package counts
        (home / "unrelated.py").write_text("other = 1\n")
        (home / "pack" / "unrelated.py").write_text("other = 1\n")
    importlib.import_module(target.removesuffix(".Mine"))
    assert source_of(target) == first, "the hash is another once the code is imported"
    (home / helper).write_text("value = 2\n")
    assert source_on_disk(target, str(home)) != on_disk


@pytest.mark.parametrize(("file", "helper", "text"), HIDDEN.values(), ids=HIDDEN)
def test_what_is_not_imported_does_not_count(home: Path, file: str, helper: str, text: str) -> None:
    target = write(home, file, helper, text)
    first = source_of(target)
    (home / helper).write_text("value = 2\n")
    assert source_of(target) == first


def test_an_imported_helper_counts_as_it_was_and_one_that_waits_as_it_is(home: Path) -> None:
    target = write(home, "mine.py", "helper.py", "import helper\ndef late():\n    import spaced.deep")
    (home / "spaced").mkdir()
    (home / "spaced" / "deep.py").write_text("value = 1\n")
    importlib.import_module("mine")
    first = source_of(target)
    (home / "helper.py").write_text("value = 2\n")
    assert source_of(target) == first != {"source": source_on_disk(target, str(home))}
    (home / "spaced" / "deep.py").write_text("value = 2\n")
    assert source_of(target) != first


def test_installed_packages_and_pythons_own_do_not_count(home: Path) -> None:
    target = write(home, "mine.py", "helper.py", "import json\nimport numpy\nimport pytest")
    with_them = source_of(target)
    (home / "mine.py").write_text("import helper" + CLASS)
    assert with_them != source_of(target)
    for name in ("json.py", "numpy.py"):  # they lie in the folder, but Python finds others first
        (home / name).touch()
    assert source_of(write(home, "mine.py", "helper.py", "import json\nimport numpy\nimport pytest")) == with_them


def test_what_was_installed_into_the_folder_does_not_count_and_what_lies_beside_it_does(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`pip install --target .` leaves its packages and their records among the user's files."""
    monkeypatch.setattr("gsbench.runs.source.PATH_AT_START", (*PATH_AT_START, str(home)))  # as PYTHONPATH=. would
    target = write(home, "mine.py", "helper.py", "import helper, between\nimport spaced.deep")
    (home / "spaced").mkdir()
    (home / "spaced" / "deep.py").write_text("value = 1\n")
    before = source_of(target)
    info = home / "spaced-1.0.dist-info"
    info.mkdir()
    (info / "RECORD").write_text("spaced/deep.py,,\n")
    _installed_names.cache_clear()
    for name in ("spaced", "helper", "between"):
        allowed_modules().pop(name)
    without = source_of(target)
    assert without != before
    (home / "spaced" / "deep.py").write_text("value = 2\n")
    assert source_of(target) == without
    (home / "helper.py").write_text("value = 2\n")
    assert source_of(target) != without
    _installed_names.cache_clear()


def test_a_class_passed_on_by_another_module_has_the_files_of_both(home: Path) -> None:
    write(home, "mine.py", "helper.py", "")
    (home / "between.py").write_text("from mine import Mine\nMine.value = 1\n")
    one, other, both = source_of("mine.Mine"), source_of("between.Mine"), source_of("between.Mine", "mine.Mine")
    assert len({one["source"], other["source"]}) == 2
    assert both == other  # it imports the other
    (home / "between.py").write_text("from mine import Mine\nMine.value = 2\n")
    assert source_of("mine.Mine") == one
    assert source_of("between.Mine", "mine.Mine") != both


def test_a_circle_of_imports_ends_and_a_broken_file_is_hashed(home: Path) -> None:
    target = write(home, "mine.py", "helper.py", "import helper")
    (home / "helper.py").write_text("import mine\ndef broken(:\n")
    first = source_of(target)
    (home / "helper.py").write_text("import mine\ndef broken(;\n")
    assert source_of(target) != first


def test_an_archive_of_modules_is_hashed(home: Path) -> None:
    hashes = []
    for value in (1, 2):
        with zipfile.ZipFile(home / f"modules{value}.zip", "w") as archive:
            archive.writestr("zipped_mine.py", f"value = {value}" + CLASS)
        sys.path.append(str(home / f"modules{value}.zip"))
        hashes.append(source_of("zipped_mine.Mine"))
        sys.path.pop()
    assert hashes[0] != hashes[1]


def test_a_module_from_a_folder_that_no_text_names_is_told(home: Path) -> None:
    target = write(home, "mine.py", "helper.py", "import os, sys\nsys.path.append(os.environ['MY_LIB'])\nimport far")
    lib = home / "a" / "b"
    lib.mkdir(parents=True)
    (lib / "far.py").touch()
    before, first = set(sys.modules), source_of(target)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MY_LIB", str(lib))
        importlib.import_module("mine")
    assert source_of(target) == first
    assert unseen_imports(target, before) == ["far"]
    del sys.modules["far"]
