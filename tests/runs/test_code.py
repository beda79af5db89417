"""The state of gsbench's own code: which files count for what, and which edits do."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from gsbench.runs import code
from gsbench.runs.code import (
    AS_RELEASED,
    PACKAGE,
    changed_files,
    changed_while_running,
    digest_of,
    edited,
    files_of,
    state_of,
)

ADC = [("gsbench.pipeline.steps.train", None), ("gsbench.densify.adc", None)]
SOURCE = '"""A module."""\nX = 0.8  # weight\n\n\ndef loss(a):\n    """The loss."""\n    return X * a\n'


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of gsbench that is not the one that runs, without files of a release, read as by a new process."""
    copy = shutil.copytree(PACKAGE, tmp_path / "gsbench", ignore=shutil.ignore_patterns("__pycache__", "*.json"))
    monkeypatch.setattr(code, "PACKAGE", copy)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(code, "IMPORTED_AT", time.time_ns() + 10**12)
    again(monkeypatch)
    yield copy
    again(monkeypatch)


def again(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in another process."""
    monkeypatch.setattr(code, "_sources", {})
    for cached in (code._released, code._digests, code._place):
        cached.cache_clear()


@pytest.mark.parametrize(
    "edit",
    [
        lambda text: text.replace("  # weight", ""),
        lambda text: text.replace("weight", "another comment"),
        lambda text: text.replace("The loss.", "It is\n    longer."),
        lambda text: text.replace("A module.", ""),
        lambda text: text.replace("X * a", "(X\n            * a)"),
        lambda text: text.replace('    """The loss."""\n', ""),
        lambda text: text.replace("0.8", "0.80"),
    ],
)
def test_comments_docstrings_and_layout_do_not_count(edit: Callable[[str], str]) -> None:
    assert edit(SOURCE) != SOURCE
    assert digest_of(edit(SOURCE).encode()) == digest_of(SOURCE.encode())


@pytest.mark.parametrize(
    "edit",
    [
        lambda text: text.replace("0.8", "0.81"),
        lambda text: text.replace("*", "+"),
        lambda text: text.replace("(a)", "(a=None)"),
        lambda text: text.replace("return X", "return -X"),
        lambda text: text.replace("X", "Y"),
        lambda text: text.replace("    return X * a", "    return X * a\n    'more'"),
        lambda text: text.replace("X = 0.8", "X = '0.8'"),
        lambda text: text.replace("X = 0.8", "X = 'a', 'b'"),
        lambda text: text.replace("X = 0.8", "X = ['a', 'b']"),
        lambda text: text + "X = None\n",
        lambda text: text + "(",
    ],
)
def test_whatever_can_change_a_number_counts(edit: Callable[[str], str]) -> None:
    assert digest_of(edit(SOURCE).encode()) != digest_of(SOURCE.encode())


def test_a_stage_reaches_what_its_numbers_depend_on_and_no_more() -> None:
    files = files_of(ADC)
    assert {"train/trainer.py", "train/loss.py", "eval/ssim.py", "densify/adc.py", "densify/base.py"} <= files.keys()
    assert {"gaussians/trainable.py", "scene/load.py", "pipeline/components.py"} <= files.keys()
    assert not {"densify/mcmc.py", "eval/lpips.py", "verbs/tables.py", "words.py", "config/schema.py"} & files.keys()
    assert "init/colmap/mapping.py" in files_of([("gsbench.init", "Sfm")])
    assert "init/dim.py" not in files_of([("gsbench.init", "Sfm")])
    assert {"densify/mcmc.py", "densify/gns.py"} <= files_of([("gsbench.densify", None)]).keys()


def test_what_python_loads_for_a_stage_is_counted() -> None:
    """Python's own imports as the judge: no module of a room that makes numbers may be missing."""
    asked = "import gsbench.train.trainer, sys; print(*(n for n in sys.modules if n.startswith('gsbench.')))"
    loaded = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True).stdout.split()
    files = files_of([("gsbench.train.trainer", None)])
    for name in loaded:
        below = name.removeprefix("gsbench.")
        file = f"{below.replace('.', '/')}.py"
        arm = below.startswith("densify.")  # which the package passes on, and the training does not use
        if (PACKAGE / file).is_file() and below.partition(".")[0] not in code.WITHOUT_PART and not arm:
            assert file in files, name


