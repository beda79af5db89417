"""Interpolation and extrapolation: kept apart in tables and verdicts, side by side in the report."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from gsbench.analysis.cells import with_variants
from gsbench.analysis.declaration import standing
from gsbench.analysis.pairing import ViewCache, choose_pairs
from gsbench.analysis.questions import HOLDS, OPEN, TURNS, UNSURE, Turn, find_gaps, find_turns
from gsbench.analysis.report.build import build_report
from gsbench.analysis.report.question_charts import angle_charts, binned, question_part
from gsbench.analysis.report.setting_charts import sweep_charts, tradeoff_charts
from gsbench.analysis.results import Experiment, load_experiment
from gsbench.analysis.table_formats import to_markdown
from gsbench.analysis.tables import build_table
from gsbench.analysis.verdicts import declared_lines, judge
from gsbench.errors import InputError
from gsbench.eval.options import EvalConfig
from gsbench.runs.declaration import Arm
from tests.analysis.synthetic import BASE, METRICS, Plan, trial_data, write_trial

SPLITS = {"every_nth": "aaaaaaaa", "sector": "bbbbbbbb"}
SECTORS = {"sector": 0, "sectors": 8}
ANGLES = {"every_nth": np.linspace(4, 8, 6), "sector": np.linspace(8, 40, 6)}


def write_splits(
    runs: Path,
    gains: dict[str, dict[str, float]],
    fall: float = 5.0,
    noise: float = 0.02,
    seeds: int = 4,
    record: bool = True,
    **scene: object,
) -> Experiment:
    """An experiment of adc and volumetric under both splits; ``gains`` of the second by split and metric."""
    rng = np.random.default_rng(0)
    plan = Plan()
    for split, config_hash in SPLITS.items():
        for densify in ("adc", "volumetric"):
            for seed in range(seeds):
                gain = gains.get(split, {}) if densify == "volumetric" else {}
                lost = fall if split == "sector" else 0.0
                views = {
                    m: BASE[m] + gain.get(m, 0.0) - (lost if m == "psnr" else 0) + rng.normal(0, noise, 6)
                    for m in METRICS
                }
                data = trial_data(plan, "courtyard", "sfm", densify, seed, views)
                rows = views | {"angle_to_nearest": ANGLES[split]}
                if record:
                    data["held_out"] = {"every_nth": "every 8th image", "sector": "part 0 of 8 by azimuth"}[split]
                settings = {f"scene__{key}": value for key, value in (SECTORS | {"split": split} | scene).items()}
                write_trial(runs, data, rows, config_hash, **settings)
    return load_experiment(runs, "exp")


def turns_of(experiment: Experiment) -> dict[str, Turn]:
    trials = with_variants(experiment.trials)
    judged = judge(trials, choose_pairs(sorted({trial.arm for trial in trials})))
    return {turn.quantity.key: turn for turn in find_turns(trials, judged)}


def test_an_order_that_turns_is_found_with_both_intervals(tmp_path: Path) -> None:
    gains = {
        "every_nth": {"psnr": 0.5, "ssim": 0.1, "flip": -0.1},
        "sector": {"psnr": -0.5, "ssim": 0.1, "flip": 0.0},
    }
    turns = turns_of(write_splits(tmp_path, gains))
    assert {key: turn.word for key, turn in turns.items()} == {
        "psnr": TURNS, "ssim": HOLDS, "flip": turns["flip"].word, "lpips_vgg_raw": turns["lpips_vgg_raw"].word,
    }  # fmt: skip
    assert turns["flip"].word in (OPEN, UNSURE)
    psnr = turns["psnr"]
    assert (psnr.first, psnr.second) == (Arm("sfm", "adc"), Arm("sfm", "volumetric"))
    assert psnr.interpolation.verdict.interval.low > 0  # type: ignore[union-attr]
    assert psnr.extrapolation.verdict.interval.high < 0  # type: ignore[union-attr]
    assert psnr.change == pytest.approx(-1.0, abs=0.1)
    assert psnr.interval is not None
    assert psnr.interval.low < -1.0 < psnr.interval.high or psnr.interval.high < 0


def test_an_order_that_only_seems_to_turn_is_not_said_to(tmp_path: Path) -> None:
    gains = {"every_nth": {"psnr": 0.02}, "sector": {"psnr": -0.02}}
    turns = turns_of(write_splits(tmp_path, gains, noise=1.0))
    assert turns["psnr"].word in (UNSURE, OPEN)


def test_the_gap_of_an_arm_is_paired_by_seed(tmp_path: Path) -> None:
    experiment = write_splits(tmp_path, {}, fall=5.0)
    gaps = {(gap.arm.densify, gap.quantity.key): gap for gap in find_gaps(experiment.trials)}
    gap = gaps["adc", "psnr"]
    values = {
        s: [t.metrics["psnr"] for t in experiment.trials if t.densify == "adc" and t.split.startswith(s)]
        for s in SPLITS
    }
    assert gap.mean == pytest.approx(np.mean(values["sector"]) - np.mean(values["every_nth"]))
    assert gap.interpolation == pytest.approx(np.mean(values["every_nth"]))
    assert gap.interval is not None
    assert gap.interval.low < -5 < gap.interval.high
    assert ("adc", "train_time") not in gaps


def test_tables_put_splits_side_by_side_and_mark_the_best_of_each(tmp_path: Path) -> None:
    experiment = write_splits(tmp_path, {"every_nth": {"psnr": 1.0}, "sector": {"psnr": -1.0}})
    text = to_markdown(build_table(experiment, metrics=["psnr"]))
    header = next(line for line in text.splitlines() if "every_nth" in line)
    assert header.index("every_nth") < header.index("sector")
    rows = {name: next(line for line in text.splitlines() if f"| {name} |" in line) for name in ("adc", "volumetric")}
    cells = {name: [cell.strip() for cell in row.strip("| ").split("|")] for name, row in rows.items()}
    assert [cell.startswith("**") for cell in cells["volumetric"][-2:]] == [True, False]
    assert [cell.startswith("**") for cell in cells["adc"][-2:]] == [False, True]
    assert "Held out (interpolation): every 8th image; 6 of 48 views." in text
    assert "Held out (extrapolation): part 0 of 8 by azimuth; 6 of 48 views." in text
    assert "not compared" not in text


def test_two_splits_never_share_a_cell(tmp_path: Path) -> None:
    experiment = write_splits(tmp_path, {})
    with pytest.raises(InputError, match="differ in"):
        build_table(experiment, rows=["scene", "densify"], columns=["init"])


def test_a_declared_question_makes_the_verdict_and_the_other_is_secondary(tmp_path: Path) -> None:
    experiment = write_splits(tmp_path, {"every_nth": {"psnr": 0.5}, "sector": {"psnr": 0.5}})
    (tmp_path / "exp" / "declared.jsonl").write_text(
        json.dumps({"metric": "psnr@extrapolation", "time": "2020-01-01T00:00:00Z"}) + "\n"
    )
    trials = with_variants(experiment.trials)
    declared = standing(experiment.folder, trials)
    assert declared is not None
    assert (declared.metric, declared.question) == ("psnr", "extrapolation")
    judged = judge(trials, choose_pairs(sorted({trial.arm for trial in trials})), declared)
    roles = {
        next(t for t in trials if t.arm == pair[0]).question: {v.quantity.key: v.role for v in own.verdicts}
        for pair, own in judged.items()
    }
    assert roles["extrapolation"]["psnr"] == "declared"
    assert roles["interpolation"]["psnr"] == "secondary"
    assert {role for question in roles.values() for key, role in question.items() if key != "psnr"} == {"secondary"}
    sizes = {v.role: v.verdict.family for own in judged.values() for v in own.verdicts}
    assert sizes == {"declared": 1, "secondary": 7}
    lines = declared_lines(declared, judged)
    assert lines[0].startswith("PSNR (dB) at extrapolation was declared beforehand")
    assert sum(line.startswith("Verdict") for line in lines) == 1
    assert "split=sector" in lines[1]


@pytest.mark.parametrize("primary", ["psnr@extrapolation", "psnr@interpolation", "flip", None])
def test_primary_may_name_a_question(primary: str | None) -> None:
    assert EvalConfig(name="a", protocol="paper", primary=primary).primary == primary


@pytest.mark.parametrize(
    ("primary", "message"),
    [
        ("psnr@", "after @ comes interpolation or extrapolation"),
        ("psnr@sector", "after @ comes"),
        ("psnrr@extrapolation", "is no metric"),
    ],
)
def test_a_question_that_is_none_is_refused(primary: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        EvalConfig(name="a", protocol="paper", primary=primary)


def test_the_report_shows_both_and_draws_the_error_over_the_angle(tmp_path: Path) -> None:
    experiment = write_splits(tmp_path, {"every_nth": {"psnr": 0.5}, "sector": {"psnr": -0.5}})
    page = build_report(experiment)
    assert re.search(r"the order turns in \d between the questions", page)
    assert re.search(r"sfm-volumetric against sfm-adc: \+0\.[45]\d+ \(.* at interpolation, −0\.[45]\d+ \(", page)
    assert "From interpolation to extrapolation" in page
    assert "8.0 to 40.0 degrees" in page
    assert "angle to the nearest training view (degrees)" in page
    charts = angle_charts(with_variants(experiment.trials), ViewCache())
    assert len(charts) == 2
    assert all("sfm-adc" in chart and "sfm-volumetric" in chart and "split=" not in chart for chart in charts)


def test_one_question_alone_makes_no_statement_about_two(tmp_path: Path) -> None:
    experiment = write_splits(tmp_path, {})
    kept = [trial for trial in experiment.trials if trial.question == "interpolation"]
    part = question_part(kept, {}, ViewCache())
    assert part is not None
    assert (part.line, part.gaps, part.turns) == ("", (), ())
    assert len(part.charts) == 2


def test_bins_keep_views_of_one_angle_together() -> None:
    points = [(float(x), float(x)) for x in range(100) for _ in range(2)]
    found = binned(points, 10)
    assert len(found) == 10
    assert found[0] == (4.5, 4.5)
    assert binned([(1.0, 2.0), (1.0, 4.0)]) == [(1.0, 3.0)]
    assert binned([]) == []


def test_which_views_made_the_points_is_said_under_a_table(tmp_path: Path) -> None:
    plan, rng = Plan(), np.random.default_rng(0)
    for init, choice, taken in (
        ("sfm", "train", None),
        ("dataset", "train", 0.125),
        ("dim", "all", None),
        ("random", None, None),
    ):
        views = {m: BASE[m] + rng.normal(0, 0.01, 6) for m in METRICS}
        data = trial_data(plan, "courtyard", init, "adc", 0, views)
        data["init_report"] = {"training_points": {"removed": taken}, "mean_track_length": 3.0 if choice else None}
        write_trial(tmp_path, data, views, **({"init__points_from": choice} if choice not in (None, "all") else {}))
    notes = build_table(load_experiment(tmp_path, "exp"), metrics=["psnr"]).notes
    said = [note for note in notes if note.startswith("Initial points")]
    assert said == [
        "Initial points of dataset: from training views alone (init.points_from=train), without 12% of those of all "
        "views.",
        "Initial points of dim: from all views, test views too (init.points_from=all).",
        "Initial points of sfm: from training views alone (init.points_from=train).",
    ]


def test_split_is_told_from_results_or_from_the_configuration(tmp_path: Path) -> None:
    trials = write_splits(tmp_path, {}, sector=3, sectors=4, match_views=True).trials
    assert {trial.split for trial in trials} == {"every_nth, matched with 4", "sector 3 of 4, matched"}
    one = next(trial for trial in trials if trial.question == "extrapolation")
    assert one.conditions["split"] == one.split


def test_no_chart_joins_the_two_questions(tmp_path: Path) -> None:
    trials = with_variants(write_splits(tmp_path, {}).trials)
    assert sweep_charts(trials) == []
    titles = [re.findall(r"<figcaption>(.*?)</figcaption>", chart)[0] for chart in tradeoff_charts(trials)]
    assert titles
    assert all(title.endswith((", every_nth", ", sector 0 of 8")) for title in titles)
