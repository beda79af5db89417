"""Access control of the viewer: only its own page and local programs that are not web pages may connect.

A browser lets any web page connect to servers of this machine. It sends the page's origin (``Origin``) and the name
under which the page called the server (``Host``), which reveals a foreign name that resolves to this machine (DNS
rebinding).
"""

import http
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock
from urllib.parse import urlsplit

from gsbench.errors import GsbenchError

LOOPBACK = ("127.0.0.1", "localhost", "::1")
SERVE = "websockets.asyncio.server.serve"  # the function with which viser starts its server


def is_own_page(hosts: list[str], origins: list[str]) -> bool:
    """Return whether ``Host`` and ``Origin`` headers belong to the viewer's own page or to a program without a page.

    Any port is allowed, since connections may be forwarded, but both headers must have the same port.
    """
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
    """Make the server that viser starts within the block refuse foreign pages, for files and for connections.

    Raises GsbenchError if viser did not start its server through `SERVE`.
    """
    import websockets.asyncio.server
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    serve, started = websockets.asyncio.server.serve, []

    def guarded(*words: Any, process_request: Callable[..., Any] | None = None, **settings: Any) -> Any:
        def process(connection: Any, request: Any) -> Any:
            if not is_own_page(request.headers.get_all("Host"), request.headers.get_all("Origin")):
                return Response(http.HTTPStatus.FORBIDDEN, "FORBIDDEN", Headers(), b"")
            return None if process_request is None else process_request(connection, request)

        started.append(True)
        return serve(*words, process_request=process, **settings)

    # viser has no parameter for a check of requests, so the function that it calls is replaced while it starts.
    with mock.patch(SERVE, guarded):
        yield
    if not started:
        raise GsbenchError("this version of viser cannot be kept from strange web pages: install viser 1.0 or 1.1")
