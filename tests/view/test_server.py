"""The viewer on finished trials: what it draws, and how its page starts and stops."""

import contextlib
import math
import socket
import threading
import time
import urllib.request
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from gsbench.events import Cause
from gsbench.raster import create_rasterizer
from gsbench.view import server
from gsbench.view.server import Session, Viewer, check_port
from gsbench.view.trials import Layers, TrialPainter, find_trial, load_viewed
from tests.helpers import refusal
from tests.view.browser import Browser


@pytest.fixture(scope="module")
def painters(small_runs):
    cpu = torch.device("cpu")
    trials = [find_trial(f"small:courtyard:{name}:0", small_runs) for name in ("adc", "volumetric")]
    rasterizer = create_rasterizer("reference", cpu)
    return [TrialPainter(load_viewed(trial, cpu), rasterizer) for trial in trials]


@pytest.fixture
def viewer(painters):
    pytest.importorskip("viser", reason="the viewer needs viser (extra view)")
    viewer = Viewer(painters, 0)
    yield viewer
    viewer.stop()


def wait_until(condition):
    deadline = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.005)


def test_page_answers_until_it_is_stopped(painters):
    pytest.importorskip("viser", reason="the viewer needs viser (extra view)")
    viewer = Viewer(painters[:1], 0)
    assert viewer.url.startswith("http://127.0.0.1:")
    with urllib.request.urlopen(viewer.url, timeout=20) as answer:
        assert answer.status == 200
        assert b"<html" in answer.read().lower()
    stopped = []
    viewer._sessions[3] = SimpleNamespace(stop=lambda: stopped.append("page"))
    viewer.stop()
    assert stopped == ["page"]

    def is_gone():
        try:
            urllib.request.urlopen(viewer.url, timeout=2).close()
        except OSError:  # refused, or cut
            return True
        return False

    wait_until(is_gone)


def test_two_trials_and_their_photograph_share_one_camera(viewer, painters, monkeypatch):
    view = painters[0].trial.views[1]
    picture = viewer.draw(view.camera, Layers(), view)
    height, width = view.image.shape[:2]
    assert picture.shape == (height, 3 * width, 3)
    panes = [view.image, *(painter.draw(view.camera, Layers()) for painter in painters)]
    for place, pane in enumerate(panes):
        # below the label, right of the dividing line
        assert_array_equal(picture[20:, place * width + 2 : (place + 1) * width], pane[20:, 2:])
    monkeypatch.setattr(server, "side_by_side", dict)
    labels = [f"courtyard random-{name} seed 0: 40 Gaussians" for name in ("adc", "volumetric")]
    assert list(viewer.draw(view.camera, Layers(), None)) == labels
    assert list(viewer.draw(view.camera, Layers(), view)) == ["photograph view001.png", *labels]


def test_controls_choose_what_is_drawn_and_wake_the_pages(viewer):
    woken = []
    viewer._sessions[7] = SimpleNamespace(wake=lambda: woken.append(1), stop=lambda: None)
    first, second = viewer.views.values()
    assert viewer.layers() == Layers(3, 100.0, False, -1.523, False)
    assert (viewer.resting_height, viewer.photograph()) == (540, first)
    degree, share, threshold = viewer._degree, viewer._share, viewer._threshold
    assert (degree.min, degree.max, degree.step) == (0, 3, 1)
    assert (share.min, share.max, share.step) == (1, 100, 1)
    volumes = np.concatenate([painter.trial.log10_volumes for painter in viewer.painters])
    assert volumes.max() < -2  # and the slider begins at -1.523
    assert (threshold.min, threshold.max) == (math.floor(volumes.min()), -1)
    flags = [(viewer._cloud, True), (viewer._causes, True)]
    changes = [(degree, 0), (share, 50), (threshold, -2.0), *flags]
    for count, (control, value) in enumerate(changes, start=1):
        control.value = value
        assert len(woken) == count
    assert viewer.layers() == Layers(0, 50.0, True, -2.0, True)
    for sent, used in ((-5, 0), (10**6, 3)):  # a page may send any value
        degree.value = sent
        assert viewer.layers().sh_degree == used
    for height, pixels in (("810", 810), ("99999", 270)):
        viewer._height.value = height
        assert viewer.resting_height == pixels
    for name, beside, wanted in (("free", True, None), (second.name, True, second)):
        viewer._view.value, viewer._beside.value = name, beside
        assert viewer.photograph() is wanted
    viewer._beside.value = False
    assert viewer.photograph() is None
    assert len(woken) == 12  # once for each change


