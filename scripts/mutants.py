"""Mutation testing: plant small faults one at a time in a copy, and see whether the quick tests
notice them.

    python scripts/mutants.py # 160 faults over all packages, two at a time
    python scripts/mutants.py --packages densify eval --count 40 --seed 3 --coverage lines.db

A fault is one of these:

- comparison: becomes its opposite, ``<`` becomes ``>=`` and ``==`` becomes ``!=``;
- border: a comparison with a whole number includes its border or excludes it, ``> 0`` becomes ``>=
  0``. Other comparisons are not changed so: between continuous values that has no visible effect;
- sign: ``+`` becomes ``-``, ``*`` becomes ``/``, ``and`` becomes ``or``, and the other way round;
- off by one: a whole number becomes one larger;
- dropped: a statement is removed;
- swapped: the first two arguments of a call change places.

Texts, messages and annotations get no faults. A fault is caught if a test of ``make test`` fails or
hangs. A table and the survivors are printed as Markdown. A survivor either shows a gap in the tests
or changes nothing. Triton's kernels are left out: their tests belong to ``make test-all``.

First all quick tests run once, and coverage.py records which of them run each line (``--coverage``
names a file that keeps this for further seeds of the same code). The tests of a fault are those
that run its line. Some lines have no such record: what runs at the import of a module, or in a
compiled kernel. Their tests are those of the package, then others that import the module.
"""

from __future__ import annotations

import argparse
import ast
import copy
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from queue import Queue

import coverage

ROOT = Path(__file__).parents[1]
SOURCE = "src/gsbench"
GROUND = "ground"  # the single files of the package
PACKAGES = [GROUND, *sorted(path.name for path in (ROOT / SOURCE).iterdir() if path.is_dir())]
PACKAGES = [package for package in PACKAGES if not package.startswith("_")]
YAML = ["tests/config/test_yaml_defaults.py"]  # the defaults of classes
FURTHER_TESTS = {
    "app": ["tests/end_to_end/test_smoke.py"],
    "claims": ["tests/app/test_looks.py"],
    "verbs": ["tests/claims", "tests/app"],
    "pipeline": ["tests/end_to_end/test_smoke.py"],
    "densify": YAML,
    "eval": YAML,
    "init": YAML,
    "train": YAML,
}
LEFT_OUT = "triton"  # files with this in their path
# Swapped arguments change nothing in calls of these.
SYMMETRIC = {"maximum", "minimum", "min", "max", "add", "ssim_map", "similarity", "fma", "dot"}
SPEED_ONLY = {"prefetch"}  # calls that change no result
PYTEST = [sys.executable, "-m", "pytest", "-m", "not slow", "-p", "no:cacheprovider"]
SECONDS = 300  # time limit for the tests of one fault; a kernel that never ends uses all of it
Replacements = dict[type[ast.AST], type[ast.AST]]
OPPOSITE: Replacements = {
    **{
        ast.Lt: ast.GtE,
        ast.GtE: ast.Lt,
        ast.Gt: ast.LtE,
        ast.LtE: ast.Gt,
        ast.Eq: ast.NotEq,
        ast.NotEq: ast.Eq,
    },
}
BORDER: Replacements = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}
OTHER_SIGN: Replacements = {
    **{
        ast.Add: ast.Sub,
        ast.Sub: ast.Add,
        ast.Mult: ast.Div,
        ast.Div: ast.Mult,
        ast.And: ast.Or,
        ast.Or: ast.And,
    },
}


@dataclass(frozen=True)
class Fault:
    """One change of one file: the text between two offsets (bytes) is replaced."""

    file: str
    line: int
    kind: str
    start: int
    end: int
    before: str
    after: str

    @property
    def package(self) -> str:
        parts = Path(self.file).relative_to(SOURCE).parts
        return parts[0] if len(parts) > 1 else GROUND


def describe(fault: Fault) -> str:
    """One line of Markdown: the place of the fault and its change."""
    before, after = (" ".join(text.split()) for text in (fault.before, fault.after))
    return f"`{fault.file}:{fault.line}` {fault.kind}: `{before}` → `{after}`"


