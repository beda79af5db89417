"""Tables: the numbers in the cells, what is refused, what is marked, and the formats."""

import csv
import io
import re
import shutil
import statistics
import subprocess
from html.parser import HTMLParser
from shlex import split

import numpy as np
import pandas as pd
import pytest

from gsbench.analysis.quantities import (
    Change,
    asked_quantity,
    choose_quantities,
    quantity,
    relative_change,
)
from gsbench.analysis.report.build import build_report
from gsbench.analysis.results import load_experiment
from gsbench.analysis.table_formats import (
    Column,
    Row,
    Table,
    TableEntry,
    csv_of,
    escape_latex,
    to_csv,
    to_html_page,
    to_latex,
    to_markdown,
)
from gsbench.analysis.tables import build_table, with_agreement
from tests.analysis.synthetic import Plan, trial_data, write_runs, write_trial
from tests.helpers import read_json, refusal


def one_trial(runs, seed, config_hash="c0ffee00", settings=None, **values):
    """A trial of one scene; ``psnr=…`` gives a metric, ``_iterations=…`` a key of results.json."""
    metrics = {key: value for key, value in values.items() if not key.startswith("_")}
    plan = Plan()
    views = {key: np.array([value]) for key, value in metrics.items()}
    densify = str(values.get("_densify", "adc"))
    scene = str(values.get("_scene", "garden"))
    data = trial_data(plan, scene, "sfm", densify, seed, views)
    data |= {key[1:]: value for key, value in values.items() if key.startswith("_")}
    return write_trial(runs, data, views, config_hash, **(settings or {}))


def texts(table):
    return [
        [*row.labels, *(f"*{e.text}*" if e.bold else e.text for e in row.entries)]
        for row in table.rows
    ]


def test_a_cell_is_mean_and_sample_deviation_over_trials(tmp_path):
    for seed, psnr in enumerate((27.0, 27.1, 27.5)):
        one_trial(tmp_path, seed, psnr=psnr)
    table = build_table(load_experiment(tmp_path, "exp"), metrics=["psnr"])
    # mean 27.2, deviation sqrt((0.04 + 0.01 + 0.09) / 2) = 0.2646
    assert texts(table) == [["garden", "sfm", "adc", "27.20 ± 0.26"]]


def test_the_best_is_bold_and_ties_after_rounding_are_both_best(tmp_path):
    for densify, psnr, flip in (
        ("adc", 27.001, 0.1),
        ("none", 26.0, 0.3),
        ("volumetric", 26.996, 0.05),
    ):
        one_trial(tmp_path, 0, _densify=densify, psnr=psnr, flip=flip)
    table = build_table(load_experiment(tmp_path, "exp"), metrics=["psnr", "flip", "gaussians"])
    assert [row[3:5] for row in texts(table)] == [
        ["*27.00*", "0.100"],
        ["26.00", "0.300"],
        ["*27.00*", "*0.050*"],
    ]
    assert not any(row.entries[2].bold for row in table.rows)  # a count is a cost, not a merit


def test_bold_is_by_scene_not_by_table(make_experiment):
    table = build_table(make_experiment(effect={"psnr": 1.0}), metrics=["psnr"])
    bold = {row.labels[:3] for row in table.rows if row.entries[0].bold}
    assert bold == {(s, "sfm", "volumetric") for s in ("courtyard", "garden", "mean of 2 scenes")}


def test_no_mean_is_shown_if_no_scene_has_every_arm(tmp_path):
    paths = write_runs(tmp_path, Plan())
    for path in [*paths[0:3], *paths[9:]]:  # courtyard has volumetric alone, garden adc
        shutil.rmtree(path)
    table = build_table(
        load_experiment(tmp_path, "exp"), rows=["scene"], columns=["densify"], metrics=["psnr"]
    )
    assert [row[0] for row in texts(table)] == ["courtyard", "garden"]


