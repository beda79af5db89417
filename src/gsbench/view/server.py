"""The viewer's page: viser handles camera and controls, gsbench's rasterizers draw the pictures.

One trial fills the page; two are shown side by side from the same camera. Because all pictures are
drawn here, the page shows what was evaluated in any browser.

Only the viewer's own page and local programs that are not web pages may connect. A browser lets any
web page connect to servers of this machine. It sends the page's origin (``Origin``) and the name
under which the page called the server (``Host``), which reveals a foreign name that resolves to
this machine (DNS rebinding).
"""

import http
import logging
import math
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from unittest import mock
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gsbench.errors import GsbenchError, InputError
from gsbench.scene.types import Camera, View
from gsbench.view.trials import Picture, ViewedTrial, photograph_at, side_by_side

log = logging.getLogger(__name__)

HOST = "127.0.0.1"  # only this machine can connect
LOOPBACK = (HOST, "localhost", "::1")
SERVE = "websockets.asyncio.server.serve"  # the function with which viser starts its server
FREE_VIEW = "free"
MOVING_HEIGHT, RESTING_HEIGHT = 240, 540  # px of the picture while the camera moves, and at rest
REST_SECONDS = 0.25  # without a change, after which the sharp picture is drawn
MAX_ASPECT = 10.0  # of a page, whose width decides the size of the picture
MIN_FOV = 1e-3  # radians
MAX_DISTANCE = 1e9  # world units


class Viewer:
    """Serves ``trials`` (one or two) on a loopback port until ``stop``; port 0: a free one."""

    def __init__(self, trials: Sequence[ViewedTrial], port: int) -> None:
        import viser

        self.trials = tuple(trials)
        self.views: dict[str, View] = {view.name: view for view in trials[0].views}
        self.up = mean_up(trials[0].views)
        with refuse_other_pages():
            self.server: Any = viser.ViserServer(host=HOST, port=port, verbose=False)
        self.server.gui.configure_theme(
            control_layout="collapsible", show_logo=False, show_share_button=False
        )
        self.server.scene.set_up_direction(self.up)
        self._sessions: dict[int, Session] = {}
        self._view = self.server.gui.add_dropdown(
            "Test view", (FREE_VIEW, *self.views), initial_value=next(iter(self.views))
        )
        self._view.on_update(self._go_to_view)
        self.server.on_client_connect(self._connect)
        self.server.on_client_disconnect(self._disconnect)

    @property
    def url(self) -> str:
        return f"http://{HOST}:{self.server.get_port()}"

    @property
    def view(self) -> View | None:
        """The test view whose photograph is shown, if any."""
        return self.views.get(self._view.value)

    @property
    def panes(self) -> int:
        return len(self.trials) + (self.view is not None)

    def stop(self) -> None:
        """Close the page and end all drawing."""
        for session in list(self._sessions.values()):
            session.stop()
        self.server.stop()

    def draw(self, camera: Camera, view: View | None) -> Picture:
        """The page's picture from ``camera``: the photograph of ``view``, and each trial."""
        panes = [] if view is None else [(f"photograph {view.name}", photograph_at(camera, view))]
        for trial in self.trials:
            label = f"{trial.label}: {len(trial.gaussians):,} Gaussians"
            panes.append((label, trial.draw(camera)))
        return side_by_side(panes)

    def _go_to_view(self, event: Any) -> None:
        session = None if event.client is None else self._sessions.get(event.client.client_id)
        if self.view is not None and session is not None:
            session.go_to(self.view)
        for one in list(self._sessions.values()):
            one.wake()

    def _connect(self, client: Any) -> None:
        session = Session(self, client)
        self._sessions[client.client_id] = session
        session.go_to(self.view or next(iter(self.views.values())))
        session.start()

    def _disconnect(self, client: Any) -> None:
        session = self._sessions.pop(client.client_id, None)
        if session is not None:
            session.stop()


class Session:
    """One browser page; its thread draws coarsely while things change, sharply at rest."""

    def __init__(self, viewer: Viewer, client: Any) -> None:
        self.viewer, self.client = viewer, client
        self._changed, self._stopped = threading.Event(), threading.Event()
        self._thread = threading.Thread(
            target=self._loop, name=f"gsbench view {client.client_id}", daemon=True
        )
        client.camera.on_update(lambda _: self.wake())

    def start(self) -> None:
        self._changed.set()
        self._thread.start()

    def wake(self) -> None:
        self._changed.set()

    def stop(self) -> None:
        self._stopped.set()
        self._changed.set()
        if self._thread.is_alive():
            self._thread.join(timeout=10)

    def go_to(self, view: View) -> None:
        """Move the page's camera to that of ``view``, so that the whole view is seen."""
        own, camera = view.camera, self.client.camera
        aspect = float(camera.aspect or 1.0) / self.viewer.panes
        forward = own.rotation[2]  # [3] world
        with self.client.atomic():
            camera.up_direction = level_up(own, self.viewer.up)
            camera.position = own.center
            camera.look_at = own.center + forward * orbit_distance(list(self.viewer.views.values()))
            camera.fov = fitting_fov(own, aspect)

    def _loop(self) -> None:
        while not self._stopped.is_set():
            self._changed.wait()
            self._changed.clear()
            self._show(MOVING_HEIGHT)
            # A change within this time starts again with a coarse picture, which keeps up with it.
            if not self._changed.wait(REST_SECONDS):
                self._show(RESTING_HEIGHT)

    def _show(self, height: int) -> None:
        if self._stopped.is_set():
            return
        page = self.client.camera
        try:
            seen = (page.wxyz, page.position, page.fov, page.aspect)
            camera = page_camera(*seen, height, self.viewer.panes)
            image = self.viewer.draw(camera, self.viewer.view)
        except Exception as error:  # noqa: BLE001
            # A page may send any values, and they must not end this thread.
            log.debug("view: %r", error)
            return
        if not self._stopped.is_set():
            self.client.scene.set_background_image(image, format="jpeg", jpeg_quality=90)


