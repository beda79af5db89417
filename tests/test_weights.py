"""Weights files: where they are found, and what is refused."""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import pickle
import subprocess
import sys
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from urllib.error import URLError

import pytest
import torch

from gsbench.errors import InputError
from gsbench.weights import MissingWeights, WeightsFile, find_all_weights, find_weights, load_state

STATE = {"a.weight": torch.arange(6.0).reshape(2, 3), "a.bias": torch.zeros(2)}


def spec(content: bytes | None = None, url: str | None = None, digits: int = 64, name: str = "net.pth") -> WeightsFile:
    sha256 = None if content is None else hashlib.sha256(content).hexdigest()[:digits]
    return WeightsFile((name, f"other/{name}"), url, sha256, "free", "example.org")


@pytest.fixture(autouse=True)
def empty_caches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv("GSBENCH_WEIGHTS", raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    return tmp_path / "torch" / "hub" / "checkpoints"


def test_search_order_is_argument_environment_cache(
    tmp_path: Path, empty_caches: Path, monkeypatch: pytest.MonkeyPatch
):
    places = [tmp_path / "argument" / "deep" / "below", tmp_path / "environment" / "other", empty_caches]
    for place in places:
        place.mkdir(parents=True)
        (place / "net.pth").write_bytes(b"x")
    monkeypatch.setenv("GSBENCH_WEIGHTS", str(tmp_path / "environment"))
    assert find_weights(spec(b"x"), tmp_path / "argument") == places[0] / "net.pth"
    assert find_weights(spec(b"x")) == places[1] / "net.pth"
    monkeypatch.delenv("GSBENCH_WEIGHTS")
    assert find_weights(spec(b"x")) == places[2] / "net.pth"


@pytest.mark.parametrize("digits", [16, 64])
def test_wrong_checksum_is_refused_and_a_right_copy_elsewhere_taken(tmp_path: Path, empty_caches: Path, digits: int):
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "net.pth").write_bytes(b"truncat")
    with pytest.raises(MissingWeights, match=r"net.pth has sha256 .* wrong or truncated; replace it"):
        find_weights(spec(b"truncated", digits=digits), folder)
    empty_caches.mkdir(parents=True)
    (empty_caches / "net.pth").write_bytes(b"truncated")
    assert find_weights(spec(b"truncated", digits=digits), folder).parent == empty_caches


def test_missing_files_are_named_together_with_places_and_sources(tmp_path: Path):
    with pytest.raises(MissingWeights) as caught:
        find_all_weights([spec(), spec(name="second.pth")], tmp_path, download=False)
    message = str(caught.value)
    for part in ("net.pth, second.pth", str(tmp_path), "GSBENCH_WEIGHTS", "example.org", "switched off"):
        assert part in message
    assert "\n" not in message
    with pytest.raises(InputError, match="does not exist"):
        find_weights(spec(), tmp_path / "nowhere")


def test_download_is_checked_and_kept(tmp_path: Path, empty_caches: Path):
    source = tmp_path / "served.bin"
    source.write_bytes(b"good")
    found = find_weights(spec(b"good", source.as_uri()))
    assert found == empty_caches / "net.pth"
    assert found.read_bytes() == b"good"
    source.unlink()
    assert find_weights(spec(b"good", source.as_uri())) == found


def test_download_says_how_far_it_is(tmp_path: Path, empty_caches: Path, caplog: pytest.LogCaptureFixture):
    caplog.set_level(logging.INFO, "gsbench")
    source = tmp_path / "served.bin"
    source.write_bytes(b"g" * 2_500_000)
    find_weights(spec(source.read_bytes(), source.as_uri()))
    lines = [record.getMessage() for record in caplog.records]
    assert lines == [
        f"downloading net.pth (2.5 MB) from {source.as_uri()} to {empty_caches}",  # before anything has come
        "weights: net.pth 1048576/2500000 1.05 MB of 2.5 MB",
        "weights: net.pth 2500000/2500000 2.5 MB of 2.5 MB",
    ]


