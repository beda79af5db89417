"""Compiled kernels on disk are used only with the sources that they were made from."""

import importlib
import inspect
import shutil
from pathlib import Path
from types import FunctionType, ModuleType, SimpleNamespace

import numba
import pytest

from gsbench.system.jit import PACKAGE, SOURCES, _Announcement, cache_base, cache_folder
from tests.test_architecture import arrows, modules

KERNEL_MODULES = sorted(
    path.relative_to(PACKAGE).as_posix()
    for path in PACKAGE.rglob("*.py")
    if "\n@kernel\n" in path.read_text()
)


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    """A copy of gsbench's sources."""
    copy, unwanted = tmp_path_factory.mktemp("sources") / "gsbench", ("__pycache__",)
    return Path(shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns(*unwanted)))


def functions_of(value, seen):
    """The Python function behind a compiled one, and those that it calls."""
    function = getattr(value, "py_func", value)
    if not isinstance(function, FunctionType) or id(function) in seen:
        return
    seen.add(id(function))
    if not function.__module__.startswith("gsbench."):
        return
    yield function
    for name in _names(function.__code__):
        found = function.__globals__.get(name)
        for candidate in vars(found).values() if isinstance(found, ModuleType) else [found]:
            yield from functions_of(candidate, seen)


def _names(code):
    yield from code.co_names
    for constant in code.co_consts:
        if inspect.iscode(constant):
            yield from _names(constant)


def test_modules_with_kernels_are_found():
    assert len(KERNEL_MODULES) >= 5


@pytest.mark.parametrize("module", KERNEL_MODULES)
def test_sources_include_every_function_that_kernels_call(module):
    loaded = importlib.import_module("gsbench." + module.removesuffix(".py").replace("/", "."))
    seen = set()
    reached = [
        function
        for value in vars(loaded).values()
        if hasattr(value, "py_func")
        for function in functions_of(value, seen)
    ]
    assert reached
    missing = {Path(function.__code__.co_filename).resolve() for function in reached} - sources(
        PACKAGE
    )
    assert not missing


def sources(package):
    places = [package / source for source in SOURCES]
    return {
        path for place in places for path in (place.rglob("*.py") if place.is_dir() else [place])
    }


@pytest.mark.parametrize("source", SOURCES)
def test_a_change_in_any_source_changes_the_folder(package, source):
    before = cache_folder.__wrapped__(package)
    assert before == cache_folder()  # the same sources elsewhere
    place = package / source
    path = place if place.suffix else place / "__init__.py"
    content = path.read_bytes()
    path.write_bytes(content + b"\n# changed\n")
    assert cache_folder.__wrapped__(package) != before, source
    path.write_bytes(content)
    (package / "cli.py").write_text("changed = True\n")
    assert cache_folder.__wrapped__(package) == before


def test_sources_include_every_module_that_kernels_import():
    """Modules that only prepare calls of kernels are exceptions."""
    known = {path.relative_to(PACKAGE).as_posix() for path in sources(PACKAGE)}
    around = {
        "logs.py",
        "errors.py",
        "words.py",
        "files.py",
        "parsing.py",
        "system/resources.py",
        "system/locks.py",
        "system/machine.py",
        "scene/types.py",
        "scene/colmap.py",
        "scene/rules.py",
        "raster/splitting.py",
    }
    around |= {"eval/images.py", "eval/protocol.py", "scene/options.py", "__init__.py"}
    files = {name: path.relative_to(PACKAGE).as_posix() for name, path in modules().items()}
    for name, targets in arrows().items():
        if files[name] in known:
            strange = {files[target] for target in targets if target in files} - known - around
            assert not strange, f"{name} imports {strange}"


def test_the_cache_is_in_the_configured_folder_or_another_writable_one(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "given"))
    assert cache_base.__wrapped__() == tmp_path / "given"
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "below"))
    assert cache_base.__wrapped__() == tmp_path / "cache" / "gsbench" / "numba"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert cache_base.__wrapped__().name.startswith("gsbench-numba-")


def test_processors_do_not_share_a_folder(monkeypatch):
    """Machines of two kinds may have one home folder, and write there at once."""
    folders = {cache_folder.__wrapped__()}
    for name, features in (("bonnell", ""), ("haswell", "+avx2"), ("haswell", "+avx2,+fma")):
        monkeypatch.setattr(numba.config, "CPU_NAME", name)
        monkeypatch.setattr(numba.config, "CPU_FEATURES", features)
        folders.add(cache_folder.__wrapped__())
    assert len(folders) == 4


def test_compiling_is_announced_once_and_only_for_own_kernels(caplog):
    def event(module):
        function = SimpleNamespace(__module__=module)
        return SimpleNamespace(data={"dispatcher": SimpleNamespace(py_func=function)})

    announcement = _Announcement()
    said = []
    for module in ("gsbenchmark.kernels", "numpy", "gsbench.raster", "gsbench.train", "numpy"):
        announcement.on_start(event(module))
        said.append(len(caplog.messages))
    assert said == [0, 0, 1, 1, 1]
    assert caplog.messages == ["compiling kernels for this processor, some 30 s, once"]
