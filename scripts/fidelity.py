"""The table of the page on fidelity: how far each arm is from a restatement of its source.

    python scripts/fidelity.py              print it, from the facts at the ends of conf/densify/*.yaml
    python scripts/fidelity.py --measure    measure each largest difference anew

A restatement is a second implementation of a source's rules in tests/densify: one Gaussian at a
time in numpy, from the facts of the source, with no code shared with gsbench or the source.
Differences are relative to the larger of 1 and the value, over all raw parameters and both Adam
moments of every Gaussian after a refinement, in float64. The table states the next power of ten.
Only the first and the last case of a test are measured; the test itself runs all.
"""

from __future__ import annotations

import importlib
import inspect
import itertools
import json
import math
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from gsbench.config.schema import CLASS_DEFAULTS
from gsbench.parsing import LOADER

ROOT = Path(__file__).parents[1]
CONF = ROOT / "conf" / "densify"
HEAD = """| `densify=` | source | compared | largest difference | not implemented, or different |
|---|---|---|---|---|
"""

FACTS = ("Source", "Compared", "Difference", "Tests", "Otherwise")
# A fact is one comment line; indented comment lines continue it.
FACT = re.compile(rf"^# (?P<key>{'|'.join(FACTS)}): (?P<text>.*(?:\n#   .*)*)$", re.MULTILINE)


@cache
def shipped_arms() -> dict[str, Mapping[str, Any]]:
    """The settings of each densifier that gsbench ships, by name, without ``densify/external``."""
    return {path.stem: _with_defaults(path.stem) for path in sorted(CONF.glob("*.yaml"))}


@cache
def facts_of(name: str) -> dict[str, str]:
    """The facts at the end of the file of the shipped arm ``name``, by their key (`FACTS`)."""
    content = (CONF / f"{name}.yaml").read_text(encoding="utf-8")
    return {match["key"]: match["text"].replace("\n#   ", " ") for match in FACT.finditer(content)}


@cache
def _with_defaults(name: str) -> dict[str, Any]:
    """The settings of an arm, which override those of the arms in its ``defaults``."""
    settings: dict[str, Any] = {}
    content = _own_settings(name)
    for parent in content.pop("defaults", []):
        if parent.startswith("/schema/"):  # the options of a class
            _, _, group, cls = parent.removesuffix("@_here_").split("/")
            settings |= json.loads(CLASS_DEFAULTS.read_text(encoding="utf-8"))[group][cls]
        elif parent != "_self_":
            settings |= _with_defaults(parent)
    return settings | content


def _own_settings(name: str) -> dict[str, Any]:
    settings: dict[str, Any] = yaml.load(
        (CONF / f"{name}.yaml").read_text(encoding="utf-8"), Loader=LOADER
    )
    return settings


@dataclass(frozen=True)
class Arm:
    """A row of the table: an arm's source, what is compared, how far, by which tests; deviations."""

    source: str
    compared: str
    difference: str  # the largest, as a power of ten
    tests: tuple[tuple[str, str], ...]  # module below tests.densify, function
    otherwise: str


def read_arm(name: str) -> Arm:
    """The row of the arm ``name``, from the facts at the end of its YAML."""
    facts = facts_of(name)
    tests = [test.split(".") for test in facts.get("Tests", "").split(", ") if test]
    return Arm(
        facts["Source"],
        facts["Compared"],
        facts["Difference"],
        tuple((module, function) for module, function in tests),
        facts.get("Otherwise", ""),
    )


ARMS = {name: read_arm(name) for name in shipped_arms()}


def calls_of(function: Any) -> Iterator[dict[str, Any]]:
    """The arguments of each case of a parametrised test, as pytest would give them."""
    tables = []
    for mark in getattr(function, "pytestmark", []):
        if mark.name == "parametrize":
            names, values = mark.args
            names = (
                [name.strip() for name in names.split(",")]
                if isinstance(names, str)
                else list(names)
            )
            tables.append(
                [
                    dict(zip(names, value if len(names) > 1 else [value], strict=True))
                    for value in values
                ]
            )
    for parts in itertools.product(*tables):
        yield {name: value for part in parts for name, value in part.items()}


def measured(arm: str) -> float:
    """The largest difference that the tests of an arm measure. Raises AssertionError if one fails."""
    sys.path.insert(0, str(ROOT))
    try:
        restatement = importlib.import_module("tests.densify.restatement")
        restatement.DIFFERENCES.clear()
        for module, name in ARMS[arm].tests:
            function = getattr(importlib.import_module(f"tests.densify.{module}"), name)
            cases = list(calls_of(function))
            for arguments in cases[:1] + cases[1:][-1:]:
                assert set(arguments) == set(inspect.signature(function).parameters), (
                    f"{name}: fixtures cannot be given"
                )
                function(**arguments)
        if ARMS[arm].tests and not restatement.DIFFERENCES:
            raise AssertionError(f"{arm}: nothing was compared")
        return max(restatement.DIFFERENCES, default=0.0)
    finally:
        sys.path.remove(str(ROOT))


def bound(difference: float) -> str:
    """The next power of ten as text; 0 for no difference."""
    return (
        "0"
        if difference == 0
        else f"1e{math.ceil(math.log10(difference)):+03d}".replace("e-0", "e-")
    )


def table() -> str:
    """The table in Markdown."""
    rows = (
        f"| `{k}` | {a.source} | {a.compared} | {a.difference} | {a.otherwise} |"
        for k, a in ARMS.items()
    )
    return HEAD + "\n".join(rows) + "\n"


def main(argv: list[str]) -> int:
    if argv not in ([], ["--measure"]):
        print(__doc__)
        return 2
    if not argv:
        print(table(), end="")
        return 0
    found = {arm: bound(measured(arm)) for arm in ARMS}
    other = {arm: now for arm, now in found.items() if now != ARMS[arm].difference}
    for arm, now in other.items():
        print(f"{arm}: measured {now}, conf/densify/{arm}.yaml says {ARMS[arm].difference}")
    return 1 if other else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
