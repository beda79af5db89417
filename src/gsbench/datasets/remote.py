"""A file on an HTTP server, read like a local one: in pieces where the server serves ranges, else whole.

Every piece is counted and compared with what the server said at first: a connection that is cut or stalls is taken up
where it stopped, and a file that changes in between is an error, never a mixture.
"""

from __future__ import annotations

import hashlib
import http.client
import io
import logging
import re
import ssl
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from gsbench.errors import GsbenchError, InputError
from gsbench.files import CHUNK

T = TypeVar("T")
log = logging.getLogger(__name__)

PARTIAL = 206
TRANSIENT = (408, 425, 429, 500, 502, 503, 504)  # the server may do better in a moment
MAX_PAUSE_SECONDS = 30.0
TAIL_BYTES = 1 << 17  # of a zip file: the end record, the longest comment (64 KiB), and a small directory
CONTENT_RANGE = re.compile(r"bytes (\d+)-(\d+)/(\d+)")
PROGRESS_BYTES = 1 << 12  # a failure after fewer bytes than these counts as one more in a row


class FetchError(GsbenchError):
    """Error of the network or the server (exit code 1); the same command goes on from here."""


class RangesRefusedError(Exception):
    """Error of a server that sends whole files only."""


@dataclass(frozen=True)
class Patience:
    """Limits of waiting for a server: seconds without a byte, and failures in a row (each waits twice as long)."""

    timeout: float = 30.0
    tries: int = 5
    pause: float = 1.0  # seconds before the second try

    def wait(self, failures: int, reason: str) -> None:
        seconds = min(MAX_PAUSE_SECONDS, self.pause * 2 ** (failures - 1))
        log.info("%s: trying again in %.3g s", reason, seconds)
        time.sleep(seconds)


class RemoteFile(io.RawIOBase):
    """The file at ``url``, read by ranges. Raises ``RangesRefusedError`` at once where the server refuses them.

    Reads that follow one another share a connection: ``expect`` says how far a run of them will go.
    """

    def __init__(self, url: str, patience: Patience | None = None) -> None:
        super().__init__()
        self.url = url
        self.patience = patience or Patience()
        self.identity = ""  # what the server says of this version of the file
        self._position = 0
        self._expected_end = 0
        self._stream: http.client.HTTPResponse | None = None
        self._stream_position = self._stream_end = 0
        self._tail = b""
        self.size = _retried(self._first_answer, url, self.patience)
        self._tail_start = max(0, self.size - TAIL_BYTES)
        self._tail = self._fetch(self._tail_start, self.size - self._tail_start)

    def seekable(self) -> bool:
        return True

    def readable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._position

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self.size}[whence]
        if start + offset < 0:
            raise OSError("seek before the start of the file")  # as a local file, which zipfile relies on
        self._position = start + offset
        return self._position

    def expect(self, end: int) -> None:
        """Say that the coming reads go on up to the byte ``end``."""
        self._expected_end = min(end, self.size)

    def read(self, size: int = -1) -> bytes:
        count = max(0, self.size - self._position)
        if size is not None and size >= 0:
            count = min(count, size)
        if count and self._tail and self._position >= self._tail_start:
            offset = self._position - self._tail_start
            data = self._tail[offset : offset + count]
        else:
            data = self._fetch(self._position, count)
        self._position += len(data)
        return data

    def close(self) -> None:
        self._drop()
        super().close()

    def _fetch(self, start: int, count: int) -> bytes:
        data = bytearray()
        failures, failed_at = 0, 0
        while len(data) < count:
            try:
                piece = self._at(start + len(data), count - len(data)).read1(min(CHUNK, count - len(data)))
                if not piece:
                    raise http.client.IncompleteRead(b"", count - len(data))
            except RETRIED as error:
                self._drop()
                failures = failures + 1 if len(data) - failed_at < PROGRESS_BYTES else 1
                failed_at = len(data)
                _give_up_or_wait(error, failures, self.url, self.patience)
                continue
            data += piece
            self._stream_position += len(piece)
        return bytes(data)

    def _at(self, position: int, count: int) -> http.client.HTTPResponse:
        """A connection that delivers the bytes from ``position`` on, ``count`` of them at least."""
        if self._stream is not None and (self._stream_position != position or position >= self._stream_end):
            self._drop()
        if self._stream is None:
            end = max(position + count, self._expected_end)
            self._stream = self._request(position, end)
            self._stream_position, self._stream_end = position, end
        return self._stream

    def _request(self, start: int, end: int) -> http.client.HTTPResponse:
        response = _open(self.url, self.patience.timeout, {"Range": f"bytes={start}-{end - 1}"})
        try:
            match = CONTENT_RANGE.match(response.headers.get("Content-Range", ""))
            if response.status != PARTIAL or match is None:
                raise FetchError(f"{self.url}: the server no longer serves ranges: try again, or give another --mirror")
            first, _, size = map(int, match.groups())
            if (size, _identity(response)) != (self.size, self.identity):
                raise FetchError(f"{self.url} has changed while it was being fetched: the same command starts anew")
            if first != start:
                raise FetchError(f"{self.url}: the server sent bytes from {first} on, not from {start} as asked")
        except BaseException:
            response.close()
            raise
        return response

    def _first_answer(self) -> int:
        """Ask for the first byte only: this tells size and version, and whether ranges are served."""
        with _open(self.url, self.patience.timeout, {"Range": "bytes=0-0"}) as response:
            match = CONTENT_RANGE.match(response.headers.get("Content-Range", ""))
            if response.status != PARTIAL or match is None:
                raise RangesRefusedError
            self.identity = _identity(response)
            return int(match.group(3))

    def _drop(self) -> None:
        if self._stream is not None:
            self._stream.close()
            self._stream = None


