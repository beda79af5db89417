"""The isolated call: results, exceptions and crashes come back as what they are."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest

import gsbench
from gsbench.errors import InputError
from gsbench.system.isolate import CrashError, run_isolated
from tests.processes import heed_interrupts

PATIENCE = 120.0  # seconds; a slow machine needs fewer
SOURCE = Path(gsbench.__file__).parents[1]

FUNCTIONS = """
import os, sys, time
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

def refuse():
    raise InputError("the folder is empty: add photos")

def odd():
    raise Unpicklable("x", 1)

def abort():
    sys.stderr.write("noise\\nterminate called: what():  the model is broken\\n")
    sys.stderr.flush()
    os.abort()

def leave():
    os._exit(7)

def beat(path):
    while True:
        with open(path, "a") as stream:
            stream.write(".")
        time.sleep(0.02)
"""


@pytest.fixture
def functions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
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
    np.testing.assert_array_equal(doubled, array * 2)


def test_child_imports_neither_torch_nor_the_main_module(functions):
    modules, main_file = run_isolated(functions.loaded_modules)
    assert "torch" not in modules
    assert "pytest" not in modules
    assert main_file is None


def test_exception_keeps_type_text_and_traceback(functions):
    with pytest.raises(InputError, match="the folder is empty: add photos") as caught:
        run_isolated(functions.refuse, what="reading")
    assert "in refuse" in "".join(caught.value.__notes__)
    with pytest.raises(RuntimeError, match="Unpicklable: x-1"):
        run_isolated(functions.odd)


def test_crash_is_one_line_with_the_reason(functions, tmp_path: Path):
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


@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGKILL])
def test_child_ends_with_its_parent(functions, tmp_path: Path, sign: signal.Signals):
    beats, script = tmp_path / "beats.txt", tmp_path / "main.py"
    script.write_text(
        textwrap.dedent(f"""
        import sys
        sys.path[:0] = [{str(SOURCE)!r}, {str(tmp_path)!r}]
        from gsbench.system.isolate import run_isolated
        import isolated_functions
        run_isolated(isolated_functions.beat, {str(beats)!r})  # no __main__ guard: it must not be imported again
        """)
    )
    parent = subprocess.Popen(
        [sys.executable, str(script)], stderr=subprocess.PIPE, preexec_fn=heed_interrupts
    )
    deadline = time.monotonic() + PATIENCE
    while not beats.exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    assert beats.exists()
    parent.send_signal(sign)
    _, errors = parent.communicate(timeout=PATIENCE)
    deadline = time.monotonic() + PATIENCE
    assert parent.returncode != 0
    if sign == signal.SIGINT:
        assert b"KeyboardInterrupt" in errors
    size = -1
    while beats.stat().st_size != size:  # it writes fifty times a second as long as it lives
        assert time.monotonic() < deadline
        size = beats.stat().st_size
        time.sleep(0.5)
