"""``gsbench tables``, ``report`` and ``explain`` with made-up results."""

import csv
from pathlib import Path
from shlex import split
from types import SimpleNamespace

import pytest

from gsbench.runs.code import AS_RELEASED
from gsbench.verbs.results import _origin, explain, explain_cell, report, tables
from tests.helpers import refusal, table
from tests.trials import write_runs


def test_a_cell_names_its_trials_hashes_and_versions(tmp_path, capsys):
    paths = write_runs(tmp_path, experiment="table1", inits=("dim",), scenes=("garden",))
    assert explain(["table1:garden:lpips:volumetric"], tmp_path) == 0
    text = capsys.readouterr().out
    for path in paths:
        assert (str(path) in text) == ("volumetric" in str(path))
    for expected in (
        "LPIPS VGG raw of dim-volumetric on garden",
        "over 3 of 3 trials",
        "data-garden",
        "torch 2.13.0",
        "protocol: paper-1",
        "resolution: 400x300",
        "iterations: 2000",
    ):
        assert expected in text


def test_missing_trials_and_metrics_are_reported(tmp_path):
    paths = write_runs(tmp_path, scenes=("garden",), densifiers=("adc", "adc_2"))
    (paths[0] / "results.json").unlink()
    (paths[-1] / "results.json").unlink()  # of another arm, whose name has the arm's
    text = explain_cell("exp:garden:psnr:adc", tmp_path)
    assert "over 2 of 3 trials" in text
    assert "Left out\n  exp/garden/sfm-adc/c0ffee00-seed0: unfinished" in text
    assert "adc_2" not in text.partition("Conditions")[2]
    assert "Verdicts\n  NOT ASKED: sfm-adc_2 against sfm-adc: not asked beforehand" in text
    assert "not available: weights file alexnet.pth not found" in explain_cell(
        "exp:garden:lpips_alex:adc", tmp_path
    )


@pytest.mark.parametrize(
    "address, words",
    table(__file__, "addresses"),
)
def test_bad_addresses_are_explained(tmp_path, address, words):
    write_runs(tmp_path, scenes=("garden",), inits=("sfm", "dim"))
    with refusal(words):
        explain_cell(address, tmp_path)


# ---- tables


@pytest.fixture
def made(tmp_path, monkeypatch):
    """The runs folder of an experiment with two arms on one scene, and of one with a single arm."""
    write_runs(tmp_path / "runs", scenes=("garden",))
    write_runs(tmp_path / "runs", experiment="alone", densifiers=("adc",))
    monkeypatch.chdir(tmp_path)
    return tmp_path / "runs"


def test_tables_alone_lists_the_experiments(made, capsys):
    assert tables([], made) == 0
    assert capsys.readouterr().out.splitlines() == ["alone", "exp"]
    assert tables([], made / "empty") == 0
    assert "no experiment in" in capsys.readouterr().out


@pytest.mark.parametrize("values, seeds", [("0,2", 2), ("1", 1), ("2,7", 1), ("0,1,2", 3)])
def test_where_takes_several_values(made, capsys, values, seeds):
    assert tables(split(f"exp --where seed={values} --format trials"), made) == 0
    assert len(capsys.readouterr().out.splitlines()) == 1 + 2 * seeds
    for wrong, words in (("seed=8,9", "no trial has seed=8,9"), ("seed", "KEY=VALUE")):
        with refusal(words):
            tables(split(f"exp --where {wrong}"), made)


FAIR = ["--layout", "fairness"]


@pytest.mark.parametrize(
    "words, files, begins",
    table(__file__, "files"),
)
def test_tables_are_written_where_out_says(made, capsys, words, files, begins):
    assert tables(["exp", *split(words)], made) == 0
    assert capsys.readouterr().out.splitlines() == files
    for name in files:
        assert Path(name).read_text().startswith(begins), name


def test_a_table_of_trials_has_a_row_for_each_and_no_option_of_a_table(made, capsys):
    assert tables(split("exp --format trials --where densify=adc"), made) == 0
    rows = list(csv.DictReader(capsys.readouterr().out.splitlines()))
    assert [(row["densify"], row["seed"]) for row in rows] == [("adc", str(k)) for k in range(3)]
    for option in split("--rows --columns --metrics --layout --paper"):
        value = {"--layout": "plain", "--paper": "3dgs"}.get(option, "psnr")
        with refusal(f"shows all, and takes no {option}"):
            tables(["exp", "--format", "trials", option, value], made)


def test_fairness_sheets_need_two_arms(made):
    with refusal("experiment alone has one arm"):
        tables(["alone", *FAIR], made)


