"""The rules of docs/architecture.md on imports between modules, also on those inside functions."""

import ast
import functools
import re
from pathlib import Path

import pytest

import gsbench

PACKAGE = Path(gsbench.__file__).parent
# The layers from the top down. A package may import those of layers below its own, and the base.
LAYERS = (
    {"__main__"},
    {"cli"},
    {"verbs"},
    {"app"},
    {"launch", "bench", "renders", "claims"},
    {"pipeline", "view"},
    {"tracking"},
    {"config"},
    {"train", "external", "analysis"},
    {"densify", "eval"},
    {"raster", "init"},
    {"scene"},
    {"gaussians", "datasets", "runs"},
    {"system"},
)
BASE = {
    "downloads",
    "errors",
    "events",
    "files",
    "logs",
    "normalization",
    "parsing",
    "settings",
    "weights",
    "words",
}
# usable without the program
LIBRARY = ("train", "densify", "raster", "eval", "scene", "gaussians", "init", "external")
WITHOUT_TORCH = ("analysis", "runs", "datasets", "system", "config", "claims", "cli")
KNOW_HYDRA = {"app", "config"}
HYDRA = {"hydra", "omegaconf"}
# The only modules that a package may import from a package below it.
ONLY = {
    # tables of facts, which load no torch
    ("analysis", "eval"): {"gsbench.eval.facts", "gsbench.eval.protocol"},
    ("config", "train"): {"gsbench.train.options"},
    ("config", "external"): {"gsbench.external.settings"},
}

TYPES_ONLY = "if TYPE_CHECKING:\n    {}\nelse:\n    pass"


