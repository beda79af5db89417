"""MLflow's first page compares ideas: parent runs with means, deviations, counts and verdicts."""

import subprocess
import sys
import threading
import time
from shlex import split

import pytest
from numpy.testing import assert_allclose

from gsbench.analysis.comparison import compare
from gsbench.analysis.results import read_experiment
from gsbench.runs.trial_folder import TrialFolder
from gsbench.tracking import connect, ensure_experiment, show_ideas
from gsbench.tracking.ideas import addresses, description
from gsbench.tracking.sync import sync
from gsbench.verbs import servers
from tests.helpers import change_json
from tests.processes import bytes_written, wait_until
from tests.tracking.helpers import (
    begin_trial,
    child_environment,
    found_runs,
    free_port,
    write_trial,
)
from tests.trials import trial_values
from tests.view.browser import Browser

NOTE, PARENT = "mlflow.note.content", "mlflow.parentRunId"


def write_sweep(runs, arms=("adc", "volumetric"), name="swept"):
    """Trials of arms, on two scenes with two seeds; later arms have a larger PSNR."""
    folders = []
    for number, arm in enumerate(arms):
        for scene in ("courtyard", "yard"):
            for seed in (0, 1):
                values = trial_values(runs, seed, name, scene=scene, densify=arm)
                folder = begin_trial(values)
                write_trial(folder, values, psnr=20 + number + seed / 10)
                folders.append(TrialFolder(folder))
    return folders


def shown(client, name="swept"):
    """The parent runs by name, and the trials' runs by the name of their parent."""
    runs = found_runs(client, name)
    parents = {run.info.run_id: run for run in runs if run.data.tags.get("kind") == "idea"}
    below = {run.info.run_name: [] for run in parents.values()}
    for run in runs:
        if run.info.run_id not in parents:
            parent = parents[run.data.tags[PARENT]]
            below[parent.info.run_name].append(run)
    return {run.info.run_name: run for run in parents.values()}, below


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
def test_an_idea_is_a_run_with_its_trials_below(kind, tmp_path, request):
    uri = None if kind == "sqlite" else request.getfixturevalue("postgresql")
    folders = write_sweep(tmp_path / "runs")
    assert list(sync(folders, uri))[-1] == "8 trials mirrored now, 0 before"
    client = connect(uri, tmp_path / "runs")
    ideas, below = shown(client)
    assert {name: len(runs) for name, runs in below.items()} == {"adc": 4, "volumetric": 4}
    numbers = ideas["volumetric"].data.metrics
    # over scenes and seeds 0 and 1: 21.0 and 21.1 in both scenes
    assert_allclose(numbers["eval/psnr_dB"], 21.05)
    assert_allclose(numbers["deviation/psnr_dB"], 0.1 / 2**0.5, rtol=1e-6)
    assert numbers["trials"] == 4
    assert "a_init-volumetric against a_init-adc" in ideas["volumetric"].data.tags[NOTE]
    assert ideas["adc"].data.tags["verdict"] == "baseline"
    assert (
        "| courtyard | a_init | volumetric | " in client.get_experiment_by_name("swept").tags[NOTE]
    )


@pytest.mark.slow
def test_a_superseded_trial_is_tagged_and_in_no_mean_and_a_failed_one_is_nested(tmp_path):
    runs = tmp_path / "runs"
    folders = write_sweep(runs, ("adc", "mine"))
    mine = [one.path for one in folders if "mine" in str(one.path)]
    for path in mine:
        change_json(path / "results.json", code={"sources": {"mine": "1" * 64}})
    later = []
    for path in mine:
        values = trial_values(
            runs, int(path.name[-1]), "swept", scene=path.parts[-3], densify="mine"
        )
        new = path.with_name(f"0123abcd-seed{path.name[-1]}")
        begin_trial(values)
        (path / "config.yaml").rename(path / "kept")
        new.mkdir()
        (new / "config.yaml").write_text((path / "kept").read_text())
        (path / "kept").rename(path / "config.yaml")
        write_trial(new, values, psnr=30.0, code={"sources": {"mine": "2" * 64}})
        later.append(TrialFolder(new))
    failed = later[0].path.with_name("0123abcd-seed9")
    failed.mkdir()
    (failed / "config.yaml").write_text((later[0].path / "config.yaml").read_text())
    (failed / "failed.json").write_text('{"message": "x"}')
    list(sync([*folders, *later, TrialFolder(failed)], None))
    client = connect(None, runs)
    ideas, below = shown(client)
    assert ideas["mine"].data.metrics["eval/psnr_dB"] == 30.0
    assert ideas["mine"].data.metrics["trials"] == 4
    old = [run for run in below["mine"] if "superseded" in run.data.tags]
    assert sorted(run.data.metrics["eval/psnr_dB"] for run in old) == [21.0, 21.0, 21.1, 21.1]
    assert [run.info.status for run in below["mine"]].count("FAILED") == 1
    # what is renewed again stays one run
    show_ideas(runs / "swept", None)
    assert len(shown(client)[0]) == 2


