"""The paper as data: its numbers agree with its text, and measured cells are marked by them."""

import re
from shlex import split

import numpy as np
import pytest

from gsbench.analysis.cells import Cell
from gsbench.analysis.paper import (
    DIFFERS,
    INTERVAL,
    ROUNDING,
    agreement,
    load_published,
    paper_tables,
    published_names,
    published_table,
)
from gsbench.analysis.table_formats import to_html_page, to_latex, to_markdown
from gsbench.analysis.tables import build_table
from gsbench.system.install import conf_dir
from gsbench.verbs.results import tables
from tests.analysis.helpers import trials_of
from tests.analysis.test_tables import texts
from tests.helpers import refusal
from tests.trials import write_runs, write_trial


def numbers(table):
    """{(scene, init, densify, quantity): the printed number}"""
    return {
        (scene, *arm, key): table.find(scene, *arm, key)
        for scene in table.scenes
        for arm in table.arms
        for key in table.quantities
    }


def cell(mean, std=None, count=3):
    return Cell(mean, std, count, 3, 1, ())


@pytest.fixture
def garden(make_experiment):
    return make_experiment(experiment="table1", inits=("dim",), scenes=("garden",))


@pytest.mark.shared
def test_the_numbers_are_those_of_the_printed_tables(shared):
    """Every number of the tables in the paper's text, row by row, with its printed digits."""
    tables, text = load_published().tables, (shared / "paper.md").read_text()
    rows = [
        [c.strip().strip("*") for c in line.strip("|").split("|")]
        for line in text.splitlines()
        if "|" in line
    ]
    name = {"Tree-hill": "treehill", "Dr.Johnson": "drjohnson"}
    table1 = [row for row in rows if len(row) == 12 and re.fullmatch(r"[\d.]+", row[1])]
    assert len(table1) == 13
    for row in table1:
        scene = name.get(row[-1], row[-1].lower())
        table, shown = tables["table1"], ("ssim", "psnr", "lpips_vgg_raw", "gaussians_millions")
        keys = [(q, arm) for q in (*shown, "train_minutes") for arm in ("adc", "volumetric")]
        assert [table.find(scene, "dim", arm, q) for q, arm in keys] == row[1:11]
    table2 = [row for row in rows if len(row) == 5 and re.fullmatch(r"[\d.]+", row[1])]
    assert len(table2) == 12
    for row in table2:
        scene = name.get(row[0], row[0].lower())
        arms = (("sfm", "adc"), ("dim", "adc"), ("sfm", "volumetric"), ("dim", "volumetric"))
        found = [tables["table2"].find(scene, *arm, "lpips_vgg_raw") for arm in arms]
        assert found == row[1:]


def test_the_papers_contradictions_follow_from_its_numbers():
    paper = load_published()
    table1, table2 = map(numbers, paper.tables.values())
    text = "\n".join(paper.contradictions)

    def pairs(quantity):
        keys = [
            [(scene, "dim", arm, quantity) for arm in ("adc", "volumetric")]
            for scene in paper.tables["table1"].scenes
        ]
        return [(float(table1[one]), float(table1[other])) for one, other in keys]

    for name, quantity in (("Gaussians", "gaussians_millions"), ("Training time", "train_minutes")):
        costs = np.array(pairs(quantity))
        totals, ratios = (
            costs[:, 1].sum() / costs[:, 0].sum() - 1,
            (costs[:, 1] / costs[:, 0]).mean() - 1,
        )
        assert (
            f"{name}: {totals:+.1%} as a ratio of totals, {ratios:+.1%} as the mean of scenes"
            in text
        )
        assert name != "Gaussians" or f"{totals:.2%}".replace("%", " %") in text
    for name, quantity, digits in (
        ("SSIM", "ssim", 4),
        ("PSNR", "psnr", 3),
        ("LPIPS", "lpips_vgg_raw", 4),
    ):
        found = np.array(pairs(quantity))
        one, other = found.mean(axis=0)
        gains = (found[:, 1] - found[:, 0]) * (-1 if name == "LPIPS" else 1)
        counts = (
            f"better in {(gains > 0).sum()}, equal as printed in {(gains == 0).sum()}, worse "
            f"in {(gains < 0).sum()}"
        )
        assert (
            f"{name}: mean of 13 scenes {one:.{digits}f} (3DGS), {other:.{digits}f} (ours); ours "
            f"is {counts}." in text
        )
    for key, printed in table2.items():
        other = table1.get(key, printed)
        halves = (0.5 * 10.0 ** -len(own.partition(".")[2]) for own in (printed, other))
        if abs(float(printed) - float(other)) > sum(halves):  # their ranges do not overlap
            name = {"adc": "3DGS", "volumetric": "Ours"}[key[2]]
            assert f"{key[0]} {name} {table1[key]}/{printed}" in text
    assert set(paper.tables["table1"].scenes) - set(paper.tables["table2"].scenes) == {"train"}