def test_download_shows_a_bar_on_a_terminal(tmp_path: Path):
    pty = pytest.importorskip("pty", reason="needs terminals as Unix has them")
    source = tmp_path / "served.bin"
    source.write_bytes(b"g" * 2_500_000)
    code = (
        "from gsbench.weights import WeightsFile, find_weights\n"
        f"find_weights(WeightsFile(('net.pth',), {source.as_uri()!r}, None, 'free', 'example.org'))"
    )
    ours, theirs = pty.openpty()
    environment = dict(os.environ) | {"TERM": "xterm", "COLUMNS": "100"}
    with subprocess.Popen([sys.executable, "-c", code], stderr=theirs, env=environment):
        os.close(theirs)
        shown = b""
        with contextlib.suppress(OSError):  # Linux: the other end is closed
            while piece := os.read(ours, 1 << 16):
                shown += piece
    os.close(ours)
    assert b"weights: net.pth" in shown
    assert b"2.5 MB of 2.5 MB" in shown
    assert "━".encode() in shown


def test_download_that_ends_early_is_no_file(empty_caches: Path):
    class Short(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Length", "100")
            self.end_headers()
            self.wfile.write(b"x" * 40)

        def log_message(self, *words: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Short) as server:
        threading.Thread(target=server.handle_request, daemon=True).start()
        with pytest.raises(MissingWeights, match="the connection ended after 40 of 100 bytes"):
            find_weights(spec(url=f"http://127.0.0.1:{server.server_port}/net.pth"))
    assert list(empty_caches.iterdir()) == []


def test_damaged_download_leaves_nothing(tmp_path: Path, empty_caches: Path):
    source = tmp_path / "served.bin"
    source.write_bytes(b"bad")
    with pytest.raises(MissingWeights, match="is damaged"):
        find_weights(spec(b"good", source.as_uri()))
    assert list(empty_caches.iterdir()) == []


def test_without_a_network_the_answer_comes_at_once(monkeypatch: pytest.MonkeyPatch):
    """One attempt, and no waiting for another."""
    attempts = []

    def unreachable(url: str, **_: object):
        attempts.append(url)
        raise URLError("Name or service not known")

    monkeypatch.setattr("urllib.request.urlopen", unreachable)
    with pytest.raises(MissingWeights, match="the download failed"):
        find_weights(spec(url="http://weights.invalid/net.pth"))
    assert attempts == ["http://weights.invalid/net.pth"]


@pytest.mark.parametrize("name", ["net.pth", "net.safetensors", "net-pth"])
def test_state_round_trip(tmp_path: Path, name: str):
    path = tmp_path / name
    if name.endswith("safetensors"):
        pytest.importorskip("safetensors.torch").save_file(STATE, path)
    else:
        torch.save(STATE, path)
    state = load_state(path)
    assert state.keys() == STATE.keys()
    torch.testing.assert_close(state["a.weight"], STATE["a.weight"])


def test_state_within_a_checkpoint(tmp_path: Path):
    torch.save({"epoch": 3, "extractor": STATE}, tmp_path / "net.pth")
    assert load_state(tmp_path / "net.pth", entry="extractor").keys() == STATE.keys()
    with pytest.raises(MissingWeights, match="no entry 'model'"):
        load_state(tmp_path / "net.pth", entry="model")
    with pytest.raises(MissingWeights, match="something other than tensors"):
        load_state(tmp_path / "net.pth")


class Malicious:
    """Pickles to a call that would create a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return (Path.touch, (self.path,))


@pytest.mark.parametrize("how", ["torch", "pickle"])
def test_code_in_a_file_is_not_run(tmp_path: Path, how: str):
    trace = tmp_path / "was_here"
    if how == "torch":
        torch.save({"a": Malicious(trace)}, tmp_path / "net.pth")
    else:
        (tmp_path / "net.pth").write_bytes(pickle.dumps({"a": Malicious(trace)}))
    with pytest.raises(MissingWeights, match="cannot be read as plain tensors"):
        load_state(tmp_path / "net.pth")
    assert not trace.exists()


@pytest.mark.parametrize("name", ["net.pth", "net.safetensors"])
@pytest.mark.parametrize("content", [b"", b"<html>404</html>", "half"])
def test_truncated_and_foreign_files(tmp_path: Path, name: str, content: bytes | str):
    path = tmp_path / name
    if content == "half":
        if name.endswith("safetensors"):
            pytest.importorskip("safetensors.torch").save_file(STATE, path)
        else:
            torch.save(STATE, path)
        content = path.read_bytes()[: path.stat().st_size // 2]
    path.write_bytes(content)
    with pytest.raises(MissingWeights, match="cannot be read as plain tensors") as caught:
        load_state(path)
    assert "\n" not in str(caught.value)
