"""The code that made a result: rooms of gsbench behind a stage, and modules of a user."""

import hashlib
import importlib
import importlib.util
import os
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import pytest

from gsbench.errors import InputError
from gsbench.runs import keys
from gsbench.runs.keys import (
    AS_RELEASED,
    PACKAGE,
    ROOMS,
    Stage,
    UserCode,
    changed_rooms,
    changed_since_asked,
    edited,
    flatten,
    has_changed_since_import,
    module_digest,
    options_of,
    rasterizer_inputs,
    states_of,
    step_of,
    syntax_of,
    unnamed_modules,
    user_modules,
)
from gsbench.system.own_modules import allow_modules, allowed_modules
from tests.conftest import script
from tests.test_architecture import modules, reached

SOURCE = (
    '"""A module."""\nX = 0.8  # weight\n\n\ndef loss(a):\n    """The loss."""\n    return X * a\n'
)
# Rooms that determine no number: texts, processes, places of files. What `config` and `settings` make
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
# Rooms that a step's module imports but that need not be in its key: another stage's key has them, or
# they only make objects.
BESIDE: dict[str, tuple[str, ...]] = {
    "scene": ("gaussians",),
    "init": (),
    "train": ("init", "eval", "weights.py", "pipeline/steps/scene.py"),
    "ground_truth": ("init", "gaussians"),
    "evaluate": ("init",),
}


@pytest.fixture
def package(tmp_path, monkeypatch) -> Iterator[Path]:
    """A copy of gsbench, other than the one that runs, without the files of a release.

    It is read as by a new process.
    """
    copy = shutil.copytree(
        PACKAGE, tmp_path / "gsbench", ignore=shutil.ignore_patterns("__pycache__", "*.json")
    )
    monkeypatch.setattr(keys, "PACKAGE", copy)
    again()
    yield copy
    again()


def again() -> None:
    """Forget what this process has read, as in a new process."""
    for cached in (keys._released, keys._state, keys._first_contents):
        cached.cache_clear()


@pytest.mark.parametrize(
    "edit",
    [
        lambda text: text.replace("weight", "another comment"),
        lambda text: text.replace("The loss.", "It is\n    longer."),
        lambda text: text.replace("A module.", ""),
        lambda text: text.replace("X * a", "(X\n            * a)"),
        lambda text: text.replace('    """The loss."""\n', ""),
        lambda text: text.replace("0.8", "0.80"),
    ],
)
def test_comments_docstrings_and_layout_do_not_count(edit):
    assert edit(SOURCE) != SOURCE
    assert syntax_of(edit(SOURCE).encode()) == syntax_of(SOURCE.encode())


@pytest.mark.parametrize(
    "edit",
    [
        lambda text: text.replace("0.8", "0.81"),
        lambda text: text.replace("*", "+"),
        lambda text: text.replace("(a)", "(a=None)"),
        lambda text: text.replace("X", "Y"),
        lambda text: text.replace("    return X * a", "    return X * a\n    'more'"),
        lambda text: text.replace("X = 0.8", "X = '0.8'"),
        lambda text: text + "X = None\n",
        lambda text: text + "(",
    ],
)
def test_edits_that_can_change_a_number_count(edit):
    assert syntax_of(edit(SOURCE).encode()) != syntax_of(SOURCE.encode())


@pytest.mark.parametrize("stage", ROOMS)
def test_the_table_has_all_rooms_that_a_stage_imports(stage):
    known = (
        *ROOMS[stage],
        *BESIDE[stage],
        "__init__.py",
        "pipeline/__init__.py",
        "pipeline/steps/__init__.py",
    )
    for name in reached(f"gsbench.pipeline.steps.{STEPS[stage]}"):
        file = modules()[name].relative_to(PACKAGE).as_posix()
        if file.partition("/")[0].removesuffix(".py") not in WITHOUT_NUMBERS:
            assert any(file == room or file.startswith(f"{room}/") for room in known), file


def test_all_rooms_exist():
    for room in {room for rooms in ROOMS.values() for room in rooms}:
        assert (PACKAGE / room).exists(), room


