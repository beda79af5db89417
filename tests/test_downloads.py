"""Downloads try again after failures that may pass, and say in one line why they gave up."""

import hashlib
import time
from types import SimpleNamespace

import pytest
import requests
import urllib3
from requests import exceptions as failures

from gsbench import downloads
from gsbench.downloads import FetchError, RetryPolicy, download, with_retries
from gsbench.errors import InputError

URL = "http://a.org/b"


@pytest.fixture
def pauses(monkeypatch):
    """The pauses, which take no time."""
    pauses = []
    monkeypatch.setattr(time, "sleep", pauses.append)
    return pauses


def failing(errors):
    """An action that raises the errors one after the other, and then succeeds."""

    def action():
        if errors:
            raise errors.pop(0)
        return "done"

    return action


def refusal(status):
    answer = SimpleNamespace(status_code=status, reason="No")
    return failures.HTTPError(f"{status} error", response=answer)


def test_pauses_double_up_to_a_limit(pauses, logged):
    lost = [failures.ConnectionError("lost") for _ in range(7)]
    assert with_retries(failing(lost), URL, RetryPolicy(tries=8)) == "done"
    assert pauses == [1, 2, 4, 8, 16, 30, 30]
    assert logged.messages[:2] == ["lost: trying again in 1 s", "lost: trying again in 2 s"]


def test_the_last_try_ends_with_an_error_without_a_pause(pauses):
    lost = [urllib3.exceptions.HTTPError("lost") for _ in range(5)]
    with pytest.raises(FetchError, match=rf"^{URL}: 5 failures in a row \(lost\): to continue, "):
        with_retries(failing(lost), URL, RetryPolicy(pause=0.5))
    assert pauses == [0.5, 1, 2, 4]


@pytest.mark.parametrize(
    "error, said",
    [
        (failures.SSLError("old"), r"the certificate is not trusted here \(old\)"),
        (failures.InvalidURL("no host"), r"no address that can be fetched \(no host\)"),
        (failures.InvalidSchema("ftp"), r"no address that can be fetched \(ftp\)"),
        *((refusal(status), f"the server says {status} No: give another") for status in (403, 404)),
    ],
)
def test_a_permanent_failure_is_not_tried_again(error, said, pauses):
    with pytest.raises(InputError, match=said):
        with_retries(failing([error]), URL, RetryPolicy())
    assert pauses == []


@pytest.mark.parametrize("status", [408, 425, 429, 500, 502, 503, 504])
def test_a_busy_server_is_asked_again(status, pauses):
    assert with_retries(failing([refusal(status)]), URL, RetryPolicy()) == "done"
    assert pauses == [1]


@pytest.mark.parametrize(
    "error, reason",
    [
        (failures.ReadTimeout("x"), "no answer in time"),
        (urllib3.exceptions.ReadTimeoutError(None, "", "x"), "no answer in time"),
        (failures.ConnectionError("HTTPPool: Read timed out."), "no answer in time"),
        (failures.ChunkedEncodingError("x"), "the connection was cut"),
        (urllib3.exceptions.ProtocolError("x"), "the connection was cut"),
        (failures.ConnectionError(ValueError(KeyError("inner"))), "'inner'"),
        (failures.ConnectionError(SimpleNamespace(reason=1)), "namespace(reason=1)"),
        (failures.ConnectionError(), "ConnectionError"),
    ],
)
def test_a_failure_is_named_by_its_cause(error, reason):
    with pytest.raises(FetchError) as raised:
        with_retries(failing([error]), URL, RetryPolicy(tries=1))
    assert f"1 failures in a row ({reason})" in str(raised.value)


@pytest.mark.parametrize("length, total", [("5", 5), (None, None), ("many", None)])
def test_every_try_starts_from_the_beginning_and_reports_its_bytes(
    tmp_path, monkeypatch, pauses, length, total
):
    bodies = [[b"xy", failures.ChunkedEncodingError()], [b"abc", b"de"]]
    asked = []

    class Answer:
        headers = {} if length is None else {"Content-Length": length}

        def __enter__(self):
            return self

        def __exit__(self, *error):
            pass

        def raise_for_status(self):
            pass

        def iter_content(self, size):
            for piece in bodies.pop(0):
                if isinstance(piece, Exception):
                    raise piece
                yield piece

    monkeypatch.setattr(requests, "get", lambda url, **how: asked.append((url, how)) or Answer())
    seen = []
    digest = download(
        URL, tmp_path / "a", RetryPolicy(timeout=7), lambda done, whole: seen.append((done, whole))
    )
    assert (tmp_path / "a").read_bytes() == b"abcde"
    assert digest == hashlib.sha256(b"abcde").hexdigest()
    assert seen == [(0, total), (2, total), (0, total), (3, total), (5, total)]
    headers = {"User-Agent": "gsbench", "Accept-Encoding": "identity"}
    assert asked == [(URL, {"headers": headers, "stream": True, "timeout": 7})] * 2
    assert downloads.RetryPolicy().timeout == 30
