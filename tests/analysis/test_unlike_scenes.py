"""An arm that has other settings or conditions on other scenes: no mean hides that."""

from dataclasses import replace

import numpy as np
import pytest

from gsbench.analysis.differences import between_scenes_notes, ingredients_between
from gsbench.analysis.fairness import caveats, fairness_table
from gsbench.analysis.judgement import judge
from gsbench.analysis.notes import texts
from gsbench.analysis.report.build import build_report
from gsbench.analysis.results import load_experiment
from gsbench.analysis.tables import build_table
from gsbench.errors import InputError
from gsbench.runs.experiments import Arm, Declaration, Question
from tests.analysis.synthetic import Plan, trial_data, write_trial

STAGES = {"scene": 1, "init": 1, "train": 1, "evaluate": 1}
NO_MEAN = "No mean over the scenes is shown, since they differ in conditions or code."


def write(runs, scene, config_hash="c0ffee00", densify="adc", settings=None, **results):
    """Two trials of a scene; ``settings`` are settings, ``results`` keys of results.json."""
    for seed in (0, 1):
        views = {"psnr": 20.0 + (densify == "mcmc") + np.zeros(2) + seed}
        data = trial_data(Plan(), scene, "sfm", densify, seed, views) | results
        write_trial(runs, data, views, config_hash, **(settings or {}))


def table(runs, **how):
    """The table of the experiment, and whether it has a mean over scenes."""
    made = build_table(load_experiment(runs, "exp"), metrics=["psnr"], **how)
    return made, any(row.labels[0].startswith("mean of") for row in made.rows)


def lines(made):
    return [note for note in made.notes if "more than the scene" in note or "No mean" in note]


def test_settings_of_an_arm_that_differ_between_scenes_are_stated(tmp_path):
    write(tmp_path, "park", "a" * 8, settings={"densify__start": 500, "init__count": 5})
    write(tmp_path, "room", "b" * 8, settings={"densify__start": 900, "init__count": 5})
    write(tmp_path, "yard", "a" * 8, settings={"densify__start": 500, "init__count": 5})
    made, has_mean = table(tmp_path)
    assert has_mean
    assert lines(made) == [
        "Scenes of sfm-adc differ in more than the scene: densify.start (500 on park, yard, 900 on "
        "room)."
    ]


def test_arms_with_the_same_differences_share_a_line(tmp_path):
    for densify in ("adc", "mcmc"):
        for scene, most in (("park", 1000), ("room", 2000)):
            settings = {"densify__max_gaussians": most}
            budget = {"max_gaussians": most, "cap": "hard"}
            write(tmp_path, scene, f"{most:08d}", densify, settings, budget=budget)
    made, has_mean = table(tmp_path)
    assert has_mean  # each scene has its own budget, as in many papers
    assert lines(made) == [
        "Scenes of sfm-adc and sfm-mcmc differ in more than the scene: densify.max_gaussians (1000 "
        "on park, 2000 on room)."
    ]
    table(tmp_path, rows=("densify",))  # is not refused


def test_what_is_swept_on_a_scene_or_belongs_to_the_scene_is_not_stated(tmp_path):
    for scene, starts in (("park", (500, 900)), ("room", (900,))):
        for start in starts:
            own = {"densify__start": start, "scene__path": scene, "scene__views": len(scene) + 1}
            write(tmp_path, scene, f"{start:08d}", settings=own)
    assert lines(table(tmp_path)[0]) == []


@pytest.mark.parametrize(
    "key, values",
    [
        ("protocol", ("paper-1", "standard-1")),
        ("iterations", (2000, 7000)),
        ("raster", ("cpu", "gsplat")),
        ("split", ("every 8th", "sector 90 deg")),
    ],
)
def test_no_mean_is_shown_over_scenes_under_different_conditions(tmp_path, key, values):
    for scene, value in zip(("park", "room"), values, strict=True):
        write(tmp_path, scene, **{key: value})
    made, has_mean = table(tmp_path)
    assert not has_mean
    first, second = lines(made)
    assert first == NO_MEAN
    assert second == (
        f"Scenes of sfm-adc differ in more than the scene: {key} ({values[0]} on park, {values[1]} "
        "on room)."
    )
    with pytest.raises(InputError, match=key):
        table(tmp_path, rows=("densify",))


