"""The files of gsbench that a file of it imports, read from their text, for kernels that are compiled and kept."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]


def import_closure(source: Path, package: Path = PACKAGE) -> frozenset[Path]:
    """``source`` and every file of ``package`` that it imports, directly or through others.

    Read from the text, wherever the import stands: also inside functions.
    """
    found: set[Path] = set()
    waiting = [source.resolve()]
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting += _imported(path, package.resolve())
    return frozenset(found)


@cache
def _imported(source: Path, package: Path) -> tuple[Path, ...]:
    """The files of ``package`` that the text of ``source`` imports."""
    inner = source.relative_to(package).with_suffix("").parts
    is_package = source.name == "__init__.py"
    module = ".".join((package.name, *(inner[:-1] if is_package else inner)))
    files = []
    for imported, name in _names(ast.parse(source.read_bytes()), module, is_package):
        # A name is a module below, or else comes out of the module that is named.
        files.append((_file(f"{imported}.{name}", package) if name else None) or _file(imported, package))
    return tuple(file for file in files if file is not None)


def _file(module: str, package: Path) -> Path | None:
    """File of the module ``module`` of ``package``; None for modules of other packages."""
    first, *rest = module.split(".")
    if first != package.name:
        return None
    place = package.joinpath(*rest)
    for file in (place / "__init__.py", place.with_suffix(".py")):
        if file.is_file():
            return file
    return None


def _names(tree: ast.Module, module: str, is_package: bool) -> Iterator[tuple[str, str | None]]:
    """The modules that import statements name, each with what is taken of it, None for the module itself."""
    package = module if is_package else module.rpartition(".")[0]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, None) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")
            above = ".".join(parts[: len(parts) - node.level + 1]) if node.level else ""
            source = ".".join(part for part in (above, node.module) if part)
            yield from ((source, alias.name) for alias in node.names)
