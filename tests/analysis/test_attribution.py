"""The differences between two arms are named wherever the arms are compared."""

from types import SimpleNamespace

import pytest
import yaml

from gsbench.analysis.cells import with_variants
from gsbench.analysis.differences import (
    DEPARTURES,
    ELSEWHERE,
    NO_RECORD,
    compared_trials,
    ingredients,
    ingredients_between,
    ingredients_note,
    is_mixed,
)
from gsbench.runs.code import config_hash
from gsbench.runs.experiments import Arm
from tests.analysis.helpers import loaded, page_of, table_of
from tests.analysis.tables import TABLES
from tests.conftest import ROOT, script
from tests.helpers import change_json
from tests.trials import write_arms

shipped_arms = script("fidelity").shipped_arms
SCHEDULE = {"train.densify_start": 500, "train.densify_stop": 15_000, "train.mcmc_stop": 25_000}
SCHEDULE |= {"train.densify_interval": 100, "train.opacity_reset_interval": 3000}
SCHEDULE |= {"train.iterations": 30_000}


def densifier(name, **changes):
    """The settings of a shipped densifier, with ``changes``."""
    own = {key: SCHEDULE.get(str(v).strip("${}"), v) for key, v in shipped_arms()[name].items()}
    return own | changes


def config(name, **changes):
    """The same settings as a trial records them."""
    return SCHEDULE | {f"densify.{key}": v for key, v in densifier(name, **changes).items()}


def write_two(runs, *names):
    return write_arms(runs, {name: densifier(name) for name in names})


def sentences(runs):
    """What the table says of the differences between arms."""
    return [note for note in table_of(runs).notes if "differs from" in note]


def trials_of(runs, arms, settings=None):
    write_arms(runs, arms, settings=settings)
    return with_variants(loaded(runs).trials)


def sentence(trials, first, second):
    pair = Arm("sfm", first), Arm("sfm", second)
    found = ingredients_between(trials, *pair)
    return str(ingredients_note(found, *pair)) if is_mixed(found) else ""


# --- ingredients


def test_a_sentence_names_six_ingredients_and_counts_the_rest():
    first, second = Arm("sfm", "adc"), Arm("sfm", "mine")
    said = "sfm-mine differs from sfm-adc by 0, 1, 2, 3, 4"
    assert str(ingredients_note("012345", first, second)) == f"{said} and 5."
    assert str(ingredients_note("01234567", first, second)) == f"{said}, 5 and 2 more."
    assert str(ingredients_note("0", first, second)) == "sfm-mine differs from sfm-adc by 0 alone."


def test_settings_of_the_first_configuration_come_first():
    one, other = (
        {"densify._target_": "t", "densify.a": 1},
        {"densify._target_": "t", "densify.b": 2},
    )
    assert ingredients(one, other) == ("a", "b")
    assert ingredients(other, one) == ("b", "a")


@pytest.mark.parametrize(
    "first, second, expected",
    TABLES["ingredients"],
)
def test_shipped_arms_differ_in_the_ingredients_of_their_classes_and_settings(
    first, second, expected
):
    assert [*ingredients(config(first), config(second))] == expected


def test_every_shipped_class_lists_how_it_departs_from_adc():
    assert {settings["_target_"] for settings in shipped_arms().values()} == set(DEPARTURES)


def test_settings_that_only_name_or_place_a_trial_are_no_ingredients():
    other = config("adc") | {"densify.name": "adc-2", "eval.primary": "psnr", "eval.lpips": []}
    other |= {"train.log_every": 1, "seed": 4, "threads": 2, "launch.name": "slurm"}
    assert ingredients(config("adc"), other) == ()


@pytest.mark.parametrize(
    "key", ["densify.name_noise", "init.weights_power", "scene.path_length", "raster.named"]
)
def test_a_users_setting_that_begins_like_an_ignored_one_is_an_ingredient(key):
    other = config("adc") | {key: 2}
    assert ingredients(other | {key: 1}, other) == (key.removeprefix("densify."),)


def test_changes_outside_the_densifier_are_ingredients():
    other = config("adc", stop=9000)
    other |= {"train.opacity": 0.05, "train.scale": 0.1, "scene.max_size": 160}
    found = ingredients(config("adc"), other)
    assert {*found} == {"schedule", "learning rates", "scene.max_size"}
    sfm = config("adc") | {"init._target_": "gsbench.init.Sfm", "init.max_num_features": 1}
    dim = config("adc") | {"init._target_": "gsbench.init.Dim", "init.extractor": "aliked"}
    found = ingredients(sfm | {"init.poses": "own"}, dim | {"init.poses": "shared"})
    assert {*found} == {"initial cloud", "cameras"}