def test_a_users_description_is_kept(runs):
    write_sweep(runs, name="described")
    show_ideas(runs / "described", None)
    client = connect(None, runs)
    experiment = client.get_experiment_by_name("described")
    assert "volumetric" in experiment.tags[NOTE]
    client.set_experiment_tag(experiment.experiment_id, NOTE, "my own words")
    show_ideas(runs / "described", None)
    assert client.get_experiment_by_name("described").tags[NOTE] == "my own words"


def test_a_long_description_is_cut_at_a_line(tmp_path):
    write_sweep(tmp_path, tuple(f"arm{number:02}_{'x' * 40}" for number in range(20)))
    experiment = read_experiment(tmp_path / "swept")
    text = description(experiment, compare(experiment))
    assert len(text) <= 5000
    assert text.splitlines()[-1] == "`gsbench report swept` shows more."


def test_a_deleted_experiment_is_restored(runs):
    client = connect(None, runs)
    first = ensure_experiment(client, "gone", runs)
    client.delete_experiment(first)
    assert ensure_experiment(client, "gone", runs) == first
    assert client.get_experiment(first).lifecycle_stage == "active"


@pytest.mark.slow
def test_a_killed_process_leaves_no_incomplete_database(tmp_path):
    """A process that is killed while it makes the tables does not stop the next one."""
    code = (
        "import sys; from pathlib import Path; from gsbench.tracking import connect; "
        "connect(None, Path(sys.argv[1]))"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], env=child_environment())
    # not its journal, which comes and goes
    while bytes_written(tmp_path, ".mlflow.db.tmp-*[0-9]") == 0:
        assert process.poll() is None
        time.sleep(0.001)
    process.kill()
    process.wait()
    assert not (tmp_path / "mlflow.db").exists()
    assert connect(None, tmp_path).search_experiments()
    assert (tmp_path / "mlflow.db").exists()


@pytest.mark.slow
@pytest.mark.browser
def test_a_browser_shows_a_row_for_each_idea(tmp_path, monkeypatch):
    runs, port = tmp_path / "runs", free_port()
    list(sync(write_sweep(runs), None))
    server = f"http://127.0.0.1:{port}"
    page = addresses(server, show_ideas(runs / "swept", None))["ideas"]
    started = []
    popen = servers.subprocess.Popen
    monkeypatch.setattr(
        servers.subprocess, "Popen", lambda *a, **k: started.append(popen(*a, **k)) or started[-1]
    )
    words = split(f"swept --port {port}")
    thread = threading.Thread(target=servers.ui, args=(words, runs))
    # signals need the main thread
    monkeypatch.setattr(servers, "stop_on_signals", lambda: threading.Lock())
    thread.start()
    try:
        wait_until(lambda: servers._serves(server, "swept", page), pause=0.5)
        with Browser(page, tmp_path / "profile", (1500, 1000)) as browser:

            def text(picture):
                script = "document.body.innerText"
                found = browser.call("Runtime.evaluate", expression=script, returnByValue=True)
                return found["result"].get("value") or ""

            for name in ("volumetric", "\nadc\n"):
                browser.wait_until(lambda picture, name=name: name in text(picture), name)
            lines = text(None).splitlines()
            assert "adc" in lines
            assert not [line for line in lines if line.startswith("adc · courtyard")]
    finally:
        for process in started:
            process.terminate()
        thread.join(30)