def test_variants_made_by_other_code_keep_their_means(tmp_path):
    """Each of them has one version of the code on all scenes."""
    for start, version in ((500, 1), (900, 2)):
        for scene in ("park", "room"):
            code = {"sources": {}, "stages": STAGES | {"train": version}}
            write(tmp_path, scene, f"{start:08d}", settings={"densify__start": start}, code=code)
    made, has_mean = table(tmp_path)
    assert has_mean
    assert lines(made) == []


def test_versions_that_a_gate_compares_are_no_difference_between_scenes(tmp_path):
    for version in (1, 2):
        code = {"sources": {}, "stages": STAGES | {"train": version}}
        for scene in ("park", "room"):
            write(tmp_path / str(version), scene, code=code)
    old, new = (load_experiment(tmp_path / str(version), "exp").trials for version in (1, 2))
    assert between_scenes_notes(old, new) == []
    assert texts(between_scenes_notes([*old[:2], *new[2:]])) == [
        "Scenes of sfm-adc differ in more than the scene: the version of stage train."
    ]


def test_no_mean_is_shown_over_versions_of_the_code(tmp_path):
    for scene, version in (("park", 1), ("room", 2)):
        write(tmp_path, scene, code={"sources": {}, "stages": STAGES | {"train": version}})
    made, has_mean = table(tmp_path)
    assert not has_mean
    assert lines(made) == [
        NO_MEAN,
        "Scenes of sfm-adc differ in more than the scene: the version of stage train.",
    ]


def test_resolution_and_data_are_those_of_a_scene(tmp_path):
    write(tmp_path, "park", resolution=[400, 300])
    write(tmp_path, "room", resolution=[300, 200])
    made, has_mean = table(tmp_path)
    assert has_mean
    assert lines(made) == []


def test_a_verdict_on_named_trials_says_how_the_scenes_differ(tmp_path):
    for densify in ("adc", "mcmc"):
        write(tmp_path, "park", "a" * 8, densify, iterations=2000)
        write(tmp_path, "room", "a" * 8, densify, iterations=7000)
    scenes = {
        scene: tuple(f"{scene}/sfm-{arm}/{'a' * 8}" for arm in ("adc", "mcmc"))
        for scene in ("park", "room")
    }
    asked = Question(
        metric="psnr", sign=1, baseline=Arm("", "a"), arm=Arm("", "b"), scenes=scenes, seeds=(0, 1)
    )
    trials = load_experiment(tmp_path, "exp").trials
    declaration = Declaration(time="2020-01-01T00:00:00Z", questions=(asked,))
    (verdict,) = judge(trials, declaration)
    assert tuple(texts(verdict.notes)) == (
        "Scenes of sfm-adc and sfm-mcmc differ in more than the scene: iterations (2000 on park, "
        "7000 on room).",
    )
    (alone,) = judge(
        trials, replace(declaration, questions=(replace(asked, scenes={"park": scenes["park"]}),))
    )
    assert alone.notes == ()


@pytest.fixture
def tuned_on_room(tmp_path):
    """Arms that differ in one setting on one scene, and in a second one on another scene."""
    for densify, start in (("adc", 500), ("mcmc", 900)):
        own = {"densify___target_": "mine.Own", "densify__grow": 1 + (densify == "mcmc")}
        write(tmp_path, "park", "a" * 8, densify, own | {"densify__split_size": 500})
        write(tmp_path, "room", "b" * 8, densify, own | {"densify__split_size": start})
    return load_experiment(tmp_path, "exp").trials


FIRST, SECOND = Arm("sfm", "adc"), Arm("sfm", "mcmc")


def test_arms_differ_by_one_setting_alone_only_if_they_do_on_every_scene(tuned_on_room):
    assert ingredients_between(tuned_on_room, FIRST, SECOND) == ("grow", "split_size")
    park = [trial for trial in tuned_on_room if trial.scene == "park"]
    assert ingredients_between(park, FIRST, SECOND) == ("grow",)
    said = "sfm-mcmc differs from sfm-adc by grow and split_size."
    assert said in texts(caveats(tuned_on_room, FIRST, SECOND))


def test_a_fairness_sheet_has_the_values_of_all_scenes(tuned_on_room):
    sheet = fairness_table(tuned_on_room, FIRST, SECOND)
    rows = {row.labels[0]: [entry.text for entry in row.entries] for row in sheet.rows}
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
    page = build_report(load_experiment(tmp_path, "exp"))
    verdict = page.partition('<div class="verdict">')[2].partition("</div>")[0]
    assert (
        "Scenes of sfm-mcmc differ in more than the scene: densify.split_size (500 on " in verdict
    )
