"""Photographs that renders are compared with, and the places at which they are entered."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from numpy.testing import assert_array_equal
from PIL import Image

from gsbench.analysis.comparison import compare
from gsbench.analysis.results import load_experiment
from gsbench.cli import run
from gsbench.config.compose import compose_one
from gsbench.renders.imported import Destination, Measured, check_destination, find_destination
from gsbench.renders.measure import _lines
from gsbench.renders.sources import ReferenceImages, find_reference_images
from gsbench.scene.names import Matching
from tests.helpers import change_json, read_json, refusal, write
from tests.trials import write_runs

QUICK = ["eval.lpips=[]", "eval.flip=false"]
COURTYARD = ReferenceImages(
    {}, "the test views of a trial", "0" * 64, (96, 72), {}, "courtyard", "sfm"
)
OWN = ("store", "Store", "mlartifacts")
FOLDER = ReferenceImages({}, "the pictures in a folder", "0" * 64, (96, 72), {})


@pytest.mark.parametrize(
    "word, scene, seed, truth, said",
    [
        ("table1:mine", "garden", 0, COURTYARD, "--scene garden: .* of the scene courtyard"),
        ("table1:mine", None, -1, COURTYARD, "--seed -1: must be 0 or more"),
        ("table1:mine", "../x", 0, FOLDER, r"--scene \.\./x: must be a plain folder name"),
        ("table1:mine", None, 0, FOLDER, "give it with --scene"),
        *((f"{own}:arm", None, 0, COURTYARD, f"{own} is gsbench's own folder") for own in OWN),
        (".jobs:arm", None, 0, COURTYARD, "is not EXPERIMENT:ARM"),
    ],
)
def test_places_that_would_mix_or_damage_results_are_refused(
    word, scene, seed, truth, said, tmp_path
):
    with refusal(said):
        find_destination(word, scene, seed, truth, tmp_path)


@pytest.fixture(scope="module")
def defaults():
    return dict(compose_one(QUICK).values)


@pytest.fixture
def trial(runs, defaults):
    """The folder of a trial of ``exp`` that tests the scene garden in two views, one masked."""
    plan = {"scenes": ["garden"], "densifiers": ["adc"], "seeds": [0]}
    (folder,) = write_runs(runs, **plan, views=2, pictures=True)
    config = read_json(folder / "config.yaml")
    config = defaults | config | {"scene": {"name": "garden", "path": "there"}}
    write(folder / "config.yaml", config)
    (folder / "masks").mkdir()
    mask = np.zeros((120, 160), np.uint8)
    mask[40:, :] = 255
    Image.fromarray(mask).save(folder / "masks" / "view001.png")
    return folder


def test_renders_are_entered_beside_the_trial_of_their_photographs(trial, runs, said, capsys):
    renders = trial.parents[4] / "mine"
    renders.mkdir()
    for name in ("view000", "view001"):
        picture = np.asarray(Image.open(trial / "ground_truth" / f"{name}.png")).astype(int)
        picture[40:] += 10 - 20 * (picture[40:] > 127)  # off by 10 levels
        Image.fromarray(picture.astype(np.uint8)).save(renders / f"{name}.png")
    words = ["evaluate", renders, "--truth", "exp:garden:adc:0", "--as", "exp:theirs"]
    found = json.loads(said(*words, "--seed", 3, "--json"))
    entered = Path(found["entered"])
    assert entered.parent == runs / "exp" / "garden" / "sfm-theirs"
    assert entered.name.endswith("-seed3")
    psnr = 20 * np.log10(255 / 10)
    assert found["views"]["view001"]["psnr"] == pytest.approx(psnr)  # the upper third is masked
    assert found["views"]["view000"]["psnr"] == pytest.approx(psnr + 10 * np.log10(1.5))
    assert (found["names_matched"], found["left_out"]) == ("apart from the extension", [])
    assert found["pictures"] == {"view000": "view000.png", "view001": "view001.png"}
    results = read_json(entered / "results.json")
    assert results["metrics"] == pytest.approx(found["metrics"])
    wanted = {
        **{"status": "complete", "evaluated_from": "renders", "raster": "unknown"},
        **{"iterations": 0, "test_views": 2, "resolution": [400, 300], "seed": 3},
        "renders": {"folder": str(renders), "names matched": "apart from the extension"},
    }
    assert {key: results[key] for key in wanted} == wanted
    assert results["hashes"]["data"] == "data-garden"
    config = yaml.safe_load((entered / "config.yaml").read_text())
    assert (config["name"], config["seed"], config["runs"]) == ("exp", 3, str(runs))
    assert config["scene"] == {"name": "garden", "path": "there"}
    assert config["init"] == {"name": "sfm"}
    assert config["densify"] == {"name": "theirs", "evaluated_from": "renders"}
    for folder, source in (("renders", renders), ("ground_truth", trial / "ground_truth")):
        pictures = [Image.open(place / "view001.png") for place in (entered / folder, source)]
        assert_array_equal(*pictures)
    assert [mask.name for mask in (entered / "masks").iterdir()] == ["view001.png"]
    assert {one.densify for one in load_experiment(runs, "exp").trials} == {"adc", "theirs"}

    assert f"entered as {entered}" in said(*words, "--seed", 3)  # the same again
    Image.fromarray(np.zeros((120, 160, 3), np.uint8)).save(renders / "view000.png")
    assert run([*map(str, words), "--seed", "3"]) == 2
    assert "seed 3 of sfm-theirs on garden is taken" in capsys.readouterr().err
    said(*words[:-1], "new:dnn-theirs")
    (other,) = runs.glob("new/garden/dnn-theirs/*-seed0")
    assert yaml.safe_load((other / "config.yaml").read_text())["init"] == {"name": "dnn"}


def test_a_named_metric_writes_the_question_about_all_seeds_of_the_baseline(trial, runs, said):
    second = trial.with_name(trial.name.replace("seed0", "seed1"))
    shutil.copytree(trial, second)
    change_json(second / "results.json", seed=1)
    words = ["evaluate", trial / "renders", "--truth", "exp:garden:adc:0", "--as", "exp:theirs"]
    for seed in (0, 1):
        said(*words, "eval.primary=psnr", "--seed", seed)
    experiment = load_experiment(runs, "exp")
    (question,) = experiment.history.questions
    assert question.seeds == {"garden": (0, 1)}
    (answer,) = compare(experiment).answers
    assert (answer.verdict.state, answer.verdict.done) == ("answered", 4)


@pytest.mark.parametrize(
    "word, said",
    [("eval.primary=psnr", "add --as"), ("eval.at=[7]", "no effect on renders")],
)
def test_settings_without_effect_on_renders_are_refused(trial, runs, refused, word, said):
    assert said in refused("evaluate", trial / "renders", "--truth", trial, word)


def test_the_photographs_may_be_those_of_a_trial_by_an_earlier_version(trial, said):
    config = read_json(trial / "config.yaml")
    config["eval"] |= {"fps": None, "more": ["psnr_cc"], "primary": "psnr_cc"}  # gone since
    write(trial / "config.yaml", config)
    assert "protocol paper-1" in said("evaluate", trial / "renders", "--truth", "exp:garden:adc")


def test_photographs_are_found_by_trial_folder_and_address(trial, runs, tmp_path, refused, said):
    other = trial.with_name("deadbeef-seed0")  # the same arm with another setting
    shutil.copytree(trial, other)
    config = read_json(other / "config.yaml")
    config["densify"] |= {"split_size": 0.02}
    write(other / "config.yaml", config)
    for arm, folder in (("adc[split_size=0.02]", other), ("sfm-adc[split_size=0.02]", other)):
        truth = find_reference_images(f"exp:garden:{arm}", [], runs)
        assert truth.photographs["view001"] == folder / "ground_truth" / "view001.png"
    assert "choose one of exp:garden:sfm-adc[split_size=" in refused(
        "evaluate", trial / "renders", "--truth", "exp:garden:adc"
    )
    shutil.rmtree(other)
    for place in (trial, trial / "ground_truth", trial / "renders", "exp:garden:adc"):
        truth = find_reference_images(str(place), [], runs)
        assert (truth.scene, truth.init, truth.resolution) == ("garden", "sfm", (400, 300))
        assert truth.photographs["view001"] == trial / "ground_truth" / "view001.png"
        assert truth.masks == {"view001": trial / "masks" / "view001.png"}
    renders = trial / "renders"
    # photographs of a scene come from the experiment's own trial of it, unless settings are given
    garden = ["evaluate", renders, "--truth", "garden", "--as", "exp:mine"]
    assert "the test views of exp/garden/sfm-adc/" in said(*garden, "--protocol", "standard")
    assert "nothing" in refused(*garden, "scene.path=nothing")
    address = ["evaluate", renders, "--truth", "exp:garden:adc"]
    assert "protocol standard-1" in said(*address, "--protocol", "standard")
    assert "protocol paper-1" in said(*address, *QUICK)
    assert "scene.width=7: the settings of the test views" in refused(*address, "scene.width=7")
    (tmp_path / "empty").mkdir()
    for place, words in (
        (tmp_path / "empty", "holds no pictures that gsbench reads: write PNG"),
        ("gardn", "is no folder, no trial EXPERIMENT:SCENE:ARM and no scene; did you mean"),
    ):
        assert words in refused("evaluate", renders, "--truth", place)
    results = read_json(trial / "results.json")
    del results["resolution"]
    write(trial / "results.json", results)
    assert "no record of the size or hash of its test views" in refused(*address)


@pytest.mark.parametrize("words, count", [((), 100), (("init=random", "init.count=7"), 7)])
def test_photographs_of_a_scene_are_its_test_views_as_a_trial_sees_them(words, count, tmp_path):
    """With the fastest initialiser if the scene has cameras, unless one is chosen."""
    size = ["scene.views=9", "scene.width=64", "scene.height=48", f"runs={tmp_path}"]
    truth = find_reference_images("courtyard", [*size, *words], tmp_path)
    assert list(truth.photographs) == ["0000.png", "0008.png"]
    assert {Image.open(path).size for path in truth.photographs.values()} == {(64, 48)}
    assert (truth.what, truth.scene, truth.init) == (
        "the test views of courtyard",
        "courtyard",
        None,
    )
    assert (truth.resolution, len(truth.data), truth.masks) == ((64, 48), 64, {})
    assert truth.config["init"]["count"] == count


def test_the_initialiser_of_an_arm_is_that_of_the_experiments_own_trials(tmp_path):
    write_runs(tmp_path, scenes=["garden"], inits=["random"], seeds=[0])
    garden = ReferenceImages(
        {}, "the pictures in a folder", "0" * 64, (96, 72), {}, "garden", "sfm"
    )
    assert find_destination("exp:mine", None, 0, garden, tmp_path).init == "random"
    assert find_destination("exp:a-mine-2", None, 0, garden, tmp_path) == Destination(
        "exp", "garden", "a", "mine-2", 0
    )
    assert find_destination("new:mine", "garden", 0, FOLDER, tmp_path).init == "renders"
    write_runs(tmp_path, scenes=["garden"], seeds=[0])
    with refusal(r"has random, sfm on garden: say which, .* exp:random-mine"):
        find_destination("exp:mine", None, 0, garden, tmp_path)
    for folder in (tmp_path / "exp" / "garden").glob("sfm-*/*"):
        change_json(folder / "results.json", evaluated_from="renders")
    assert find_destination("exp:mine", None, 0, garden, tmp_path).init == "random"


def test_the_scene_of_the_photographs_may_be_repeated(tmp_path):
    wanted = Destination("table1", "courtyard", "sfm", "mine", 3)
    assert find_destination("table1:mine", "courtyard", 3, COURTYARD, tmp_path) == wanted
    assert find_destination("table1:mine", None, 3, COURTYARD, tmp_path) == wanted
    assert find_destination("table1:mine", "garden", 3, FOLDER, tmp_path).scene == "garden"


@pytest.mark.parametrize(
    "data, resolution, said",
    [
        ("data-garden", (400, 300), None),
        ("data-garden", (400, 301), "tests garden on other photographs"),
        ("data-stump", (400, 300), "tests garden on other photographs"),
    ],
)
def test_renders_of_other_photographs_than_the_experiments_are_refused(
    data, resolution, said, tmp_path
):
    write_runs(tmp_path, scenes=("garden",), seeds=(0,))
    truth = ReferenceImages({}, "the pictures in a folder", data, resolution, {})
    destination = Destination("exp", "garden", "sfm", "mine", 0)
    with refusal(said):
        check_destination(destination, truth, tmp_path)


def test_printed_lines_have_the_views_their_mean_and_the_reasons_of_missing_metrics():
    evaluator = SimpleNamespace(
        protocol=SimpleNamespace(id="paper-1"),
        unavailable={"lpips_vgg_raw": "no weights", "flip": "renders alone"},
        awaited={"lpips_vgg_raw"},
        own={},
    )
    matching = Matching({}, "by their order", ("x", "y"))
    views = {"a": {"psnr": 20.0, "ssim": 0.5}, "bcdef": {"psnr": 21.0, "ssim": 0.25}}
    lines = _lines(Measured(FOLDER, [], views, evaluator, {}), matching, Path("runs/x"))
    assert lines[0] == "2 views: the pictures in a folder; protocol paper-1"
    assert lines[1:3] == ["names matched by their order", "left out, without a photograph: x, y"]
    assert lines[3:7] == [
        "       PSNR (dB)  SSIM",
        "a         20.000  0.5000",
        "bcdef     21.000  0.2500",
        "mean      20.500  0.3750",
    ]
    assert lines[7:] == ["lpips_vgg_raw: n/a, no weights", "entered as runs/x"]