def test_missing_and_incomplete_cells_are_marked_with_their_count(tmp_path):
    paths = write_runs(tmp_path, Plan())
    (paths[0] / "results.json").unlink()  # courtyard, adc, seed 0
    for path in paths[9:]:  # garden, volumetric
        shutil.rmtree(path)
    table = build_table(
        load_experiment(tmp_path, "exp"), rows=["scene"], columns=["densify"], metrics=["psnr"]
    )
    rows = {row[0]: row[1:] for row in texts(table)}
    assert rows["courtyard"][0].strip("*").endswith("(2/3)")
    assert rows["garden"][1] == "— (0/3)"
    assert "(2/3)" not in rows["garden"][0]
    assert "mean of 1 scene" in rows  # only courtyard has both arms
    assert any(
        "Left out (1): exp/courtyard/sfm-adc/c0ffee00-seed0: unfinished" in note
        for note in table.notes
    )


def test_an_unavailable_metric_is_na_with_its_reason(make_experiment):
    table = build_table(make_experiment(), metrics=["lpips_alex"])
    assert {row.entries[0].text for row in table.rows} == {"n/a"}
    assert "LPIPS Alex: n/a, weights file alexnet.pth not found." in table.notes


@pytest.mark.parametrize("there", [True, False])
def test_the_only_lpips_that_was_asked_for_has_a_column(there, tmp_path):
    measured = {"lpips_squeeze": 0.1} if there else {}
    one_trial(tmp_path, 0, settings={"eval__lpips": ["squeeze"]}, psnr=27.0, **measured)
    keys = [quantity.key for quantity in choose_quantities(load_experiment(tmp_path, "exp").trials)]
    assert [key for key in keys if key.startswith("lpips")] == ["lpips_squeeze"]


def test_the_lpips_of_the_protocol_has_a_column_even_when_it_is_missing(tmp_path):
    one_trial(tmp_path, 0, psnr=27.0)
    table = build_table(load_experiment(tmp_path, "exp"))
    assert [column.heading for column in table.columns][1] == "LPIPS VGG raw ↓"
    assert table.rows[0].entries[1].text == "n/a"


@pytest.mark.parametrize(
    "key, values",
    [
        ("iterations", (7000, 30000)),
        ("raster", ("cpu", "cuda")),
        ("protocol", ("paper-1", "standard-1")),
        ("resolution", ([400, 300], [800, 600])),
        ("budget", ({"max_gaussians": 1, "cap": "soft"}, {"max_gaussians": 2, "cap": "soft"})),
        ("hashes", ({"data": "a"}, {"data": "b"})),
    ],
)
def test_a_cell_never_mixes_conditions(tmp_path, key, values):
    for seed, value in enumerate(values):
        one_trial(tmp_path, seed, psnr=27.0, **{f"_{key}": value})
    named = "data" if key == "hashes" else key
    with refusal(f"differ in {named}: "):
        build_table(load_experiment(tmp_path, "exp"))


def test_a_cell_never_mixes_settings(tmp_path):
    one_trial(tmp_path, 0, "aaaaaaaa", psnr=27.0)
    one_trial(tmp_path, 1, "bbbbbbbb", {"densify__volume_threshold": 0.1}, psnr=28.0)
    experiment = load_experiment(tmp_path, "exp")
    with refusal(r"differ in densify\.volume_threshold: 0\.03 \| 0\.1"):
        build_table(experiment, rows=["scene", "densify"])
    # by default it becomes a row
    assert build_table(experiment).row_headings[-1] == "densify.volume_threshold"
    table = build_table(experiment, rows=["scene", "densify.volume_threshold"], metrics=["psnr"])
    assert [row.labels for row in table.rows] == [("garden", "0.03"), ("garden", "0.1")]


def test_settings_that_only_say_where_a_trial_ran_do_not_matter(tmp_path):
    one_trial(tmp_path, 0, "aaaaaaaa", psnr=27.0)
    one_trial(
        tmp_path, 1, "bbbbbbbb", {"tracking__name": "off", "scene__path": "/elsewhere"}, psnr=28.0
    )
    assert (
        texts(build_table(load_experiment(tmp_path, "exp"), metrics=["psnr"]))[0][3]
        == "27.50 ± 0.71"
    )


def test_one_seed_twice_is_refused(tmp_path):
    one_trial(tmp_path, 0, "aaaaaaaa", psnr=27.0)
    one_trial(tmp_path, 0, "bbbbbbbb", psnr=27.0)
    with refusal("seed 0 twice"):
        build_table(load_experiment(tmp_path, "exp"))


