"""The fairness sheet has everything that records and files say about two arms."""

import re
import shutil

import pytest

from gsbench.analysis.cells import with_variants
from gsbench.analysis.fairness import UNLIKE, _shown, fairness_table
from gsbench.analysis.notes import Note
from gsbench.analysis.table_formats import to_latex
from gsbench.runs.experiments import Arm
from tests.analysis.helpers import page_of, rows_of, trials_of
from tests.analysis.test_attribution import densifier
from tests.helpers import change_json, write, write_lines
from tests.trials import search_record, write_arms

LEFT, RIGHT = Arm("sfm", "adc"), Arm("sfm", "longaxis")


def sheet(runs, second="longaxis", first="adc"):
    return fairness_table(with_variants(trials_of(runs)), Arm("sfm", first), Arm("sfm", second))


def change(paths, arm, **values):
    for path in paths:
        if path.parent.name == f"sfm-{arm}":
            change_json(path / "results.json", **values)


@pytest.fixture
def paths(tmp_path):
    return write_arms(tmp_path, {name: densifier(name) for name in ("adc", "longaxis")})


def test_the_sheet_has_settings_schedules_and_measurements_side_by_side(tmp_path, paths):
    counts = {"train_views": 40, "num_init_points": 9000, "num_gaussians": 31_000}
    hashes = {"data": "data-courtyard", "cloud": "abcdef" * 3}
    made = {"versions": {"gsbench": "0.2.0"}, "seconds": {"train": 80.0}, "hashes": hashes}
    change(paths, "longaxis", **counts, **made)
    for path in paths:
        if path.parent.name == "sfm-longaxis":
            write_lines(path / "events.jsonl", [{"step": 100 * k} for k in range(1, 24)])
    rows = rows_of(sheet(tmp_path))
    assert rows["views for training"] == ["42", "40", UNLIKE]
    assert rows["initial points"] == ["3,000", "9,000", UNLIKE]
    assert rows["initial cloud (hash)"][1:] == ["abcdefabcdef", UNLIKE]
    assert rows["Gaussians in the end"] == ["20,000 to 20,020, mean 20,010", "31,000", UNLIKE]
    assert rows["rounds of the densifier"] == ["15", "23", UNLIKE]
    assert rows["seconds of training"][1] == "80"
    assert rows["code"] == ["gsbench 0.1.0", "gsbench 0.2.0", UNLIKE]
    assert rows["budget"] == ["50,000 Gaussians (soft)", "50,000 Gaussians (soft)", ""]
    assert rows["densify.gradient_threshold"] == ["0.0002", "0.0008", UNLIKE]
    assert rows["densify.split_distance"] == ["–", "0.45", UNLIKE]
    assert "densify.split_size" not in rows  # alike


def test_only_trials_that_are_compared_count(tmp_path, paths):
    """Seed 2 of the baseline has no partner, so its count is not part of the comparison."""
    shutil.rmtree(paths[-1])
    table = sheet(tmp_path)
    assert rows_of(table)["Gaussians in the end"][0] == "20,000 to 20,010, mean 20,005"
    assert "Compared: 2 pairs of trials of one scene and seed." in table.notes


def test_arms_without_a_common_seed_have_a_sheet_of_all_their_trials(tmp_path):
    write_arms(tmp_path, {"adc": densifier("adc")}, seeds=(0, 1))
    write_arms(tmp_path, {"longaxis": densifier("longaxis")}, seeds=(2,))
    table = sheet(tmp_path)
    assert rows_of(table)["trials"] == ["2", "1", UNLIKE]
    assert "Compared: 0 pairs of trials of one scene and seed." in table.notes


def test_long_values_are_cut():
    shown = [_shown(value) for value in ("x" * 60, "x" * 61, 3, None)]
    assert shown == ["x" * 60, "x" * 59 + "…", "3", "null"]


def test_the_notes_name_the_ingredients_and_the_tuning(tmp_path, paths):
    notes = sheet(tmp_path).notes
    assert notes[0] == "sfm-longaxis differs from sfm-adc by split, gradient and threshold."
    assert f"Tuning. {Note.of('no tuning')}" in notes


