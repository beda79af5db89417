"""Digests of gsbench's code and of the user's."""

import hashlib
import importlib
import importlib.util
import json
import os
import shutil
import sys
from itertools import chain

import pytest

from gsbench.runs import code
from gsbench.runs.code import (
    AS_RELEASED,
    PACKAGE,
    changed_since_asked,
    config_hash,
    edited,
    has_changed_since_import,
    module_digest,
    states_of,
    syntax_of,
    unnamed_modules,
    user_modules,
)
from gsbench.runs.keys import CODE_OF_STAGE
from gsbench.system.programs import allow_modules, allowed_modules
from tests.conftest import script
from tests.helpers import table, write
from tests.test_architecture import modules, reached

SOURCE = (
    '"""A module."""\nX = 0.8  # weight\n\n\ndef loss(a):\n    """The loss."""\n    return X * a\n'
)
# Packages that determine no number: texts, processes, places of files. What `config` and `settings` make
# of the user's words is itself in the keys.
WITHOUT_NUMBERS = frozenset(
    """
    analysis app bench cli claims config datasets downloads errors files launch logs parsing renders runs
    settings system tracking verbs view words
    """.split()  # noqa: SIM905 - words are easier to read than a list of quoted ones
)
STEPS = {
    "scene": "scene",
    "init": "scene",
    "train": "train",
    "ground_truth": "scene",
    "evaluate": "evaluate",
}
# Packages that a step's module imports but that need not be in its key: another stage's key has them, or
# they only make objects.
BESIDE = {
    "scene": ("gaussians",),
    "init": (),
    "train": ("init", "eval", "weights.py", "pipeline/steps/scene.py"),
    "ground_truth": ("init", "gaussians"),
    "evaluate": ("init",),
}


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A copy of gsbench, other than the one that runs, without the files of a release.

    It is read as by a new process, whose user has an empty cache.
    """
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    copy = shutil.copytree(
        PACKAGE, tmp_path / "gsbench", ignore=shutil.ignore_patterns("__pycache__", "*.json")
    )
    monkeypatch.setattr(code, "PACKAGE", copy)
    again()
    yield copy
    again()


def again():
    """Forget what this process has read, as in a new process."""
    for cached in (code._released, code.state_of, code._first_contents, code._kept_digests):
        cached.cache_clear()


@pytest.mark.parametrize(
    "old, new",
    table(__file__, "no edits"),
)
def test_comments_docstrings_and_layout_do_not_count(old, new):
    assert old in SOURCE
    assert syntax_of(SOURCE.replace(old, new).encode()) == syntax_of(SOURCE.encode())


def test_comments_in_a_table_of_data_do_not_count():
    old, new = b"a: 1  # one\nb: {c: 2}\n", b"# a table\na: 1\n\nb:\n  c: 2\n"
    assert syntax_of(old, "x.yaml") == syntax_of(new, "x.yaml")
    for edit in (b"a: 2\nb: {c: 2}", b"b: {c: 2}\na: 1"):
        assert syntax_of(edit, "x.yaml") != syntax_of(old, "x.yaml")


@pytest.mark.parametrize(
    "old, new",
    table(__file__, "edits"),
)
def test_edits_that_can_change_a_number_count(old, new):
    assert syntax_of(SOURCE.replace(old, new).encode()) != syntax_of(SOURCE.encode())


@pytest.mark.parametrize("stage", STEPS)
def test_the_table_has_all_packages_that_a_stage_imports(stage):
    known = (
        *CODE_OF_STAGE[stage],
        *BESIDE[stage],
        "__init__.py",
        "pipeline/__init__.py",
        "pipeline/steps/__init__.py",
    )
    for module in reached(f"gsbench.pipeline.steps.{STEPS[stage]}"):
        file = modules()[module].relative_to(PACKAGE).as_posix()
        if file.partition("/")[0].removesuffix(".py") not in WITHOUT_NUMBERS:
            assert any(file == name or file.startswith(f"{name}/") for name in known), file


def test_all_packages_exist():
    assert not [name for name in {*chain(*CODE_OF_STAGE.values())} if not (PACKAGE / name).exists()]


def changed(before):
    """The packages whose state is not as it was ``before``."""
    now = states_of(before)
    return [name for name, state in before.items() if now[name] != state]


def test_the_next_process_notices_an_edit_but_not_a_comment(package):
    before = states_of([*CODE_OF_STAGE["train"], "gone"])
    loss = package / "train/loss.py"
    text = loss.read_text()
    loss.write_text(text + "# more\n")
    again()
    assert changed(before) == []
    loss.write_text(text + "MORE = 1\n")
    assert changed(before) == [], "this process has loaded what it was"
    again()
    assert changed(before) == ["train"]
    assert {len(state) for state in before.values()} == {16}
    loss.unlink()
    again()
    assert changed(before) == ["train"]
    assert changed({"gone": "0"}) == ["gone"]


def test_the_digest_of_a_package_is_the_recorded_one(tmp_path, monkeypatch):
    """Recorded before the code of the digests was moved: stores of edited checkouts stay valid."""
    monkeypatch.setattr(code, "PACKAGE", tmp_path)
    (tmp_path / "pack/inner").mkdir(parents=True)
    for name in ("pack/b.py", "pack/inner/deep.py", "one.py"):
        (tmp_path / name).write_text(
            f"{name} ("
        )  # Python's versions write syntax trees differently
    again()
    found = states_of(["pack", "one.py"])
    again()
    assert found == {"one.py": "8955de80759662ec", "pack": "7d79c895ac4d3f58"}


@pytest.mark.slow
def test_released_code_adds_nothing_to_keys(package, tmp_path, monkeypatch):
    # before the first release
    assert edited(states_of(CODE_OF_STAGE["train"])) == states_of(CODE_OF_STAGE["train"])
    script("released").main()
    again()
    with monkeypatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path / "empty"))
        patch.setattr(code, "syntax_of", lambda *_: pytest.fail("a released package is parsed"))
        released = states_of(CODE_OF_STAGE["train"])
    assert set(released.values()) == {AS_RELEASED}
    assert edited(released) == {}
    with (package / "densify/adc.py").open("a") as file:
        file.write("# a comment\n")
    (package / "eval/ssim.py").write_text("C1 = 2\n")
    again()
    assert list(edited(states_of(CODE_OF_STAGE["train"]))) == changed(released) == ["eval/ssim.py"]
    # the next release, for which the version of the stage was bumped, or the numbers are the same
    script("released").main()
    again()
    assert changed(released) == []


def test_the_users_cache_keeps_digests_and_may_be_damaged(package, tmp_path, monkeypatch):
    before = states_of(["train"])
    again()
    with monkeypatch.context() as patch:
        patch.setattr(code, "syntax_of", lambda *_: pytest.fail("it is parsed again"))
        assert changed(before) == []
    (kept,) = (tmp_path / "cache").rglob("*.json")
    key = next(iter(json.loads(kept.read_text())))
    for damaged in ("{", '{"a": 1}', json.dumps({key: AS_RELEASED})):
        kept.write_text(damaged)
        again()
        assert changed(before) == []


def test_an_edit_while_this_process_works_is_noticed(package):
    states_of(["train", "scene"])
    assert changed_since_asked(["train", "scene"]) == []
    with (package / "train/loss.py").open("a") as file:
        file.write("MORE = 1\n")
    assert changed_since_asked(["train", "scene"]) == ["train"]


@pytest.mark.parametrize("one, other", [("f()", "g()"), ("1", "2"), ("if a:\n 'x'", "if a:\n 'y'")])
def test_only_docstrings_are_left_out(one, other):
    assert syntax_of(one.encode()) != syntax_of(other.encode())


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
    assert code._digest_on_disk(spec) is None
    (tmp_path / "passing.py").write_text(CLASS)
    assert code._digest_on_disk(spec) == hashlib.sha256(syntax_of(CLASS.encode())).hexdigest()


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