def test_arms_under_different_conditions_are_shown_but_not_compared(tmp_path):
    one_trial(tmp_path, 0, psnr=27.0)
    one_trial(tmp_path, 0, psnr=28.0, _densify="volumetric", _iterations=7000)
    table = build_table(load_experiment(tmp_path, "exp"), metrics=["psnr"])
    assert [row[3] for row in texts(table)] == ["27.00", "28.00"]
    assert "garden: not compared, no best marked: the arms differ in iterations." in table.notes


@pytest.mark.parametrize(
    "second_budget, blocked, compared",
    [
        # neither cap acted, so none limited the growth
        ({"max_gaussians": None, "cap": None}, (0, 0), True),
        ({"max_gaussians": None, "cap": None}, (3, 0), False),
        ({"max_gaussians": 1000, "cap": "hard"}, (0, 3), False),
        ({"max_gaussians": 50_000, "cap": "soft"}, (3, 0), True),  # one budget for both
        # a time limit may have stopped its growth
        ({"max_gaussians": None, "cap": None, "seconds": 60}, (0, 0), False),
        (
            {"max_gaussians": None, "cap": None},
            (None, 0),
            False,
        ),  # unknown whether the cap blocked any
        # a governor steers growth even if it refuses nothing
        ({"max_gaussians": 1000, "cap": "governor"}, (0, 0), False),
    ],
)
def test_arms_are_compared_under_one_budget_or_under_none_that_acted(
    tmp_path, second_budget, blocked, compared
):
    first, second = ({} if count is None else {"blocked_by_cap": count} for count in blocked)
    one_trial(tmp_path, 0, psnr=27.0, _events=first)
    one_trial(tmp_path, 0, psnr=28.0, _densify="none", _budget=second_budget, _events=second)
    table = build_table(load_experiment(tmp_path, "exp"), metrics=["psnr"])
    assert [row[3] for row in texts(table)] == ["27.00", "*28.00*" if compared else "28.00"]
    assert (
        "garden: not compared, no best marked: the arms differ in budget." in table.notes
    ) is not compared


def test_the_mean_of_scenes_gives_each_the_same_weight(tmp_path):
    for scene, psnrs in (("a", (20.0, 22.0)), ("b", (30.0, 31.0))):
        for seed, psnr in enumerate(psnrs):
            one_trial(tmp_path, seed, psnr=psnr, _scene=scene)
    experiment = load_experiment(tmp_path, "exp")
    mean, std = (21.0 + 30.5) / 2, statistics.stdev([25.0, 26.5])  # by seed: (20+30)/2, (22+31)/2
    for table in (
        build_table(experiment, metrics=["psnr"]),
        build_table(experiment, rows=["densify"], metrics=["psnr"]),
    ):
        assert table.rows[-1].entries[0].text == f"{mean:.2f} ± {std:.2f}"


def test_changes_of_costs_are_given_of_totals_and_as_the_mean_of_ratios(make_experiment, tmp_path):
    for scene, adc, volumetric in (("a", 1_000_000, 2_000_000), ("b", 3_000_000, 3_000_000)):
        one_trial(tmp_path, 0, psnr=20.0, _scene=scene, _num_gaussians=adc)
        one_trial(
            tmp_path, 0, psnr=20.0, _scene=scene, _num_gaussians=volumetric, _densify="volumetric"
        )
    trials = load_experiment(tmp_path, "exp").trials
    arms = [[trial for trial in trials if trial.densify == name] for name in ("adc", "volumetric")]
    change = relative_change(*arms, lambda trial: trial.record.num_gaussians)
    assert change == Change(5 / 4 - 1, 0.5, 2)  # totals 4M -> 5M; ratios 2 and 1
    assert str(change) == "+25.0% as a ratio of totals, +50.0% as the mean of 2 scenes"
    assert relative_change(arms[0], [], lambda trial: trial.record.num_gaussians) is None