def download(url: str, target: Path, patience: Patience, advance: Callable[[int, int | None], None]) -> str:
    """The whole file at ``url`` into ``target``; returns its sha256. ``advance`` gets the bytes so far and in all.

    For servers that refuse ranges: what is cut starts from the beginning.
    """

    def once() -> str:
        digest, done = hashlib.sha256(), 0
        with _open(url, patience.timeout, {}) as response, target.open("wb") as file:
            length = response.headers.get("Content-Length")
            total = int(length) if length and length.isdigit() else None
            while piece := response.read1(CHUNK):
                file.write(piece)
                digest.update(piece)
                done += len(piece)
                advance(done, total)
        if total is not None and done != total:
            raise http.client.IncompleteRead(b"", total - done)
        return digest.hexdigest()

    return _retried(once, url, patience)


def size_of(url: str, patience: Patience) -> int | None:
    """The size of the file at ``url`` in bytes, where the server says so."""

    def once() -> int | None:
        with _open(url, patience.timeout, {}) as response:
            length = response.headers.get("Content-Length")
            return int(length) if length and length.isdigit() else None

    return _retried(once, url, patience)


RETRIED = (TimeoutError, ConnectionError, http.client.HTTPException, urllib.error.URLError)


def _retried(action: Callable[[], T], url: str, patience: Patience) -> T:
    failures = 0
    while True:
        try:
            return action()
        except RETRIED as error:
            failures += 1
            _give_up_or_wait(error, failures, url, patience)


def _give_up_or_wait(error: Exception, failures: int, url: str, patience: Patience) -> None:
    """Wait before the next try; raises where there is none: the server said no, or failed too often."""
    if isinstance(error, urllib.error.HTTPError) and error.code not in TRANSIENT:
        raise InputError(f"{url}: the server says {error.code} {error.reason}: give another address with --mirror")
    if isinstance(getattr(error, "reason", None), ssl.SSLCertVerificationError):
        raise InputError(f"{url}: the certificate is not trusted here ({_reason(error)}): mend it, or give --mirror")
    if failures >= patience.tries:
        raise FetchError(
            f"{url}: {failures} failures in a row ({_reason(error)}): the same command goes on from here"
        ) from error
    patience.wait(failures, _reason(error))


def _reason(error: Exception) -> str:
    if isinstance(error, http.client.IncompleteRead):
        return "the connection was cut"
    if isinstance(error, TimeoutError) or isinstance(getattr(error, "reason", None), TimeoutError):
        return "no answer in time"
    return str(getattr(error, "reason", error)) or type(error).__name__


def _open(url: str, timeout: float, headers: dict[str, str]) -> http.client.HTTPResponse:
    request = urllib.request.Request(url, headers={"Accept-Encoding": "identity", "User-Agent": "gsbench"} | headers)
    response: http.client.HTTPResponse = urllib.request.urlopen(request, timeout=timeout)
    return response


def _identity(response: http.client.HTTPResponse) -> str:
    return response.headers.get("ETag") or response.headers.get("Last-Modified") or ""
