"""Every file in ``conf`` composes, and its classes can be built and check their options."""

import dataclasses
import json
import re
from functools import cache
from pathlib import Path
from shlex import split

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from gsbench.app.command import compose_trials
from gsbench.config.build import build, build_metrics
from gsbench.config.command_words import check_words
from gsbench.config.compose import compose_one
from gsbench.config.overrides import key_of, parse_word
from gsbench.config.schema import check, plain, register_schemas
from gsbench.runs.code import config_hash
from gsbench.system.install import conf_dir
from gsbench.train.options import STEPS
from tests.helpers import refusal, table, write

GROUPS = ("scene", "init", "densify", "raster", "train", "eval", "tracking", "launch")


def options(group):
    return sorted(path.stem for path in Path(conf_dir(), group).glob("*.yaml"))


@cache
def composed(*overrides):
    """The values of a configuration, which tests share and do not change."""
    register_schemas()
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        config = compose("config", overrides=list(overrides))
    return check(plain(config))


@pytest.fixture(scope="module")
def base():
    """A composed configuration, for changes of single values: a composition takes long."""
    register_schemas()
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        return compose("config")


def changed(base, changes):
    config = base.copy()
    OmegaConf.set_struct(config, False)
    for key, value in changes.items():
        OmegaConf.update(config, key, value, merge=False)
    return check(plain(config))


def checked(base, *words):
    return changed(base, {key_of(word): parse_word(word).value() for word in words})


PLACES = {option: ["init.path=/data/model.ply"] for option in ("ply", "points")}
READER = ["scene._target_=mine.Reader", "allow_targets=[mine]"]
OF_FOLDER = ("photos", "colmap", "transforms", "blender", "reader")


def with_option(group, option):
    """The values of a configuration with this option.

    A composition takes long, so each shows an option of every group but ``train``.
    """
    if group == "train":
        return composed(f"train={option}", *["densify=none"] * (option == "none"))[group]
    row = options(group).index(option)
    chosen = {one: options(one)[row % len(options(one))] for one in GROUPS} | {"train": "paper"}
    more = ["scene.path=/data/capture"] * (chosen["scene"] != "courtyard")
    more += PLACES.get(chosen["init"], []) + READER * (chosen["scene"] == "reader")
    return composed(*(f"{one}={name}" for one, name in chosen.items()), *more)[group]


@pytest.mark.parametrize(
    "group, option", [(group, option) for group in GROUPS for option in options(group)]
)
def test_every_option_composes(group, option):
    name = "capture" if group == "scene" and option in OF_FOLDER else option
    assert with_option(group, option)["name"] == name


@pytest.mark.parametrize("option", options("densify"))
def test_every_densifier_can_be_built_and_shows_all_its_options(option):
    values = with_option("densify", option)
    densifier = build("densify", values, [])
    if dataclasses.is_dataclass(densifier):
        names = {field.name for field in dataclasses.fields(densifier) if field.init}
        assert names == set(values) - {"_target_", "name"}  # the YAML shows every option


@pytest.mark.parametrize("option", options("init"))
def test_every_initialiser_shows_all_its_options(option, tmp_path):
    model = write(tmp_path / "model.ply", "ply\nend_header\n")
    values = with_option("init", option) | ({"path": str(model)} if option in PLACES else {})
    initializer = build("init", values, [])
    names = {field.name for field in dataclasses.fields(initializer) if field.init}
    assert names == set(values) - {"_target_", "name"}


def test_the_demo_downloads_little_and_declares_what_it_measures():
    trials = compose_trials(["+experiment=demo"], multirun=True)
    asked = {
        (tuple(trial.values["eval"]["lpips"]), trial.values["eval"]["primary"]) for trial in trials
    }
    # SSIM needs no weights; LPIPS is measured where its weights are
    assert asked == {(("squeeze",), "ssim")}


@pytest.mark.parametrize(
    "words, said",
    table(__file__, "errors"),
)
def test_errors_name_the_key(base, words, said):
    with refusal(re.escape(said)):
        checked(base, *words.split())


