"""COLMAP's SIFT features, their matching, and the verification of matched pairs.

All of it calls native code that can abort: run it isolated.

Matching uses several cores by processes instead of threads, since COLMAP's matcher is not safe with
two threads in one process. Its nearest-neighbour search (faiss) calls a BLAS that pycolmap's wheels
build for one thread and without locks. Two simultaneous calls can corrupt each other's numbers:
rarely, and mostly on a busy machine, a pair loses some or most of its matches. With one thread for
each process, matches are repeatable to the bit; COLMAP's brute force took 24 times as long. Each
call builds a search index for each of its images, which costs more than matching a pair, so the
pairs are divided into parts with few images.
"""

from __future__ import annotations

import math
import shutil
import sqlite3
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import pycolmap

from gsbench.init.colmap.database import image_ids, image_ids_as_names, rename_images, write_pairs
from gsbench.init.options import ColmapOptions, SiftOptions
from gsbench.logs import Progress
from gsbench.system.isolate import run_with_progress

MAX_BLOCK = 16  # images on each side of a part; with more, progress would be reported too rarely
PARTS_PER_PROCESS = 6  # enough that processes end at about the same time
FEATURE_TABLES = ("keypoints", "descriptors")
MATCH_TABLES = ("matches", "two_view_geometries")

IdPair = tuple[int, int]


@dataclass(frozen=True)
class MatchingJob:
    """Inputs of a matching process: ``parts``, lists of pairs of ids, to match into ``result``.

    ``features`` is the database with keypoints and descriptors. ``template`` is a copy without
    them, whose images are named by their ids, because COLMAP splits the lines of its pair lists at
    spaces.
    """

    features: Path
    template: Path
    result: Path
    parts: list[list[IdPair]]
    sift: SiftOptions


def match_sift(
    database: Path,
    pairs: Sequence[tuple[str, str]],
    sift: SiftOptions,
    processes: int,
    progress: Progress,
) -> None:
    """Match ``pairs`` of image names and verify them.

    The result does not depend on the number of processes or on the division into parts: a pair's
    matches depend on its descriptors alone, and its RANSAC starts from the seed.
    """
    folder = database.parent / "matching"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    ids = image_ids(database)
    id_pairs = [(ids[first], ids[second]) for first, second in pairs]
    parts = divide_pairs(id_pairs, _block_size(len(ids), processes))
    _copy_without_features(database, folder / "empty.db")
    jobs = [
        MatchingJob(database, folder / "empty.db", folder / f"matches-{index}.db", share, sift)
        for index, share in enumerate(distribute_parts(parts, processes))
    ]
    progress("match", 0, len(pairs))
    if len(jobs) == 1:
        match_parts(jobs[0], progress)
    else:
        _match_in_processes(jobs, len(pairs), progress)
    for job in jobs:
        _insert(database, job.result, MATCH_TABLES)
    shutil.rmtree(folder)


def match_parts(job: MatchingJob, progress: Progress) -> None:
    """Match and verify the parts in turn. Calls native code that can abort: run it isolated."""
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.WARNING)
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    options.num_threads = 1  # see the module's docstring
    options.guided_matching = job.sift.guided_matching
    options.sift.max_ratio = job.sift.max_ratio
    options.sift.cross_check = job.sift.cross_check
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = job.result.with_suffix(".pairs.txt")
    shutil.copyfile(job.template, job.result)
    done, total = 0, sum(map(len, job.parts))
    part_database = job.result.with_suffix(".part.db")
    for part in job.parts:
        shutil.copyfile(job.template, part_database)
        images = sorted(set(chain.from_iterable(part)))
        _insert(part_database, job.features, FEATURE_TABLES, images)
        write_pairs(pairing.match_list_path, [(str(first), str(second)) for first, second in part])
        pycolmap.match_image_pairs(
            part_database,
            matching_options=options,
            pairing_options=pairing,
            verification_options=verification_options(job.sift),
            device=pycolmap.Device.cpu,
        )
        _insert(job.result, part_database, MATCH_TABLES)
        part_database.unlink()
        done += len(part)
        progress("match", done, total)


