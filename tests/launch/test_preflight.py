"""Checks of trials before any of them runs, and the way to their launcher."""

import sys
from types import SimpleNamespace

import pytest

from gsbench.launch import batch, estimates
from gsbench.launch.batch import (
    begin,
    check_trackers,
    missing_folders,
    missing_weights,
    need_no_check,
    run_batch,
)
from gsbench.launch.jobs import Outcome
from gsbench.runs.commands import read_history
from gsbench.runs.trial_folder import TrialFolder
from tests.helpers import refusal, table
from tests.launch.test_jobs import SLURM, nothing
from tests.trials import LOCAL, bare_trial, write_results


def trial(runs, seed=0, launch=None, **settings):
    courtyard = {"name": "courtyard", "path": "", "kind": "courtyard"}
    launch = launch or LOCAL | {"name": "serial"}
    tracking = {"enabled": False, "_target_": "gsbench.tracking.NoSuch"}
    settings = {"scene": courtyard, "tracking": tracking} | settings
    return bare_trial(runs, seed, launch, [f"seed={seed}"], **settings)


@pytest.fixture
def called(monkeypatch):
    """The launchers and checks that were called, with their seeds, instead of doing it."""
    names = []

    def stand_in(name):
        def launcher(trials, **words):
            names.append((name, [one.values["seed"] for one in trials], *words.values()))
            return [Outcome(one.folder, "failed") for one in trials]

        return launcher

    for name in ("run_serial", "run_local", "run_slurm", "check_parts"):
        monkeypatch.setattr(batch, name, stand_in(name))
    monkeypatch.setattr(batch, "Mirror", lambda trials: stand_in("Mirror")(trials) and nothing())
    return names


@pytest.mark.parametrize(
    "launch, launchers",
    [
        (LOCAL | {"name": "serial"}, ["Mirror", "run_serial"]),
        (LOCAL, ["Mirror", "run_local"]),
        (SLURM, ["run_slurm"]),
    ],
)
def test_unfinished_trials_go_to_their_launcher_once_checked_and_planned(
    tmp_path, monkeypatch, called, launch, launchers
):
    runs = tmp_path / "runs"
    declaring = {"eval": {"primary": "psnr"}}
    one, two = (trial(runs, seed, launch, **declaring) for seed in (0, 1))
    monkeypatch.setattr(TrialFolder, "why_not_done", lambda self, *_: self.path != one.folder)
    write_results(one.folder, one.values)
    left = runs / "store/init/.a.removed"
    left.mkdir(parents=True)
    done, failed = run_batch([one, two, two])
    assert (done.folder, done.status, done.message) == (one.folder, "done", "psnr 20.5")
    assert (failed.folder, failed.status) == (two.folder, "failed")
    assert called == [
        ("check_parts", [1], launch is not SLURM),
        *[(name, [1]) for name in launchers],
    ]
    assert set(read_history(runs / "x").planned) == {one.folder, two.folder}
    assert not left.exists()
    called.clear()
    run_batch([one])
    begin([one, two])
    assert called == [
        ("check_parts", [], launch is not SLURM),
        ("check_parts", [1], launch is not SLURM),
    ]


def test_what_is_missing_here_matters_unless_the_trials_run_elsewhere(tmp_path, called):
    runs = tmp_path / "runs"
    photos = {"name": "mine", "path": str(tmp_path / "photos"), "kind": "images"}
    tracked = {"enabled": True, "_target_": "gsbench.tracking.TensorBoard", "x": 1}
    for wrong, said in (
        ({"scene": photos}, "scene mine: the folder"),
        ({"tracking": tracked}, r"tracking\.x is not a setting"),
        ({"eval": {"weights": "nosuch"}}, r"eval\.weights=nosuch: no such folder"),
    ):
        with refusal(said):
            run_batch([trial(runs, **wrong)])
        begin([trial(runs, 0, SLURM, **wrong)])
    one = trial(runs, eval={"weights": "nosuch"})
    write_results(one.folder, one.values)
    with refusal("no such folder"):  # wrong even if all trials are done
        run_batch([one])
    with refusal("name eval.primary"):
        run_batch([trial(tmp_path / "new", eval={"primary": name}) for name in ("psnr", "ssim")])
    assert not (tmp_path / "new").exists()
    called.clear()
    run_batch([trial(runs, 0, SLURM, eval={"weights": "nosuch"})])
    assert [name for name, *_ in called] == ["check_parts", "run_slurm"]
    check_trackers([trial(runs, tracking={"enabled": True})])


def test_each_missing_folder_is_named_once_with_the_way_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setenv("GSBENCH_DATA", str(tmp_path))
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").touch()

    def scene(name, kind, folder, **more):
        return {"scene": {"name": name, "kind": kind, "path": str(tmp_path / folder), **more}}

    trials = [
        trial(tmp_path),
        trial(tmp_path, **scene("b", "images", "file")),
        *[trial(tmp_path, **scene("a", "colmap", "none", sparse=model)) for model in ("0", "1")],
        trial(tmp_path, **scene("c", "colmap", "empty")),
        trial(tmp_path, **scene("d", "images", "empty")),
    ]
    lines = missing_folders(trials)
    assert lines[0] == f"scene a: the folder {tmp_path / 'none'} does not exist"
    assert lines[1] == f"scene b: the folder {tmp_path / 'file'} is a file"
    assert lines[2].startswith("scene c: ")
    assert lines[3:] == [
        "scene.path must name its folder, or GSBENCH_DATA that of the known scenes"
    ]
    assert missing_folders(trials[:1]) == []
    named = [("eval", "z"), ("eval", "y"), ("init", str(tmp_path)), ("init", "z"), ("eval", None)]
    trials = [
        trial(tmp_path, **{group: {"name": "a", "weights": folder}}) for group, folder in named
    ]
    assert [line.partition(":")[0] for line in missing_weights(trials)] == [
        "eval.weights=y",
        "eval.weights=z",
        "init.weights=z",
    ]
    assert missing_folders(trials) == missing_weights(trials)


@pytest.mark.parametrize(
    "word, free",
    table(__file__, "shipped_choices_alone_need_no_check"),
)
def test_shipped_choices_alone_need_no_check(word, free):
    trials = [SimpleNamespace(overrides=words) for words in (("name=x",), ("seed=1", word))]
    assert need_no_check(trials) == free


def test_weights_are_searched_once_for_equal_options(monkeypatch):
    asked = []

    def make_evaluator(options):
        asked.append(options)
        return SimpleNamespace(awaited=["lpips_vgg"])

    parts = SimpleNamespace(make_evaluator=make_evaluator)
    monkeypatch.setitem(sys.modules, "gsbench.pipeline.parts", parts)
    estimates._unavailable_now.cache_clear()
    for flip in (False, True, False):
        assert estimates.unavailable_now({"flip": flip}) == ["lpips_vgg"]
    assert [options.flip for options in asked] == [False, True]
    estimates._unavailable_now.cache_clear()
