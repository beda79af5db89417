"""A file server on loopback that can imitate faults of real servers."""

import re
import threading
import time
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import MappingProxyType, SimpleNamespace

RANGE = re.compile(r"bytes=(\d*)-(\d*)")


class Manners:
    """How the server behaves. ``cut_every`` and ``stall_every`` count the bytes of a body."""

    ranges = True
    cut_every = stall_every = None
    cuts = 1_000_000  # how many bodies are cut or stalled
    claimed_size = None  # a wrong length of the file, sent in headers
    damage = None  # (path, offset, body) -> body
    status = MappingProxyType({})  # path -> error status instead of the file
    fail_first = 0  # number of requests that get 503 first
    redirect = False
    shift = 0  # bytes by which the start of a range is wrong

    def __init__(self, **changes):
        vars(self).update(changes)


@contextmanager
def serve(folder):
    """Serve the files of ``folder`` while the block runs.

    Yields its ``url``, its ``manners``, the ``requests`` as (path, range), and the bytes ``sent``.
    """

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *_):
            return

        def end_headers(self):
            self.send_header("Connection", "close")
            super().end_headers()

        def do_GET(self):
            manners = state.manners
            asked = self.headers.get("Range", "")
            state.requests.append((self.path, asked))
            if manners.fail_first:
                manners.fail_first -= 1
                self.send_error(503)
                return
            if manners.redirect and not self.path.startswith("/moved"):
                self.send_response(302)
                self.send_header("Location", f"/moved{self.path}")
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            path = self.path.removeprefix("/moved")
            if path in manners.status:
                self.send_error(manners.status[path])
                return
            file = folder / path.lstrip("/")
            if not file.is_file():
                self.send_error(404)
                return
            size = file.stat().st_size
            first, last = 0, size - 1
            partial = manners.ranges and (match := RANGE.fullmatch(asked)) is not None
            if partial:
                if match[1]:
                    first = int(match[1]) + manners.shift
                    last = min(int(match[2] or last), last)
                else:  # the last bytes
                    first = max(0, size - int(match[2]))
                if first > last:
                    self.send_error(416)
                    return
            self.send_response(206 if partial else 200)
            claimed = manners.claimed_size or size
            self.send_header("Content-Length", str(last - first + 1 + claimed - size))
            if partial:
                self.send_header("Content-Range", f"bytes {first}-{last}/{claimed}")
            self.end_headers()
            self.body(path, file, first, last + 1)

        def body(self, path, file, first, end):
            manners = state.manners
            with file.open("rb") as stream:
                stream.seek(first)
                position = first
                while position < end:
                    data = stream.read(min(1 << 14, end - position))
                    if manners.damage is not None:
                        data = manners.damage(path, position, data)
                    limit = manners.cut_every or manners.stall_every
                    beyond = limit is not None and position + len(data) - first > limit
                    stop = beyond and manners.cuts > 0
                    if stop:
                        data = data[: max(0, limit - (position - first))]
                    try:
                        self.wfile.write(data)
                    except OSError:  # the client has closed the connection
                        return
                    state.sent += len(data)
                    position += len(data)
                    if stop:
                        manners.cuts -= 1
                        if manners.stall_every:
                            time.sleep(1.0)  # longer than the clients of the tests wait
                        return

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    state = SimpleNamespace(folder=folder, manners=Manners(), requests=[], sent=0)
    state.url = f"http://127.0.0.1:{server.server_port}"
    threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
    try:
        yield state
    finally:
        server.shutdown()
        server.server_close()