@pytest.mark.parametrize(
    "measured, expected",
    [
        (cell(0.124), ROUNDING),  # rounds to 0.12
        (cell(0.126), DIFFERS),  # a single trial has no interval
        (cell(0.130, 0.002), DIFFERS),  # 0.130 - 4.303 * 0.002 / sqrt(3) = 0.12503 > 0.125
        (cell(0.130, 0.0021), INTERVAL),  # 0.130 - 4.303 * 0.0021 / sqrt(3) = 0.12478
        (cell(0.110, 0.0021), INTERVAL),
        (cell(0.200, 0.001), DIFFERS),
        # 12.706 for two trials: 0.130 - 12.706 * 0.00055 / sqrt(2) = 0.12506
        (cell(0.130, 0.00055, 2), DIFFERS),
        (cell(0.130, 0.00056, 2), INTERVAL),
    ],
)
def test_a_measured_cell_is_marked_by_its_agreement_with_the_printed_number(measured, expected):
    assert agreement(measured, "0.12") == expected


def test_table1_has_the_papers_rows_and_marks_what_was_not_run(make_experiment):
    scenes = ("courtyard", "garden", "bonsai")
    experiment = make_experiment(experiment="table1", inits=("dim",), scenes=scenes)
    measured, difference = paper_tables(experiment, "table1")
    rows = [row.labels[0] for row in measured.rows]
    # a scene that the paper lacks comes last
    assert rows == [*load_published().tables["table1"].scenes, "courtyard", "mean of 3 scenes"]
    by_scene = {row.labels[0]: row for row in measured.rows}
    assert by_scene["stump"].entries[0].text == "— (0/3)"
    arms = ("adc", "volumetric")
    assert {row.labels for row in difference.rows} == {(s, "dim", a) for s in scenes for a in arms}
    psnr = by_scene["garden"].entries[2].cell
    shown = (
        next(row for row in difference.rows if row.labels == ("garden", "dim", "adc"))
        .entries[3]
        .text
    )
    assert shown.split()[0].replace("−", "-") == f"{psnr.mean - 27.06:+.2f}"


def test_table1_names_the_initialiser_that_replaces_the_papers(make_experiment):
    experiment = make_experiment(experiment="table1", inits=("sfm",), scenes=("garden",))
    _, difference = paper_tables(experiment, "table1")
    assert any("from sfm replace the paper's DIM" in note for note in difference.notes)


def test_table2_has_the_papers_columns(make_experiment):
    experiment = make_experiment(experiment="table2", inits=("dim", "sfm"), scenes=("garden",))
    measured, _ = paper_tables(experiment, "table2")
    assert [c.heading for c in measured.columns] == [
        "SfM + 3DGS",
        "DIM + 3DGS",
        "SfM + Ours",
        "DIM + Ours",
    ]


def test_another_lpips_is_not_compared_with_the_papers(garden):
    _, difference = paper_tables(garden, "table1", metrics=["psnr", "flip"])
    assert [column.group for column in difference.columns] == ["PSNR (dB)", "PSNR (dB)"]
    assert any("no such number: flip" in note for note in difference.notes)


def test_an_experiment_without_the_papers_arms_is_refused(make_experiment):
    experiment = make_experiment(densifiers=("none",), scenes=("garden",))
    with refusal("no trial for table2"):
        paper_tables(experiment, "table2")
    assert build_table(experiment).rows


