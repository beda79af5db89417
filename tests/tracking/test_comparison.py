"""The page of an experiment in MLflow answers which arm is better, also in a browser."""

import base64
import json
import threading
import time
import zlib
from pathlib import Path
from shlex import split
from types import SimpleNamespace

import mlflow
import numpy as np
import pytest
from PIL import Image

from gsbench.analysis.results import read_experiment
from gsbench.runs.trial_folder import TrialFolder
from gsbench.tracking import connect, publish
from gsbench.tracking.comparison import MAX_TAG, OWN_NOTE, _set, addresses, description
from gsbench.tracking.tracker_run import sync
from gsbench.verbs import servers
from tests.tracking.helpers import (
    begin_trial,
    ended_trial,
    found_runs,
    free_port,
    mirror_trial,
    options,
    run_of,
    write_trial,
)
from tests.trials import ask_about, trial_values, write_runs
from tests.view.browser import Browser

NOTE, VIEW = "mlflow.note.content", "mlflow.sharedViewState.gsbench"


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


def tags_of(client, name="swept"):
    return dict(client.get_experiment_by_name(name).tags)


def unpacked(tag):
    kind, _, data = tag.partition(";")
    assert kind == "deflate"
    return dict(json.loads(zlib.decompress(base64.b64decode(data))))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
def test_sync_makes_the_page_from_the_files(kind, tmp_path, request):
    uri = None if kind == "sqlite" else request.getfixturevalue("postgresql")
    folders = write_sweep(tmp_path / "runs")
    assert list(sync(folders, uri))[-1] == "8 trials mirrored now, 0 before"
    client = connect(uri, tmp_path / "runs")
    tags = tags_of(client)
    assert "| courtyard | a_init | volumetric | " in tags[NOTE]
    view = unpacked(tags[VIEW])
    assert view["groupBy"]["groupByKeys"] == [{"mode": "param", "groupByData": "arm"}]
    charted = {chart["metricKey"] for chart in view["compareRunCharts"]}
    names = set().union(*(run.data.metrics for run in found_runs(client, "swept")))
    assert {"eval/psnr_dB", "train/gaussians"} <= charted
    assert charted - {"train/gaussians"} <= names  # these files have no counts over iterations
    collapsed = {f"param.arm.{run.data.params['arm']}" for run in found_runs(client, "swept")}
    arms = {f"param.arm.{arm} · a_init" for arm in ("adc", "volumetric")}
    assert set(view["groupsExpanded"]) == collapsed == arms


def test_a_users_description_is_kept(runs):
    write_sweep(runs, name="described")
    publish(runs / "described", None)
    client = connect(None, runs)
    assert "volumetric" in tags_of(client, "described")[NOTE]
    experiment = client.get_experiment_by_name("described").experiment_id
    client.set_experiment_tag(experiment, NOTE, "my own words")
    publish(runs / "described", None)
    assert tags_of(client, "described")[NOTE] == "my own words"


def test_only_new_tags_are_sent_and_too_long_ones_are_left_out():
    sent = {}
    present = {VIEW: "same", NOTE: OWN_NOTE}
    client = SimpleNamespace(
        get_experiment=lambda experiment: SimpleNamespace(tags=present),
        set_experiment_tag=lambda experiment, key, value: sent.update({key: value}),
    )
    _set(client, "7", {VIEW: "same", NOTE: "a" * MAX_TAG})
    assert sent == {NOTE: "a" * MAX_TAG}
    sent.clear()
    _set(client, "7", {VIEW: "new", NOTE: "a" * (MAX_TAG + 1)})
    assert sent == {VIEW: "new"}


def test_a_description_begins_with_the_verdict(tmp_path):
    write_runs(tmp_path, effect={"psnr": 1.0}, trial_noise=0.05)
    ask_about(tmp_path)
    text = description(read_experiment(tmp_path / "exp"))
    assert text.startswith("**sfm-volumetric against sfm-adc: BETTER, PSNR (dB) +1.0")
    assert text.count("BETTER") == 2  # the first line, and that of the table
    assert "- BETTER: sfm-volumetric against sfm-adc: better in PSNR (dB) on these scenes" in text


def test_a_long_description_is_cut_at_a_line(tmp_path):
    write_sweep(tmp_path, tuple(f"arm{number:02}_{'x' * 40}" for number in range(20)))
    text = description(read_experiment(tmp_path / "swept"))
    assert len(text) <= 5000
    assert text.splitlines()[-1] == "`gsbench report swept` shows more."


@pytest.mark.parametrize("version", split("2.22.0 3.1.0 3.170.0 4.0.0"))
def test_other_versions_of_mlflow_get_the_plain_page(version):
    assert addresses("http://a/", "7", version) == {"experiment": "http://a/#/experiments/7"}


@pytest.mark.slow
def test_portrait_and_landscape_pictures_keep_their_sizes(runs):
    folder, values = ended_trial(runs, seed=2000)
    sizes = {"a": (8, 4), "b": (4, 8)}
    for kind in ("renders", "ground_truth"):
        (folder / kind).mkdir()
        for name, size in sizes.items():
            Image.new("RGB", size).save(folder / f"{kind}/{name}.png")
    assert mirror_trial(options(), folder, values)
    client = connect(None, runs)
    run = run_of(client, 2000)
    paths = [item.path for item in client.list_artifacts(run.info.run_id, "images")]
    names = [path for path in paths if path.endswith(".png")]
    assert len(names) == 6
    for name in names:
        with Image.open(client.download_artifacts(run.info.run_id, name)) as image:
            assert image.size == sizes[Path(name).name[0]]


@pytest.mark.slow
@pytest.mark.browser
def test_a_browser_shows_the_arms_as_groups_and_a_chart(tmp_path, monkeypatch):
    runs, port = tmp_path / "runs", free_port()
    list(sync(write_sweep(runs), None))
    server = f"http://127.0.0.1:{port}"
    page = addresses(server, publish(runs / "swept", None), mlflow.__version__)["arms"]
    started = []
    popen = servers.subprocess.Popen
    monkeypatch.setattr(
        servers.subprocess, "Popen", lambda *a, **k: started.append(popen(*a, **k)) or started[-1]
    )
    words = split(f"swept --port {port} --no-browser")
    thread = threading.Thread(target=servers.ui, args=(words, runs))
    # signals need the main thread
    monkeypatch.setattr(servers, "stop_on_signals", lambda: threading.Lock())
    thread.start()
    try:
        deadline = time.monotonic() + 120
        while not servers._serves(server, "swept", page):
            assert time.monotonic() < deadline
            time.sleep(0.5)
        with Browser(page, tmp_path / "profile", (1500, 1000)) as browser:

            def evaluated(script):
                found = browser.call("Runtime.evaluate", expression=script, returnByValue=True)
                return found["result"].get("value")

            bars = (
                "[...document.querySelectorAll('.barlayer .point path')].filter(p => "
                "p.getBBox().width > 5).length"
            )
            browser.wait_until(
                lambda picture: (evaluated(bars) or 0) >= 4, "two bars in each of two charts"
            )
            text = evaluated("document.body.innerText")
            assert "Group: adc · a_init" in text
            assert "Group: volumetric · a_init" in text
            assert "viewing a shared view" in text
            assert np.ptp(browser.picture()) > 0
    finally:
        for process in started:
            process.terminate()
        thread.join(30)
