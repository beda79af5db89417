"""Every place where gsbench starts a process is listed here, with the folder where it starts."""

import ast
import os
import sys
from pathlib import Path

import pytest

from gsbench.system import install, programs, resources
from tests.helpers import write
from tests.processes import completed

SRC = Path(programs.__file__).parents[1]

# "own": an empty folder; "neutral": gsbench's; "current": the current folder, since the user's
# relative paths count from there. A Python starts with -P, and imports nothing from there.
STARTS = {
    ("external/program.py", "watch", "subprocess.Popen"): "own",
    ("launch/states.py", "read_queue", "subprocess.run"): "neutral",
    ("pipeline/steps/train.py", "check_version", "subprocess.run"): "own",
    ("system/install.py", "run_git", "subprocess.run"): "neutral",
    ("system/isolate.py", "_run_child", "subprocess.Popen"): "current",
    ("system/resources.py", "nvidia_smi", "subprocess.run"): "neutral",
    ("tracking/mirror.py", "_start", "subprocess.Popen"): "own",
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
        assert (words.get("cwd") == "NEUTRAL") == (where == "neutral")
        assert ({"cwd", "env"} <= words.keys()) == (where != "current")


def test_every_python_starts_without_the_current_folder_in_its_search_path():
    for file in SRC.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.List) and ast.unparse(node).startswith("[sys.executable"):
                assert ast.unparse(node).startswith("[sys.executable, '-P', "), file


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


@pytest.mark.parametrize(
    "given, kept",
    [
        ("", ""),
        (".", ""),
        (":/a", "/a"),
        ("/a:", "/a"),
        ("./:b:/a/", "{here}/b:/a"),
        ("{here}", "{here}"),
    ],
)
def test_the_current_folder_is_no_place_for_modules_and_programs(
    given, kept, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), "/a"])
    monkeypatch.setenv("PYTHONPATH", given.format(here=tmp_path))
    monkeypatch.setenv("PATH", f".{os.pathsep}/bin{os.pathsep}{os.pathsep}bin")
    programs.protect_environment()
    assert os.environ["PYTHONPATH"] == kept.format(here=tmp_path)
    assert os.environ["PATH"] == "/bin"
    assert os.environ["PYTHONSAFEPATH"]
    assert (str(tmp_path) in sys.path) == (given in ("", "{here}"))


READ_BY_LIBRARIES = ("sitecustomize.py", "usercustomize.py", "json.py", "yaml.py", "requests.py")
READ_BY_LIBRARIES += (
    "wandb/settings",
    ".env",
    ".netrc",
    "MLproject",
    "pyproject.toml",
    "conftest.py",
)
READ_BY_LIBRARIES += ("matplotlibrc", ".numba_config.yaml", "alembic.ini", "uname", "git", "python")
WATCHED = """
import os, sys
here, seen = os.getcwd(), set()
def hook(event, words):
    if event in ("open", "os.listdir", "os.scandir") and isinstance(words[0], str | bytes):
        place = os.path.abspath(os.fsdecode(words[0]))
        if os.path.dirname(place).startswith(here) and not place.startswith(here + "/runs"):
            seen.add(place)
sys.addaudithook(hook)
from gsbench.cli import run
code = run(sys.argv[1:])
print("seen", sorted(seen), "code", code)
"""
TINY = "scene=courtyard scene.views=8 scene.width=32 scene.height=24 init=random init.count=50"
TINY += " densify=none train.iterations=1 eval.lpips=[] raster=reference name=tiny"


@pytest.mark.slow
@pytest.mark.parametrize("path", ["", ".:"])
def test_no_library_reads_what_lies_in_the_current_folder(path, tmp_path):
    (tmp_path / "wandb").mkdir()
    for name in READ_BY_LIBRARIES:
        file = tmp_path / name
        file.write_text("#!/bin/sh\ntouch exploded\n" if "." not in name else "raise SystemExit(9)")
        file.chmod(0o755)
    environment = os.environ | {"PATH": path + os.environ["PATH"], "PYTHONPATH": str(SRC.parent)}
    for words in (TINY.split(), ["sync"], ["tables", "tiny"], ["report", "tiny"], ["doctor"]):
        command = [sys.executable, "-P", "-c", WATCHED, *words]
        done = completed(command, code=None, cwd=tmp_path, env=environment)
        assert done.stdout.splitlines()[-1] == "seen [] code 0", done.stderr
    assert not (tmp_path / "exploded").exists()
