"""Sources of the package that a module is made of: the files that it imports, and those that these import."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[2]


def import_closure(source: Path, package: Path = PACKAGE) -> frozenset[Path]:
    """``source`` and every file of ``package`` that it imports, directly or through others.

    Read from the text, wherever the import stands: also inside functions, and for type checkers only.
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
    files = []
    for node in ast.walk(ast.parse(source.read_bytes())):
        if isinstance(node, ast.Import):
            files += [_file(alias.name, package) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            module = _absolute(node, source, package)
            # A name is a module below, or else comes out of the module that is named.
            files += [_file(f"{module}.{alias.name}", package) or _file(module, package) for alias in node.names]
    return tuple(file for file in files if file is not None)


def _absolute(node: ast.ImportFrom, source: Path, package: Path) -> str:
    """The full name of the module that ``from … import`` names."""
    if node.level == 0:
        return node.module or ""
    parents = list(_parents(source, package))
    above = parents[node.level - 1] if node.level <= len(parents) else ""
    return f"{above}.{node.module}" if node.module else above


def _parents(source: Path, package: Path) -> Iterator[str]:
    """The packages around ``source``, from the inside."""
    folder = source.parent
    while folder == package or package in folder.parents:
        yield ".".join((package.name, *folder.relative_to(package).parts))
        folder = folder.parent


def _file(module: str, package: Path) -> Path | None:
    """Where the module ``module`` of ``package`` lies; None for modules of other packages."""
    first, *rest = module.split(".")
    if first != package.name:
        return None
    place = package.joinpath(*rest)
    for file in (place / "__init__.py", place.with_suffix(".py")):
        if file.is_file():
            return file
    return None
