"""Write docs/fidelity.md: how far each arm is from a restatement of its source.

    python scripts/fidelity.py            say whether the page agrees with what the tests measure
    python scripts/fidelity.py --write    write it

A restatement is a second implementation of a source's rules in tests/densify: one Gaussian at a
time in numpy, from the facts of the source, with no code shared with gsbench or the source.
Differences are relative to the larger of 1 and the value, over all raw parameters and both Adam
moments of every Gaussian after a refinement, in float64. The page states the next power of ten.
Only the first and the last case of a test are measured; the test itself runs all.
"""

from __future__ import annotations

import importlib
import inspect
import itertools
import math
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from gsbench.parsing import LOADER

ROOT = Path(__file__).parents[1]
PAGE, CONF = ROOT / "docs" / "fidelity.md", ROOT / "conf" / "densify"
ROW = re.compile(r"^\| `(\w+)` \|.*\| (0|1e-\d+) \|[^|]*\|$", re.MULTILINE)
HEAD = """# How near each arm is to its source

We read the sources for facts; we copied nothing and ran none of them. Then we wrote each source's rules a second time,
as we understood them: one Gaussian at a time in numpy (`tests/densify/`). Each row says how far gsbench's arm is from
that restatement, on random Gaussians with uneven Adam moments. Both give the same Gaussians in the same order, with the
same counts, parameters and moments, up to the largest difference. It is relative to the larger of 1 and the value, in
float64, rounded up to a power of ten. Random numbers come from gsbench's generator; a source draws others.

`scripts/fidelity.py --write` makes this page from the facts at the end of each arm's file in `conf/densify/`. A test
makes it again and compares.

| `densify=` | source | compared | largest difference | not implemented, or different |
|---|---|---|---|---|
"""
TAIL = """
Rasterizer and optimiser are compared elsewhere: every executor with the float64 reference (`tests/raster`), the
learning rates and the schedule in `tests/pipeline`. On bonsai (800×533, 7,000 iterations, one run each), `adc` is within
0.06 dB and 2 % of the Gaussians of the authors' 2023 code, run on the same GPU ([page](../findings/paper_size.md)). `conf/train/` has presets of learning rates, with their sources.

`tests/train/test_resolution.py` restates DashGaussian's schedule of sizes (`train.resolution_schedule`;
YouyuChen0207/DashGaussian 4e3b560, `utils/schedule_utils.py`, `train_dash.py:75`, `:182`): the size is the same at
every iteration. The differences: DashGaussian prunes before it grows, by opacity only, and growth at the limit replaces
the pruned Gaussians. Its clones and splits each take the whole allowance. Its window over a spectrum of odd sides is
one pixel off the mean. In gsbench small pictures have 8 bits.
"""

FACTS = ("Source", "Compared", "Tests", "Otherwise")
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
    content = _own_settings(name)
    parents = [parent for parent in content.pop("defaults", []) if parent != "_self_"]
    return {
        key: value for parent in parents for key, value in _with_defaults(parent).items()
    } | content


def _own_settings(name: str) -> dict[str, Any]:
    settings: dict[str, Any] = yaml.load(
        (CONF / f"{name}.yaml").read_text(encoding="utf-8"), Loader=LOADER
    )
    return settings


@dataclass(frozen=True)
class Arm:
    """A row of the page: an arm's source, what is compared, the tests of that, and deviations."""

    source: str
    compared: str
    tests: tuple[tuple[str, str], ...]  # module below tests.densify, function
    otherwise: str


def read_arm(name: str) -> Arm:
    """The row of the arm ``name``, from the facts at the end of its YAML."""
    facts = facts_of(name)
    tests = [test.split(".") for test in facts.get("Tests", "").split(", ") if test]
    return Arm(
        facts["Source"],
        facts["Compared"],
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


def page(bounds: dict[str, str]) -> str:
    """The text of the page; ``bounds`` is the largest difference of each arm as text."""
    rows = (
        f"| `{k}` | {a.source} | {a.compared} | {bounds[k]} | {a.otherwise} |"
        for k, a in ARMS.items()
    )
    return HEAD + "\n".join(rows) + "\n" + TAIL


def bounds_of(text: str) -> dict[str, str]:
    """The largest difference of each arm that a page states."""
    return dict(ROW.findall(text))


def main(argv: list[str]) -> int:
    if argv not in ([], ["--write"]):
        print(__doc__)
        return 2
    text = page({arm: bound(measured(arm)) for arm in ARMS})
    if argv:
        PAGE.write_text(text, encoding="utf-8")
    same = PAGE.exists() and PAGE.read_text(encoding="utf-8") == text
    print("the page is what was measured" if same else "the page differs: --write")
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
