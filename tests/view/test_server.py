"""The viewer on finished trials: what it draws, and how its page starts and stops."""

from __future__ import annotations

import contextlib
import re
import socket
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from gsbench.errors import InputError
from gsbench.events import Cause
from gsbench.raster import create_rasterizer
from gsbench.system.install import install_command
from gsbench.verbs import servers
from gsbench.view.server import Session, Viewer, check_port
from gsbench.view.trials import Layers, TrialPainter, find_trial, load_viewed, read_causes
from tests.view.browser import Browser

pytestmark = pytest.mark.slow
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def painters(small_runs: Path) -> list[TrialPainter]:
    rasterizer = create_rasterizer("cpu", CPU)
    trials = [find_trial(f"small:courtyard:{name}:0", small_runs) for name in ("adc", "volumetric")]
    return [TrialPainter(load_viewed(trial, CPU), rasterizer) for trial in trials]


@pytest.fixture
def viewer(painters: list[TrialPainter]) -> Iterator[Viewer]:
    pytest.importorskip("viser", reason="the viewer needs viser (extra view)")
    viewer = Viewer(painters, 0)
    yield viewer
    viewer.stop()


def test_drawing_a_test_view_gives_the_trials_own_render(
    small_runs: Path, painters: list[TrialPainter]
) -> None:
    for painter, name in zip(painters, ("adc", "volumetric"), strict=True):
        trial = find_trial(f"small:courtyard:{name}", small_runs)
        assert [view.name for view in painter.trial.views] == ["0000.png", "0008.png"]
        for view in painter.trial.views:
            render = np.asarray(Image.open(trial.path / "renders" / view.name))
            np.testing.assert_array_equal(painter.draw(view.camera, Layers()), render)
            photograph = np.asarray(Image.open(trial.path / "ground_truth" / view.name))
            np.testing.assert_array_equal(view.image, photograph)


def test_large_gaussians_are_shown_in_the_colour_of_their_cause(
    painters: list[TrialPainter],
) -> None:
    painter = painters[1]
    trial = painter.trial
    volumes = 4 / 3 * np.pi * trial.gaussians.scales.double().prod(-1).numpy()
    threshold = float(np.quantile(np.log10(volumes), 0.98))
    chosen = painter.above(threshold)
    assert sorted(chosen) == sorted(np.flatnonzero(volumes > 10**threshold))
    counts = painter.counts_above(threshold)
    assert sum(counts.values()) == len(chosen)
    camera = trial.views[0].camera
    plain = painter.draw(camera, Layers(causes=True, log10_volume=99.0))
    np.testing.assert_array_equal(plain, painter.draw(camera, Layers()))
    picture = painter.draw(camera, Layers(causes=True, log10_volume=threshold)).astype(float)
    large = trial.gaussians.select(torch.from_numpy(chosen))
    with torch.no_grad():
        alpha = painter.rasterizer.render(large, camera, 0, torch.zeros(3)).alpha.numpy()[..., None]
    colors = (picture - 0.35 * (1 - alpha) * plain) / alpha.clip(1e-6)
    seen = colors[alpha[..., 0] > 0.2]  # mixtures of the causes' colours
    hues = np.array([cause.color for cause in Cause if counts[cause]], float)
    assert len(seen)
    assert (seen > hues.min(axis=0) - 8).all()
    assert (seen < hues.max(axis=0) + 8).all()


def test_page_answers_until_it_is_stopped(painters: list[TrialPainter]) -> None:
    pytest.importorskip("viser", reason="the viewer needs viser (extra view)")
    viewer = Viewer(painters[:1], 0)
    assert viewer.url.startswith("http://127.0.0.1:")
    with urllib.request.urlopen(viewer.url, timeout=20) as answer:
        assert answer.status == 200
        assert b"<html" in answer.read().lower()
    viewer.stop()
    deadline = time.monotonic() + 20
    with contextlib.suppress(OSError):  # refused, or cut
        while time.monotonic() < deadline:
            urllib.request.urlopen(viewer.url, timeout=2).close()
            time.sleep(0.2)
    assert time.monotonic() < deadline, "the page still answers after stop"


def test_two_trials_and_their_photograph_share_one_camera(
    viewer: Viewer, painters: list[TrialPainter]
) -> None:
    view = painters[0].trial.views[1]
    picture = viewer.draw(view.camera, viewer.layers(), view)
    height, width = view.image.shape[:2]
    assert picture.shape == (height, 3 * width, 3)
    panes = [view.image, *(painter.draw(view.camera, Layers()) for painter in painters)]
    for place, pane in enumerate(panes):
        # below the label, right of the dividing line
        shown = picture[12:, place * width + 2 : (place + 1) * width]
        np.testing.assert_array_equal(shown, pane[12:, 2:])


def test_drawing_continues_after_a_page_sends_nonsense(viewer: Viewer) -> None:
    shown: list[np.ndarray] = []
    seen = {"wxyz": (0, 0, 0, 0), "position": (np.nan, 0, 0), "fov": 0.9, "aspect": 1e6}
    camera = SimpleNamespace(on_update=lambda _: None, **seen)
    scene = SimpleNamespace(set_background_image=lambda image, **_: shown.append(image))
    page = SimpleNamespace(client_id=0, camera=camera, scene=scene)
    session = Session(viewer, page)
    session.start()
    viewer._degree.value = 10**6
    session.wake()
    time.sleep(1)
    assert not shown
    page.camera.wxyz, page.camera.position, page.camera.aspect = (1, 0, 0, 0), (0, 0, -3), 1.5
    session.wake()
    deadline = time.monotonic() + 60
    while not shown and time.monotonic() < deadline:
        time.sleep(0.1)
    session.stop()
    assert shown


@pytest.mark.browser
def test_page_shows_the_trials_in_a_browser(viewer: Viewer, tmp_path: Path) -> None:
    with Browser(viewer.url, tmp_path) as browser:
        # Without the controls and the browser's own notes.
        browser.wait_until(lambda page: bool(page[150:, :800].std() > 20), "the trials")


def test_a_wrong_address_of_a_trial_is_refused_with_the_right_ones(
    small_runs: Path, tmp_path: Path
) -> None:
    folder = find_trial("small:courtyard:adc", small_runs).path
    assert find_trial(str(folder), tmp_path).path == folder
    assert find_trial("small:courtyard:random-adc:0", small_runs).path == folder
    for address, words in {
        "small:courtyard:mcmc": "small:courtyard:random-adc:0",
        "small:courtyard:adc:7": "small:courtyard:random-adc:0",
        "small": "EXPERIMENT:SCENE:DENSIFY",
        "nothing:courtyard:adc": "nothing",
        str(folder.parent): "not a",
    }.items():
        with pytest.raises(InputError, match=words):
            find_trial(address, small_runs)
    with pytest.raises(InputError, match=r"lineage\.npz"):
        read_causes(folder / "lineage.npz", 1)


def test_without_viser_the_error_names_the_install_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(InputError, match=re.escape(install_command("view"))):
        servers.view(["a:b:c"], Path())
    with pytest.raises(InputError, match="one or two"):
        servers.view(["a:b:c"] * 3, Path())


def test_a_port_in_use_is_refused() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(InputError, match="--port"):
            check_port(taken.getsockname()[1])
