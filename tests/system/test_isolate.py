"""The isolated call: results, exceptions and crashes come back as what they are."""

import os
import sys
import time
from types import SimpleNamespace

import numpy as np
import psutil
import pytest
from numpy.testing import assert_array_equal

from gsbench.system import isolate
from gsbench.system.isolate import CrashError, run_isolated
from tests.helpers import refusal, table

FUNCTIONS = """
import logging, os, sys
import numpy as np
from gsbench.errors import InputError

class Unpicklable(Exception):
    def __init__(self, a, b):
        super().__init__(f"{a}-{b}")

def add(a, b, scale=1):
    return (a + b) * scale

def double(array):
    return array * 2, os.getpid()

def loaded_modules():
    return sorted(sys.modules), sys.modules["__main__"].__dict__.get("__file__")

def warn():
    logging.getLogger("gsbench.x").warning("%s is odd", "it")
    logging.getLogger("gsbench.x").info("and more")

def refuse():
    raise InputError("the folder is empty: add photos")

def odd():
    raise Unpicklable("x", 1)

def work(job, progress):
    print("printed")
    progress("a", job, 5)
    if job == 3:
        raise ValueError("three")
    progress("b", 1, None, "note")
    return job + 1

def abort():
    sys.stderr.write("noise\\nterminate called: what():  the model is broken\\n")
    sys.stderr.flush()
    os.abort()

def leave():
    os._exit(7)
"""


@pytest.fixture
def functions(tmp_path, monkeypatch):
    (tmp_path / "isolated_functions.py").write_text(FUNCTIONS)
    monkeypatch.syspath_prepend(tmp_path)
    sys.modules.pop("isolated_functions", None)
    import isolated_functions

    yield isolated_functions
    sys.modules.pop("isolated_functions", None)


def test_result_comes_back_from_another_process(functions):
    assert run_isolated(functions.add, 1, 2, 3) == 9
    array = np.arange(1_000_000.0).reshape(1000, 1000)
    doubled, pid = run_isolated(functions.double, array)
    assert pid != os.getpid()
    assert_array_equal(doubled, array * 2)


def test_child_imports_neither_torch_nor_the_main_module(functions):
    modules, main_file = run_isolated(functions.loaded_modules)
    assert "torch" not in modules
    assert "pytest" not in modules
    assert main_file is None


def test_exception_keeps_type_text_and_traceback(functions):
    with refusal("the folder is empty: add photos") as caught:
        run_isolated(functions.refuse, what="reading")
    assert "in refuse" in "".join(caught.value.__notes__)
    with pytest.raises(RuntimeError, match="Unpicklable: x-1"):
        run_isolated(functions.odd)


def test_warnings_of_the_function_are_logged_here(functions, caplog):
    run_isolated(functions.warn)
    assert caplog.messages == ["it is odd"]


def test_crash_is_one_line_with_the_reason(functions, tmp_path):
    log = tmp_path / "log.txt"
    log.write_text("what() of an earlier call\n")
    with pytest.raises(CrashError) as caught:
        run_isolated(functions.abort, what="undistortion", log=log)
    message = str(caught.value)
    assert message.startswith("undistortion crashed (SIGABRT)")
    assert "the model is broken" in message
    assert "earlier" not in message
    assert "\n" not in message
    assert "noise" in log.read_text()


def test_early_exit_without_output(functions):
    with pytest.raises(CrashError, match=r"exit code 7.*no output"):
        run_isolated(functions.leave)


# ---- parts, in this process


@pytest.mark.parametrize(
    "output, said",
    [
        (b"", "(no output)"),
        (b"\n  \n", "(no output)"),
        (b"one\n two \nthree\nfour\n", "two | three | four"),
        (b"Error: a\nlater\nb error\nlast\n", "Error: a | b error"),
        (b"  File x, Error\n@ 0x1 error\n*** Check failed\nfree(): y\n\xff\n", "free(): y"),
        (b"e1 error\ne2 error\ne3 error\ne4 error", "e2 error | e3 error | e4 error"),
    ],
)
def test_the_last_lines_that_tell_a_reason_are_quoted(output, said, tmp_path):
    assert isolate.error_lines(output) == said
    (tmp_path / "log").write_bytes(b"Error: earlier\n" + output)
    assert isolate.error_tail(tmp_path / "log", 15) == said


def test_only_the_end_of_a_long_output_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(isolate, "_TAIL_BYTES", 8)
    (tmp_path / "log").write_text("Error: a\nError: b")
    assert isolate.error_tail(tmp_path / "log") == "Error: b"


@pytest.mark.parametrize(
    "code, said",
    table(__file__, "the_end_of_a_process_is_described"),
)
def test_the_end_of_a_process_is_described(code, said):
    assert isolate.describe_exit(code) == said


def test_progress_and_output_of_a_function_are_forwarded_to_the_end(functions, tmp_path):
    told, log = [], tmp_path / "log"

    def report(*given, **named):
        told.append((*given, *named.values()))
        raise BrokenPipeError  # a closed terminal stops nothing

    assert isolate.run_isolated(functions.work, 2, what="work", log=log, progress=report) == 3
    assert told == [("a", 2, 5, ""), ("b", 1, None, "note")]
    assert log.read_text() == "printed\n"
    with pytest.raises(ValueError, match="three"):
        isolate.run_isolated(functions.work, 3, what="work", progress=report)
    assert told[2:] == [("a", 3, 5, "")]


def test_descendants_that_cannot_be_killed_are_given_up(monkeypatch):
    now = iter([100.0, 104.9, 105.0])
    asked = []
    monkeypatch.setattr(time, "monotonic", lambda: next(now))
    monkeypatch.setattr(time, "sleep", lambda seconds: None)
    stubborn = SimpleNamespace(status=lambda: "running", kill=lambda: asked.append(1))
    here = SimpleNamespace(children=lambda recursive: [stubborn])
    monkeypatch.setattr(psutil, "Process", lambda: here)
    isolate.end_descendants()
    assert asked == [1]