def test_metrics_of_earlier_iterations_have_columns_of_their_own(tmp_path):
    for seed, (early, late) in enumerate(((20.0, 27.0), (22.0, 28.0))):
        one_trial(tmp_path, seed, psnr=late, _metrics_at={"7000": {"metrics": {"psnr": early}}})
    experiment = load_experiment(tmp_path, "exp")
    table = build_table(experiment, metrics=["psnr@7000", "psnr"])
    assert [column.heading for column in table.columns] == ["PSNR at 7,000 ↑", "PSNR (dB) ↑"]
    assert texts(table)[0][3:] == ["21.00 ± 1.41", "27.50 ± 0.71"]
    with refusal(r"measured at iteration '9000'; measured were \(eval\.at\) 7000"):
        build_table(experiment, metrics=["psnr@9000"])


def test_unknown_names_are_refused(make_experiment):
    experiment = make_experiment()
    with refusal("unknown metric 'pnsr'"):
        build_table(experiment, metrics=["pnsr"])
    with refusal(r"no trial has a setting 'densify\.grad_tresh'"):
        build_table(experiment, rows=["scene", "densify.grad_tresh"])


def test_the_notes_say_how_to_read_the_table_and_what_is_left_out(tmp_path):
    paths = write_runs(tmp_path, Plan(experiment="exp"))
    (paths[-1] / "results.json").write_text("{")
    notes = build_table(load_experiment(tmp_path, "exp"), metrics=["psnr", "lpips_alex"]).notes
    assert notes[:4] == (
        "Mean over 3 trials; ± is the deviation (n − 1) over trials.",
        "Bold: best mean of a scene after rounding; this is not a test.",
        "(k/3): k of 3 trials with a value; —: none.",
        "Protocol paper-1.",
    )
    assert any(note.endswith("n/a, weights file alexnet.pth not found.") for note in notes)
    assert notes[-1].startswith("Left out (1): exp/garden/sfm-volumetric/c0ffee00-seed2: damaged")
    complete = build_table(load_experiment(tmp_path, "exp"), rows=["densify"], metrics=["psnr"])
    assert (
        complete.notes[0]
        == "Mean over 3 trials; ± is the deviation (n − 1) over the trials' means of scenes."
    )


def test_rows_are_in_the_order_of_numbers_then_of_text(tmp_path):
    for cap in (9, 10, 100, None):
        one_trial(tmp_path, 0, f"{cap or 0:08x}", {"densify__cap": cap}, psnr=20.0)
    table = build_table(load_experiment(tmp_path, "exp"), rows=["densify.cap"], metrics=["psnr"])
    assert [row.labels for row in table.rows] == [("9",), ("10",), ("100",), ("–",)]


def test_markdown_has_a_line_for_each_row_and_equal_numbers_of_cells(make_experiment):
    text = to_markdown(build_table(make_experiment(), rows=["scene"], columns=["densify"]))
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert lines[0].startswith("| scene | PSNR (dB) ↑ adc | PSNR (dB) ↑ volumetric |")
    assert len({line.count("|") for line in lines}) == 1
    assert len(lines) == 2 + 2 + 1
    assert "**" in text


def test_csv_has_a_line_for_each_cell_in_full_precision(make_experiment):
    experiment = make_experiment()
    rows = list(
        csv.DictReader(io.StringIO(to_csv(build_table(experiment, metrics=["psnr", "gaussians"]))))
    )
    first = next(row for row in rows if row["scene"] == "courtyard" and row["quantity"] == "psnr")
    values = [
        t.metrics["psnr"] for t in experiment.trials if (t.scene, t.densify) == ("courtyard", "adc")
    ]
    assert float(first["mean"]) == pytest.approx(statistics.fmean(values), abs=1e-12)
    assert float(first["std"]) == pytest.approx(statistics.stdev(values), abs=1e-12)
    assert first["trials"].split()[0] == "exp/courtyard/sfm-adc/c0ffee00-seed0"
    assert len(rows) == (4 + 2) * 2


class Balance(HTMLParser):
    """Counts cells by row and checks that tags close in order."""

    def __init__(self):
        super().__init__()
        self.open = []
        self.rows = []

    def handle_starttag(self, tag, attrs):
        if tag not in ("meta", "br"):
            self.open.append(tag)
        if tag == "tr":
            self.rows.append(0)
        if tag in ("td", "th"):
            self.rows[-1] += int(dict(attrs).get("colspan") or 1)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


