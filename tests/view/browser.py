"""A headless Chromium, steered by its DevTools protocol, in real time.

Chromium's own ``--screenshot`` waits in virtual time, which runs ahead while nothing but a web
socket is open: on a busy machine the picture was taken before the server had drawn.
"""

import base64
import io
import itertools
import json
import shutil
import subprocess
import time
import urllib.request
from shlex import split

import numpy as np
import pytest
from PIL import Image

FLAGS = split(
    "--headless --no-sandbox --disable-gpu --enable-unsafe-swiftshader --no-first-run "
    "--disable-sync --disable-background-networking --disable-component-update "
    "--remote-debugging-port=0"
)
SECONDS = 300  # a limit for a page that never changes; a slow machine needs less
SECONDS_BETWEEN_LOOKS = 0.5


class Browser:
    """A window of ``size`` on the page ``url``; the test is skipped where there is no Chromium."""

    def __init__(self, url, profile, size=(1200, 600)):
        found = map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))
        chromium = next(filter(None, found), None)
        if chromium is None:
            pytest.skip("needs a headless Chromium")
        sockets = pytest.importorskip(
            "websockets.sync.client", reason="needs websockets, which viser brings"
        )
        words = [f"--user-data-dir={profile}", f"--window-size={size[0]},{size[1]}", url]
        self._process = subprocess.Popen(
            [chromium, *FLAGS, *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        self._ids = itertools.count()
        try:
            address = self.wait_for(lambda: self._page(profile), "a page")
            self._socket = sockets.connect(address, max_size=None)
        except BaseException:
            self._process.kill()
            raise

    def __enter__(self):
        return self

    def __exit__(self, *reason):
        self._socket.close()
        self._process.kill()
        self._process.wait()

    def wait_until(self, condition, what):
        """The first picture of the page, [H, W, 3] in [0, 255], that fulfils ``condition``."""
        return self.wait_for(
            lambda: picture if condition(picture := self.picture()) else None, what
        )

    def picture(self):
        """A screenshot of the window, [H, W, 3] in [0, 255]."""
        data = base64.b64decode(self.call("Page.captureScreenshot")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(float)

    def call(self, method, **parameters):
        """The result of a DevTools ``method``."""
        number = next(self._ids)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=SECONDS))
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return dict(answer["result"])

    def _page(self, profile):
        """The web socket address of the page; None if there is no page yet."""
        try:
            port = (profile / "DevToolsActivePort").read_text().split()[0]
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=20) as answer:
                pages = [target for target in json.load(answer) if target["type"] == "page"]
        except (OSError, IndexError):
            return None
        return str(pages[0]["webSocketDebuggerUrl"]) if pages else None

    def wait_for(self, look, what):
        """The first result of ``look`` that is not None."""
        deadline = time.monotonic() + SECONDS
        while time.monotonic() < deadline:
            found = look()
            if found is not None:
                return found
            assert self._process.poll() is None, "the browser ended"
            time.sleep(SECONDS_BETWEEN_LOOKS)
        raise AssertionError(f"the browser did not show {what} within {SECONDS} s")