def test_a_users_metric_can_be_declared_if_it_has_a_direction(base, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    text = "class Known:\n    direction = 1\n    def measure(self, image, truth): return 1.0\n"
    text += "class Unknown(Known):\n    direction = 0\n"
    (tmp_path / "declared_metrics.py").write_text(text)
    for name in ("Known", "Unknown"):
        own = [
            f"eval.extra.mine._target_=declared_metrics.{name}",
            "allow_targets=[declared_metrics]",
        ]
        values = checked(base, *own, "eval.primary=mine")["eval"]
        if name == "Known":
            assert set(build_metrics(values, ["declared_metrics"])) == {"mine"}
        else:
            with refusal(r"eval\.primary=mine: declared_metrics\.Unknown does not say"):
                build_metrics(values, ["declared_metrics"])


def test_wrong_type_in_a_component_names_the_key(base):
    with refusal(r"densify\.max_gaussians"):
        build("densify", checked(base, "densify.max_gaussians=1.5")["densify"], [])
    with refusal(r"densify\.cap.*'soft'"):
        build("densify", checked(base, "densify.cap=squishy")["densify"], [])


@pytest.mark.slow
def test_every_component_of_gsbench_checks_its_own_options():
    """`build` leaves the checks to them. A list of lists is wrong for every kind of option."""
    for group in ("init", "densify"):
        for option in options(group):
            values = with_option(group, option)
            for key in values.keys() - {"_target_", "name"}:
                with refusal(rf"{group}\.{key}"):
                    build(group, values | {key: [[None]]}, [])


def test_asking_for_more_metrics_changes_the_hash(base):
    words = ("seed=0", "eval.more=[gmsd]", "eval.more=[fsim]", "eval.at=[7]")
    assert len({config_hash(checked(base, word)) for word in words}) == 4


@pytest.mark.parametrize("place", ["densify", "raster", "eval.extra.edges"])
def test_hash_follows_the_source_of_a_users_class(base, place, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    own = [f"{place}._target_=own_class.Mine", "allow_targets=[own_class]"]
    hashes = []
    for text in ("A = 1\n", "A = 2\n", "A = 1\n"):
        (tmp_path / "own_class.py").write_text(text)
        hashes.append(config_hash(checked(base, *own)))
    assert hashes[0] == hashes[2] != hashes[1]
    assert config_hash(checked(base)) not in hashes


@pytest.mark.parametrize(
    "changes, said",
    table(__file__, "rules"),
)
def test_rules_between_settings(base, changes, said):
    with refusal(said and re.escape(said)):
        values = changed(base, changes)
        for key, value in changes.items():
            group, _, name = key.rpartition(".")
            assert (values[group] if group else values)[name] == value


def test_values_are_resolved_converted_and_hydras_node_is_left_out(base, monkeypatch):
    asked = []
    at_once = lambda *given: asked.append(given) or 6  # noqa: E731
    monkeypatch.setattr("gsbench.config.schema.trials_at_once", at_once)
    changes = {
        "hydra": {"a": "${nosuch}"},
        "scene.width": 1e3,
        "scene.height": "${scene.width}",
        "densify.max_gaussians": 1000,
        "launch.parallel": "auto",
        "device": "cpu",
        "raster": {"name": "own", "_target_": "mine.Own", "speed": "1e3"},
    }
    values = changed(base, changes)
    assert "hydra" not in values
    assert (values["scene"]["width"], values["scene"]["height"]) == (1000, 1000)
    assert values["launch"]["parallel"] == 6
    assert asked == [(1000, "cpu")]
    # the other keys are options of the user's class
    assert values["raster"] == changes["raster"]
    assert plain({"a": (1, [2, (3,)])}) == {"a": [1, [2, [3]]]}


def test_values_of_a_trial_have_the_types_of_json(base):
    """OmegaConf 2.4 keeps tuples, which JSON does not have."""
    values = checked(base)
    assert json.loads(json.dumps(values)) == values


def test_an_own_metric_must_be_allowed_and_name_a_class():
    with refusal(r"eval\.extra\.edges\._target_=mine\.X is not gsbench's own"):
        compose_one(["eval.extra.edges._target_=mine.X"])
    with refusal(r"eval\.extra\.edges must name a class"):
        composed("eval.extra.edges=3")


READ = "name=1_1 name=1e3 densify.name=1e3 name=007 name=2,1_1 scene.path=1.50"
KEPT = 'name=12 name=on name=0x10 name="1e3" name=2026-11-26 name=a_1 densify.volume_threshold=1e-3'


@pytest.mark.parametrize("word", READ.split())
def test_a_text_that_would_be_read_as_a_number_is_refused(word):
    with refusal("would be read as the number"):
        check_words([word])


@pytest.mark.parametrize("word", KEPT.split())
def test_other_words_are_kept_as_typed(word):
    check_words([word])


@pytest.mark.parametrize(
    "words, scaled",
    table(__file__, "scaled"),
)
def test_all_steps_of_the_schedule_are_scaled(words, scaled):
    values = composed("densify=adc", *words)
    train, densify = values["train"], values["densify"]
    keys = ("iterations", "densify_start", "densify_stop", "densify_interval")
    assert [*(train[key] for key in keys), train["opacity_reset_interval"]] == scaled
    assert [densify[key] for key in ("start", "stop", "interval")] == scaled[1:4]
    assert densify["opacity_reset_interval"] == scaled[4]
    # a schedule that is written out makes the same trial
    own = [f"train.{key}={json.dumps(train[key])}" for key in STEPS]
    assert config_hash(composed("densify=adc", words[0], *own)) == config_hash(values)


@pytest.mark.parametrize("value", split("0 -1 x true"))
def test_a_scale_that_is_no_number_above_zero_is_refused(base, value):
    with refusal(r"train\.steps_scaler must be"):
        checked(base, f"train.steps_scaler={value}")