def test_a_field_is_a_row_or_a_column(made):
    with refusal(r"init, scene is in --rows and --columns: choose one"):
        tables(split("exp --rows scene,init,densify --columns init,scene"), made)


def test_the_papers_contradictions_are_listed_unless_an_experiment_has_their_name(made, capsys):
    assert tables(["paper"], made) == 0
    assert all(line.startswith("- ") for line in capsys.readouterr().out.splitlines())
    write_runs(made, experiment="paper", scenes=("garden",))
    tables(["paper"], made)
    assert capsys.readouterr().out.startswith("### Experiment paper")


def test_trials_that_are_left_out_are_named_on_the_error_stream(made, capsys):
    place = next((made / "exp").glob("*/sfm-adc/*-seed0"))
    (place / "results.json").write_text("{")
    for verb, words in ((tables, []), (report, ["--out", "r.html"])):
        verb(["exp", *words], made)
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("left out: exp/garden/sfm-adc/c0ffee00-seed0")


# ---- report


@pytest.mark.parametrize(
    "words, file",
    [
        ("", "{runs}/exp/report.html"),
        ("--out r.HTML", "r.HTML"),
        ("--out new", "new/exp-report.html"),
        ("--out r.html/", "r.html"),
    ],
)
def test_a_report_is_written_where_out_says(made, capsys, words, file):
    assert report(["exp", *split(words)], made) == 0
    place = file.format(runs=made)
    assert capsys.readouterr().out == f"{place}\n"
    assert Path(place).read_text().startswith("<!doctype html>")


def test_a_report_compares_with_a_densifier_of_the_experiment(made, capsys):
    report(split("exp --baseline volumetric --out r.html"), made)
    assert "sfm-adc against sfm-volumetric" in Path("r.html").read_text()
    with refusal("--baseline mcmc: exp has adc, volumetric"):
        report(split("exp --baseline mcmc"), made)


# ---- explain: where the numbers of a trial come from


def test_an_origin_names_program_machine_and_code():
    record = SimpleNamespace(
        num_gaussians=12345,
        num_init_points=None,
        test_views=7,
        trained_by=None,
        hashes={"data": "d", "train": "t"},
        versions={"torch": "2.13.0"},
        renders={"folder": "r"},
        code=SimpleNamespace(commit="", edited=False, packages={"init": AS_RELEASED}),
    )
    trial = SimpleNamespace(
        record=record,
        path=Path("runs/x"),
        from_renders=False,
        program=None,
        conditions={"data": 1},
        machine="",
        code_texts=[],
        edits=[],
    )
    own = {"folder": "runs/x", "Gaussians": "12,345 from 0 points", "views": "7 for testing"}
    assert _origin(trial) == own | {"train": "t", "versions": "torch 2.13.0"}
    trial.from_renders, record.test_views = True, None
    assert _origin(trial)["Gaussians"] == "folder r"
    assert _origin(trial)["views"] == "? for testing"
    trial.program = "nerfstudio"
    assert _origin(trial)["Gaussians"] == "its own renders"
    record.trained_by = SimpleNamespace(version="brush 1", command=["brush", "a"])
    trial.machine, trial.code_texts = "a CPU", ["code of mine ffff", "stage train 2"]
    record.code.commit, record.code.edited = "abc", True
    found = _origin(trial)
    assert found["program"] == "brush 1: brush a"
    assert found["machine"] == "a CPU"
    assert found["code"] == "code of mine ffff, stage train 2"
    assert found["commit"] == "abc, edited"
    assert "edited" not in found
    record.code.packages["eval"] = "1" * 64
    assert _origin(trial)["edited"] == "since the last release: eval"
    del record.code.packages["init"]  # all packages count as edited before the first release
    assert "edited" not in _origin(trial)


def test_a_report_of_some_trials_has_no_verdict_that_lost_trials(tmp_path, capsys):
    write_runs(tmp_path, scenes=("garden", "room"), densifiers=("adc", "mcmc", "volumetric"))
    assert report(["exp"], tmp_path) == 0
    whole = (tmp_path / "exp/report.html").read_text()
    assert report(split("exp --where scene=garden --where densify=adc,mcmc"), tmp_path) == 0
    page = (tmp_path / "exp/report.html").read_text()
    assert "sfm-mcmc against sfm-adc: not tested, since --where scene=garden --where dens" in page
    assert ("volumetric" in whole, "volumetric" in page) == (True, False)
    with refusal("no trial has scene=attic"):
        report(split("exp --where scene=attic"), tmp_path)