def test_the_next_process_notices_an_edit_but_not_a_comment(package):
    before = states_of(ROOMS["train"])
    assert changed_rooms(before) == []
    loss = package / "train" / "loss.py"
    text = loss.read_text()
    loss.write_text(text + "# more\n")
    again()
    assert changed_rooms(before) == []
    loss.write_text(text + "MORE = 1\n")
    assert changed_rooms(before) == [], "this process has loaded what it was"
    again()
    assert changed_rooms(before) == ["train"]
    assert states_of(ROOMS["scene"]) == {
        room: before.get(room) or keys._state(room) for room in ROOMS["scene"]
    }
    loss.unlink()
    again()
    assert changed_rooms(before) == ["train"]
    assert changed_rooms({"gone": "0"}) == ["gone"]


def test_released_code_adds_nothing_to_keys(package, monkeypatch):
    # before the first release
    assert edited(states_of(ROOMS["train"])) == states_of(ROOMS["train"])
    script("released").main()
    again()
    with monkeypatch.context() as patch:
        patch.setattr(keys, "syntax_of", lambda source: pytest.fail("a released room is parsed"))
        released = states_of(ROOMS["train"])
    assert set(released.values()) == {AS_RELEASED}
    assert edited(released) == {}
    with (package / "densify" / "adc.py").open("a") as file:
        file.write("# a comment\n")
    (package / "eval" / "ssim.py").write_text("C1 = 2\n")
    again()
    assert list(edited(states_of(ROOMS["train"]))) == changed_rooms(released) == ["eval/ssim.py"]
    # the next release, for which the version of the stage was bumped, or the numbers are the same
    script("released").main()
    again()
    assert changed_rooms(released) == []


def test_an_edit_while_this_process_works_is_noticed(package):
    states_of(["train", "scene"])
    assert changed_since_asked(["train", "scene"]) == []
    with (package / "train" / "loss.py").open("a") as file:
        file.write("MORE = 1\n")
    assert changed_since_asked(["train", "scene"]) == ["train"]


# ---- the user's code

NAMES = ("own_code", "helper", "pack", "late")
CLASS = "class Mine: ...\n"


