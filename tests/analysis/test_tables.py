"""Tables: the numbers in the cells, what is refused, what is marked, and the formats."""

import csv
import io
import re
import shutil
import statistics
from dataclasses import replace
from shlex import split

import pandas as pd
import pytest

from gsbench.analysis.cells import select_trials, short_reason
from gsbench.analysis.quantities import (
    Change,
    asked_quantity,
    choose_quantities,
    quantity,
    relative_change,
)
from gsbench.analysis.table_formats import (
    FORMATS,
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
from gsbench.analysis.tables import build_table
from gsbench.words import printable
from tests.analysis.helpers import loaded, page_of, rows_of, table_of, trials_of
from tests.analysis.tables import TABLES
from tests.helpers import refusal
from tests.markup import Page
from tests.processes import completed
from tests.trials import BUDGET, ask_about, write_runs, write_trial

SIDE_BY_SIDE = {"rows": ["scene"], "columns": ["densify"]}


def texts(table):
    return [
        [*row.labels, *(f"*{e.text}*" if e.bold else e.text for e in row.entries)]
        for row in table.rows
    ]


def bold_of(table):
    """The labels of rows whose first entry is bold."""
    return {row.labels[:3] for row in table.rows if row.entries[0].bold}


def test_bold_is_the_best_mean_that_was_shown_to_be_better(tmp_path):
    """A verdict is about the mean of its scenes, so no cell of a single scene is bold."""
    write_runs(tmp_path, effect={"psnr": 1.0}, densifiers=("adc", "volumetric", "mcmc"))
    assert bold_of(table_of(tmp_path, "psnr")) == set()  # nobody asked beforehand
    ask_about(tmp_path)
    table = table_of(tmp_path, "psnr", "gaussians")
    assert bold_of(table) == {("mean of 2 scenes", "sfm", "volumetric")}
    assert not any(row.entries[1].bold for row in table.rows)
    assert table.notes[0].endswith("Bold: the best mean, and shown to be better.")
    assert [line.partition(":")[0] for line in table.verdicts[:2]] == ["UNDECIDED", "BETTER"]
    assert table.verdicts[-1].startswith("2 questions, 2 statements; if none had an effect")


@pytest.mark.parametrize("effect, bold", [(0.001, set()), (-1.0, {("garden", "sfm", "adc")})])
def test_a_baseline_is_bold_where_the_arm_was_shown_to_be_worse(tmp_path, effect, bold):
    """The largest mean is not bold without a verdict for it."""
    write_runs(tmp_path, effect={"psnr": effect}, scenes=("garden",))
    ask_about(tmp_path)
    assert bold_of(table_of(tmp_path, "psnr")) == bold


def test_at_most_five_notes_stand_below_a_table(make_experiment):
    table = build_table(make_experiment())
    many = replace(table, notes=tuple(f"note {k}" for k in range(9)))
    lines = to_markdown(many).splitlines()
    shown = [line for line in lines if line.startswith("- ") and ": sfm" not in line]
    assert shown == [
        "- note 0",
        "- note 1",
        "- note 2",
        "- note 3",
        "- 5 more notes: in the report.",
    ]
    few = replace(table, notes=tuple(f"note {k}" for k in range(5)))
    assert to_markdown(few).splitlines()[-1] == "- note 4"
    # a page folds the others
    assert "<summary>5 more notes</summary>" in to_html_page(many)
    assert "more note" not in to_html_page(few)


def test_no_mean_is_shown_if_no_scene_has_every_arm(tmp_path):
    paths = write_runs(tmp_path)
    for path in [*paths[0:3], *paths[9:]]:  # courtyard has volumetric alone, garden adc
        shutil.rmtree(path)
    table = table_of(tmp_path, "psnr", **SIDE_BY_SIDE)
    assert [*rows_of(table)] == ["courtyard", "garden"]


def test_missing_and_incomplete_cells_are_marked_with_their_count(tmp_path):
    paths = write_runs(tmp_path)
    (paths[0] / "results.json").unlink()  # courtyard, adc, seed 0
    for path in paths[9:]:  # garden, volumetric
        shutil.rmtree(path)
    table = table_of(tmp_path, "psnr", **SIDE_BY_SIDE)
    rows = rows_of(table)
    assert rows["courtyard"][0].endswith("(2/3)")
    assert rows["garden"][1] == "— (0/3)"
    assert "(2/3)" not in rows["garden"][0]
    assert "mean of 1 scene" in rows  # only courtyard has both arms
    words = "Left out (1): exp/courtyard/sfm-adc/c0ffee00-seed0: unfinished"
    assert any(words in note for note in table.notes)


def test_an_unavailable_metric_is_na_with_its_reason(make_experiment):
    table = build_table(make_experiment(), metrics=["lpips_alex"])
    assert {row.entries[0].text for row in table.rows} == {"n/a"}
    assert "LPIPS Alex: n/a, weights file alexnet.pth not found." in table.notes


@pytest.mark.parametrize("there", [True, False])
def test_the_only_lpips_that_was_asked_for_has_a_column(there, tmp_path):
    measured = {"lpips_squeeze": 0.1} if there else {}
    write_trial(tmp_path, settings={"eval.lpips": ["squeeze"]}, psnr=27.0, **measured)
    keys = [quantity.key for quantity in choose_quantities(trials_of(tmp_path))]
    assert [key for key in keys if key.startswith("lpips")] == ["lpips_squeeze"]


def test_the_lpips_of_the_protocol_has_a_column_even_when_it_is_missing(tmp_path):
    write_trial(tmp_path, psnr=27.0)
    table = table_of(tmp_path)
    assert table.columns[1].heading == "LPIPS VGG raw ↓"
    assert table.rows[0].entries[1].text == "n/a"


@pytest.mark.parametrize(
    "key, values",
    TABLES["conditions"],
)
def test_a_cell_never_mixes_conditions(tmp_path, key, values):
    for seed, value in enumerate(values):
        write_trial(tmp_path, seed, psnr=27.0, **{f"_{key}": value})
    named = "data" if key == "hashes" else key
    with refusal(f"differ in {named}: "):
        table_of(tmp_path)


def test_a_cell_never_mixes_settings(tmp_path):
    write_trial(tmp_path, 0, "aaaaaaaa", psnr=27.0)
    write_trial(tmp_path, 1, "bbbbbbbb", {"densify.volume_threshold": 0.1}, psnr=28.0)
    with refusal(r"differ in densify\.volume_threshold: 0\.03 \| 0\.1"):
        table_of(tmp_path, rows=["scene", "densify"])
    # by default it becomes a row
    assert table_of(tmp_path).row_headings[-1] == "densify.volume_threshold"
    table = table_of(tmp_path, "psnr", rows=["scene", "densify.volume_threshold"])
    assert [row.labels for row in table.rows] == [("garden", "0.03"), ("garden", "0.1")]


@pytest.mark.parametrize(
    "settings",
    [{"tracking.name": "off", "scene.path": "/elsewhere"}, {"eval.extra": None}],
    ids=["where it ran", "null, as if missing"],
)
def test_some_settings_do_not_matter(tmp_path, settings):
    write_trial(tmp_path, 0, "aaaaaaaa", psnr=27.0)
    write_trial(tmp_path, 1, "bbbbbbbb", settings, psnr=28.0)
    assert rows_of(table_of(tmp_path, "psnr"))["garden"] == ["27.50 ± 0.71"]


def test_one_seed_twice_is_refused(tmp_path):
    write_trial(tmp_path, 0, "aaaaaaaa", psnr=27.0)
    write_trial(tmp_path, 0, "bbbbbbbb", psnr=27.0)
    with refusal("seed 0 twice"):
        table_of(tmp_path)


def test_arms_under_different_conditions_are_shown_but_not_compared(tmp_path):
    write_trial(tmp_path, psnr=27.0)
    write_trial(tmp_path, psnr=28.0, densify="volumetric", _iterations=7000)
    table = table_of(tmp_path, "psnr")
    assert [row[3] for row in texts(table)] == ["27.00", "28.00"]
    assert "the arms differ in iterations, so they are not compared" in table.verdicts[0]


UNLIMITED = {"max_gaussians": None, "cap": None}


@pytest.mark.parametrize(
    "second_budget, blocked, compared",
    [
        (UNLIMITED, (0, 0), True),  # neither cap acted, so none limited the growth
        (UNLIMITED, (3, 0), False),
        ({"max_gaussians": 1000, "cap": "hard"}, (0, 3), False),
        (BUDGET, (3, 0), True),  # one budget for both
        (UNLIMITED | {"seconds": 60}, (0, 0), False),  # a time limit may have stopped its growth
        (UNLIMITED, (None, 0), False),  # unknown whether the cap blocked any
        # a governor steers growth even if it refuses nothing
        ({"max_gaussians": 1000, "cap": "governor"}, (0, 0), False),
    ],
)
def test_arms_are_compared_under_one_budget_or_under_none_that_acted(
    tmp_path, second_budget, blocked, compared
):
    first, second = ({} if count is None else {"blocked_by_cap": count} for count in blocked)
    write_trial(tmp_path, psnr=27.0, _events=first)
    write_trial(tmp_path, psnr=28.0, densify="none", _budget=second_budget, _events=second)
    table = table_of(tmp_path, "psnr")
    assert [row[3] for row in texts(table)] == ["27.00", "28.00"]
    assert ("the arms differ in budget" in table.verdicts[0]) is not compared


def test_the_mean_of_scenes_gives_each_the_same_weight(tmp_path):
    for scene, psnrs in (("a", (20.0, 22.0)), ("b", (30.0, 31.0))):
        for seed, psnr in enumerate(psnrs):
            write_trial(tmp_path, seed, psnr=psnr, scene=scene)
    mean, std = (21.0 + 30.5) / 2, statistics.stdev([25.0, 26.5])  # by seed: (20+30)/2, (22+31)/2
    for how in ({}, {"rows": ["densify"]}):
        row = table_of(tmp_path, "psnr", **how).rows[-1]
        assert row.entries[0].text == f"{mean:.2f} ± {std:.2f}"


def test_changes_of_costs_are_given_of_totals_and_as_the_mean_of_ratios(tmp_path):
    arms = {"adc": (1_000_000, 3_000_000), "volumetric": (2_000_000, 3_000_000)}
    for densify, counts in arms.items():
        for scene, count in zip("ab", counts, strict=True):
            write_trial(tmp_path, psnr=20.0, scene=scene, densify=densify, _num_gaussians=count)
    first, second = (
        [trial for trial in trials_of(tmp_path) if trial.densify == name] for name in arms
    )
    change = relative_change(first, second, lambda trial: trial.record.num_gaussians)
    assert change == Change(5 / 4 - 1, 0.5, 2)  # totals 4M -> 5M; ratios 2 and 1
    assert str(change) == "+25.0% as a ratio of totals, +50.0% as the mean of 2 scenes"
    assert relative_change(first, [], lambda trial: trial.record.num_gaussians) is None


def test_metrics_of_earlier_iterations_have_columns_of_their_own(tmp_path):
    for seed, (early, late) in enumerate(((20.0, 27.0), (22.0, 28.0))):
        write_trial(tmp_path, seed, psnr=late, _metrics_at={"7000": {"metrics": {"psnr": early}}})
    table = table_of(tmp_path, "psnr@7000", "psnr")
    assert [column.heading for column in table.columns] == ["PSNR at 7,000 ↑", "PSNR (dB) ↑"]
    assert texts(table)[0][3:] == ["21.00 ± 1.41", "27.50 ± 0.71"]
    with refusal(r"measured at iteration '9000'; measured were \(eval\.at\) 7000"):
        table_of(tmp_path, "psnr@9000")
    with refusal("unknown metric 'pnsr'"):
        table_of(tmp_path, "pnsr")


def test_the_notes_say_how_to_read_the_table_and_what_is_left_out(tmp_path):
    paths = write_runs(tmp_path)
    (paths[-1] / "results.json").write_text("{")
    notes = table_of(tmp_path, "psnr", "lpips_alex").notes
    assert notes[0] == (
        "Mean over 3 trials; ± is the deviation (n − 1) over trials. Protocol paper-1."
    )
    assert notes[1].startswith("Left out (1): exp/garden/sfm-volumetric/c0ffee00-seed2: damaged")
    assert "(k/3): k of 3 trials with a value; —: none." in notes
    assert any(note.endswith("n/a, weights file alexnet.pth not found.") for note in notes)
    assert (
        table_of(tmp_path, "psnr", rows=["densify"])
        .notes[0]
        .startswith(
            "Mean over 3 trials; ± is the deviation (n − 1) over the trials' means of scenes."
        )
    )


def test_rows_are_in_the_order_of_numbers_then_of_text(tmp_path):
    for cap in (9, 10, 100, None):
        write_trial(tmp_path, 0, f"{cap or 0:08x}", {"densify.cap": cap}, psnr=20.0)
    assert [*rows_of(table_of(tmp_path, "psnr", rows=["densify.cap"]))] == ["9", "10", "100", "–"]


def test_markdown_has_a_line_for_each_row_and_equal_numbers_of_cells(make_experiment):
    text = to_markdown(build_table(make_experiment(), **SIDE_BY_SIDE))
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert lines[0].startswith("| scene | PSNR (dB) ↑ adc | PSNR (dB) ↑ volumetric |")
    assert len({line.count("|") for line in lines}) == 1
    assert len(lines) == 2 + 2 + 1


def test_csv_has_a_line_for_each_cell_in_full_precision(make_experiment):
    experiment = make_experiment()
    text = to_csv(build_table(experiment, metrics=["psnr", "gaussians"]))
    rows = list(csv.DictReader(io.StringIO(text)))
    first = next(row for row in rows if row["scene"] == "courtyard" and row["quantity"] == "psnr")
    values = [
        t.metrics["psnr"] for t in experiment.trials if (t.scene, t.densify) == ("courtyard", "adc")
    ]
    assert float(first["mean"]) == pytest.approx(statistics.fmean(values), abs=1e-12)
    assert float(first["std"]) == pytest.approx(statistics.stdev(values), abs=1e-12)
    assert first["trials"].split()[0] == "exp/courtyard/sfm-adc/c0ffee00-seed0"
    assert len(rows) == (4 + 2) * 2


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


@pytest.mark.parametrize("name", FORMATS)
def test_no_character_of_a_text_acts_on_a_terminal_or_turns_a_line_around(name):
    strange = "a\x1b[31m\u202eb"
    entries = (TableEntry(strange),)
    table = Table(
        strange, (strange,), (Column(strange, strange, (strange, "")),), (Row((strange,), entries),)
    )
    text = FORMATS[name][1](replace(table, notes=(strange,)))
    assert text == printable(text)
    assert "u202eb" in text


def test_html_is_well_formed_and_escaped(make_experiment):
    layout = {"rows": ["scene", "init"], "columns": ["densify"], "title": "<b>"}
    page = to_html_page(build_table(make_experiment(), **layout))
    parsed = Page(page)
    assert parsed.open == []
    rows = []
    for tag, attributes in parsed.elements:
        if tag == "tr":
            rows.append(0)
        if tag in ("td", "th"):
            rows[-1] += int(attributes.get("colspan", 1))
    assert len(set(rows)) == 1
    assert "&lt;b&gt;" in page
    heads = page[page.index("<thead>") : page.index("</thead>")]
    assert all(f">{name}</th>" in heads for name in ("adc", "volumetric"))


def test_latex_escapes_what_is_special():
    assert escape_latex("a_b & 5 % ± 1 → #1") == "a\\_b \\& 5 \\% $\\pm$ 1 $\\to$ \\#1"


def test_latex_keeps_names_of_any_script_and_says_what_they_need(make_experiment):
    table = build_table(make_experiment())
    assert "xelatex" not in to_latex(table)
    source = to_latex(replace(table, title="李明 and é"))
    assert "李明 and é" in source
    assert source.splitlines()[1] == "% needs xelatex or lualatex, and a font with 明李"


def has_latex():
    """Whether pdflatex and booktabs are installed."""
    if shutil.which("pdflatex") is None or shutil.which("kpsewhich") is None:
        return False
    return completed(split("kpsewhich booktabs.sty"), code=None).returncode == 0


@pytest.mark.skipif(not has_latex(), reason="pdflatex with booktabs is not installed")
def test_latex_compiles(make_experiment, tmp_path):
    (make_experiment().trials[0].path / "results.json").write_text("{")
    layouts = {}, {"rows": ["scene"], "columns": ["init", "densify"]}
    body = "\n".join(to_latex(table_of(tmp_path, **layout)) for layout in layouts)
    head = "\\documentclass{article}\n\\usepackage{booktabs}\n\\begin{document}\n"
    (tmp_path / "table.tex").write_text(head + body + "\\end{document}\n")
    command = split("pdflatex -interaction=nonstopmode -halt-on-error table.tex")
    completed(command, cwd=tmp_path, encoding="latin-1")
    assert (tmp_path / "table.pdf").is_file()


@pytest.mark.parametrize(
    "counts, heading, cells",
    TABLES["small counts"],
)
def test_a_small_count_keeps_its_digits_on_every_surface(tmp_path, counts, heading, cells):
    for densify, count in zip(("adc", "volumetric"), counts, strict=True):
        write_trial(tmp_path, densify=densify, psnr=20.0, _num_gaussians=count)
    table = table_of(tmp_path, "gaussians")
    assert table.columns[0].heading == heading
    assert [row.entries[0].text for row in table.rows] == cells
    latex = to_latex(table).replace("$\\downarrow$", "↓")
    for page in (to_markdown(table), latex, page_of(tmp_path)):
        assert all(text in page for text in (heading, *cells))


@pytest.mark.parametrize(
    "gaussians, seconds, headings",
    TABLES["units"],
)
def test_counts_from_a_thousand_and_times_from_ten_minutes_have_the_larger_unit(
    tmp_path, gaussians, seconds, headings
):
    took = {"init": 5.0, "train": seconds, "evaluate": 2.0}
    write_trial(tmp_path, psnr=20.0, _num_gaussians=gaussians, _seconds=took)
    (trial,) = trials_of(tmp_path)

    def read(names):
        found = [quantity(name, [trial]) for name in names.split()]
        return found, [one.read(trial) for one in found]

    found, values = read("num_gaussians train init_points total_time")
    assert [one.name.partition(" ↓")[0] for one in found] == headings
    scales = {"(min)": 60, "(k)": 1e3, "(M)": 1e6}
    own = [gaussians, seconds, 3000, seconds + 7]
    for one, name, value, unscaled in zip(found, headings, values, own, strict=True):
        unit = name.split()[-1]
        assert value == pytest.approx(unscaled / scales.get(unit, 1))
        decimals = {"Gaussians": 0, "(M)": 2}.get(unit, 1)
        assert one.format(1.23456) == f"{1.23456:.{decimals}f}"
    asked = asked_quantity("gaussians")
    assert (asked.key, asked.name, asked.read(trial)) == ("gaussians", "Gaussians", gaussians)
    fixed, values = read("gaussians_millions train_minutes peak_memory_mb")
    assert [one.format(1.26) for one in fixed] == ["1.26", "1.3", "1"]
    assert values == pytest.approx([gaussians / 1e6, seconds / 60, 900])


@pytest.mark.parametrize(
    "why, said", [("the download failed: no network", " (the download failed)"), ("b.pth", "")]
)
def test_the_note_on_missing_weights_says_if_a_download_failed(why, said):
    reason = f"weights not found: a.pth (looked in /home; {why}): get them from there"
    assert short_reason(reason) == (
        f"weights not found: a.pth{said}; gsbench doctor says where they come from"
    )


# ---- a user's own metric that is added later: for older trials its setting counts as unset

KEY = "eval.extra.mae._target_"
OWN = {"eval.extra": {"mae": {"_target_": "mine.Mae"}}}


@pytest.fixture
def added(tmp_path):
    for seed in (0, 1):
        for densify in ("adc", "volumetric"):
            write_trial(tmp_path, seed, "aaaaaaaa", densify=densify, psnr=27.0 + seed)
            write_trial(tmp_path, seed, "bbbbbbbb", OWN, densify=densify, psnr=27.0 + seed, mae=3.0)
    return tmp_path


def test_tables_show_trials_with_and_without_the_metric(added):
    experiment = loaded(added)
    table = build_table(experiment)
    assert table.row_headings == ("scene", "init", "densify", KEY)
    shown = {(row.labels[2], row.labels[3]) for row in table.rows if row.labels[0] == "garden"}
    assert shown == {(arm, value) for arm in ("adc", "volumetric") for value in ("–", "mine.Mae")}
    assert len(select_trials(experiment.trials, {KEY: "mine.Mae"})) == 4
    assert len(select_trials(experiment.trials, {KEY: "None"})) == 4


@pytest.mark.parametrize("name", ["eval.extra.mea._target_", "densify.volume_treshold", "nothing"])
def test_a_key_that_no_trial_has_is_refused(added, name):
    experiment = loaded(added)
    with refusal(f"no trial has a setting '{name}'"):
        build_table(experiment, rows=["scene", name])
    with refusal(f"no trial has a setting '{name}'"):
        select_trials(experiment.trials, {name: "None"})