def test_the_legend_counts_the_large_gaussians_of_each_trial_by_cause(viewer):
    one, other = (painter.trial for painter in viewer.painters)
    one.causes[:], other.causes[:] = Cause.CLONE, Cause.CLONE
    threshold = round(float(np.sort(one.log10_volumes)[-4]) - 5e-4, 3)  # four of one are larger
    one.causes[one.log10_volumes.argmax()] = Cause.ADDED
    larger = (other.log10_volumes > threshold).sum()
    viewer._threshold.value = threshold
    assert viewer._legend.content == (
        f"V > {10**threshold:.3g}<br><span style='color:#56b4e9'>&#9679;</span> clone: 3 | "
        f"{larger}<br><span style='color:#0072b2'>&#9679;</span> added: 1 | 0"
    )


def make_page(shown, **camera):
    """A stand-in for a browser page; ``moves`` are called when its camera moves."""
    moves = []
    seen = {"wxyz": (1, 0, 0, 0), "position": (0, 0, -3), "fov": 0.9, "aspect": 1.5} | camera
    return SimpleNamespace(
        client_id=5,
        moves=moves,
        atomic=contextlib.nullcontext,
        camera=SimpleNamespace(on_update=moves.append, **seen),
        scene=SimpleNamespace(set_background_image=lambda image, **_: shown.append(image)),
    )


def test_a_page_is_drawn_coarsely_while_it_moves_and_sharply_once_at_rest(viewer, monkeypatch):
    monkeypatch.setattr(server, "REST_SECONDS", 0.01)
    shown = []
    drawn = []
    page = make_page(shown)

    def draw(camera, *chosen):
        assert chosen == (viewer.layers(), viewer.photograph())
        drawn.append((camera.width, camera.height))
        if len(drawn) == 1:
            page.moves[0](None)
        return drawn[-1]

    monkeypatch.setattr(viewer, "draw", draw)
    viewer._connect(page)
    wait_until(lambda: len(shown) == 3)
    time.sleep(0.03)
    # three panes share the page's width of 1.5 heights
    assert drawn == shown == [(120, 240), (120, 240), (270, 540)]
    viewer._redraw()
    wait_until(lambda: len(shown) == 5)
    viewer._disconnect(page)
    assert not viewer._sessions
    assert "gsbench view 5" not in {thread.name for thread in threading.enumerate()}
    viewer._disconnect(page)  # of a page that is not known


def test_a_page_moves_to_the_view_that_it_chooses(viewer):
    page = make_page([])
    session = viewer._sessions[5] = Session(viewer, page)
    session.go_to(viewer.views["view000.png"])
    camera = page.camera
    assert_allclose(camera.position, [1, 2, 0])
    assert_allclose(camera.look_at, [1, 2, 0.5])  # the cameras' distance from their mean
    assert_allclose(camera.up_direction, [0, -1, 0])
    # the picture reaches 33.5 px beside its principal point, and its focal length is 50 px
    assert math.tan(camera.fov / 2) == pytest.approx(33.5 / 50 / (1.5 / 3))
    camera.aspect = None  # not known yet
    viewer._view.value = "view001.png"
    assert camera.position[0] == 1  # another page chose it
    viewer._go_to_view(SimpleNamespace(client=page))
    assert camera.position[0] == 2
    assert math.tan(camera.fov / 2) == pytest.approx(25.5 / 50 * 3)
    viewer._view.value = "free"
    viewer._go_to_view(SimpleNamespace(client=page))
    assert camera.position[0] == 2


def test_nonsense_of_a_page_is_not_drawn_and_nothing_is_once_it_is_closed(viewer):
    shown = []
    page = make_page(shown, wxyz=(0, 0, 0, 0), position=(np.nan, 0, 0), aspect=1e6)
    session = Session(viewer, page)
    session._show(24)
    assert not shown
    page.camera.wxyz, page.camera.position, page.camera.aspect = (1, 0, 0, 0), (0, 0, -3), 1.5
    session._show(24)
    assert [picture.shape for picture in shown] == [(24, 3 * 12, 3)]
    draw = viewer.draw

    def closing(*words):
        session.stop()
        return draw(*words)

    viewer.draw = closing
    session._show(24)
    viewer.draw = pytest.fail
    session._show(24)
    assert len(shown) == 1


@pytest.mark.slow
@pytest.mark.browser
def test_page_shows_the_trials_in_a_browser(viewer, tmp_path):
    with Browser(viewer.url, tmp_path) as browser:
        # Without the controls and the browser's own notes.
        browser.wait_until(lambda page: bool(page[150:, :800].std() > 20), "the trials")


def test_a_port_in_use_is_refused_and_one_that_was_just_left_is_not():
    with socket.socket() as taken:
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with refusal(f"port {port} cannot be used .*--port"):
            check_port(port)
        with socket.create_connection(("127.0.0.1", port)):
            taken.accept()[0].close()  # the server ends first, so the port stays in TIME_WAIT
    check_port(port)