@pytest.fixture
def home(tmp_path, monkeypatch) -> Iterator[Path]:
    """A folder in which a user types commands, whose modules are allowed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    allow_modules(NAMES[:3])
    yield tmp_path
    for name in [*sys.modules]:
        if name.split(".")[0] in NAMES:
            del sys.modules[name]
    allowed_modules().clear()


def digest(path: Path) -> str:
    return hashlib.sha256(keys.syntax_of(path.read_bytes())).hexdigest()


def values_of(
    *targets: str, allowed: tuple[str, ...] = ("own_code", "helper")
) -> dict[str, object]:
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
    (home / "pack" / "inner").mkdir(parents=True)
    (home / "pack" / "folder.py").mkdir()
    files = {
        "mine.py": CLASS,
        "inner/deep.py": "X = 1\n",
        "inner/kernel.cu": "int x;\n",
        "notes.txt": "a",
    }
    for name, text in files.items():
        (home / "pack" / name).write_text(text)  # without __init__.py: a namespace
    first = module_digest("pack")
    (home / "pack" / "notes.txt").write_text("b")
    assert module_digest("pack") == first
    (home / "pack" / "inner" / "deep.py").write_text('"""A docstring."""\nX  = 1  # a comment\n')
    assert module_digest("pack") == first
    for name, other in {"inner/deep.py": "X = 2\n", "inner/kernel.cu": "int x;\n\n"}.items():
        (home / "pack" / name).write_text(other)
        assert module_digest("pack") != first
        (home / "pack" / name).write_text(files[name])
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


def test_a_module_of_another_folder_is_found_even_if_its_namesake_is_imported(home):
    (home / "own_code.py").write_text(CLASS)
    importlib.import_module("own_code")
    other = home / "elsewhere"
    other.mkdir()
    (other / "own_code.py").write_text("class Other: ...\n")
    assert module_digest("own_code", str(other)) == digest(other / "own_code.py")
    assert module_digest("own_code", str(home)) == digest(home / "own_code.py")
    (home / "own_code.py").unlink()
    assert module_digest("own_code", str(home)) is None


def test_imported_modules_that_are_not_named_are_listed(home):
    (home / "own_code.py").write_text(
        "import sys\nsys.path.insert(0, 'lib')\nimport late, json.tool, helper\n" + CLASS
    )
    (home / "lib").mkdir()
    (home / "lib" / "late.py").touch()
    (home / "helper.py").touch()
    before = set(sys.modules)
    importlib.import_module("own_code")
    assert unnamed_modules(before, {"own_code", "helper"}) == ["late"]


def test_a_module_whose_file_is_gone_has_no_digest(tmp_path):
    spec = importlib.util.spec_from_file_location("passing", tmp_path / "passing.py")
    assert spec is not None
    assert keys._digest_on_disk(spec) is None
    (tmp_path / "passing.py").write_text(SOURCE)
    assert keys._digest_on_disk(spec) == hashlib.sha256(keys.syntax_of(SOURCE.encode())).hexdigest()


def test_a_new_file_is_found_even_if_its_folder_keeps_its_time(home):
    """Python keeps the list of a folder's files as long as the folder has the same time."""
    assert module_digest("own_code") is None
    state = home.stat()
    (home / "own_code.py").write_text(CLASS)
    os.utime(home, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert module_digest("own_code") == digest(home / "own_code.py")


# ---- what enters a key


@pytest.mark.parametrize(
    ("one", "other"), [("f()", "g()"), ("1", "2"), ("if a:\n 'x'", "if a:\n 'y'")]
)
def test_only_docstrings_are_left_out(one, other):
    assert syntax_of(one.encode()) != syntax_of(other.encode())


def test_a_digest_of_a_room_is_short():
    assert {len(state) for state in edited(states_of(ROOMS["evaluate"])).values()} <= {16}


def test_flattening_keeps_empty_groups_only_if_asked():
    nested = {"a": {"b": 1, "c": {}}, "d": {"e": {"f": None}}}
    assert flatten(nested) == {"a.b": 1, "d.e.f": None}
    assert flatten(nested, keep_empty=True) == {"a.b": 1, "a.c": {}, "d.e.f": None}


@dataclass(frozen=True)
class Own:
    """A user's class; gsbench would leave ``threads`` out."""

    threads: int = 2
    place: Path = Path("a")
    pair: tuple[int, ...] = (1, 2)
    hidden: int = field(default=0, init=False)


def test_a_users_class_enters_a_key_with_its_code_and_all_its_options():
    user = UserCode({"tests": "0abc"}, {"densify": "tests.Own", "eval.extra.own": "gsbench.X"})
    options = {"threads": 2, "place": "a", "pair": [1, 2]}
    named = {"class": "tests.runs.test_keys.Own", "source": {"tests": "0abc"}} | options
    assert options_of("densify", Own(), user) == named
    # a class that is defined outside gsbench, under any name
    assert options_of("eval", Own(), user, "eval.extra.own") == named
    stage = Stage("scene", 1)  # of gsbench's own
    assert [user.is_behind(stage, place) for place in ("densify", "eval.extra.own", "init")] == [
        True,
        False,
        False,
    ]
    assert options_of("init", stage, user) == {
        "class": "gsbench.runs.keys.Stage",
        "name": "scene",
        "version": 1,
        "resumable": False,
        "scratch": [],
    }


def test_a_rasterizer_enters_a_key_by_its_name_or_as_a_users_class():
    rasterizer = SimpleNamespace(name="cpu")  # defined outside gsbench
    assert rasterizer_inputs(rasterizer, UserCode({"m": "1"})) == {
        "name": "cpu",
        "class": "types.SimpleNamespace",
        "source": {"m": "1"},
    }
    assert rasterizer_inputs(Stage("cpu", 1)) == "cpu"


def test_a_step_has_the_differing_rooms_and_checks_for_edits_only_if_it_starts_processes(
    home, monkeypatch
):
    monkeypatch.setattr(keys, "states_of", lambda rooms: {"scene": "released", "init": "1234"})
    monkeypatch.setattr(keys, "changed_since_asked", lambda rooms: ["init"])
    (home / "own_code.py").write_text(CLASS)
    importlib.import_module("own_code")
    user = UserCode({"own_code": str(module_digest("own_code"))})
    step = step_of(keys.CAPTURE, {"x": 1}, lambda folder: None, user, in_processes=True)
    assert step.inputs == {"x": 1, "code": {"init": "1234"}}
    assert step.code == {"scene": "released", "init": "1234"}
    with pytest.raises(InputError, match="gsbench's init changed while scene ran"):
        step.check()
    (home / "own_code.py").write_text(CLASS + CLASS)
    with pytest.raises(InputError, match="gsbench's init, the code of own_code changed"):
        step.check()
    step_of(keys.CAPTURE, {"x": 1}, lambda folder: None, user).check()
    monkeypatch.setattr(keys, "states_of", lambda rooms: {"scene": "released"})
    assert step_of(keys.CAPTURE, {"x": 1}, lambda folder: None).inputs == {"x": 1}
