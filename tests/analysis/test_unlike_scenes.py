"""An arm that has other settings or conditions on other scenes: no mean hides that."""

import pytest

from gsbench.analysis.differences import between_scenes_notes, ingredients_between
from gsbench.analysis.fairness import caveats, fairness_table
from gsbench.analysis.notes import texts
from gsbench.runs.experiments import Arm
from tests.analysis.helpers import page_of, rows_of, table_of, trials_of
from tests.analysis.tables import TABLES
from tests.helpers import refusal
from tests.trials import write_trial

NO_MEAN = "No mean over the scenes is shown, since they differ in conditions or code."


def code(version):
    stages = {"scene": 1, "init": 1, "evaluate": 1, "train": version}
    return {"sources": {}, "stages": stages}


def write(runs, scene, config_hash="c0ffee00", densify="adc", settings=None, **results):
    """Two trials of a scene; ``results`` are keys of results.json with ``_`` before them."""
    for seed in (0, 1):
        psnr = 20.0 + (densify == "mcmc") + seed
        place = {"scene": scene, "densify": densify}
        write_trial(runs, seed, config_hash, settings, **place, psnr=psnr, **results)


def lines(runs, has_mean=True):
    """The notes on scenes; the table has a mean over them or not."""
    made = table_of(runs, "psnr")
    assert any(row.labels[0].startswith("mean of") for row in made.rows) == has_mean
    return [note for note in made.notes if "more than the scene" in note or "No mean" in note]


def test_settings_of_an_arm_that_differ_between_scenes_are_stated(tmp_path):
    for scene, start in (("park", 500), ("room", 900), ("yard", 500)):
        write(tmp_path, scene, f"{start:08}", settings={"densify.start": start, "init.count": 5})
    assert lines(tmp_path) == [
        "Scenes of sfm-adc differ in more than the scene: densify.start (500 on park, yard, 900 on "
        "room)."
    ]


def test_arms_with_the_same_differences_share_a_line(tmp_path):
    for densify in ("adc", "mcmc"):
        for scene, most in (("park", 1000), ("room", 2000)):
            settings = {"densify.max_gaussians": most}
            budget = {"max_gaussians": most, "cap": "hard"}
            write(tmp_path, scene, f"{most:08d}", densify, settings, _budget=budget)
    assert lines(tmp_path) == [  # and a mean: each scene has its own budget, as in many papers
        "Scenes of sfm-adc and sfm-mcmc differ in more than the scene: densify.max_gaussians (1000 "
        "on park, 2000 on room)."
    ]
    table_of(tmp_path, "psnr", rows=("densify",))  # is not refused


def test_what_is_swept_on_a_scene_or_belongs_to_the_scene_is_not_stated(tmp_path):
    for scene, starts in (("park", (500, 900)), ("room", (900,))):
        for start in starts:
            own = {"densify.start": start, "scene.path": scene, "scene.views": len(scene) + 1}
            write(tmp_path, scene, f"{start:08d}", settings=own)
    assert lines(tmp_path) == []


@pytest.mark.parametrize(
    "key, values",
    TABLES["unlike conditions"],
)
def test_no_mean_is_shown_over_scenes_under_different_conditions(tmp_path, key, values):
    for scene, value in zip(("park", "room"), values, strict=True):
        write(tmp_path, scene, **{f"_{key}": value})
    assert lines(tmp_path, has_mean=False) == [
        NO_MEAN,
        f"Scenes of sfm-adc differ in more than the scene: {key} ({values[0]} on park, {values[1]} "
        "on room).",
    ]
    with refusal(key):
        table_of(tmp_path, "psnr", rows=("densify",))


def test_a_condition_that_one_scene_lacks_is_no_difference(tmp_path):
    """Old trials have no split, renders of another program no rasterizer."""
    write(tmp_path, "park", _split="every 8th")
    write(tmp_path, "room")
    assert lines(tmp_path) == []


