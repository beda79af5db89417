"""Matching in several processes gives the matches of COLMAP on one thread."""

import itertools
import shutil
from functools import partial

import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsbench.init import Sfm
from gsbench.init.base import Timer
from gsbench.init.colmap.database import DatabaseTask, create_database, unknown_camera_groups
from gsbench.init.colmap.matches import divide_pairs, extract_sift, match_sift
from gsbench.init.colmap.pairs import best_pairs
from gsbench.init.sfm import Job
from gsbench.logs import no_progress

pairs_of_some_images = st.integers(2, 40).flatmap(
    lambda count: st.sets(st.sampled_from(list(itertools.combinations(range(1, count + 1), 2))))
)


@given(pairs_of_some_images, st.integers(1, 9), st.integers(1, 5))
def test_every_pair_is_matched_once(pairs, block, processes):
    shares = divide_pairs(sorted(pairs), block, processes)
    assert sorted(pair for share in shares for part in share for pair in part) == sorted(pairs)
    assert all(len(part) <= block * block for share in shares for part in share)
    assert 1 <= len(shares) <= processes


def test_shares_are_about_equal_and_parts_hold_few_images():
    shares = divide_pairs(list(itertools.combinations(range(1, 101), 2)), 10, 4)
    parts = [{image for pair in part for image in pair} for share in shares for part in share]
    assert max(map(len, parts)) <= 2 * 10
    sizes = [sum(map(len, share)) for share in shares]
    assert max(sizes) - min(sizes) <= 10 * 10


@pytest.fixture(scope="module")
def features(bare_photos, tmp_path_factory):
    """A database with features of photographs whose names have spaces, and all pairs of them."""
    return database_of(bare_photos, bare_photos.image_names, tmp_path_factory.mktemp("features"))


def database_of(bare_photos, originals, folder):
    (folder / "images").mkdir()
    names = [f"IMG {index} (1).png" for index in range(len(originals))]
    for name, original in zip(names, originals, strict=True):
        shutil.copy(bare_photos.images / original, folder / "images" / name)
    database, images = folder / "database.db", folder / "images"
    pairs, options = list(itertools.combinations(names, 2)), Sfm(camera="single", threads=1)
    create_database(database, unknown_camera_groups(images, names, options))
    extract_sift(DatabaseTask(database, images, names, pairs), options, no_progress)
    return database, pairs


def read_matches(database):
    """Matches and verified geometries by pair, as bytes."""
    with pycolmap.Database.open(database) as opened:
        pair_ids, matches = opened.read_all_matches()
        geometry_ids, geometries = opened.read_two_view_geometries()
    found = {pair: [one] for pair, one in zip(pair_ids, matches, strict=True)}
    for pair, one in zip(geometry_ids, geometries, strict=True):
        found[pair] += [one.inlier_matches, one.E, one.F, one.H]
    return {
        pair: [None if part is None else np.asarray(part).tobytes() for part in parts]
        for pair, parts in found.items()
    }


@pytest.mark.parametrize("processes", [1, 3])
@pytest.mark.slow
def test_matches_equal_those_of_colmap_on_one_thread(features, tmp_path, processes):
    database, pairs = features
    shutil.copy(database, tmp_path / "colmap.db")
    matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    matching.num_threads, matching.use_gpu = 1, False
    verification.ransac.random_seed = 0
    options = {"matching_options": matching, "verification_options": verification}
    pycolmap.match_exhaustive(tmp_path / "colmap.db", **options, device=pycolmap.Device.cpu)
    shutil.copy(database, tmp_path / "database.db")
    told = []
    tell = lambda phase, done, total: told.append(done)  # noqa: E731
    match_sift(tmp_path / "database.db", pairs, Sfm(threads=processes), tell)
    ours, theirs = read_matches(tmp_path / "database.db"), read_matches(tmp_path / "colmap.db")
    assert ours == theirs
    assert sum(len(parts[0]) > 0 for parts in theirs.values()) > 10
    assert (told[0], max(told)) == (0, len(pairs))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["colmap.db", "database.db"]
    # the images have their own names again
    with pycolmap.Database.open(tmp_path / "database.db") as opened:
        names = {image.name for image in opened.read_all_images()}
    assert names == {name for pair in pairs for name in pair}


def test_colmaps_matcher_never_gets_a_second_thread(bare_photos, tmp_path, monkeypatch):
    """Two threads in one process can corrupt matches, but too rarely to test for it."""
    database, pairs = database_of(bare_photos, bare_photos.image_names[:3], tmp_path)
    threads = []
    match = pycolmap.match_image_pairs

    def noting(path, **options):
        threads.append(options["matching_options"].num_threads)
        match(path, **options)

    monkeypatch.setattr(pycolmap, "match_image_pairs", noting)
    told = []
    match_sift(database, pairs, Sfm(threads=1), lambda *at: told.append(at))
    assert set(threads) == {1}
    assert (told[0], told[-1]) == (("match", 0, len(pairs)), ("match", len(pairs), len(pairs)))
    assert sum(bool(parts[0]) for parts in read_matches(database).values()) > 1


@pytest.mark.slow
def test_auto_matches_only_the_pairs_that_a_preview_proposes(
    features, bare_photos, tmp_path, monkeypatch
):
    """Few images get all pairs; with more (here five), each gets its best partners."""
    database, pairs = features
    shutil.copy(database, tmp_path / "database.db")
    names = sorted({name for pair in pairs for name in pair})
    task = DatabaseTask(tmp_path / "database.db", bare_photos.images, names, pairs)
    monkeypatch.setattr("gsbench.init.colmap.pairs.ALL_PAIRS_UP_TO", 5)
    monkeypatch.setattr("gsbench.init.colmap.pairs.best_pairs", partial(best_pairs, partners=2))
    monkeypatch.setattr("gsbench.init.colmap.matches.extract_sift", lambda *_: None)
    options = Sfm(threads=1, pairs="auto")
    job = Job(options, bare_photos, tmp_path, tmp_path, None)
    counts = options.fill(job, task, no_progress, Timer())["counts"]
    assert counts["pairs_selected"] + counts["pairs_left_out"] == len(pairs)
    assert counts["pairs_left_out"] > 10
    matched = read_matches(task.database)
    assert len(matched) == counts["pairs_selected"]
    kept = {tuple(sorted(pycolmap.pair_id_to_image_pair(pair))) for pair in matched}
    # neighbours on the arc agree best
    assert {(index, index + 1) for index in range(1, len(names))} <= kept
