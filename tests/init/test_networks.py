"""Features of all images and matches of all pairs, with stand-ins for the networks."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from gsbench.errors import GsbenchError
from gsbench.files import file_sha256
from gsbench.init import Dim
from gsbench.init.networks import extract_and_match
from gsbench.init.networks.features import Features
from gsbench.init.reconstruction import Job
from tests.helpers import refusal, write

NAMES = ("a.png", "b.png", "c.png")


class Networks:
    """Notes what is computed: ``keypoints`` of each image, and ``matched`` pairs of ``counts``."""

    def __init__(self):
        self.made, self.extracted, self.matched = [], [], []
        self.keypoints = {"a.png": 2, "b.png": 3, "c.png": 4}
        self.without = set()

    def build(self, kind):
        def make(*_):
            self.made.append(kind)
            return self.match if kind == "matcher" else kind

        return make

    def extract(self, path, extractor, settings, device):
        assert extractor == "extractor"
        self.extracted.append(path.name)
        count = self.keypoints[path.name]
        # on the diagonal of the image; the descriptors are the number of keypoints
        keypoints = np.arange(count, dtype=np.float32).repeat(2).reshape(-1, 2)
        descriptors = np.full((count, 1), count, np.float32)
        return Features(keypoints, descriptors, np.ones(count, np.float32), (8, 8), (8, 8))

    def match(self, first, second):
        pair = (len(first.keypoints), len(second.keypoints))
        self.matched.append(pair)
        return np.zeros((0 if pair in self.without else 1, 2), np.uint32)


@pytest.fixture
def networks(monkeypatch):
    made = Networks()
    monkeypatch.setitem(extract_and_match.EXTRACTORS, "superpoint", made.build("extractor"))
    monkeypatch.setattr(extract_and_match, "build_matcher", made.build("matcher"))
    monkeypatch.setattr(extract_and_match, "extract_features", made.extract)
    monkeypatch.setattr(Dim, "find_weights", lambda _: made.weights)
    return made


@pytest.fixture
def job(networks, bare_photos, tmp_path):
    images = tmp_path / "images"
    images.mkdir()
    for number, name in enumerate(NAMES):
        Image.new("L", (8, 8), number).save(images / name)
    capture = replace(bare_photos, images=images, image_names=NAMES, test_names=())
    networks.weights = [write(tmp_path / name, name) for name in ("extractor.pth", "matcher.pth")]
    return Job(Dim(threads=1), capture, tmp_path, tmp_path / "work", None)


def run(job, progress=lambda *at: None):
    return extract_and_match.extract_and_match(job.options, job, progress)


def open_store(job):
    return extract_and_match.open_store(job.options, job, job.options.find_weights())


def test_each_image_and_pair_is_computed_once(networks, job):
    told = []
    found = run(job, lambda *at: told.append(at))
    assert networks.made == ["extractor", "matcher"]
    assert networks.extracted == list(NAMES)
    assert networks.matched == [(2, 3), (2, 4), (3, 4)]
    assert told == [(what, done, 3) for what in ("extract", "match") for done in range(4)]
    counted = {"pairs_selected": 3, "pairs_without_matches": 0, "images_without_keypoints": 0}
    assert found.counts == counted
    assert set(found.seconds) == {"extract", "match"}
    again = run(job)
    assert networks.made == ["extractor", "matcher"]  # no network is loaded again
    assert (again.counts, len(networks.extracted), len(networks.matched)) == (found.counts, 3, 3)
    store = open_store(job)  # what is gone or damaged is computed again, and nothing else
    store.features_path("a.png").unlink()
    store.features_path("b.png").write_bytes(b"half a file")
    store.matches_path("b.png", "c.png").unlink()
    run(job)
    assert networks.extracted[3:] == ["a.png", "b.png"]
    assert networks.matched[3:] == [(3, 4)]


def test_images_without_keypoints_and_pairs_without_matches_are_counted(networks, job):
    networks.keypoints["a.png"] = 0
    found = run(job)
    assert networks.matched == [(3, 4)]
    assert found.counts["images_without_keypoints"] == 1
    assert found.counts["pairs_without_matches"] == 2
    assert found.warnings == ("no keypoint in a.png: no point comes from these images",)


def test_nothing_to_match_is_refused(networks, job):
    networks.without = {(2, 3), (2, 4), (3, 4)}
    with refusal("dim: no pair of images has a match"):
        run(job)
    networks.keypoints = dict.fromkeys(NAMES, 0)
    with refusal("dim: no keypoint in any image"):
        run(replace(job, work_dir=job.work_dir / "other"))


def test_keypoints_on_ignored_pixels_are_left_out(networks, job):
    mask = np.full((8, 8), 255, np.uint8)
    mask[1, 1] = 0
    Image.fromarray(mask).save(job.work_dir.parent / "mask.png")
    masks = {"c.png": job.work_dir.parent / "mask.png"}
    masked = replace(job, capture=replace(job.capture, masks=masks))
    run(masked)
    store = open_store(masked)
    assert store.features("c.png").keypoints.tolist() == [[0, 0], [2, 2], [3, 3]]
    assert len(store.features("b.png").keypoints) == 3


def test_pairs_that_the_preview_leaves_out_are_counted(networks, job, monkeypatch):
    seen = []

    def proposed(names, strongest):
        seen.extend(strongest(name).tolist() for name in names)
        return [("a.png", "c.png")]

    monkeypatch.setattr(extract_and_match, "proposed_pairs", proposed)
    monkeypatch.setattr(extract_and_match, "STRONGEST", 2)
    found = run(replace(job, options=Dim(threads=1, pairs="auto")))
    assert seen == [[[2.0]] * 2, [[3.0]] * 2, [[4.0]] * 2]
    assert networks.matched == [(2, 4)]
    assert (found.counts["pairs_selected"], found.counts["pairs_left_out"]) == (1, 2)


def test_the_weights_are_named_by_their_digests_and_tell_stored_files_apart(
    networks, job, tmp_path
):
    run(job)
    weights = tmp_path / "w.pth"
    weights.write_bytes(b"weights")
    networks.weights[1] = weights
    assert run(job).settings["weights_sha256"] == {
        file.name: file_sha256(file) for file in networks.weights
    }
    assert (len(networks.extracted), len(networks.matched)) == (3, 6)
    networks.weights[0] = weights
    run(job)
    assert (len(networks.extracted), len(networks.matched)) == (6, 9)


def test_stored_files_that_are_gone_are_named(networks, job):
    store = open_store(job)
    for read, names, said in (
        (store.features, ("a.png",), r"features of a\.png are gone from .*work"),
        (store.matches, ("a.png", "b.png"), r"matches of a\.png and b\.png are gone"),
    ):
        with pytest.raises(GsbenchError, match=f"the stored {said}"):
            read(*names)
    np.save(store.matches_path("a.png", "b.png"), np.zeros((4, 3)))
    assert store.read_matches("a.png", "b.png") is None