def is_whole_number(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and type(node.value) is int


def changed_nodes(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """The faults that fit a node, as (kind, changed node)."""
    new = copy.deepcopy(node)
    if isinstance(new, ast.Compare):
        first = type(new.ops[0])
        for kind, replacements in (("comparison", OPPOSITE), ("border", BORDER)):
            if kind == "border" and not any(map(is_whole_number, (new.left, new.comparators[0]))):
                continue
            if first in replacements:
                changed = copy.deepcopy(new)
                changed.ops[0] = replacements[first]()  # type: ignore[call-overload]
                yield kind, changed
    elif isinstance(new, ast.BinOp | ast.BoolOp) and type(new.op) in OTHER_SIGN:
        if isinstance(new, ast.BinOp) and any(
            isinstance(side, ast.JoinedStr) for side in (new.left, new.right)
        ):
            return
        new.op = OTHER_SIGN[type(new.op)]()  # type: ignore[assignment]
        yield "sign", new
    elif is_whole_number(new):
        new.value += 1  # type: ignore[attr-defined]
        yield "off by one", new
    elif isinstance(new, ast.AugAssign) or (
        isinstance(new, ast.Expr) and isinstance(new.value, ast.Call)
    ):
        yield "dropped", ast.Pass()
    elif (
        isinstance(new, ast.Call)
        and len(new.args) > 1
        and all(isinstance(arg, ast.Name) for arg in new.args[:2])
    ):
        if (
            ast.unparse(new.func).rpartition(".")[2] in SYMMETRIC
            or new.args[0].id == new.args[1].id
        ):
            return
        new.args[:2] = new.args[1::-1]
        yield "swapped", new


def is_silent(node: ast.AST) -> bool:
    """Return whether a node is a message, a text or a hint to the processor, below which no faults
    are planted."""
    if isinstance(node, ast.Raise | ast.JoinedStr | ast.Assert):
        return True
    called = node.func if isinstance(node, ast.Call) else None
    if isinstance(called, ast.Name) and called.id in SPEED_ONLY:
        return True
    return (
        isinstance(called, ast.Attribute)
        and isinstance(called.value, ast.Name)
        and called.value.id == "log"
    )


def visited(node: ast.AST) -> Iterator[ast.AST]:
    """The nodes in which a fault may be planted, parents first."""
    if is_silent(node) or (isinstance(node, ast.Expr) and is_silent(node.value)):
        return
    yield node
    for name, field in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for child in field if isinstance(field, list) else [field]:
            if isinstance(child, ast.AST):
                yield from visited(child)


def faults_of(path: Path) -> list[Fault]:
    """All faults that can be planted in a file."""
    text = path.read_text()
    lines = [0]
    for line in text.encode().splitlines(keepends=True):  # columns of the syntax tree count bytes
        lines.append(lines[-1] + len(line))
    faults = []
    changes = (
        (node, *change) for node in visited(ast.parse(text)) for change in changed_nodes(node)
    )
    for node, kind, changed in changes:
        start, end = (
            lines[row - 1] + column
            for row, column in (
                (node.lineno, node.col_offset),
                (node.end_lineno, node.end_col_offset),
            )
        )  # type: ignore[attr-defined]
        before, after = text.encode()[start:end].decode(), ast.unparse(changed)
        if isinstance(changed, ast.BinOp | ast.BoolOp | ast.Compare):
            after = f"({after})"
        file = path.relative_to(ROOT).as_posix()
        faults.append(Fault(file, node.lineno, kind, start, end, before, after))  # type: ignore[attr-defined]
    return faults


def files_of(package: str) -> list[Path]:
    """The source files of a package."""
    if package == GROUND:
        return sorted((ROOT / SOURCE).glob("*.py"))
    return sorted((ROOT / SOURCE / package).rglob("*.py"))


def choose_faults(packages: list[str], count: int, seed: int) -> list[Fault]:
    """Choose about ``count`` faults, by the square root of packages' sizes; all kinds are equally
    likely."""
    rng = random.Random(seed)
    by_package = {
        package: [
            fault
            for path in files_of(package)
            if LEFT_OUT not in path.as_posix()
            for fault in faults_of(path)
        ]
        for package in packages
    }
    weights = {package: len(faults) ** 0.5 for package, faults in by_package.items()}
    picked = []
    for package, faults in by_package.items():
        by_kind = {
            kind: [f for f in faults if f.kind == kind] for kind in sorted({f.kind for f in faults})
        }
        for _ in range(max(1, round(count * weights[package] / sum(weights.values())))):
            kind = rng.choice([kind for kind, left in by_kind.items() if left])
            picked.append(by_kind[kind].pop(rng.randrange(len(by_kind[kind]))))
    return picked


def copy_checkout(folder: Path) -> Path:
    """Copy the checkout, tracked and new files, into ``folder``, and link development data beside
    it, if any."""
    listing = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    place = folder / "checkout"
    for name in filter(None, listing.stdout.split("\0")):
        if (ROOT / name).is_file():
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, place / name)
    if (ROOT.parent / "shared").exists():
        (folder / "shared").symlink_to((ROOT.parent / "shared").resolve())
    return place


class Reached:
    """The quick tests that run each line of the source, by the record of coverage.py."""

    def __init__(self, record: Path) -> None:
        self._data = coverage.CoverageData(str(record))
        self._data.read()
        self._files = {
            name[name.index(SOURCE + "/") :]: name for name in self._data.measured_files()
        }

    def tests(self, fault: Fault) -> list[str]:
        """The tests that run the first line of a fault. Where a fixture runs it, all tests of the
        fixture's file: the test that happened to be the first is not the one that looks."""
        if fault.file not in self._files:
            return []
        contexts = self._data.contexts_by_lineno(self._files[fault.file]).get(fault.line, [])
        found = set()
        for context in filter(None, contexts):  # "tests/test_x.py::test_a[b]|run"
            test, _, phase = context.rpartition("|")
            found.add(test if phase == "run" else test.partition("::")[0])
        return sorted(test for test in found if test.partition("::")[0] not in found - {test})


def record_coverage(place: Path, record: Path) -> None:
    """Run all quick tests of a copy, and write which of them runs each line."""
    words = [*PYTEST, "-n", "2", "--cov", "gsbench", "--cov-context", "test", "--cov-report", ""]
    environment = os.environ | {"PYTHONPATH": str(place / "src"), "COVERAGE_FILE": str(record)}
    if subprocess.run(words, cwd=place, env=environment, check=False).returncode:
        raise SystemExit("the quick tests fail without a fault: mend them first")


def tests_of(fault: Fault, place: Path, reached: Reached) -> list[str]:
    """The tests for a fault: those that run its line, or all that may. The module's own are the
    first, then those of its package."""
    own_folders = tests_of_package(fault.package, place)

    def distance(test: str) -> int:
        file = Path(test.partition("::")[0])
        if file.stem == f"test_{Path(fault.file).stem}":
            return 0
        return 1 if any(file.is_relative_to(folder) for folder in own_folders) else 2

    tests = reached.tests(fault) or [*own_folders, *importing_tests(fault, place)]
    return [*sorted(tests, key=distance), *FURTHER_TESTS.get(fault.package, [])]


def importing_tests(fault: Fault, place: Path) -> list[str]:
    """The files of tests that import the module of a fault."""
    module = Path(fault.file).relative_to("src").with_suffix("").as_posix().replace("/", ".")
    parent, _, name = module.rpartition(".")
    imports = re.compile(rf"{re.escape(module)}\b|from {re.escape(parent)} import .*\b{name}\b")
    every = sorted((place / "tests").rglob("test_*.py"))
    return [
        path.relative_to(place).as_posix() for path in every if imports.search(path.read_text())
    ]


def tests_of_package(package: str, place: Path) -> list[str]:
    """The folder of a package's tests; for the single files, those beside the folders."""
    if package == GROUND:
        return [path.relative_to(place).as_posix() for path in (place / "tests").glob("test_*.py")]
    return [f"tests/{package}"]


def is_caught(fault: Fault, place: Path, reached: Reached) -> bool:
    """Plant the fault in the copy, run its tests, and remove it again."""
    words = [*PYTEST, "-x", "-q", "-n", "0", *tests_of(fault, place, reached)]
    # No byte code of faulty files is kept: Python takes files of one size and second for the same.
    environment = os.environ | {"PYTHONPATH": str(place / "src"), "PYTHONDONTWRITEBYTECODE": "1"}
    original = (place / fault.file).read_bytes()
    faulty = original[: fault.start] + fault.after.encode() + original[fault.end :]
    (place / fault.file).write_bytes(faulty)
    try:
        done = subprocess.run(
            words, cwd=place, env=environment, capture_output=True, timeout=SECONDS, check=False
        )
        return done.returncode != 0
    except subprocess.TimeoutExpired:
        return True
    finally:
        (place / fault.file).write_bytes(original)
        # makes its kept byte code valid again
        shutil.copystat(ROOT / fault.file, place / fault.file)


def plant(faults: list[Fault], workers: int, kept: Path | None) -> Iterator[tuple[Fault, bool]]:
    """Plant the faults, each in a copy of its worker; yields each with whether a test noticed.

    ``kept`` is a file for the record of coverage, which is made if it is missing.
    """
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(workers) as pool:
        places: Queue[Path] = Queue()
        for worker in range(workers):
            places.put(copy_checkout(Path(folder) / str(worker)))
        record = (kept or Path(folder) / "lines.db").absolute()
        if not record.exists():
            record_coverage(Path(folder) / "0/checkout", record)
        reached = Reached(record)

        def tried(fault: Fault) -> tuple[Fault, bool]:
            place = places.get()
            try:
                return fault, is_caught(fault, place, reached)
            finally:
                places.put(place)

        for done in as_completed([pool.submit(tried, fault) for fault in faults]):
            yield done.result()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--packages", nargs="+", default=PACKAGES, choices=PACKAGES)
    parser.add_argument("--count", type=int, default=160)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--coverage", type=Path, help="file of the lines that each test runs")
    arguments = parser.parse_args()
    faults = choose_faults(arguments.packages, arguments.count, arguments.seed)
    random.Random(arguments.seed).shuffle(faults)
    results = {}
    for fault, caught in plant(faults, arguments.workers, arguments.coverage):
        results[fault] = caught
        print("caught  " if caught else "SURVIVED", describe(fault), flush=True)
    planted = Counter(fault.package for fault in results)
    seen = Counter(fault.package for fault in results if results[fault])
    print("\n| package | planted | caught |\n|---|---|---|")
    for package in sorted(planted):
        print(f"| {package} | {planted[package]} | {seen[package]} |")
    print(f"| all | {planted.total()} | {seen.total()} ({seen.total() / planted.total():.0%}) |\n")
    for fault in sorted(
        (f for f, found in results.items() if not found), key=lambda f: (f.file, f.line)
    ):
        print(f"- {describe(fault)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
