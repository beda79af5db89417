"""Machine code that is kept on disk belongs to the sources that it was made of, wherever these lie."""

from __future__ import annotations

import importlib
import inspect
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import numba
import pytest

from gsbench.system.jit import PACKAGE, cache_base, cache_folder, import_closure

KERNEL_MODULES = sorted(
    path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py") if "\n@kernel\n" in path.read_text()
)


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A copy of gsbench's sources."""
    return Path(shutil.copytree(PACKAGE, tmp_path / "gsbench", ignore=shutil.ignore_patterns("__pycache__")))


def functions_of(value: Any, seen: set[int]) -> Iterator[FunctionType]:
    """The Python function behind a compiled one, and those that it calls, as Python itself resolves their names."""
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


def _names(code: Any) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if inspect.iscode(constant):
            yield from _names(constant)


def test_the_kernels_are_where_they_are_looked_for() -> None:
    assert len(KERNEL_MODULES) >= 5


@pytest.mark.parametrize("module", KERNEL_MODULES)
def test_the_closure_has_every_function_that_kernels_reach(module: str) -> None:
    loaded = importlib.import_module("gsbench." + module.removesuffix(".py").replace("/", "."))
    closure = import_closure(PACKAGE / module)
    seen: set[int] = set()
    reached = [function for value in vars(loaded).values() for function in functions_of(value, seen)]
    assert len(reached) > 3
    missing = {Path(function.__code__.co_filename).resolve() for function in reached} - closure
    assert not missing


@pytest.mark.parametrize("module", KERNEL_MODULES)
def test_a_change_in_any_source_changes_the_folder(package: Path, module: str) -> None:
    before = cache_folder(package / module, package)
    assert before == cache_folder(PACKAGE / module)  # the same sources elsewhere
    for source in import_closure(package / module, package):
        content = source.read_bytes()
        source.write_bytes(content + b"\n# changed\n")
        assert cache_folder(package / module, package) != before, source
        source.write_bytes(content)
    (package / "cli.py").write_text("changed = True\n")
    assert cache_folder(package / module, package) == before


def test_a_helper_that_moves_is_followed(package: Path) -> None:
    (package / "raster" / "vectors").mkdir()
    (package / "raster" / "cpu" / "simd.py").rename(package / "raster" / "vectors" / "wide.py")
    composite = package / "raster" / "cpu" / "composite.py"
    text = composite.read_text().replace("gsbench.raster.cpu.simd", "gsbench.raster.vectors.wide")
    composite.write_text(text)
    assert package / "raster" / "vectors" / "wide.py" in import_closure(composite, package)


def test_every_way_to_import(tmp_path: Path) -> None:
    package = tmp_path / "pack"
    files = {
        "__init__.py": "",
        "a.py": "import pack.b\nfrom pack import c\nfrom . import d\nfrom .sub.e import x\nimport os\n",
        "b.py": "def f():\n    from pack.sub import name\nif TYPE_CHECKING:\n    import pack.stranger\n",
        "c.py": "from pack.absent import x\n",
        "d.py": "import pack.a\n",
        "sub/__init__.py": "from ..late import name\n",
        "sub/e.py": "x = 1\n",
        "late.py": "name = 1\n",
        "stranger.py": "",
    }
    for name, text in files.items():
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / name).write_text(text)
    found = {path.relative_to(package).as_posix() for path in import_closure(package / "a.py", package)}
    assert found == set(files) - {"stranger.py", "__init__.py"}  # no name comes out of the outermost package


def test_the_base_is_the_folder_that_is_set_or_another_that_can_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "given"))
    assert cache_base.__wrapped__() == tmp_path / "given"
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "below"))
    assert cache_base.__wrapped__() == tmp_path / "cache" / "gsbench" / "numba"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert cache_base.__wrapped__().name.startswith("gsbench-numba-")


def test_processors_do_not_share_a_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    """Machines of two kinds may have one home folder, and write there at once."""
    source = PACKAGE / KERNEL_MODULES[0]
    folders = {cache_folder(source)}
    for name, features in (("bonnell", ""), ("haswell", "+avx2"), ("haswell", "+avx2,+fma")):
        monkeypatch.setattr(numba.config, "CPU_NAME", name)
        monkeypatch.setattr(numba.config, "CPU_FEATURES", features)
        folders.add(cache_folder(source))
    assert len(folders) == 4
