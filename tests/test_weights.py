"""Weights files: search, download, and refusal of wrong files."""

import hashlib
import pickle
import sys
from pathlib import Path

import pytest
import torch
from torch.testing import assert_close

from gsbench import downloads
from gsbench.weights import (
    MissingWeightsError,
    WeightsFile,
    digests_of_unpinned,
    find_all_weights,
    find_weights,
    hub_cache,
    load_state,
)
from tests.datasets.server import Manners, serve
from tests.helpers import refusal, write

pytestmark = pytest.mark.usefixtures("no_weights")
STATE = {"a.weight": torch.arange(6.0).reshape(2, 3), "a.bias": torch.zeros(2)}


def spec(content=None, url=None, digits=64, name="net.pth"):
    sha256 = None if content is None else hashlib.sha256(content).hexdigest()[:digits]
    return WeightsFile((name, f"other/{name}"), url, sha256, "" if url else "example.org")


def test_search_order_is_argument_environment_cache(tmp_path, no_weights, monkeypatch):
    places = [
        tmp_path / "argument/deep/below",
        tmp_path / "environment/other",
        no_weights,
    ]
    for place in places:
        write(place / "net.pth", b"x")
    monkeypatch.setenv("GSBENCH_WEIGHTS", str(tmp_path / "environment"))
    assert find_weights(spec(b"x"), tmp_path / "argument") == places[0] / "net.pth"
    assert find_weights(spec(b"x")) == places[1] / "net.pth"
    monkeypatch.delenv("GSBENCH_WEIGHTS")
    assert find_weights(spec(b"x")) == places[2] / "net.pth"


def test_every_name_counts_and_the_first_right_file_is_taken(tmp_path):
    for name, content in (("b/net.pth", b"2"), ("a/net.pth", b"1"), ("other/net.pth", b"3")):
        write(tmp_path / name, content)
    named = WeightsFile(("net.pth", "other/net.pth"), None)
    # beside the names themselves come the sub-folders, in order
    assert find_weights(named, tmp_path) == tmp_path / "other/net.pth"
    assert find_weights(WeightsFile(("net.pth",), None), tmp_path) == tmp_path / "a/net.pth"
    assert find_weights(spec(b"2"), tmp_path) == tmp_path / "b/net.pth"
    (tmp_path / "net.pth").mkdir()
    two = [spec(b"3"), spec(b"1"), spec(b"3")]
    assert find_all_weights(two, tmp_path) == [
        tmp_path / name for name in ("other/net.pth", "a/net.pth", "other/net.pth")
    ]


def test_a_copy_has_a_name_and_a_checksum_of_its_own(tmp_path):
    digest = hashlib.sha256(b"copy").hexdigest()
    named = WeightsFile(("net.pth",), None, "0" * 64, "b.pth, from there", (("b.pth", digest),))
    write(tmp_path / "below/b.pth", b"copy")
    assert find_weights(named, tmp_path) == tmp_path / "below/b.pth"
    write(tmp_path / "below/b.pth", b"other")
    with pytest.raises(MissingWeightsError, match=r"with the file from b\.pth, from there"):
        find_weights(named, tmp_path)


def test_only_the_cache_is_not_searched_below(no_weights, monkeypatch):
    write(no_weights / "deep/net.pth", b"x")
    with pytest.raises(MissingWeightsError, match="it has no address to download from"):
        find_weights(spec())
    monkeypatch.setenv("GSBENCH_WEIGHTS", str(no_weights.parent))
    assert find_weights(spec()).parent.name == "deep"
    monkeypatch.delenv("TORCH_HOME")
    monkeypatch.setenv("XDG_CACHE_HOME", "/x")
    assert hub_cache() == Path("/x/torch/hub/checkpoints")
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", "/home/me")
    assert hub_cache() == Path("/home/me/.cache/torch/hub/checkpoints")


def test_after_a_failed_download_no_other_is_tried(monkeypatch):
    asked = []

    def download(url, target, policy, advance):
        asked.append((url, policy))
        raise OSError("no network")

    monkeypatch.setattr(downloads, "download", download)
    with pytest.raises(
        MissingWeightsError, match=r"net.pth, b.pth \(.*failed: no network"
    ) as error:
        find_all_weights([spec(url="http://a"), spec(url="http://b", name="b.pth")])
    assert "get them from http://a, http://b" in str(error.value)
    assert asked == [("http://a", downloads.RetryPolicy(timeout=10.0, tries=1))]


def test_users_files_without_a_published_checksum_are_known_by_their_digest(tmp_path, no_weights):
    """Such a file may be any, so that it belongs into the keys of results; a download may not."""
    write(no_weights / "net.pth", b"downloaded")
    assert digests_of_unpinned([spec()]) == []
    (tmp_path / "net.pth").write_bytes(b"mine")
    digest = hashlib.sha256(b"mine").hexdigest()
    assert digests_of_unpinned([spec(), spec(b"x", name="other.pth")], tmp_path) == [digest]


