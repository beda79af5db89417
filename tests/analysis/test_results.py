"""Reading result files: sound trials are read, all others are named and left out."""

import subprocess
import sys

import pytest

from gsbench.analysis.results import load_experiment, read_views
from gsbench.runs.experiments import list_experiments
from tests.analysis.helpers import loaded, trials_of
from tests.helpers import change_json, refusal, write
from tests.trials import write_arms, write_runs


def test_every_complete_trial_is_read(tmp_path):
    paths = write_runs(tmp_path)
    experiment = loaded(tmp_path)
    assert {trial.path for trial in experiment.trials} == set(paths)
    assert experiment.warnings == ()
    assert experiment.seeds == (0, 1, 2)


def test_trials_are_in_the_order_of_seeds_then_of_configurations(tmp_path):
    for cap in (1, 2):
        write_arms(tmp_path, {"adc": {"cap": cap}}, seeds=(1, 0))
    trials = trials_of(tmp_path)
    assert [trial.seed for trial in trials] == [0, 0, 1, 1]
    assert [trial.config_hash for trial in trials] == sorted(
        {trial.config_hash for trial in trials}
    ) * 2


def test_hydra_and_report_files_beside_the_trials_are_ignored(tmp_path):
    write_runs(tmp_path)
    (tmp_path / "exp/.hydra").mkdir()
    (tmp_path / "exp/report.html").write_text("")
    (tmp_path / "exp/multirun.yaml").write_text("")
    assert loaded(tmp_path).warnings == ()


DAMAGES = {  # keys of results.json, its new content, or a change of the folder
    "half a file": ('{"status": "comp', "not JSON"),
    "binary": (b"\xff\xfe\x00", "not JSON"),
    "a list": ("[]", "should be a dictionary"),
    "nan": ({"metrics": {"psnr": float("nan")}}, "metrics.psnr is nan"),
    "text for a number": ({"metrics": {"psnr": "27"}}, "metrics.psnr is '27'"),
    "no seconds": ({"seconds": None}, "seconds is None"),
    "no count": ({"num_gaussians": None}, "num_gaussians"),
    "no protocol": ({"protocol": None}, "protocol is None"),
    "still running": ({"status": "running"}, "unfinished"),
    "another scene": ({"scene": "kitchen"}, "foreign, its results.json is of scene 'kitchen'"),
    "another experiment": ({"experiment": "other"}, "of experiment 'other'"),
    "another arm": ({"densify": "none"}, "of arm 'sfm-none'"),
    "another seed": ({"seed": 7}, "of seed '7'"),
    "a copy under another name": (
        lambda path: path.rename(path.with_name("copy of run")),
        "not named",
    ),
    "a link": (lambda path: (path / "figures").symlink_to(path.parents[3]), "strange, "),
    "nothing yet": (
        lambda path: (path / "results.json").unlink(),
        "unfinished, no results.json yet",
    ),
}


@pytest.mark.parametrize("damage", list(DAMAGES))
def test_a_trial_that_cannot_be_used_is_named_and_left_out(tmp_path, damage):
    paths = write_runs(tmp_path)
    spoil, words = DAMAGES[damage]
    if callable(spoil):
        spoil(paths[4])
    elif isinstance(spoil, dict):
        change_json(paths[4] / "results.json", **spoil)
    else:
        write(paths[4] / "results.json", spoil)
    experiment = loaded(tmp_path)
    assert len(experiment.trials) == len(paths) - 1
    assert len(experiment.warnings) == 1
    assert words in experiment.warnings[0]
    assert str(paths[4].parent.relative_to(tmp_path)) in experiment.warnings[0]


def test_a_failed_trial_says_why(tmp_path):
    path = write_runs(tmp_path)[0]
    (path / "results.json").unlink()
    write(
        path / "failed.json", {"error": "TrainingError", "message": "the loss is not finite at 812"}
    )
    assert loaded(tmp_path).warnings == (
        "exp/courtyard/sfm-adc/c0ffee00-seed0: failed, the loss is not finite at 812",
    )


def test_an_unknown_experiment_names_the_known_ones(tmp_path):
    write_runs(tmp_path)
    (tmp_path / "store").mkdir()
    assert list_experiments(tmp_path) == ["exp"]
    with refusal("there: exp"):
        load_experiment(tmp_path, "demo")
    with refusal("none yet"):
        load_experiment(tmp_path / "nowhere", "demo")


def test_an_experiment_without_a_usable_trial_is_an_error(tmp_path):
    for path in write_runs(tmp_path, scenes=("garden",), seeds=(0,)):
        (path / "results.json").unlink()
    with refusal("no complete trial among 2 folders"):
        loaded(tmp_path)


def test_views_must_average_to_the_metrics_of_their_trial(tmp_path):
    path = write_runs(tmp_path, seeds=(0,), scenes=("garden",))[0]
    trial = next(trial for trial in trials_of(tmp_path) if trial.path == path)
    views = read_views(trial)
    assert len(views) == 6
    assert set(views["view000"]) == {"psnr", "ssim", "lpips_vgg_raw", "flip"}
    lines = (path / "per_view.csv").read_text().splitlines()
    (path / "per_view.csv").write_text("\n".join(lines[:-2]) + "\n")
    with refusal("does not average"):
        read_views(trial)
    (path / "per_view.csv").unlink()
    with refusal("is missing"):
        read_views(trial)


def test_reading_and_tabulating_load_no_torch():
    modules = "verbs.results, analysis.statistics, analysis.images, analysis.report.build"
    imports = "; ".join(f"import gsbench.{module}" for module in modules.split(", "))
    code = f"import sys; {imports}; sys.exit('torch' in sys.modules or 'mlflow' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