STRANGE = "=cmd|' /C calc'!A0<img src=x onerror=alert(1)> ![x](http://there)\n| y"


def test_a_strangers_text_is_text_in_every_format():
    column = Column(STRANGE, STRANGE, (STRANGE, STRANGE))
    rows = (Row((STRANGE,), (TableEntry(STRANGE),)), Row(("x",), (TableEntry("+0.3 ± 0.1"),)))
    table = Table(STRANGE, ("scene",), (column,), rows, (STRANGE,))
    lines = to_markdown(table).splitlines()
    assert len(lines) == 8  # title, table and note have one line each
    assert not any(tag in line for line in lines for tag in ("]\\(x", "](")), lines
    assert not any(re.search(r"(?<!\\)<[a-z/]", line) for line in lines)
    for row in csv.DictReader(to_csv(table).splitlines()):
        assert all(not text.startswith("=") for text in row.values())
    assert "+0.3 ± 0.1" in to_csv(table).split(",")
    for text in ("@SUM(1)", "-1+cmd|x", "+x", " =1"):
        assert csv_of(pd.DataFrame([[text, -1.5]])).splitlines()[1] == f"'{text},-1.5"
    latex = to_latex(Table("\\input{x}\n\n^^5cinput%", ("scene",), (column,), rows[1:]))
    assert "\\input" not in latex
    assert "\\textasciicircum{}\\textasciicircum{}5cinput\\%" in latex


def test_html_is_well_formed_and_escaped(make_experiment):
    experiment = make_experiment()
    parser = Balance()
    parser.feed(to_html_page(build_table(experiment, rows=["scene", "init"], columns=["densify"])))
    assert parser.open == []
    assert len(set(parser.rows)) == 1
    assert "&lt;b&gt;" in to_html_page(build_table(experiment, title="<b>"))
    page = to_html_page(build_table(experiment, rows=["scene", "init"], columns=["densify"]))
    heads = page[page.index("<thead>") : page.index("</thead>")]
    assert all(f">{name}</th>" in heads for name in ("adc", "volumetric"))


def test_latex_escapes_what_is_special():
    assert escape_latex("a_b & 5 % ± 1 → #1") == "a\\_b \\& 5 \\% $\\pm$ 1 ? \\#1"


def has_latex():
    """Whether pdflatex and booktabs are installed."""
    if shutil.which("pdflatex") is None or shutil.which("kpsewhich") is None:
        return False
    return (
        subprocess.run(["kpsewhich", "booktabs.sty"], capture_output=True, check=False).returncode
        == 0
    )


@pytest.mark.skipif(not has_latex(), reason="pdflatex with booktabs is not installed")
def test_latex_compiles(make_experiment, tmp_path):
    experiment = make_experiment()
    (experiment.trials[0].path / "results.json").write_text("{")
    experiment = load_experiment(tmp_path, "exp")
    tables = [
        build_table(experiment),
        build_table(experiment, rows=["scene"], columns=["init", "densify"]),
    ]
    body = "\n".join(to_latex(table) for table in tables)
    source = (
        "\\documentclass{article}\n\\usepackage{booktabs}\n\\begin{document}\n"
        + body
        + "\\end{document}\n"
    )
    (tmp_path / "table.tex").write_text(source)
    command = split("pdflatex -interaction=nonstopmode -halt-on-error table.tex")
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, check=False)
    assert done.returncode == 0, done.stdout.decode("latin-1")[-2000:]
    assert (tmp_path / "table.pdf").is_file()


def test_latex_has_as_many_cells_as_columns(make_experiment):
    source = to_latex(build_table(make_experiment(), rows=["scene"], columns=["densify"]))
    width = len(re.search(r"begin\{tabular\}\{(\w+)\}", source)[1])
    body = source.split("\\midrule")[1].split("\\bottomrule")[0]
    assert {
        len(re.split(r"(?<!\\)&", line)) for line in body.splitlines() if line.endswith("\\\\")
    } == {width}