def test_variants_made_by_other_code_keep_their_means(tmp_path):
    """Each of them has one version of the code on all scenes."""
    for start, version in ((500, 1), (900, 2)):
        for scene in ("park", "room"):
            settings = {"densify.start": start}
            write(tmp_path, scene, f"{start:08d}", settings=settings, _code=code(version))
    assert lines(tmp_path) == []


def test_versions_that_a_gate_compares_are_no_difference_between_scenes(tmp_path):
    for version in (1, 2):
        for scene in ("park", "room"):
            write(tmp_path / str(version), scene, _code=code(version))
    old, new = (trials_of(tmp_path / str(version)) for version in (1, 2))
    assert between_scenes_notes(old, new) == []
    assert texts(between_scenes_notes([*old[:2], *new[2:]])) == [
        "Scenes of sfm-adc differ in more than the scene: the version of stage train."
    ]


def test_no_mean_is_shown_over_versions_of_the_code(tmp_path):
    for scene, version in (("park", 1), ("room", 2)):
        write(tmp_path, scene, _code=code(version))
    assert lines(tmp_path, has_mean=False) == [
        NO_MEAN,
        "Scenes of sfm-adc differ in more than the scene: the version of stage train.",
    ]


def test_resolution_and_data_are_those_of_a_scene(tmp_path):
    write(tmp_path, "park", _resolution=[400, 300])
    write(tmp_path, "room", _resolution=[300, 200])
    assert lines(tmp_path) == []


@pytest.fixture
def tuned_on_room(tmp_path):
    """Arms that differ in one setting on one scene, and in a second one on another scene."""
    for densify, start in (("adc", 500), ("mcmc", 900)):
        own = {"densify._target_": "mine.Own", "densify.grow": 1 + (densify == "mcmc")}
        write(tmp_path, "park", "a" * 8, densify, own | {"densify.split_size": 500})
        write(tmp_path, "room", "b" * 8, densify, own | {"densify.split_size": start})
    return trials_of(tmp_path)


FIRST, SECOND = Arm("sfm", "adc"), Arm("sfm", "mcmc")


def test_arms_differ_by_one_setting_alone_only_if_they_do_on_every_scene(tuned_on_room):
    assert ingredients_between(tuned_on_room, FIRST, SECOND) == ("grow", "split_size")
    park = [trial for trial in tuned_on_room if trial.scene == "park"]
    assert ingredients_between(park, FIRST, SECOND) == ("grow",)
    said = "sfm-mcmc differs from sfm-adc by grow and split_size."
    assert said in texts(caveats(tuned_on_room, FIRST, SECOND))


def test_a_fairness_sheet_has_the_values_of_all_scenes(tuned_on_room):
    sheet = fairness_table(tuned_on_room, FIRST, SECOND)
    rows = rows_of(sheet)
    assert rows["densify.grow"] == ["1", "2", "≠"]
    assert rows["densify.split_size"] == ["500", "500, 900", "≠"]
    assert sheet.notes[1] == (
        "Scenes of sfm-mcmc differ in more than the scene: densify.split_size (500 on park, 900 on "
        "room)."
    )


def test_arms_without_a_common_scene_are_described_by_one_trial_each(tuned_on_room):
    apart = [one for one in tuned_on_room if (one.scene == "room") == (one.densify == "mcmc")]
    assert ingredients_between(apart, FIRST, SECOND) == ("grow", "split_size")
    both = [*apart, *(one for one in tuned_on_room if one.densify == "mcmc")]
    assert ingredients_between(both, FIRST, SECOND) == ("grow",)  # on the park, which both have


def test_the_report_says_it_beside_the_verdict(tuned_on_room, tmp_path):
    verdict = page_of(tmp_path).partition('<details class="idea"')[2].partition("<table")[0]
    assert (
        "Scenes of sfm-mcmc differ in more than the scene: densify.split_size (500 on " in verdict
    )
