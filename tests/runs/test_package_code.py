"""The digests of gsbench's own code, package by package, and the packages behind each stage."""

import shutil
from itertools import chain

import pytest

from gsbench.runs import package_code
from gsbench.runs.keys import CODE_OF_STAGE
from gsbench.runs.package_code import (
    AS_RELEASED,
    PACKAGE,
    changed_since_asked,
    edited,
    states_of,
    syntax_of,
)
from tests.conftest import script
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

    It is read as by a new process.
    """
    copy = shutil.copytree(
        PACKAGE, tmp_path / "gsbench", ignore=shutil.ignore_patterns("__pycache__", "*.json")
    )
    monkeypatch.setattr(package_code, "PACKAGE", copy)
    again()
    yield copy
    again()


def again():
    """Forget what this process has read, as in a new process."""
    for cached in (package_code._released, package_code.state_of, package_code._first_contents):
        cached.cache_clear()


@pytest.mark.parametrize(
    "old, new",
    [
        ("weight", "another comment"),
        ("The loss.", "It is\n    longer."),
        ("A module.", ""),
        ("X * a", "(X\n            * a)"),
        ('    """The loss."""\n', ""),
        ("0.8", "0.80"),
    ],
)
def test_comments_docstrings_and_layout_do_not_count(old, new):
    assert old in SOURCE
    assert syntax_of(SOURCE.replace(old, new).encode()) == syntax_of(SOURCE.encode())


@pytest.mark.parametrize(
    "old, new",
    [
        ("0.8", "0.81"),
        ("*", "+"),
        ("(a)", "(a=None)"),
        ("X", "Y"),
        ("    return X * a", "    return X * a\n    'more'"),
        ("X = 0.8", "X = '0.8'"),
        ("X * a\n", "X * a\nX = None\n"),
        ("X * a\n", "X * a\n("),
    ],
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
    monkeypatch.setattr(package_code, "PACKAGE", tmp_path)
    (tmp_path / "pack/inner").mkdir(parents=True)
    for name in ("pack/b.py", "pack/inner/deep.py", "one.py"):
        (tmp_path / name).write_text(
            f"{name} ("
        )  # Python's versions write syntax trees differently
    again()
    found = states_of(["pack", "one.py"])
    again()
    assert found == {"one.py": "8955de80759662ec", "pack": "7d79c895ac4d3f58"}


def test_released_code_adds_nothing_to_keys(package, monkeypatch):
    # before the first release
    assert edited(states_of(CODE_OF_STAGE["train"])) == states_of(CODE_OF_STAGE["train"])
    script("released").main()
    again()
    with monkeypatch.context() as patch:
        patch.setattr(
            package_code, "syntax_of", lambda source: pytest.fail("a released package is parsed")
        )
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


def test_an_edit_while_this_process_works_is_noticed(package):
    states_of(["train", "scene"])
    assert changed_since_asked(["train", "scene"]) == []
    with (package / "train/loss.py").open("a") as file:
        file.write("MORE = 1\n")
    assert changed_since_asked(["train", "scene"]) == ["train"]


@pytest.mark.parametrize("one, other", [("f()", "g()"), ("1", "2"), ("if a:\n 'x'", "if a:\n 'y'")])
def test_only_docstrings_are_left_out(one, other):
    assert syntax_of(one.encode()) != syntax_of(other.encode())