def page_camera(
    wxyz: NDArray[np.float64],
    position: NDArray[np.float64],
    fov: float,
    aspect: float,
    height: int,
    panes: int,
) -> Camera:
    """The camera of one of ``panes`` equal panes of a page.

    ``wxyz`` rotates camera axes (x right, y down, z forward) to the world, and ``position`` [3] is
    in world units. ``fov`` is the vertical field of view in radians, ``aspect`` the page's width
    over its height, ``height`` in px. Raises ValueError for values that are no camera, or a page
    that is too wide.
    """
    numbers = np.concatenate([np.ravel(wxyz), np.ravel(position), [fov, aspect]]).astype(np.float64)
    length = float(np.linalg.norm(numbers[:4]))
    # A page may send any values. Each of them decides the memory of a picture, or is a divisor.
    if not np.isfinite(numbers).all() or np.abs(numbers).max() > MAX_DISTANCE or length < 1e-6:
        raise ValueError("the page has no camera")
    if not (MIN_FOV < fov < math.pi - MIN_FOV and 1 / MAX_ASPECT < aspect < MAX_ASPECT):
        raise ValueError(
            f"a page of {aspect:.3g} heights with a view of {fov:.3g} radians is not drawn"
        )
    world_from_camera = Rotation.from_quat(numbers[[1, 2, 3, 0]]).as_matrix()
    width = max(1, round(height * aspect / panes))
    focal = height / 2 / math.tan(fov / 2)
    rotation = world_from_camera.T
    translation = -rotation @ np.asarray(position)
    intrinsics = (focal, focal, width / 2, height / 2)
    return Camera(width, height, *intrinsics, rotation, translation)


def fitting_fov(camera: Camera, aspect: float) -> float:
    """The vertical angle (radians) at which a pane of ``aspect`` shows all that ``camera`` does."""
    half_height = max(camera.cy, camera.height - camera.cy) / camera.fy
    half_width = max(camera.cx, camera.width - camera.cx) / camera.fx
    return 2 * math.atan(max(half_height, half_width / aspect))


def mean_up(views: Sequence[View]) -> NDArray[np.float64]:
    """The mean upward direction of the cameras, a unit vector [3]."""
    up = -np.mean([view.camera.rotation[1] for view in views], axis=0)
    length = float(np.linalg.norm(up))
    return up / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])


def level_up(camera: Camera, up: NDArray[np.float64]) -> NDArray[np.float64]:
    """The unit vector [3] nearest to ``up`` that keeps the picture of ``camera`` upright.

    A page rotates around its upward direction. Around the camera's own one, the horizon would tilt.
    """
    right = camera.rotation[0]
    level = up - (up @ right) * right
    length = float(np.linalg.norm(level))
    upright = length > 1e-6 and float(level @ -camera.rotation[1]) > 0
    return level / length if upright else -camera.rotation[1]


def orbit_distance(views: Sequence[View]) -> float:
    """A page's distance to its pivot: the views' mean distance from their centre, world units."""
    centers = np.stack([view.camera.center for view in views])  # [V, 3]
    return max(float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).mean()), 1e-3)


def check_port(port: int) -> None:
    """Raise InputError if ``port`` cannot be used (0 means any free port)."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise InputError(
                f"port {port} cannot be used ({error.strerror}); give another --port"
            ) from None


def is_own_page(hosts: list[str], origins: list[str]) -> bool:
    """Return whether the headers are of the viewer's own page or of a program without a page.

    Any port is allowed, since connections may be forwarded, but both headers must have the same
    port.
    """
    # A second header could be read by one program and passed over by another.
    if len(hosts) != 1 or len(origins) > 1:
        return False
    try:
        if urlsplit(f"//{hosts[0]}").hostname not in LOOPBACK:
            return False
    except ValueError:  # not an address, for example with an open bracket
        return False
    return not origins or origins[0] == f"http://{hosts[0]}"


@contextmanager
def refuse_other_pages() -> Iterator[None]:
    """Make the server that viser starts within the block refuse foreign pages.

    Raises GsbenchError if viser did not start its server through `SERVE`.
    """
    import websockets.asyncio.server
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    serve, started = websockets.asyncio.server.serve, []

    def guarded(
        *words: Any, process_request: Callable[..., Any] | None = None, **settings: Any
    ) -> Any:
        def process(connection: Any, request: Any) -> Any:
            if not is_own_page(request.headers.get_all("Host"), request.headers.get_all("Origin")):
                return Response(http.HTTPStatus.FORBIDDEN, "FORBIDDEN", Headers(), b"")
            return None if process_request is None else process_request(connection, request)

        started.append(True)
        return serve(*words, process_request=process, **settings)

    # viser has no parameter for a check of requests, so the function that it calls is replaced
    # while it starts.
    with mock.patch(SERVE, guarded):
        yield
    if not started:
        raise GsbenchError(
            "other web pages could reach the viewer in this version of viser: install viser 1.1"
        )