def modules():
    """The file of every module of gsbench, by its dotted name; ``__init__`` by its package's."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = ("gsbench", *path.relative_to(PACKAGE).with_suffix("").parts)
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


@functools.cache
def parsed(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def imports_of(path, inside_functions=True, for_types=False):
    """The dotted names that a file imports: modules, or names in them.

    ``for_types`` includes the imports that only type checkers run.
    """
    pending = [parsed(path)]
    while pending:
        node = pending.pop()
        types_only = isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"
        if isinstance(node, ast.If) and types_only and not for_types:
            pending += node.orelse
            continue
        if not inside_functions and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}: relative imports hide circles from these tests"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        pending += ast.iter_child_nodes(node)


@functools.cache
def arrows(inside_functions=True, for_types=False):
    """For each module of gsbench, its imports: modules of gsbench, and names of other packages."""
    known = modules()
    graph = {}
    for name, path in known.items():
        graph[name] = set()
        for target in imports_of(path, inside_functions, for_types):
            if not f"{target}.".startswith("gsbench."):
                graph[name].add(target.split(".")[0])
            else:
                module = target if target in known else target.rpartition(".")[0]
                assert module in known, f"{name} imports {target}, which is not there"
                graph[name] |= {module} - {name}
    return graph


def reached(start):
    """The module ``start`` and all modules of gsbench that it imports, also through others."""
    found, waiting = set(), [start]
    while waiting:
        name = waiting.pop()
        if name not in found and name in arrows():
            found.add(name)
            waiting += arrows()[name]
    return found


def package(module):
    """The package of a module: its folder below ``gsbench``, or itself if it is in none."""
    parts = module.split(".")
    return parts[1] if parts[0] == "gsbench" and len(parts) > 1 else ""


def by_package(graph):
    """The arrows between packages."""
    packages = {package(module): set() for module in graph if package(module)}
    for module, targets in graph.items():
        if package(module):
            packages[package(module)] |= {
                package(target) for target in targets if package(target)
            } - {package(module)}
    return packages


def circle(graph):
    """The members of a circle of arrows in order, with the first again at the end; [] if none."""
    done = set()

    def visit(name, way):
        if name in way:
            return [*way[way.index(name) :], name]
        if name in done or name not in graph:
            return []
        for target in sorted(graph[name]):
            if found := visit(target, [*way, name]):
                return found
        done.add(name)
        return []

    return next((found for name in sorted(graph) if (found := visit(name, []))), [])


def upward(graph):
    """Each arrow between packages that does not run down, in words."""
    level = {name: number for number, names in enumerate(reversed(LAYERS), 1) for name in names}
    level |= dict.fromkeys(BASE, 0)
    found = []
    for module, targets in sorted(graph.items()):
        for target in sorted(targets):
            here, there = package(module), package(target)
            if here and there and here != there and level[there] >= max(level[here], 1):
                found.append(f"{module} imports {target}, which stands no lower")
    return found


def way_to(graph, start, goals):
    """A shortest chain of imports from a module to one of ``goals``; [] if none.

    Importing a module also runs the packages that contain it.
    """
    goals, ways = set(goals), {start: [start]}
    pending = [start]
    while pending:
        name = pending.pop(0)
        if name in goals:
            return ways[name]
        parts = name.split(".")
        packages = {".".join(parts[:i]) for i in range(1, len(parts))} & set(graph)
        for target in sorted(graph.get(name, set()) | packages):
            if target not in ways:
                ways[target] = [*ways[name], target]
                pending.append(target)
    return []


def test_no_circle_of_files():
    """Imports for type checkers count, since readers follow them, too."""
    found = circle(arrows(for_types=True))
    assert not found, f"{' imports '.join(found)}: the last of these imports closes a circle"


@pytest.mark.parametrize(
    "back", ["{}", "def later():\n    {}", "class A:\n    def later(self):\n        {}", TYPES_ONLY]
)
def test_a_planted_circle_of_files_is_found(tmp_path, monkeypatch, back):
    (tmp_path / "init").mkdir()
    for name, text in {
        "__init__": "",
        "init/__init__": "",
        "init/sfm": "from gsbench.init import report",
        "init/report": back.format("from gsbench.init.sfm import Sfm"),
    }.items():
        (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.setattr("tests.test_architecture.PACKAGE", tmp_path)
    found = circle(arrows.__wrapped__(for_types=True))
    assert found == ["gsbench.init.report", "gsbench.init.sfm", "gsbench.init.report"]


def test_no_circle_of_folders():
    found = circle(by_package(arrows()))
    assert not found, f"{' knows '.join(found)}: the last of these closes a circle"


def test_every_package_has_a_layer_and_arrows_run_down():
    assert set(by_package(arrows())) <= set().union(*LAYERS) | BASE
    assert not upward(arrows())


def test_the_base_is_small():
    loose = {path.stem for path in PACKAGE.glob("*.py")} - {"__init__"}
    assert loose == BASE | {"cli", "__main__"}


@pytest.mark.parametrize("above, below", sorted(ONLY))
def test_some_packages_import_only_parts_of_others(above, below):
    for module, targets in arrows().items():
        if package(module) == above:
            seen = {target for target in targets if package(target) == below}
            assert seen <= ONLY[above, below], f"{module} imports {seen - ONLY[above, below]}"


@pytest.mark.parametrize("name", LIBRARY)
def test_the_library_reaches_neither_hydra_nor_mlflow_nor_the_pipeline(name):
    program = {
        module
        for module in arrows()
        if package(module) in {"pipeline", "config", "app", "launch", "tracking"}
    }
    for module in arrows():
        if package(module) == name:
            way = way_to(arrows(), module, HYDRA | {"mlflow"} | program)
            assert not way, " imports ".join(way)


@pytest.mark.parametrize("name", WITHOUT_TORCH)
def test_packages_of_quick_commands_load_no_torch(name):
    graph = arrows(inside_functions=False)
    for module in graph:
        if package(module) == name:
            way = way_to(graph, module, {"torch"})
            assert not way, " imports ".join(way)


def test_only_two_packages_import_hydra():
    for module, targets in arrows().items():
        assert not targets & HYDRA or package(module) in KNOW_HYDRA, (
            f"{module} imports {targets & HYDRA}"
        )


def test_private_modules_of_hydra_are_not_imported():
    internal = re.compile(rf"({'|'.join(HYDRA)})\._")
    known = {name for name, path in modules().items() if any(map(internal.match, imports_of(path)))}
    assert not known


def test_verbs_do_not_import_each_other():
    # the arguments of all verbs, and the list of verbs
    shared = {"gsbench.verbs.arguments", "gsbench.verbs"}
    for module, targets in arrows().items():
        if package(module) == "verbs":
            others = {target for target in targets if package(target) == "verbs"} - shared
            assert not others, f"{module} imports {others}"


def annotated(text):
    """The functions of a file that have annotations. Triton's constants of a kernel need theirs."""
    return [
        node.name
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and (node.returns or any(getattr(each, "annotation", None) for each in ast.walk(node.args)))
        and "constexpr" not in ast.unparse(node.args)
    ]


def test_functions_of_tests_have_no_annotations():
    assert annotated("def f(a, *b: int): ...\ndef g() -> None: ...") == ["f", "g"]
    for path in Path(__file__).parent.rglob("*.py"):
        found = annotated(path.read_text(encoding="utf-8"))
        assert not found, f"{path}: {found}"


def test_the_checks_can_fail():
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c", "b"]
    assert circle({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []
    modules_apart = {"gsbench.train.x": {"gsbench.eval.x"}, "gsbench.eval.y": {"gsbench.train.y"}}
    assert not circle(modules_apart)  # no circle of modules, and yet
    assert circle(by_package(modules_apart)) == ["eval", "train", "eval"]
    assert upward(modules_apart) == [
        "gsbench.eval.y imports gsbench.train.y, which stands no lower"
    ]
    assert upward({"gsbench.words": {"gsbench.runs.x"}})
    assert not upward({"gsbench.settings": {"gsbench.words"}, "gsbench.runs.x": {"gsbench.words"}})
    chain = {
        "gsbench.train.x": {"gsbench.runs.x"},
        "gsbench.runs": {"mlflow"},
        "gsbench.runs.x": set(),
    }
    assert way_to(chain, "gsbench.train.x", {"mlflow"})[-2:] == ["gsbench.runs", "mlflow"]