def test_a_users_own_arm_has_its_class_and_version(tmp_path):
    own = {"_target_": "largest.SplitLargest", "start": 50, "share": 0.1}
    found = write_arms(tmp_path, {"adc": densifier("adc"), "largest": own})
    sources = {"largest.SplitLargest": "3fa9c1d2aaaaaaaaaaaa"}
    change(found, "largest", code={"sources": sources, "stages": {}})
    table = sheet(tmp_path, "largest")
    assert rows_of(table)["densify.share"] == ["–", "0.1", UNLIKE]
    assert "largest.SplitLargest 3fa9c1d2" in rows_of(table)["code"][1]
    said = "sfm-largest differs from sfm-adc by rule largest.SplitLargest and schedule."
    assert table.notes[0] == said


def test_trials_without_any_record_still_have_a_sheet(tmp_path, paths):
    for path in paths:
        for name in ("config.yaml", "events.jsonl"):
            (path / name).unlink()
    change(paths, "longaxis", seconds={}, hashes={"data": "data-courtyard"}, versions={})
    table = sheet(tmp_path)
    assert rows_of(table)["rounds of the densifier"] == ["not recorded", "not recorded", ""]
    assert rows_of(table)["seconds of training"][1] == "not recorded"
    assert rows_of(table)["code"] == ["gsbench 0.1.0", "not recorded", UNLIKE]
    assert "settings that are not recorded" in table.notes[0]


# --- tuning


def test_a_search_that_proposed_the_settings_is_named(tmp_path):
    write_arms(
        tmp_path,
        {"adc": densifier("adc"), "volumetric": densifier("volumetric", volume_threshold=0.06841)},
    )
    points = [
        {"value": value, "settings": {"densify.volume_threshold": threshold}}
        for value, threshold in ((27.6, 0.1), (27.5, 0.06841))
    ]
    record = search_record(points)
    write(tmp_path / "vth/tuning.json", record)
    for name, content in (("other", '{"points": [3, {"settings": []}]}'), ("broken", "{")):
        write(tmp_path / f"{name}/tuning.json", content)

    def tuning():
        return [note for note in sheet(tmp_path, "volumetric").notes if note.startswith("Tuning.")]

    (line,) = tuning()
    assert "the best of 2 points by psnr of validation views (courtyard; seed 100; the" in line
    assert "is densify.volume_threshold=0.1. " in line
    assert line.endswith("Tried: 0.1 (27.6), 0.06841 (27.5). These trials have other values.")
    write(tmp_path / "vth/tuning.json", record | {"points": points[1:]})
    unequal, line = tuning()
    assert unequal == (
        "Tuning. They were not tuned alike: sfm-adc none and sfm-volumetric 1 point of 1 seed on "
        "validation views."
    )
    assert "These trials have other values" not in line
    nothing = [point | {"value": None} for point in points]
    write(tmp_path / "vth/tuning.json", record | {"points": nothing})
    assert tuning() == ["Tuning. sfm-volumetric: the search vth found nothing."]


# --- where it is shown


def test_the_report_shows_the_sheet_beside_the_numbers_of_the_verdict(tmp_path, paths):
    page = page_of(tmp_path)
    order = '<h2 id="h-verdict"', "seeds to resolve", "Fairness sheet: sfm-longaxis", "By scene"
    places = [page.index(part) for part in order]
    assert places == sorted(places)
    assert page.count("<caption>Fairness sheet") == 1


def test_the_latex_has_columns_that_wrap(tmp_path, paths):
    text = to_latex(sheet(tmp_path))
    assert text.startswith("% needs \\usepackage{booktabs,array}\n")
    (spec,) = re.findall(r"\\begin\{tabular\}\{(.*)\}", text)
    assert spec.count("p{0.23\\linewidth}") == 3
    body = text.split("\\midrule")[1].split("\\bottomrule")[0]
    assert all(line.count(" & ") == 3 for line in body.strip().splitlines())
    assert text.count("{") - text.count("\\{") == text.count("}") - text.count("\\}")