def test_the_tables_verb_prints_and_writes_files(tmp_path, capsys):
    runs = tmp_path / "runs"
    write_runs(runs, experiment="table1", inits=("dim",), scenes=("garden",))
    assert tables(["table1"], runs) == 0
    out = capsys.readouterr().out
    assert "### Table 1, measured" in out
    assert "### Table 1, difference" in out
    assert tables(["table1", "--format", "latex", "--out", str(tmp_path / "out")], runs) == 0
    written = (tmp_path / "out").glob("[!.]*")
    assert sorted(p.name for p in written) == ["table1-difference.tex", "table1.tex"]


def test_the_table_of_differences_quotes_the_papers_setup(garden):
    _, difference = paper_tables(garden, "table1")
    for written in (to_markdown(difference), to_html_page(difference), to_latex(difference)):
        assert "The paper on hardware: it trained on one NVIDIA RTX 2080." in written


def test_an_experiment_with_the_suffix_own_has_the_papers_layout(tmp_path, capsys):
    write_runs(tmp_path, experiment="table1_own", inits=("dim_paper",), scenes=("garden",))
    assert tables(["table1_own"], tmp_path) == 0
    out = capsys.readouterr().out
    assert "### Table 1, measured (experiment table1_own)" in out
    # image matching by the settings of the paper's time is the paper's DIM
    assert "replace the paper's DIM" not in out
    assert "| garden | dim_paper | adc |" in out
    assert tables(split("table1_own --paper 3dgs"), tmp_path) == 0
    assert "The paper on poses: it takes the cameras that come" in capsys.readouterr().out


# --- other papers


@pytest.mark.parametrize("name", published_names())
def test_every_paper_names_its_source_and_has_sane_numbers(name):
    paper = load_published(name)
    assert paper.title
    assert "github.com/" in paper.source or "arxiv.org/" in paper.source
    assert paper.conventions
    bounds = {"psnr": (10, 45), "ssim": (0.3, 1), "lpips_vgg_raw": (0, 1)}
    bounds |= {"gaussians_millions": (0, 10), "train_minutes": (1, 1000)}
    for table in paper.tables.values():
        for (scene, init, densify, key), printed in numbers(table).items():
            low, high = bounds[key]
            assert low < float(printed) < high
            # scenes, initial clouds and methods have the names of gsbench
            for file in (f"scene/{scene}", f"init/{init}", f"densify/{densify}"):
                assert (conf_dir() / f"{file}.yaml").is_file()


def test_measured_values_are_shown_beside_the_printed_numbers(tmp_path, capsys):
    for seed, psnr in enumerate((27.41, 27.41, 27.41)):
        write_trial(tmp_path, seed, psnr=psnr, ssim=0.9, lpips_vgg_raw=0.2)
    write_trial(tmp_path, psnr=1.0, scene="nowhere")
    table = published_table(trials_of(tmp_path), "3dgs")
    assert texts(table) == [
        ["garden", "sfm", "adc", "27.410", "+0.000 =", "0.868", "+0.032 ≠", "0.103", "+0.097 ≠"]
    ]
    assert any("Read from github.com/nerfbaselines" in note for note in table.notes)
    assert (
        "Of 3 cells 1 are within rounding (=), 0 within our 95% t interval of the mean (≈), 2 "
        "differ" in table.notes[0]
    )
    assert tables(split("exp --paper 3dgs"), tmp_path) == 0
    assert "### Difference from 3dgs" in capsys.readouterr().out


def test_trials_that_cannot_be_compared_with_a_paper_are_refused(tmp_path):
    write_trial(tmp_path, psnr=1.0, scene="nowhere")
    with refusal("no trial here is of one of them"):
        published_table(trials_of(tmp_path), "3dgs-mcmc")
    write_trial(tmp_path, psnr=1.0)
    write_trial(tmp_path, 1, psnr=1.0, _iterations=7)
    with refusal(r"scene=garden init=sfm densify=adc would average trials that differ in iter"):
        published_table(trials_of(tmp_path), "3dgs")
    with refusal(r"no published numbers '3dsg'.*did you mean 3dgs"):
        load_published("3dsg")