def test_a_users_class_with_its_settings_is_one_ingredient():
    """Between two versions of one such class, each setting is an ingredient."""
    rule = "rule mine.Patient"
    own = config("adc", _target_="mine.Patient", patience=3)
    assert ingredients(config("adc"), own) == (rule,)
    assert ingredients(config("adc"), own | {"densify.interval": 50}) == (rule, "schedule")
    later = own | {"densify.patience": 4, "densify.options.depth": 1}
    assert ingredients(own, later) == ("patience", "options.depth")
    assert ingredients(config("longaxis"), own)[0] == rule


def test_a_comparison_of_several_ingredients_is_reported(tmp_path):
    write_two(tmp_path, "adc", "volumetric")
    assert sentences(tmp_path) == []  # one ingredient
    write_two(tmp_path, "longaxis")
    said = "sfm-longaxis differs from sfm-adc by split, gradient and threshold."
    assert sentences(tmp_path) == [said]
    assert said.rstrip(".") in page_of(tmp_path)


def test_trials_without_recorded_settings_are_reported(tmp_path):
    for path in write_two(tmp_path, "adc", "longaxis"):
        if "longaxis" in path.parent.name:
            (path / "config.yaml").unlink()
    assert sentence(list(loaded(tmp_path).trials), "adc", "longaxis").endswith(f"by {NO_RECORD}.")


def test_another_program_counts_as_many_ingredients(tmp_path):
    program = {"_target_": "gsbench.densify.External", "command": "train"}
    trials = trials_of(tmp_path, {"adc": densifier("adc"), "3dgs": program, "brush": program})
    assert sentence(trials, "adc", "3dgs") == (
        "sfm-3dgs differs from sfm-adc by everything that the program 3dgs does differently."
    )
    assert "the program brush does differently and everything that the program 3dgs" in sentence(
        trials, "3dgs", "brush"
    )


def test_a_training_elsewhere_has_unknown_ingredients(tmp_path):
    for path in write_arms(tmp_path, {"adc": densifier("adc"), "theirs": densifier("adc")}):
        if path.parent.name == "sfm-theirs":
            change_json(path / "results.json", evaluated_from="model")
    trials = list(loaded(tmp_path).trials)
    assert trials[-1].made_elsewhere
    assert sentence(trials, "adc", "theirs") == f"sfm-theirs differs from sfm-adc by {ELSEWHERE}."


# --- controls


def test_naming_a_control_does_not_change_the_configuration_hash():
    plain = {"eval": {"lpips": []}, "densify": {"name": "adc"}}
    named = plain | {"eval": {"lpips": [], "controls": {"longaxis": "absgrad"}}}
    assert config_hash(named) == config_hash(plain)


def test_experiments_list_the_control_of_every_mixed_arm():
    """Where an experiment holds an arm that isolates an ingredient of another, it says so."""
    checked = 0
    folders = (ROOT / "conf/experiment", ROOT / "findings/experiment")
    for file in sorted(file for folder in folders for file in folder.glob("*.yaml")):
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
        arms = str(
            content.get("hydra", {}).get("sweeper", {}).get("params", {}).get("densify", "")
        ).split(",")
        controls = content.get("eval", {}).get("controls", {})
        assert set(controls) | set(controls.values()) <= set(arms)
        for arm in (one for one in arms if one in shipped_arms() and "adc" in arms):
            mixed = ingredients(config("adc"), config(arm))
            alone = [
                one
                for one in arms
                if one != arm
                and len(found := ingredients(config(one), config(arm))) == 1
                and found[0] in mixed
            ]
            if len(mixed) > 1 and alone:
                checked += 1
                assert controls.get(arm) in alone, f"{file.name}: {alone} isolate what {arm} does"
    assert checked >= 2


def test_compared_trials_share_scene_and_seed_if_possible():
    arms = Arm("sfm", "a"), Arm("sfm", "b")

    def pairs(*places):
        trials = [SimpleNamespace(arm=arms[side], scene=s, seed=k) for side, s, k in places]
        found = compared_trials(trials, *arms)
        return [(one.scene, one.seed, other.scene, other.seed) for one, other in found]

    assert pairs((0, "x", 0), (0, "x", 1), (1, "x", 1)) == [("x", 1, "x", 1)]
    assert pairs((0, "x", 0), (0, "y", 0), (1, "y", 2)) == [("y", 0, "y", 2)]
    assert pairs((0, "x", 0), (0, "y", 0), (1, "y", 0), (1, "x", 0)) == [
        ("x", 0, "x", 0),
        ("y", 0, "y", 0),
    ]
    assert pairs((0, "x", 0), (0, "x", 1), (1, "y", 1)) == [("x", 1, "y", 1)]
    with pytest.raises(KeyError, match="sfm"):
        compared_trials([], *arms)