@pytest.mark.parametrize("digits", [16, 64])
def test_a_file_with_a_wrong_checksum_is_refused_unless_a_right_copy_is_found(
    tmp_path, no_weights, digits
):
    folder = tmp_path / "mine"
    write(folder / "net.pth", b"truncat")
    with pytest.raises(
        MissingWeightsError, match=r"net.pth has sha256 .* wrong or truncated; replace it"
    ):
        find_weights(spec(b"truncated", digits=digits), folder)
    write(no_weights / "net.pth", b"truncated")
    assert find_weights(spec(b"truncated", digits=digits), folder).parent == no_weights


def test_missing_files_are_named_together_with_places_and_sources(tmp_path):
    with pytest.raises(MissingWeightsError) as caught:
        find_all_weights([spec(), spec(name="second.pth")], tmp_path, download=False)
    message = str(caught.value)
    for part in (
        "net.pth, second.pth",
        str(tmp_path),
        "GSBENCH_WEIGHTS",
        "example.org",
        "switched off",
    ):
        assert part in message
    assert "\n" not in message
    with refusal("does not exist"):
        find_weights(spec(), tmp_path / "nowhere")


@pytest.fixture
def server(tmp_path):
    (tmp_path / "served").mkdir()
    with serve(tmp_path / "served") as running:
        yield running


def served(server, content):
    (server.folder / "served.bin").write_bytes(content)
    return f"{server.url}/served.bin"


def test_a_download_logs_its_progress_and_is_kept(server, no_weights, logged):
    content = b"g" * 2_500_000
    url = served(server, content)
    for _ in range(2):
        assert find_weights(spec(content, url)) == no_weights / "net.pth"
    assert (no_weights / "net.pth").read_bytes() == content
    assert len(server.requests) == 1
    lines = [record.getMessage() for record in logged.records if record.name.startswith("gsbench")]
    assert lines == [
        f"downloading net.pth (2.5 MB) from {url} to {no_weights}",  # before anything has come
        "weights: net.pth 1048576/2500000 1.05 MB of 2.5 MB",
        "weights: net.pth 2500000/2500000 2.5 MB of 2.5 MB",
    ]


@pytest.mark.parametrize(
    "content, manners, said",
    [
        (
            b"x" * 100_000,
            Manners(cut_every=40_000),
            "the download failed: .*1 failures in a row .the connection was cut",
        ),
        (b"bad", Manners(), "is damaged: try again"),
    ],
)
def test_download_that_ends_early_or_is_damaged_leaves_nothing(
    server, no_weights, content, manners, said
):
    server.manners = manners
    with pytest.raises(MissingWeightsError, match=said):
        find_weights(spec(b"good", served(server, content)))
    assert list(no_weights.iterdir()) == []


def save_state(path):
    if path.name.endswith("safetensors"):
        pytest.importorskip("safetensors.torch").save_file(STATE, path)
    else:
        torch.save(STATE, path)


@pytest.mark.parametrize("name", ["net.pth", "net.safetensors", "net-pth"])
def test_tensors_are_read_from_both_formats(tmp_path, name):
    path = tmp_path / name
    save_state(path)
    state = load_state(path)
    assert state.keys() == STATE.keys()
    assert_close(state["a.weight"], STATE["a.weight"])


def test_a_file_that_needs_a_package_counts_as_missing(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "safetensors.torch", None)
    with pytest.raises(MissingWeightsError, match="needs the package safetensors: pip install"):
        load_state(tmp_path / "net.safetensors")


def test_tensors_are_read_from_an_entry_of_a_checkpoint(tmp_path):
    torch.save({"epoch": 3, "extractor": STATE}, tmp_path / "net.pth")
    assert load_state(tmp_path / "net.pth", entry="extractor").keys() == STATE.keys()
    with pytest.raises(MissingWeightsError, match="no entry 'model'"):
        load_state(tmp_path / "net.pth", entry="model")
    with pytest.raises(MissingWeightsError, match="something other than tensors"):
        load_state(tmp_path / "net.pth")
    with pytest.raises(MissingWeightsError, match="no entry 'epoch'"):
        load_state(tmp_path / "net.pth", entry="epoch")
    torch.save([1], tmp_path / "net.pth")
    with pytest.raises(MissingWeightsError, match="it holds a list, not tensors by name"):
        load_state(tmp_path / "net.pth")


class Malicious:
    """Pickles to a call that would create a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (Path.touch, (self.path,))


@pytest.mark.parametrize("how", ["torch", "pickle"])
def test_code_in_a_file_is_not_run(tmp_path, how):
    trace = tmp_path / "was_here"
    if how == "torch":
        torch.save({"a": Malicious(trace)}, tmp_path / "net.pth")
    else:
        (tmp_path / "net.pth").write_bytes(pickle.dumps({"a": Malicious(trace)}))
    with pytest.raises(MissingWeightsError, match="cannot be read as plain tensors"):
        load_state(tmp_path / "net.pth")
    assert not trace.exists()


@pytest.mark.parametrize("name", ["net.pth", "net.safetensors"])
@pytest.mark.parametrize("content", [b"", b"<html>404</html>", "half"])
def test_truncated_and_foreign_files_are_refused(tmp_path, name, content):
    path = tmp_path / name
    if content == "half":
        save_state(path)
        content = path.read_bytes()[: path.stat().st_size // 2]
    path.write_bytes(content)
    with pytest.raises(MissingWeightsError, match="cannot be read as plain tensors") as caught:
        load_state(path)
    assert "\n" not in str(caught.value)
