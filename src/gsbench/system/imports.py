"""Imports of a Python file, read from its text: nothing is run, and an import that waits in a function counts too."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]
BY_NAME = frozenset({"import_module", "__import__"})  # called with the name of a module
# Functions that make code run which no import statement names; `attach` is lazy_loader's.
BY_OTHER_MEANS = frozenset(
    """
    exec run_path run_module spec_from_file_location spec_from_loader module_from_spec SourceFileLoader load_module
    load_source iter_modules walk_packages find_spec attach attach_stub get_class get_object instantiate locate
    """.split()  # noqa: SIM905 - words are easier to read than a list of 17 quoted ones
)
SEARCHED = frozenset({"path", "addsitedir"})  # of `sys` and `site`: where Python looks for modules
MAX_PLACE = 200  # characters of a text that may name a folder


@dataclass(frozen=True)
class Imports:
    """The imports of a file.

    ``names`` has pairs of a module and what is taken of it: a name, ``*``, or None for the module itself. What a text
    takes of a module later counts too: ``pack.helper.value`` is (``pack``, ``helper``), (``pack.helper``, ``value``).
    ``computed`` says that modules are imported whose names the text does not give. ``places`` are the texts that may
    be folders to look in, where the file changes ``sys.path``, else None.
    """

    names: tuple[tuple[str, str | None], ...] = ()
    computed: bool = False
    places: tuple[str, ...] | None = None


def read_imports(tree: ast.Module, module: str, is_package: bool) -> Imports:
    """The imports of the parsed file of ``module``; those for type checkers alone do not count."""
    package = module if is_package else module.rpartition(".")[0]
    names: dict[tuple[str, str | None], None] = {}
    by_name, by_other_means, understood = set(BY_NAME), set(BY_OTHER_MEANS), set()
    computed, searches = False, False
    nodes = list(_nodes(tree))
    for node in nodes:
        if isinstance(node, ast.Import):
            names |= {(alias.name, None): None for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            source = _absolute("." * node.level + (node.module or ""), package)
            names |= {(source, alias.name): None for alias in node.names}
            by_name |= {alias.asname for alias in node.names if alias.asname and alias.name in BY_NAME}
            by_other_means |= {alias.asname for alias in node.names if alias.asname and alias.name in BY_OTHER_MEANS}
            searches |= node.module in ("sys", "site") and any(alias.name in SEARCHED for alias in node.names)
    for node in nodes:
        if isinstance(node, ast.Call) and _word(node.func) in by_name and (found := _named(node, package)):
            understood.add(node.func)
            names[(found, None)] = None
    bound = _bound(nodes, package)
    for node in nodes:
        if isinstance(node, ast.Attribute):
            names |= dict.fromkeys(_taken(node, bound))
    for node in nodes:
        word = _word(node)
        if isinstance(node, ast.Attribute) and word in SEARCHED:
            searches |= _word(node.value) in ("sys", "site")
        computed |= word in by_other_means or (word in by_name and node not in understood)
    places = (node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str))
    kept = tuple(dict.fromkeys(place for place in places if 0 < len(place) <= MAX_PLACE and place.isprintable()))
    return Imports(tuple(names), computed, kept if searches else None)


def _nodes(tree: ast.AST) -> Iterator[ast.AST]:
    pending = [tree]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.If) and _word(node.test) == "TYPE_CHECKING":
            pending += node.orelse
            continue
        yield node
        pending += ast.iter_child_nodes(node)


def _bound(nodes: Sequence[ast.AST], package: str) -> dict[str, str]:
    """Full names of what import statements give names to."""
    bound: dict[str, str] = {}
    for node in nodes:
        if isinstance(node, ast.Import):
            for alias in node.names:
                top = alias.name.split(".")[0]
                bound[alias.asname or top] = alias.name if alias.asname else top
        elif isinstance(node, ast.ImportFrom):
            source = _absolute("." * node.level + (node.module or ""), package)
            bound |= {alias.asname or alias.name: f"{source}.{alias.name}" for alias in node.names}
    return bound


def _taken(node: ast.Attribute, bound: Mapping[str, str]) -> list[tuple[str, str]]:
    """What ``a.b.c`` takes of modules, if ``a`` is ``bound``: ``b`` of it, and ``c`` of that."""
    words: list[str] = []
    at: ast.AST = node
    while isinstance(at, ast.Attribute):
        words.append(at.attr)
        at = at.value
    if not isinstance(at, ast.Name) or at.id not in bound:
        return []
    full = [bound[at.id], *reversed(words)]
    return [(".".join(full[:depth]), full[depth]) for depth in range(1, len(full))]


def _word(node: ast.AST) -> str | None:
    """The last word of ``a.b.c``."""
    if isinstance(node, ast.Attribute):
        return node.attr
    return node.id if isinstance(node, ast.Name) else None


def _named(call: ast.Call, package: str) -> str | None:
    """The module that a call imports by a name that the text gives; None where it does not."""
    values = [*call.args, *(keyword.value for keyword in call.keywords)]
    if not values or not isinstance(values[0], ast.Constant) or not isinstance(values[0].value, str):
        return None
    name = values[0].value
    if not name.startswith("."):
        return name
    known = len(values) == 2 and _word(values[1]) in ("__package__", "__name__")
    return _absolute(name, package) if known else None


def _absolute(name: str, package: str) -> str:
    """The full name of a relative one, which begins with a dot for each package up."""
    rest = name.lstrip(".")
    level = len(name) - len(rest)
    if not level:
        return name
    parts = package.split(".")
    return ".".join([*parts[: len(parts) - level + 1], *([rest] if rest else [])])


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
    for imported, name in read_imports(ast.parse(source.read_bytes()), module, is_package).names:
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