def divide_pairs(pairs: Sequence[IdPair], block: int) -> list[list[IdPair]]:
    """Divide ``pairs`` into parts with few images: pairs of two groups of ``block`` neighbours.

    Small parts are merged up to the size of a full part.

    Examples:
        >>> divide_pairs([(1, 2), (1, 3), (1, 4), (2, 3), (2, 4), (3, 4)], 2)
        [[(1, 2)], [(1, 3), (1, 4), (2, 3), (2, 4)], [(3, 4)]]
    """
    blocks: dict[tuple[int, int], list[IdPair]] = {}
    for first, second in sorted(pairs):
        blocks.setdefault(((first - 1) // block, (second - 1) // block), []).append((first, second))
    parts: list[list[IdPair]] = []
    for _, members in sorted(blocks.items()):
        if parts and len(parts[-1]) + len(members) <= block * block:
            parts[-1] += members
        else:
            parts.append(members)
    return parts


def distribute_parts(parts: Sequence[list[IdPair]], processes: int) -> list[list[list[IdPair]]]:
    """Distribute parts over at most ``processes`` shares with about equally many pairs."""
    shares: list[list[list[IdPair]]] = [[] for _ in range(max(1, min(processes, len(parts))))]
    for part in sorted(parts, key=len, reverse=True):
        min(shares, key=lambda share: sum(map(len, share))).append(part)
    return shares


def _block_size(images: int, processes: int) -> int:
    """Images on each side of a part, so that each process gets about `PARTS_PER_PROCESS` parts."""
    # k blocks of images make k (k + 1) / 2 parts
    blocks = math.ceil(math.sqrt(2 * PARTS_PER_PROCESS * processes))
    return min(max(math.ceil(images / blocks), 2), MAX_BLOCK)


def _match_in_processes(jobs: Sequence[MatchingJob], count: int, progress: Progress) -> None:
    matched = [0] * len(jobs)

    def run(index: int) -> None:
        def report_sum(phase: str, done: int, total: int | None, note: str = "") -> None:
            matched[index] = done
            progress(phase, sum(matched), count)

        run_with_progress(match_parts, jobs[index], report_sum, what="matching")

    with ThreadPoolExecutor(len(jobs)) as pool:
        list(pool.map(run, range(len(jobs))))


def _copy_without_features(database: Path, target: Path) -> None:
    shutil.copyfile(database, target)
    with closing(sqlite3.connect(target)) as connection:
        with connection:
            for table in FEATURE_TABLES:
                connection.execute(f"DELETE FROM {table}")
        connection.execute("VACUUM")
    rename_images(target, {image_id: str(image_id) for image_id in image_ids(target).values()})


def _insert(
    target: Path, source: Path, tables: Sequence[str], images: Sequence[int] | None = None
) -> None:
    """Copy the rows of ``tables`` from ``source`` to ``target``, of all images or of some ids."""
    condition = "" if images is None else f" WHERE image_id IN ({', '.join(map(str, images))})"
    with closing(sqlite3.connect(target)) as connection:
        connection.execute("ATTACH DATABASE ? AS source", (str(source),))
        with connection:
            for table in tables:
                connection.execute(
                    f"INSERT INTO main.{table} SELECT * FROM source.{table}{condition}"
                )


# COLMAP reports no progress within a call, so the pairs are divided over several calls
VERIFY_CALLS = 20
MIN_PAIRS_PER_CALL = 50


def verification_options(options: ColmapOptions) -> pycolmap.TwoViewGeometryOptions:
    """The options of COLMAP's geometric verification of a pair."""
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = options.seed
    verification.min_num_inliers = options.min_inliers
    verification.min_inlier_ratio = options.min_inlier_ratio
    return verification


def verify_pairs(
    path: Path,
    pairs: Sequence[tuple[str, str]],
    options: pycolmap.TwoViewGeometryOptions,
    progress: Progress,
) -> None:
    """Run COLMAP's geometric verification on the stored matches of ``pairs``."""
    list_file = path.with_suffix(".pairs.txt")
    size = max(len(pairs) // VERIFY_CALLS, MIN_PAIRS_PER_CALL)
    progress("verify", 0, len(pairs))
    with image_ids_as_names(path) as new_names:
        for start in range(0, len(pairs), size):
            part = pairs[start : start + size]
            write_pairs(
                list_file, [(new_names[first], new_names[second]) for first, second in part]
            )
            pycolmap.verify_matches(path, list_file, options)
            progress("verify", start + len(part), len(pairs))
    list_file.unlink(missing_ok=True)


# COLMAP reports no progress within a call, so it is called for a few images at a time
IMAGES_PER_CALL = 8
IMAGES_PER_THREAD = 2  # least number in a call, so that all threads have work


def extract_sift(
    database: Path,
    images: Path,
    names: Sequence[str],
    sift: SiftOptions,
    threads: int,
    progress: Progress,
    masks: Path | None = None,
) -> None:
    """Detect and describe keypoints in the database's images ``names``.

    ``masks`` is a folder of masks, named as COLMAP expects. Black pixels get no keypoints.
    """
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = threads
    options.max_image_size = sift.max_image_size
    options.sift.max_num_features = sift.max_num_features
    options.sift.peak_threshold = sift.peak_threshold
    options.sift.edge_threshold = sift.edge_threshold
    options.sift.first_octave = sift.first_octave
    reading = pycolmap.ImageReaderOptions()
    if masks is not None:
        reading.mask_path = masks
    progress("extract", 0, len(names))
    batch_size = max(IMAGES_PER_CALL, IMAGES_PER_THREAD * threads)
    for start in range(0, len(names), batch_size):
        batch = list(names[start : start + batch_size])
        pycolmap.extract_features(
            database,
            images,
            image_names=batch,
            reader_options=reading,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
        progress("extract", start + len(batch), len(names))
