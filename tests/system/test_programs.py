"""Every place where gsbench starts a process is listed here, with the folder where it starts."""

import ast
import os
import sys
from functools import cache
from pathlib import Path

import pytest

from gsbench.system import install, programs, resources
from tests.helpers import table, write
from tests.processes import completed

SRC = Path(programs.__file__).parents[1]
SOURCES = {file.relative_to(SRC).as_posix(): file.read_text("utf-8") for file in SRC.rglob("*.py")}

# "own": an empty folder; "neutral": gsbench's; "current": the current folder, since the user's
# relative paths count from there. A Python starts with -P, and imports nothing from there.
STARTS = {
    ("external/run.py", "watch", "subprocess.Popen"): "own",
    ("launch/slurm.py", "make_executor", "submitit.SlurmExecutor"): "current",
    ("launch/jobs.py", "run_local", "submitit.LocalExecutor"): "current",
    ("pipeline/steps/external.py", "check_version", "subprocess.run"): "own",
    ("system/isolate.py", "_run_child", "subprocess.Popen"): "current",
    ("system/isolate.py", "continue_in_child", "os.fork"): "current",
    ("system/programs.py", "answer_of", "subprocess.run"): "neutral",
    ("tracking/beside.py", "_start", "subprocess.Popen"): "current",
    ("verbs/servers.py", "serve", "subprocess.Popen"): "own",
}
# By module, the beginnings of the names that start processes, wherever they are mentioned.
STARTERS = {
    "subprocess": ("run", "call", "check_", "Popen", "getoutput", "getstatusoutput"),
    "os": ("system", "popen", "spawn", "exec", "posix_spawn", "startfile", "fork"),
    "pty": ("spawn", "fork"),
    "webbrowser": ("open", "get"),
    "asyncio": ("create_subprocess", "subprocess"),
    "psutil": ("Popen",),
    "submitit": ("AutoExecutor", "LocalExecutor", "SlurmExecutor", "DebugExecutor"),
    "multiprocessing": ("",),
    "concurrent": ("futures.Process",),
    "pexpect": ("",),
    "torch": ("multiprocessing", "distributed", "utils.cpp_extension", "hub"),
}


parse = cache(ast.parse)


def starts_of(text):
    """Where a module mentions what starts processes: {(function, name): [call or None]}."""
    found = {}
    if not any(f"{module}." in text for module in STARTERS):
        return found
    tree = parse(text)
    parents = {child: node for node in ast.walk(tree) for child in ast.iter_child_nodes(node)}
    for node in parents:
        if not isinstance(node, ast.Attribute):
            continue
        module, _, name = ast.unparse(node).partition(".")
        if "(" in name or not name.startswith(STARTERS.get(module, ("no name",))):
            continue
        parent = place = parents[node]
        if isinstance(parent, ast.Subscript):
            continue  # a type: Popen[bytes]
        while not isinstance(place, ast.FunctionDef | ast.AsyncFunctionDef | ast.Module):
            place = parents[place]
        call = parent if isinstance(parent, ast.Call) and parent.func is node else None
        key = getattr(place, "name", ""), f"{module}.{name}"
        found.setdefault(key, []).append(call)
    return found


def _starts(name):
    """Whether an imported module is one of `STARTERS`, or such a part of one."""
    root, _, rest = name.partition(".")
    return root in STARTERS and (not rest or rest.startswith(STARTERS[root]))


def hidden_names(text):
    """The imports by which a module could start processes unseen by `starts_of`."""
    tree = parse(text)
    blocks = (node for node in ast.walk(tree) if isinstance(node, ast.If))
    for_types = (node for node in blocks if ast.unparse(node.test) == "TYPE_CHECKING")
    unseen = {part for block in for_types for part in ast.walk(block)}
    for node in ast.walk(tree):
        if node in unseen:
            continue
        if isinstance(node, ast.ImportFrom) and node.module:
            root, _, rest = node.module.partition(".")
            names = [f"{rest}.{one.name}".lstrip(".") for one in node.names]
            yield from (name for name in names if name.startswith(STARTERS.get(root, ("no name",))))
        elif isinstance(node, ast.Import):
            others = [one for one in node.names if one.asname not in (None, one.name)]
            yield from (one.asname for one in others if _starts(f"{one.name}."))
        elif isinstance(node, ast.Constant) and node.value in ("subprocess", "multiprocessing"):
            yield node.value  # as for importlib.import_module


def test_every_start_of_a_process_is_listed_with_its_folder():
    found = {
        (file, *key): calls
        for file, text in SOURCES.items()
        for key, calls in starts_of(text).items()
    }
    assert found.keys() == STARTS.keys()
    for key, where in STARTS.items():
        for call in found[key]:
            words = {word.arg: ast.unparse(word.value) for word in call.keywords}
            assert (words.get("cwd") == "NEUTRAL") == (where == "neutral")
            assert ({"cwd", "env"} <= words.keys()) == (where != "current")


def test_nobody_starts_a_process_by_another_name():
    hidden = {file: list(hidden_names(text)) for file, text in SOURCES.items()}
    assert {file: names for file, names in hidden.items() if names} == {}


@pytest.mark.parametrize(
    "line, seen",
    table(__file__, "a_start_of_a_process_is_seen_however_it_is_written"),
)
def test_a_start_of_a_process_is_seen_however_it_is_written(line, seen):
    count = len(starts_of(line))
    assert (count or next(iter(hidden_names(line)), 0)) == seen


def test_every_python_starts_without_the_current_folder_in_its_search_path():
    for file, text in SOURCES.items():
        for node in ast.walk(ast.parse(text)) if "sys.executable" in text else ():
            if isinstance(node, ast.List) and ast.unparse(node).startswith("[sys.executable"):
                assert ast.unparse(node).startswith("[sys.executable, '-P', "), file


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
        write(folder / name, f"#!/bin/sh\ntouch {tmp_path}/exploded\n").chmod(0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", entry)
    start(tmp_path)
    assert not (tmp_path / "exploded").exists()


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


READ_BY_LIBRARIES = """
sitecustomize.py usercustomize.py json.py yaml.py requests.py wandb/settings .env .netrc MLproject
pyproject.toml conftest.py matplotlibrc .numba_config.yaml alembic.ini uname git python
"""
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
codes = [run(words.split()) for words in sys.argv[1:]]
print("seen", sorted(seen), "codes", codes)
"""
TINY = "scene=courtyard scene.views=8 scene.width=32 scene.height=24 init=random init.count=50"
TINY += " densify=none train.iterations=1 eval.lpips=[] raster=reference name=tiny"


@pytest.mark.slow
def test_no_library_reads_what_lies_in_the_current_folder(tmp_path):
    for name in READ_BY_LIBRARIES.split():
        text = "#!/bin/sh\ntouch exploded\n" if "." not in name else "raise SystemExit(9)"
        write(tmp_path / name, text).chmod(0o755)
    paths = {"PATH": ".:" + os.environ["PATH"], "PYTHONPATH": str(SRC.parent)}
    commands = [TINY, "sync", "tables tiny", "report tiny", "doctor"]
    command = [sys.executable, "-P", "-c", WATCHED, *commands]
    done = completed(command, code=None, cwd=tmp_path, env=os.environ | paths)
    assert done.stdout.splitlines()[-1] == "seen [] codes [0, 0, 0, 0, 0]", done.stderr
    assert not (tmp_path / "exploded").exists()
