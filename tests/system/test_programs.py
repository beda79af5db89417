"""Every place where gsbench starts a process is listed here, with the folder where it starts."""

import ast
from pathlib import Path

import pytest

from gsbench.system import install, programs, resources
from tests.helpers import write

SRC = Path(programs.__file__).parents[1]

# "own": an empty folder; "neutral": gsbench's; "python": this interpreter with -P, in the current
# folder, since the user's relative paths count from there.
STARTS = {
    ("external/program.py", "watch", "subprocess.Popen"): "own",
    ("launch/states.py", "read_queue", "subprocess.run"): "neutral",
    ("pipeline/steps/train.py", "check_version", "subprocess.run"): "own",
    ("system/install.py", "run_git", "subprocess.run"): "neutral",
    ("system/isolate.py", "_run_child", "subprocess.Popen"): "python",
    ("system/resources.py", "nvidia_smi", "subprocess.run"): "neutral",
    ("tracking/mirror.py", "_start", "subprocess.Popen"): "python",
    ("verbs/servers.py", "_announce", "subprocess.run"): "neutral",
    ("verbs/servers.py", "serve", "subprocess.Popen"): "own",
    ("view/page.py", "write_page", "subprocess.run"): "own",
}
STARTERS = ("run", "call", "check_", "Popen", "getoutput", "getstatusoutput", "system", "popen")
MODULES = ("subprocess", "os", "pty", "webbrowser", "asyncio", "multiprocessing", "pexpect")
OF_OS = ("system", "popen", "spawn", "exec", "posix_spawn", "startfile")


def starts_of(file):
    """The calls in ``file`` that start processes."""
    found = {}
    tree = ast.parse(file.read_text(encoding="utf-8"))
    for function in ast.walk(tree):
        if not isinstance(function, ast.FunctionDef):
            continue
        for call in ast.walk(function):
            if not isinstance(call, ast.Call):
                continue
            if any(isinstance(part, ast.Call) for part in ast.walk(call.func)):
                continue  # a method of what another call returns
            name = ast.unparse(call.func)
            module, _, attribute = name.partition(".")
            if (
                (module == "subprocess" and attribute.startswith(STARTERS))
                or (module == "os" and attribute.startswith(OF_OS))
                or (module == "pty" and attribute == "spawn")
                or (module == "webbrowser" and attribute.startswith("open"))
                or attribute.startswith("create_subprocess")
                or (name.endswith((".Process", "ProcessPoolExecutor")) and module != "psutil")
            ):
                found[file.relative_to(SRC).as_posix(), function.name, name] = call
    return found


def test_every_start_of_a_process_is_listed_with_its_folder():
    found = {key: call for file in SRC.rglob("*.py") for key, call in starts_of(file).items()}
    assert found.keys() == STARTS.keys()
    for key, where in STARTS.items():
        words = {word.arg: ast.unparse(word.value) for word in found[key].keywords}
        text = ast.unparse(found[key]) + Path(SRC, key[0]).read_text()
        if where == "python":
            assert "python_command(" in text
        else:
            assert (words["cwd"] == "NEUTRAL") == (where == "neutral")
            assert "env" in words


def test_nobody_imports_a_starter_by_its_own_name():
    """`starts_of` sees ``subprocess.run``, not ``from subprocess import run``."""
    for file in SRC.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module in MODULES:
                names = [one.name for one in node.names if one.name not in ("PIPE", "DEVNULL")]
                assert not [one for one in names if one.startswith((*STARTERS, *OF_OS))], file


@pytest.mark.parametrize(
    "name, start",
    [
        ("git", lambda folder: install._git(folder, "rev-parse", "HEAD")),
        ("nvidia-smi", lambda folder: resources.nvidia_smi("index")),
    ],
)
@pytest.mark.parametrize("entry", [".", "", "bin"])
def test_no_program_of_the_current_folder_starts(name, start, entry, tmp_path, monkeypatch):
    for folder in (tmp_path, tmp_path / "bin"):
        write(folder / name, f"#!/bin/sh\ntouch {tmp_path}/exploded\n")
        (folder / name).chmod(0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", entry)
    start(tmp_path)
    assert not (tmp_path / "exploded").exists()
    assert programs.find_program(name) is None
