"""Features of all images and matches of all pairs, with stand-ins for the networks."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from PIL import Image

from gsbench.files import file_sha256
from gsbench.init import Dim, dim
from gsbench.init import networks as workshop
from gsbench.init.base import Timer
from gsbench.init.colmap import database, matches
from gsbench.init.colmap.database import DatabaseTask
from gsbench.init.networks import Features, FeatureStore
from gsbench.init.sfm import Job
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
    monkeypatch.setitem(workshop.EXTRACTORS, "superpoint", made.build("extractor"))
    monkeypatch.setattr(workshop, "build_matcher", made.build("matcher"))
    monkeypatch.setattr(workshop, "extract_features", made.extract)
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


def run(job, progress=lambda *at: None, timer=None):
    """The keypoints and the matches that are written, and the facts, of all pairs."""
    pairs, written = list(itertools.combinations(NAMES, 2)), []
    task = DatabaseTask(job.work_dir / "a.db", job.capture.images, list(NAMES), pairs)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(database, "write_features", lambda _, *given: written.extend(given))
        patch.setattr(matches, "verify_pairs", lambda *_: None)
        facts = job.options.fill(job, task, progress, timer or Timer())
    return *written, facts


def test_each_image_and_pair_is_computed_once(networks, job, monkeypatch):
    told, stores, timer = [], [], Timer()

    class Noted(FeatureStore):
        def __init__(self, *given):
            super().__init__(*given)
            stores.append(self)

    monkeypatch.setattr(workshop, "FeatureStore", Noted)
    keypoints, found, facts = run(job, lambda *at: told.append(at), timer)
    assert networks.made == ["extractor", "matcher"]
    assert networks.extracted == list(NAMES)
    assert networks.matched == [(2, 3), (2, 4), (3, 4)]
    assert told == [(what, done, 3) for what in ("extract", "match") for done in range(4)]
    counted = {"pairs_selected": 3, "pairs_without_matches": 0, "images_without_keypoints": 0}
    assert facts["counts"] == counted
    assert set(timer.seconds) == {"extract", "match", "verify"}
    assert {name: len(found) for name, found in keypoints.items()} == networks.keypoints
    again = run(job)
    assert networks.made == ["extractor", "matcher"]  # no network is loaded again
    assert (again[2], len(networks.extracted), len(networks.matched)) == (facts, 3, 3)
    for name in NAMES:
        assert_array_equal(again[0][name], keypoints[name])
    assert again[1].keys() == found.keys()
    store = stores[0]  # what is gone or damaged is computed again, and nothing else
    store.path("a.png").unlink()
    store.path("b.png").write_bytes(b"half a file")
    store.path("b.png", "c.png").unlink()
    whole = store.path("a.png", "b.png").read_bytes()
    store.path("a.png", "b.png").write_bytes(whole[:100])
    run(job)
    assert networks.extracted[3:] == ["a.png", "b.png"]
    assert networks.matched[3:] == [(2, 3), (3, 4)]


def test_images_without_keypoints_and_pairs_without_matches_are_counted(networks, job):
    networks.keypoints["a.png"] = 0
    _, found, facts = run(job)
    assert networks.matched == [(3, 4)]
    assert list(found) == [("b.png", "c.png")]
    assert facts["counts"]["images_without_keypoints"] == 1
    assert facts["counts"]["pairs_without_matches"] == 2
    assert facts["warnings"] == ["no keypoint in a.png: no point comes from these images"]


def test_nothing_to_match_is_refused(networks, job):
    networks.keypoints = dict.fromkeys(NAMES, 0)
    with refusal("dim: no keypoint in any image"):
        run(job)


def test_keypoints_on_ignored_pixels_are_left_out(networks, job):
    mask = np.full((8, 8), 255, np.uint8)
    mask[1, 1] = 0
    Image.fromarray(mask).save(job.work_dir.parent / "mask.png")
    masks = {"c.png": job.work_dir.parent / "mask.png"}
    masked = replace(job, capture=replace(job.capture, masks=masks))
    keypoints, *_ = run(masked)
    assert_array_equal(keypoints["c.png"], [[0.5, 0.5], [2.5, 2.5], [3.5, 3.5]])
    assert len(keypoints["b.png"]) == 3


def test_pairs_that_the_preview_leaves_out_are_counted(networks, job, monkeypatch):
    seen = []

    def proposed(names, strongest):
        seen.extend(strongest(name).tolist() for name in names)
        return [("a.png", "c.png")]

    monkeypatch.setattr(dim, "proposed_pairs", proposed)
    monkeypatch.setattr(dim, "STRONGEST", 2)
    *_, facts = run(replace(job, options=Dim(threads=1, pairs="auto")))
    assert seen == [[[2.0]] * 2, [[3.0]] * 2, [[4.0]] * 2]
    assert networks.matched == [(2, 4)]
    assert (facts["counts"]["pairs_selected"], facts["counts"]["pairs_left_out"]) == (1, 2)


def test_other_settings_images_masks_or_weights_have_other_files(networks, job):
    run(job)
    Image.new("L", (8, 8), 255).save(mask := job.work_dir / "mask.png")
    masked = replace(job.capture, masks={"c.png": mask})
    changes = [{}, {"options": Dim(threads=1, max_keypoints=9)}, {"capture": masked}]
    for number, change in enumerate([*changes, {"options": Dim(threads=1, filter_threshold=0.5)}]):
        run(replace(job, **change))
        assert len(networks.extracted) == len(networks.matched) == 3 * number + 3
    Image.new("L", (8, 8), 9).save(job.capture.images / "a.png")
    run(job)
    assert len(networks.extracted) == 15
    for number, file in enumerate(networks.weights):
        file.write_text("others")
        digests = {file.name: file_sha256(file) for file in networks.weights}
        assert run(job)[2]["settings"]["weights_sha256"] == digests
        assert len(networks.extracted) == 18 + 3 * number
