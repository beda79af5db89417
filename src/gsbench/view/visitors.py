"""Visitors that the viewer admits: its own page, and programs of this machine that are no page of a browser.

A browser lets any web page connect to this machine. Of a page it tells the server where it came from (``Origin``), and
what the server was called (``Host``), which a name of the page's own that leads here gives away (DNS rebinding).
"""

import http
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock
from urllib.parse import urlsplit

from gsbench.errors import GsbenchError

LOOPBACK = ("127.0.0.1", "localhost", "::1")
SERVE = "websockets.asyncio.server.serve"  # what viser starts its server with


def is_welcome(hosts: list[str], origins: list[str]) -> bool:
    """Return whether ``Host`` and ``Origin`` headers are those of the viewer's own page, or of no page.

    The port may be another one, as where a connection is forwarded, but page and server must have the same.
    """
    if len(hosts) != 1 or len(origins) > 1:
        return False
    try:
        if urlsplit(f"//{hosts[0]}").hostname not in LOOPBACK:
            return False
    except ValueError:  # such as an open bracket
        return False
    return not origins or origins[0] == f"http://{hosts[0]}"


@contextmanager
def only_welcome_visitors() -> Iterator[None]:
    """Let the server that viser starts within the block refuse all others, pages and connections alike.

    Raises GsbenchError where viser has started none in the way that is known here.
    """
    import websockets.asyncio.server
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    serve, started = websockets.asyncio.server.serve, []

    def guarded(*words: Any, process_request: Callable[..., Any] | None = None, **settings: Any) -> Any:
        def process(connection: Any, request: Any) -> Any:
            if not is_welcome(request.headers.get_all("Host"), request.headers.get_all("Origin")):
                return Response(http.HTTPStatus.FORBIDDEN, "FORBIDDEN", Headers(), b"")
            return None if process_request is None else process_request(connection, request)

        started.append(True)
        return serve(*words, process_request=process, **settings)

    with mock.patch(SERVE, guarded):
        yield
    if not started:
        raise GsbenchError("this version of viser cannot be kept from strange web pages: install viser 1.0 or 1.1")
