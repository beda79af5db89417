"""The pages of findings say what their result files say."""

from __future__ import annotations

import functools
import re
import shutil
from pathlib import Path

import pandas as pd
import pytest

from gsbench.analysis.statistics import compare
from gsbench.claims.sequential import Design, decide
from tests.conftest import ROOT
from tests.docs import findings_said as said

MAX_BYTES = 300_000
FIGURE = re.compile(r"[+−]\d*\.?\d+|(?<![\w.])\.\d+")  # a difference, or what is written without its leading zero
findings = said.script()
PAGE = findings.DOCS / "first_findings.md"


def prose() -> str:
    """The page without tables, commands and marks of emphasis, on one line."""
    page = re.sub(r"<!--.*?-->", "", PAGE.read_text(encoding="utf-8"))
    lines = [line for line in page.splitlines() if not line.startswith(("|", "    "))]
    return re.sub(r"\s+", " ", re.sub(r"[*`]", "", " ".join(lines)))


@functools.cache
def sentences() -> list[str]:
    """Every figure of the text, with the words around it."""
    return [
        *said.said_of_bonsai(),
        *said.said_of_steered_scenes(),
        *said.said_of_the_hard_cap(),
        *said.said_of_initial_clouds(),
    ]


def test_the_text_says_what_the_result_files_say() -> None:
    text = prose()
    assert [sentence for sentence in [*sentences(), *said.FROM_ELSEWHERE] if sentence not in text] == []


def test_no_figure_of_the_text_is_left_unchecked() -> None:
    text = prose()
    for sentence in sorted([*sentences(), *said.FROM_ELSEWHERE], key=len, reverse=True):
        text = text.replace(sentence, " ")
    assert [text[max(0, found.start() - 60) : found.end()] for found in FIGURE.finditer(text)] == []


def test_what_is_said_of_every_seed_and_scene_is_so() -> None:
    better = {said.LPIPS: -1, said.PSNR: 1, said.SSIM: 1, said.FLIP: -1}
    for control in ("adc", "adc-0.0012"):
        for metric, sign in better.items():
            assert (sign * said.trials("bonsai_growth", "volumetric_once", metric, control) > 0).all(axis=None), metric
    for metric in (said.PSNR, said.SSIM):
        assert (said.trials("bonsai_growth", "volumetric", metric, "adc-0.0012") < 0).all(axis=None)
    assert (said.trials("bonsai_growth", "volumetric", "num_gaussians") > 0).all(axis=None)
    assert (said.trials("fair_governor", "longaxis", said.SSIM, "absgrad") > 0).all(axis=None)
    assert (said.trials("fair_governor", "volumetric_once", said.FLIP).mean(axis=1) < 0).all()
    assert (said.trials("initialisers", "sfm_dense", said.PSNR, "sfm") > 0).all(axis=None)
    lpips = said.trials("initialisers", "sfm_dense", said.LPIPS, "sfm") < 0
    assert lpips.loc["courtyard"].all()
    assert not lpips.loc["herz_jesus"].all()


def test_what_one_family_of_the_whole_page_leaves() -> None:
    _, decided = said.decided_of_all()
    assert set(decided) == {
        ("bonsai_growth", "adc", "volumetric_once", said.SSIM),
        ("fair_governor", "absgrad", "longaxis", said.SSIM),
    }
    under_the_cap = [c for table, found in said.tables().items() if table[0] == "fair_hard" for c in found.values()]
    assert {c.verdict for c in under_the_cap} == {"no evidence"}
    clouds = said.tables()["initialisers", "sfm"]
    assert {key for key, c in clouds.items() if c.verdict != "no evidence"} == {("sfm_dense", said.PSNR)}
    steered = said.tables()["fair_governor", "adc"]
    assert {c.verdict for c in steered.values()} == {"no evidence"}
    frame = findings.read("fair_governor")
    without = findings.compared(frame[frame.scene != "bonsai"])
    assert {without["volumetric_once", metric].verdict for metric in (said.LPIPS, said.FLIP)} == {"no evidence"}


def test_a_table_of_differences_is_one_family_and_calls_nothing_better() -> None:
    sizes = {table: {c.family for c in found.values()} for table, found in said.tables().items()}
    assert sizes["fair_governor", "adc"] == {20}
    assert all(size == {len(said.tables()[table])} for table, size in sizes.items())
    page = findings.with_tables(PAGE.read_text(encoding="utf-8"))
    assert not re.search(r"^\|.*(better|worse)", page, re.MULTILINE)
    assert not re.search(r"clearly|\*\*(better|worse)", page)


def test_mcmc_has_rounds_of_its_own() -> None:
    rounds = pd.read_csv(findings.DATA / "fair_governor_rounds.csv")
    per_arm = rounds.groupby(["scene", "densify"]).step.agg(["size", "max"]).reset_index("densify")
    mcmc = per_arm.densify == "mcmc"
    assert set(zip(per_arm[mcmc]["size"], per_arm[mcmc]["max"], strict=True)) == {(23, 2500)}
    assert set(zip(per_arm[~mcmc]["size"], per_arm[~mcmc]["max"], strict=True)) == {(12, 1400)}
    counts = rounds.pivot_table(index=["scene", "step"], columns="densify", values="count")
    assert (counts.mcmc < counts.adc)[counts.adc.notna()].all()


def test_the_tables_of_the_page_are_those_of_the_result_files() -> None:
    page = PAGE.read_text(encoding="utf-8")
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
    page = PAGE.read_text(encoding="utf-8")
    for name in re.findall(r"\((findings/[^)]+)\)", page):
        assert (findings.DOCS / name).is_file(), name
    assert all(path.stat().st_size < MAX_BYTES for path in findings.DATA.iterdir())


def test_the_experiments_of_the_page_are_configurations() -> None:
    page = PAGE.read_text(encoding="utf-8")
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
        paired = findings.pair(frame, arm, "lpips_squeeze", "adc")
        rows = [matrix[:, 0] for matrix in paired.differences]
        alone, shared = (decide(rows, Design(len(rows), (2, 3), alpha), 0.005, -1) for alpha in (0.05, 0.01))
        better = compare(paired, -1).verdict == "better"
        assert alone.outcome == "for" if better else alone.outcome in ("undecided", "equivalent")
        assert shared.outcome in (alone.outcome, "undecided")
