"""The modules of a user behind a trial, and their digests."""

import hashlib
import importlib
import importlib.util
import os
import sys

import pytest

from gsbench.runs import user_code
from gsbench.runs.config_hash import config_hash
from gsbench.runs.package_code import syntax_of
from gsbench.runs.user_code import (
    has_changed_since_import,
    module_digest,
    unnamed_modules,
    user_modules,
)
from gsbench.system.programs import allow_modules, allowed_modules
from tests.helpers import write

NAMES = ("own_code", "helper", "pack", "late")
CLASS = "class Mine: ...\n"


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A folder in which a user types commands, whose modules are allowed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    allow_modules(NAMES[:3])
    yield tmp_path
    for name in [*sys.modules]:
        if name.split(".")[0] in NAMES:
            del sys.modules[name]
    allowed_modules().clear()


def digest(path):
    return hashlib.sha256(syntax_of(path.read_bytes())).hexdigest()


def values_of(*targets, allowed=("own_code", "helper")):
    return {
        "densify": {"inner": [{"_target_": name} for name in targets]},
        "allow_targets": list(allowed),
    }


def test_the_code_of_a_users_class_includes_all_allowed_modules(home):
    for name in ("own_code", "helper", "unrelated"):
        (home / f"{name}.py").write_text(CLASS)
    assert user_modules(values_of("gsbench.densify.ADC")) == {}
    assert user_modules(values_of("own_code.Mine")) == {
        n: digest(home / f"{n}.py") for n in ("own_code", "helper")
    }
    assert user_modules(values_of("nowhere_to_be_found.X", allowed=("bash", "json", "yaml"))) == {}
    # a tracker changes no result
    tracked = {"tracking": {"_target_": "helper.Tracker"}}
    assert user_modules(values_of("gsbench.densify.ADC") | tracked) == {}
    assert list(user_modules(values_of("own_code.Mine") | tracked)) == ["own_code"]
    same = {"tracking": {"_target_": "own_code.Tracker"}}
    assert list(user_modules(values_of("own_code.Mine") | same)) == ["helper", "own_code"]


def test_a_package_is_hashed_by_all_its_code_files(home):
    (home / "pack/inner").mkdir(parents=True)
    (home / "pack/folder.py").mkdir()
    files = {
        "mine.py": CLASS,
        "inner/deep.py": "X = 1\n",
        "inner/kernel.cu": "int x;\n",
        "notes.txt": "a",
    }
    for name, text in files.items():
        (home / f"pack/{name}").write_text(text)  # without __init__.py: a namespace
    first = module_digest("pack")
    (home / "pack/notes.txt").write_text("b")
    assert module_digest("pack") == first
    (home / "pack/inner/deep.py").write_text('"""A docstring."""\nX  = 1  # a comment\n')
    assert module_digest("pack") == first
    for name, other in {"inner/deep.py": "X = 2\n", "inner/kernel.cu": "int x;\n\n"}.items():
        (home / f"pack/{name}").write_text(other)
        assert module_digest("pack") != first
        (home / f"pack/{name}").write_text(files[name])
    assert module_digest("pack") == first


def test_an_imported_file_keeps_its_digest_until_it_is_loaded_again(home):
    own = home / "own_code.py"
    for text in ("A = 1\n", "A = 2\n"):  # not imported yet
        own.write_text(text)
        assert module_digest("own_code") == digest(own)
        assert not has_changed_since_import("own_code")
    module = importlib.import_module("own_code")
    first = module_digest("own_code")
    own.write_text("class Mine:\n    other = True\n")
    assert module_digest("own_code") == first != digest(own)
    assert has_changed_since_import("own_code")
    importlib.reload(module)
    assert module_digest("own_code") == digest(own)
    assert not has_changed_since_import("own_code")


def test_imported_modules_that_are_not_named_are_listed(home):
    (home / "own_code.py").write_text(
        "import sys\nsys.path.insert(0, 'lib')\nimport late, json.tool, helper\n" + CLASS
    )
    write(home / "lib/late.py", b"")
    (home / "helper.py").touch()
    before = set(sys.modules)
    importlib.import_module("own_code")
    assert unnamed_modules(before, {"own_code", "helper"}) == ["late"]


def test_a_module_whose_file_is_gone_has_no_digest(tmp_path):
    spec = importlib.util.spec_from_file_location("passing", tmp_path / "passing.py")
    assert spec is not None
    assert user_code._digest_on_disk(spec) is None
    (tmp_path / "passing.py").write_text(CLASS)
    assert user_code._digest_on_disk(spec) == hashlib.sha256(syntax_of(CLASS.encode())).hexdigest()


def test_a_new_file_is_found_even_if_its_folder_keeps_its_time(home):
    """Python keeps the list of a folder's files as long as the folder has the same time."""
    assert module_digest("own_code") is None
    state = home.stat()
    (home / "own_code.py").write_text(CLASS)
    os.utime(home, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert module_digest("own_code") == digest(home / "own_code.py")


def test_the_hash_of_a_configuration_with_a_users_code_is_the_recorded_one(home):
    """Recorded before its code was moved: folders of trials and results in stores stay valid."""
    (home / "pack/inner").mkdir(parents=True)
    for name in ("own_code.py", "pack/mine.py", "pack/inner/kernel.cu"):
        (home / name).write_text(f"{name} (")  # Python's versions write syntax trees differently
    classes = {
        "densify": {"_target_": "own_code.Mine", "threads": 2},
        "init": {"_target_": "gsbench.init.Sfm", "threads": 3},
    }
    values = classes | {"allow_targets": ["own_code", "pack"], "seed": 0}
    assert user_modules(values) == {
        "own_code": "e76bb198f2adad6c94c8d0d0fc80b2790ff0c1fa3961a44c7e3af9a00caaa885",
        "pack": "91070ce81401d6f2b9860dc63b71b99f37754d75a8182adb40a60ff9ef9ee3b8",
    }
    recorded = "c77be93f1f9553e47288efab093131490e127ff753c523e678d65f00c78e600f"
    assert config_hash(values) == recorded
