"""``gsbench export`` of models, initial models and results."""

from pathlib import Path
from shlex import split

import pytest
import torch

from gsbench.config.compose import compose_one
from gsbench.gaussians.ply import write_ply
from gsbench.runs.keys import INIT, Step
from gsbench.runs.store import Store
from gsbench.runs.trial_folder import TrialFolder
from gsbench.verbs import exchange
from tests.gaussians.helpers import random_gaussians
from tests.helpers import refusal, write
from tests.trials import write_results, write_runs

pytestmark = pytest.mark.usefixtures("runs")


def finished_trial(runs, gaussians):
    """Write a complete trial with a model and an initial cloud in the store; returns its folder."""
    values = compose_one(["name=x", "densify=adc"]).values
    folder = TrialFolder.of(values).path
    folder.mkdir(parents=True)
    write_ply(gaussians, folder / "point_cloud.ply")
    model = Step(INIT, {}, lambda made: write(made / "sparse/0/points3D.bin", b"points"))
    Store(runs / "store").get(model)
    write_results(folder, values, num_gaussians=len(gaussians), hashes={"init": model.key})
    return folder


@pytest.fixture
def gaussians():
    return random_gaussians(60, seed=3, dtype=torch.float32)


def test_results_of_an_experiment_without_trials_are_not_exported(runs):
    (runs / "empty").mkdir(parents=True)
    with refusal("'empty' has no complete trial among 0 folders"):
        exchange.export_results("empty", runs, None)


def test_export_of_the_model_and_the_initial_cloud(runs, gaussians, tmp_path, said, refused):
    folder = finished_trial(runs, gaussians)
    out = said("export x:courtyard:adc:0 --out new/model.ply")
    assert "new/model.ply: x/courtyard/sfm-adc/" in out
    model = (folder / "point_cloud.ply").read_bytes()
    assert (tmp_path / "new/model.ply").read_bytes() == model
    said(f"export init {folder} --out model")
    assert (tmp_path / "model/sparse/0/points3D.bin").read_bytes() == b"points"
    refused(f"export init {folder} --out model")
    refused(f"export {folder} --out model.xyz")
    refused("export x:courtyard:mcmc --out model.ply")
    assert "give another --out" in refused(f"export {folder} --out /proc/nowhere/model.ply")


def test_the_archive_of_results_gets_the_name_of_the_experiment_or_of_out(runs, tmp_path, said):
    write_runs(runs)
    (tmp_path / "new").mkdir()
    for out, file in (([], "exp.zip"), (["--out", "new"], "new/exp.zip"), (["--out", "a"], "a")):
        assert said("export --results exp", *out).startswith(f"{file}: results of exp, ")
        assert (tmp_path / file).stat().st_size > 1000


@pytest.mark.parametrize(
    "words",
    [
        "--results exp a:b:c",
        "a:b:c --pictures --out x.ply",
        "a:b:c",
        "--out x.ply",
        "a:b:c d:e:f --out x.ply",
        "init init d:e:f --out x",
    ],
)
def test_words_that_do_not_go_together_are_refused(refused, words):
    assert "export needs one TRIAL and --out PATH" in refused("export", *split(words))
    assert "'a/b' is not the name of an experiment" in refused("export --results a/b")


@pytest.mark.parametrize(
    "name, good",
    [("m.ply", True), ("M.PLY", True), ("m.compressed.ply", False), ("m.splat", False)],
)
def test_only_the_3dgs_form_is_written(name, good):
    if good:
        exchange.check_form(Path(name))
    else:
        with refusal(r"name a file that ends in \.ply, the 3DGS form"):
            exchange.check_form(Path(name))


def test_an_initial_model_that_is_no_longer_stored_is_named(runs, gaussians, refused):
    folder = finished_trial(runs, gaussians)
    (runs / "store/init").rename(runs / "gone")
    assert "is gone: run this trial again" in refused("export init", folder, "--out", "model")


@pytest.mark.parametrize(
    "words, file",
    [
        ("export --results exp", "exp.zip"),
        ("export --results exp --out .", "exp.zip"),
        ("tables exp --format csv --out .", "exp.csv"),
        ("report exp --out .", "exp-report.html"),
        ("site a.zip --out .", "index.html"),
        ("site a.zip --out .", "reports/exp.html"),
    ],
)
def test_a_file_that_the_user_did_not_name_is_not_overwritten(words, file, runs, refused, said):
    write_runs(runs)
    said("export --results exp --out a.zip")
    for _ in range(2):  # its own file is renewed
        said(*split(words))
    assert Path(file).is_file()
    Path(file).write_text("the user's own")
    assert "not as gsbench wrote it: move it" in refused(*split(words))
    assert Path(file).read_text() == "the user's own"