def test_an_edit_is_seen_by_the_next_process_and_a_comment_is_not(
    package: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = files_of(ADC)
    assert changed_files(before) == []
    loss = package / "train" / "loss.py"
    text = loss.read_text()
    loss.write_text(text + "# more\n")
    assert changed_files(before) == []
    again(monkeypatch)
    assert changed_files(before) == []
    loss.write_text(text + "MORE = 1\n")
    assert changed_files(before) == [], "this process has loaded what it was"
    again(monkeypatch)
    assert changed_files(before) == ["train/loss.py"]
    assert files_of(ADC) != before
    loss.write_text(text)
    again(monkeypatch)
    assert files_of(ADC) == before
    loss.unlink()
    again(monkeypatch)
    assert changed_files(before) == ["train/loss.py"]


def test_an_edit_of_the_same_size_and_time_is_seen(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before, loss = files_of(ADC), package / "train" / "loss.py"
    state = loss.stat()
    loss.write_text(loss.read_text().replace("1 - ", "2 - "))
    os.utime(loss, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert loss.stat().st_size == state.st_size
    again(monkeypatch)
    assert changed_files(before) == ["train/loss.py"]


def test_where_all_is_as_released_nothing_is_in_the_key(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert edited(files_of(ADC)) == files_of(ADC)  # before the first release
    code.main()
    again(monkeypatch)
    released = files_of(ADC)
    assert set(released.values()) == {AS_RELEASED}
    assert edited(released) == {}
    (package / "eval" / "ssim.py").write_text("C1 = 2\n")
    again(monkeypatch)
    assert list(edited(files_of(ADC))) == changed_files(released) == ["eval/ssim.py"]
    code.main()  # of the next release, where the version of the stage is bumped by hand, or the numbers are the same
    again(monkeypatch)
    assert changed_files(released) == []
    (package / "train" / "loss_log.py").unlink()  # as a release may
    code.main()
    again(monkeypatch)
    assert state_of("train/journal.py") == AS_RELEASED


def test_an_edit_of_what_is_loaded_is_taken_for_unknown(
    package: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    before = files_of(ADC)
    (package / "train" / "loss.py").touch()
    monkeypatch.setattr(code, "IMPORTED_AT", time.time_ns() - 10**9)
    monkeypatch.setitem(sys.modules, "gsbench.train.loss", sys)
    again(monkeypatch)
    assert "train/loss.py" in changed_files(before)
    assert "train/loss.py was edited when it had been loaded" in caplog.text


def test_what_is_loaded_after_an_edit_is_told(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "gsbench.train.journal", raising=False)
    monkeypatch.setitem(sys.modules, "gsbench.train.loss", sys)
    files = files_of(ADC)
    for name in ("loss.py", "loss_log.py"):
        (package / "train" / name).touch()
    assert changed_while_running(files, in_processes=False) == ["train/journal.py"]
    assert changed_while_running(files, in_processes=True) == ["train/loss.py", "train/journal.py"]


def test_it_is_quick_and_does_without_a_cache(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = files_of(ADC)
    with monkeypatch.context() as patch:
        patch.setattr(code, "_parsed", lambda file: pytest.fail(f"{file} is parsed again"))
        again(monkeypatch)
        assert files_of(ADC) == first
    for content in ("{", "[]", '{"files": 3}', '{"files": {"train/loss.py": [1]}}'):
        code._cache_file().write_text(content)
        again(monkeypatch)
        assert files_of(ADC) == first
