"""Downloads over HTTP, with retries after failures and error messages in one line."""

import hashlib
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from gsbench.errors import GsbenchError, InputError
from gsbench.files import CHUNK

T = TypeVar("T")
log = logging.getLogger(__name__)

USER_AGENT = {"User-Agent": "gsbench"}
TRANSIENT = (408, 425, 429, 500, 502, 503, 504)  # HTTP statuses that may change on a retry
MAX_PAUSE_SECONDS = 30.0


class FetchError(GsbenchError):
    """Error of the network or the server (exit code 1).

    The same command continues where it stopped.
    """


@dataclass(frozen=True)
class RetryPolicy:
    """Limits of waiting for a server."""

    timeout: float = 30.0  # seconds without a byte
    tries: int = 5  # of one file
    pause: float = 1.0  # seconds before the second try; doubles before each further one


def with_retries(action: Callable[[], T], url: str, policy: RetryPolicy) -> T:
    """The result of ``action``, a request for ``url`` that is repeated after failures.

    Raises `InputError` for a permanent refusal by the server, and `FetchError` after the last try.
    """
    import requests
    import urllib3

    for failures in range(1, policy.tries + 1):
        try:
            return action()
        except requests.exceptions.SSLError as error:
            raise InputError(
                f"{url}: the certificate is not trusted here ({error}): fix it, or give --mirror"
            ) from None
        except (requests.exceptions.InvalidURL, requests.exceptions.InvalidSchema) as error:
            raise InputError(
                f"{url}: no address that can be fetched ({error}): give another with --mirror"
            ) from None
        except (requests.RequestException, urllib3.exceptions.HTTPError) as error:
            answer = getattr(error, "response", None)
            if answer is not None and answer.status_code not in TRANSIENT:
                raise InputError(
                    f"{url}: the server says {answer.status_code} {answer.reason}: give another "
                    "address with --mirror"
                ) from None
            reason = _reason(error)
            if failures == policy.tries:
                raise FetchError(
                    f"{url}: {failures} failures in a row ({reason}): to continue, give the same "
                    "command again"
                ) from error
        pause = min(MAX_PAUSE_SECONDS, policy.pause * 2 ** (failures - 1))
        log.info("%s: trying again in %.3g s", reason, pause)
        time.sleep(pause)
    raise AssertionError("no try was allowed")


def download(
    url: str, target: Path, policy: RetryPolicy, advance: Callable[[int, int | None], None]
) -> str:
    """Write the file at ``url`` to ``target``; returns its sha256 in hexadecimal.

    ``advance`` gets the number of bytes so far and in total, or None if the server does not say.
    Each try starts from the beginning. Raises the errors of `with_retries`.
    """
    import requests

    def once() -> str:
        digest, done = hashlib.sha256(), 0
        # The length of a compressed answer would not be that of the file.
        headers = USER_AGENT | {"Accept-Encoding": "identity"}
        with (
            requests.get(url, headers=headers, stream=True, timeout=policy.timeout) as answer,
            target.open("wb") as file,
        ):
            answer.raise_for_status()
            length = answer.headers.get("Content-Length", "")
            total = int(length) if length.isdigit() else None
            advance(0, total)
            for piece in answer.iter_content(CHUNK):  # raises if fewer bytes arrive than announced
                file.write(piece)
                digest.update(piece)
                done += len(piece)
                advance(done, total)
        return digest.hexdigest()

    return with_retries(once, url, policy)


def _reason(error: Exception) -> str:
    """The innermost cause, in a few words, of an error of requests, which wraps others."""
    import requests
    import urllib3

    if isinstance(
        error, requests.exceptions.Timeout | urllib3.exceptions.TimeoutError
    ) or "timed out" in str(error):
        return "no answer in time"
    if isinstance(
        error, requests.exceptions.ChunkedEncodingError | urllib3.exceptions.ProtocolError
    ):
        return "the connection was cut"
    inner = error
    while isinstance(inner, Exception) and inner.args and isinstance(inner.args[0], Exception):
        inner = inner.args[0]
    return str(getattr(inner, "reason", None) or inner) or type(error).__name__
