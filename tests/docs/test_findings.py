"""docs/findings.md says what its result files say."""

from __future__ import annotations

import importlib.util
import re
import shutil
from pathlib import Path

import pytest

from gsbench.analysis.statistics import compare
from gsbench.claims.sequential import Design, decide
from tests.conftest import ROOT

MAX_BYTES = 300_000
spec = importlib.util.spec_from_file_location("findings", ROOT / "scripts" / "findings.py")
assert spec is not None
assert spec.loader is not None
findings = importlib.util.module_from_spec(spec)
spec.loader.exec_module(findings)


def test_the_tables_of_the_page_are_those_of_the_result_files() -> None:
    page = findings.PAGE.read_text(encoding="utf-8")
    assert len(findings.SECTION.findall(page)) >= 4
    assert findings.with_tables(page) == page
    assert "nan" not in page


def test_curves_can_be_drawn_from_the_published_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = sorted(findings.DATA.glob("*_rounds.csv"))
    for file in files:
        shutil.copy(file, tmp_path)
    monkeypatch.setattr(findings, "DATA", tmp_path)
    findings.draw()
    assert len(files) >= 2
    assert all((tmp_path / file.with_suffix(".png").name).stat().st_size > 5_000 for file in files)


def test_every_file_that_the_page_names_is_there_and_small() -> None:
    page = findings.PAGE.read_text(encoding="utf-8")
    for name in re.findall(r"\((findings/[^)]+)\)", page):
        assert (findings.PAGE.parent / name).is_file(), name
    assert all(path.stat().st_size < MAX_BYTES for path in findings.DATA.iterdir())


def test_the_experiments_of_the_page_are_configurations() -> None:
    page = findings.PAGE.read_text(encoding="utf-8")
    named = set(re.findall(r"\+experiment=(\w+)", page))
    assert named >= {"bonsai_growth", "fair_governor", "fair_hard", "initialisers"}
    assert all((ROOT / "conf" / "experiment" / f"{name}.yaml").is_file() for name in named)


@pytest.mark.parametrize("name", ["bonsai_growth", "fair_governor", "fair_hard"])
def test_stopping_when_decided_contradicts_no_finding_about_lpips(name: str) -> None:
    """Looks at two and three seeds of the same trials: what a plain comparison calls better is so, and nothing else.

    Where five arms share the 5 %, some of it is undecided.
    """
    frame = findings.read(name)
    for arm in sorted(set(frame.arm) - {"adc"}):
        paired = findings.pair(frame, arm, "lpips_squeeze")
        rows = [matrix[:, 0] for matrix in paired.differences]
        alone, shared = (decide(rows, Design(len(rows), (2, 3), alpha), 0.005, -1) for alpha in (0.05, 0.01))
        better = compare(paired, -1).verdict == "better"
        assert alone.outcome == "for" if better else alone.outcome in ("undecided", "equivalent")
        assert shared.outcome in (alone.outcome, "undecided")
