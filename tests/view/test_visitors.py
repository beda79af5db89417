"""The viewer answers requests of its own page and of programs, and of no other page."""

import http.client

import pytest

from gsbench.errors import GsbenchError
from gsbench.view.server import is_own_page, refuse_other_pages

WELCOME = [
    (["127.0.0.1:8080"], []),
    (["127.0.0.1:8080"], ["http://127.0.0.1:8080"]),
    (["localhost:9000"], ["http://localhost:9000"]),  # a port that ssh forwards
    (["[::1]:8080"], ["http://[::1]:8080"]),
]
UNWELCOME = [
    (["127.0.0.1:8080"], ["https://strange.example"]),  # a page of the web
    (["127.0.0.1:8080"], ["null"]),  # a page of a file, or in a sandbox
    (["127.0.0.1:8080"], ["http://127.0.0.1:3000"]),  # a page of another program of this machine
    (["127.0.0.1:8080"], ["http://127.0.0.1:8080.strange.example"]),
    (["127.0.0.1:8080"], ["http://strange.example#http://127.0.0.1:8080"]),
    # DNS rebinding: the page's own name leads here
    (["strange.example:8080"], ["http://strange.example:8080"]),
    (["strange.example:8080"], []),
    (["127.0.0.1.strange.example"], []),
    (["localhost.strange.example"], []),
    (["strange.example@127.0.0.1:8080"], ["http://strange.example"]),
    (["127.0.0.1:8080@strange.example"], []),
    ([""], []),
    ([], []),
    (["127.0.0.1:8080", "strange.example"], []),
    (["127.0.0.1:8080"], ["http://127.0.0.1:8080", "https://strange.example"]),
    (["[::1"], []),
    (["0.0.0.0:8080"], ["http://0.0.0.0:8080"]),  # which some browsers take for this machine
]


@pytest.mark.parametrize("hosts, origins", WELCOME + UNWELCOME)
def test_only_the_own_page_and_programs_are_accepted(hosts, origins):
    assert is_own_page(hosts, origins) == ((hosts, origins) in WELCOME)


@pytest.fixture(scope="module")
def server():
    viser = pytest.importorskip("viser", reason="the viewer needs viser (extra view)")
    with refuse_other_pages():
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server
    server.stop()


def answer(server, hosts, origins, upgrade):
    """The status that a server gives to a request with these headers."""
    connection = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=60)
    connection.putrequest("GET", "/", skip_host=True)
    for host in hosts:
        connection.putheader("Host", host)
    for origin in origins:
        connection.putheader("Origin", origin)
    if upgrade:
        headers = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
        for name, value in (headers | {"Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ=="}).items():
            connection.putheader(name, value)
    connection.endheaders()
    status = connection.getresponse().status
    connection.close()
    return status


@pytest.mark.parametrize("upgrade", [False, True], ids=["page", "connection"])
def test_the_running_server_accepts_the_same_requests(server, upgrade):
    for headers in WELCOME + UNWELCOME:
        allowed = {101 if upgrade else 200} if headers in WELCOME else {400, 403}
        assert answer(server, *headers, upgrade) in allowed, headers


def test_an_unguarded_server_is_refused():
    pytest.importorskip("viser", reason="the viewer needs viser (extra view)")
    with (
        pytest.raises(GsbenchError, match="other web pages could reach the viewer"),
        refuse_other_pages(),
    ):
        pass  # a server that starts here would not be guarded
