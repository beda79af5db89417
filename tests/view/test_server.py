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

from gsbench.raster import create_rasterizer
from gsbench.view import server
from gsbench.view.server import Session, Viewer, check_port
from gsbench.view.trials import find_trial, load_viewed
from tests.helpers import refusal
from tests.processes import wait_until
from tests.view.browser import Browser


@pytest.fixture(scope="module")
def trials(small_runs):
    cpu = torch.device("cpu")
    found = [find_trial(f"small:courtyard:{name}:0", small_runs) for name in ("adc", "volumetric")]
    return [load_viewed(trial, create_rasterizer("reference", cpu), cpu) for trial in found]


@pytest.fixture
def viewer(trials):
    pytest.importorskip("viser", reason="the viewer needs viser (extra view)")
    viewer = Viewer(trials, 0)
    yield viewer
    viewer.stop()


def test_page_answers_until_it_is_stopped(trials):
    pytest.importorskip("viser", reason="the viewer needs viser (extra view)")
    viewer = Viewer(trials[:1], 0)
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


def test_two_trials_and_their_photograph_share_one_camera(viewer, trials, monkeypatch):
    view = trials[0].views[1]
    picture = viewer.draw(view.camera, view)
    height, width = view.image.shape[:2]
    assert picture.shape == (height, 3 * width, 3)
    panes = [view.image, *(trial.draw(view.camera) for trial in trials)]
    for place, pane in enumerate(panes):
        # below the label, right of the dividing line
        assert_array_equal(picture[20:, place * width + 2 : (place + 1) * width], pane[20:, 2:])
    monkeypatch.setattr(server, "side_by_side", dict)
    labels = [f"courtyard random-{name} seed 0: 40 Gaussians" for name in ("adc", "volumetric")]
    assert list(viewer.draw(view.camera, None)) == labels
    assert list(viewer.draw(view.camera, view)) == ["photograph view001.png", *labels]


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
        assert chosen == (viewer.view,)
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
    viewer._view.value = "free"  # all pages are drawn again
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
    assert viewer.view is viewer.views["view000.png"]
    camera.aspect = None  # not known yet
    viewer._view.value = "view001.png"
    assert camera.position[0] == 1  # another page chose it
    viewer._go_to_view(SimpleNamespace(client=page))
    assert camera.position[0] == 2
    assert math.tan(camera.fov / 2) == pytest.approx(25.5 / 50 * 3)
    viewer._view.value = "free"
    viewer._go_to_view(SimpleNamespace(client=page))
    assert (camera.position[0], viewer.view, viewer.panes) == (2, None, 2)


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