@pytest.mark.parametrize(
    "counts, heading, cells",
    [
        ((512, 640), "Gaussians ↓", ["512", "640"]),
        ((999, 28_012), "Gaussians ↓", ["999", "28,012"]),
        ((1000, 28_012), "Gaussians (k) ↓", ["1.0", "28.0"]),
        ((4000, 3_410_000), "Gaussians (k) ↓", ["4.0", "3,410.0"]),
        ((100_000, 3_410_000), "Gaussians (M) ↓", ["0.10", "3.41"]),
    ],
)
def test_a_small_count_keeps_its_digits_on_every_surface(tmp_path, counts, heading, cells):
    write_runs(
        tmp_path,
        Plan(
            scenes=("garden",),
            seeds=(0,),
            gaussians=dict(zip(("adc", "volumetric"), counts, strict=True)),
        ),
    )
    experiment = load_experiment(tmp_path, "exp")
    table = build_table(experiment, metrics=["gaussians"])
    assert [heading, *cells] == [
        table.columns[0].heading,
        *(row.entries[0].text for row in table.rows),
    ]
    report = build_report(experiment)
    for page in (to_markdown(table), to_latex(table).replace("$\\downarrow$", "↓"), report):
        assert all(text in page for text in (heading, *cells))


def test_results_files_are_plain_json(make_experiment):
    trial = make_experiment().trials[0]
    assert read_json(trial.path / "results.json")["metrics"] == trial.metrics


@pytest.mark.parametrize(
    "gaussians, seconds, headings",
    [
        (999_999, 599.9, ["Gaussians (k)", "train (s)", "initial points (k)", "total (min)"]),
        (1_000_000, 600.0, ["Gaussians (M)", "train (min)", "initial points (k)", "total (min)"]),
        (900, 2.0, ["Gaussians", "train (s)", "initial points (k)", "total (s)"]),
    ],
)
def test_counts_from_a_thousand_and_times_from_ten_minutes_have_the_larger_unit(
    tmp_path, gaussians, seconds, headings
):
    write_runs(tmp_path, Plan(scenes=("garden",), seeds=(0,)))
    trials = load_experiment(tmp_path, "exp").trials
    object.__setattr__(trials[0].record, "num_gaussians", gaussians)
    trials[0].record.seconds.update(train=seconds, init=5.0, evaluate=2.0)
    found = [
        quantity(name, trials[:1])
        for name in ("num_gaussians", "train", "init_points", "total_time")
    ]
    assert [one.name.partition(" ↓")[0] for one in found] == headings
    values = [one.read(trials[0]) for one in found]
    scales = [
        {"(s)": 1, "(min)": 60, "(k)": 1e3, "(M)": 1e6}.get(name.split()[-1], 1)
        for name in headings
    ]
    own = [gaussians, seconds, 3000, seconds + 7]
    assert values == pytest.approx(
        [value / scale for value, scale in zip(own, scales, strict=True)]
    )
    decimals = [{"Gaussians": 0, "(M)": 2}.get(name.split()[-1], 1) for name in headings]
    assert [one.format(1.23456) for one in found] == [
        f"{1.23456:.{places}f}" for places in decimals
    ]
    asked = asked_quantity("gaussians")
    assert (asked.key, asked.name, asked.read(trials[0])) == ("gaussians", "Gaussians", gaussians)
    fixed = [
        quantity(name, trials[:1])
        for name in ("gaussians_millions", "train_minutes", "peak_memory_mb")
    ]
    assert [one.format(1.26) for one in fixed] == ["1.26", "1.3", "1"]
    assert [one.read(trials[0]) for one in fixed] == pytest.approx(
        [gaussians / 1e6, seconds / 60, 900]
    )


@pytest.mark.parametrize(
    "metrics, said",
    [
        (("psnr", "lpips_vgg_raw"), "was 0.52 for PSNR in one study"),
        (("ssim", "psnr"), "was 0.52 for PSNR, 0.37 for SSIM in one study"),
        (("flip",), ""),
    ],
)
def test_the_first_table_says_how_weakly_its_metrics_agree_with_people(
    make_experiment, metrics, said
):
    """Values of arXiv 2511.06830, table 3, SROCC of the main set."""
    table = build_table(make_experiment(), metrics=metrics)
    first, second = with_agreement([table, table])
    notes = [note for note in first.notes if "agree with people" in note]
    assert len(notes) == bool(said)
    assert said in "".join(notes)
    assert second == table
