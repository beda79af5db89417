"""Who may know whom (docs/architecture.md): read from the import statements, those inside functions included."""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterator
from pathlib import Path

import pytest

import gsbench

PACKAGE = Path(gsbench.__file__).parent
LIBRARY = ("scene", "gaussians", "raster", "densify", "init", "eval")  # usable without configuration files or pipeline
UPSTAIRS = ("cli", "compose", "hydra_job", "tracking", "bench")  # modules beside the rooms that are not ground floor
GROUND_FLOOR = {path.stem for path in PACKAGE.glob("*.py")} - {*UPSTAIRS}
# What each room may import of gsbench beside itself and the ground floor.
MAY_IMPORT = {
    "datasets": set(),
    "scene": {"datasets"},
    "gaussians": set(),
    "raster": {"gaussians", "scene"},
    "densify": {"gaussians", "raster"},
    "init": {"gaussians", "scene"},
    "eval": {"scene"},  # names of photographs, to match renders with
    "analysis": {"eval.facts", "eval.protocol"},  # tables of facts, which load no torch
}


def modules() -> dict[str, Path]:
    """Every module of gsbench by its dotted name; a package goes by its own."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = ("gsbench", *path.relative_to(PACKAGE).with_suffix("").parts)
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports_of(path: Path) -> Iterator[str]:
    """The dotted names that a file imports anywhere but for type checkers: modules, or names in them."""
    pending: list[ast.AST] = [ast.parse(path.read_text(encoding="utf-8"))]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            pending += node.orelse
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        pending += ast.iter_child_nodes(node)


@functools.cache
def arrows() -> dict[str, set[str]]:
    """For each module of gsbench, the modules of gsbench that it imports."""
    known = modules()
    graph: dict[str, set[str]] = {}
    for name, path in known.items():
        named = (target if target in known else target.rpartition(".")[0] for target in imports_of(path))
        graph[name] = {target for target in named if target in known and target != name}
    return graph


def circle(graph: dict[str, set[str]]) -> list[str]:
    """The modules of a circle of imports in order, the first named again at the end; empty where there is none."""
    done: set[str] = set()

    def visit(name: str, way: list[str]) -> list[str]:
        if name in way:
            return [*way[way.index(name) :], name]
        if name in done:
            return []
        for target in sorted(graph[name]):
            if found := visit(target, [*way, name]):
                return found
        done.add(name)
        return []

    return next((found for name in sorted(graph) if (found := visit(name, []))), [])


def room(module: str) -> str:
    return module.split(".")[1] if "." in module else ""


def test_no_circle_of_imports() -> None:
    found = circle(arrows())
    assert not found, f"{' imports '.join(found)}: the last of these imports closes a circle"


def test_a_circle_is_found() -> None:
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c", "b"]
    assert circle({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []


@pytest.mark.parametrize("name", sorted(MAY_IMPORT))
def test_a_room_knows_only_those_below_it(name: str) -> None:
    for module, targets in arrows().items():
        if room(module) == name:
            for target in targets:
                allowed = {name, *GROUND_FLOOR, *MAY_IMPORT[name], ""}
                known = room(target) in allowed or target.removeprefix("gsbench.") in allowed
                assert known, f"{module} imports {target}: {name} may not know {room(target)}"


@pytest.mark.parametrize("name", LIBRARY)
def test_the_library_knows_neither_hydra_nor_mlflow(name: str) -> None:
    for module, path in modules().items():
        if room(module) == name:
            foreign = {target.split(".")[0] for target in imports_of(path)} & {"hydra", "omegaconf", "mlflow"}
            assert not foreign, f"{module} imports {foreign}"


def test_the_way_down_from_the_command_line() -> None:
    """cli knows launch, launch knows the pipeline; none of them is known below, and verbs know neither cli nor each
    other."""
    above = {"cli": 0, "verbs": 1, "launch": 2, "pipeline": 3}
    for module, targets in arrows().items():
        for target in targets:
            here, there = room(module), room(target)
            if there in above and here != there:
                assert here in above or here in ("view", "tracking", "bench", "claims"), (
                    f"{module} imports {target}, which is above it"
                )
                assert above.get(here, 3) <= above[there], f"{module} imports {target}, which is above it"
            assert not (here == there == "verbs"), f"{module} imports {target}: verbs do not know each other"
