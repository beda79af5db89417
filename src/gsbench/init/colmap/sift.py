"""COLMAP's own SIFT: features, and matches verified on several cores by processes, never by threads. Run it isolated.

Two threads of COLMAP's matcher in one process are not safe. The nearest-neighbour search (faiss) calls a BLAS that
pycolmap's wheels carry built for one thread and without locks, so two calls at the same moment can spoil each other's
numbers: rarely, and mostly on a busy machine, a pair loses some or most of its matches. One thread in a process of its
own matches to the bit. The pairs are divided so that few images are needed at a time, because a call builds a search
index for each of its images anew, which costs more than matching a pair.
"""

from __future__ import annotations

import math
import shutil
import sqlite3
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pycolmap

from gsbench.init.colmap.database import image_ids, rename_images, write_pairs
from gsbench.init.colmap.reconstruct import verification_options
from gsbench.logs import Progress
from gsbench.system.isolate import run_with_progress

if TYPE_CHECKING:
    from gsbench.init.sfm import Sfm

IMAGES_PER_CALL = 8  # COLMAP reports no progress within a call, so it is called for a few images at a time, …
IMAGES_PER_THREAD = 2  # … and for more where many threads want work


def extract_sift(
    database: Path,
    images: Path,
    names: Sequence[str],
    sift: Sfm,
    threads: int,
    progress: Progress,
    masks: Path | None = None,
) -> None:
    """Detect and describe keypoints in the images ``names``, which are in the database.

    ``masks`` is a folder of masks as COLMAP names them: there are no keypoints where they are black.
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
    size = max(IMAGES_PER_CALL, IMAGES_PER_THREAD * threads)
    for start in range(0, len(names), size):
        part = list(names[start : start + size])
        pycolmap.extract_features(
            database,
            images,
            image_names=part,
            reader_options=reading,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
        progress("extract", start + len(part), len(names))


MAX_BLOCK = 16  # images on each side of a part; more would report progress too seldom
PARTS_PER_PROCESS = 6  # enough that processes end at about the same time
FEATURE_TABLES = ("keypoints", "descriptors")
MATCH_TABLES = ("matches", "two_view_geometries")

IdPair = tuple[int, int]


@dataclass(frozen=True)
class MatchingJob:
    """Job of one matching process: ``parts``, lists of pairs of image ids, whose matches go into ``result``.

    ``features`` is the database with keypoints and descriptors, ``empty`` the same without them and with images that
    are named by their ids (COLMAP's pair lists are divided at spaces, which names of photographs often contain).
    """

    features: Path
    empty: Path
    result: Path
    parts: list[list[IdPair]]
    sift: Sfm


def match_sift(
    database: Path,
    pairs: Sequence[tuple[str, str]],
    sift: Sfm,
    processes: int,
    progress: Progress,
) -> None:
    """Match ``pairs`` of image names and verify them.

    The result depends neither on the number of processes nor on how the pairs are divided: a pair's matches are a
    function of its descriptors, and its RANSAC starts from the seed.
    """
    folder = database.parent / "matching"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    ids = image_ids(database)
    parts = divide([(ids[first], ids[second]) for first, second in pairs], _block_size(len(ids), processes))
    _copy_without_features(database, folder / "empty.db")
    jobs = [
        MatchingJob(database, folder / "empty.db", folder / f"matches-{index}.db", share, sift)
        for index, share in enumerate(deal(parts, processes))
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
    """Match and verify the parts of ``job`` one after the other. Calls native code that can abort: run it isolated."""
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.WARNING)
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    options.num_threads = 1  # see the head of this file
    options.guided_matching = job.sift.guided_matching
    options.sift.max_ratio = job.sift.max_ratio
    options.sift.cross_check = job.sift.cross_check
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = job.result.with_suffix(".pairs.txt")
    shutil.copyfile(job.empty, job.result)
    done, total = 0, sum(map(len, job.parts))
    part_database = job.result.with_suffix(".part.db")
    for part in job.parts:
        shutil.copyfile(job.empty, part_database)
        _insert(part_database, job.features, FEATURE_TABLES, sorted({image for pair in part for image in pair}))
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


def divide(pairs: Sequence[IdPair], block: int) -> list[list[IdPair]]:
    """Parts of ``pairs`` that hold few images each: ``block`` neighbours against ``block`` neighbours.

    Parts that come out thin, as those of few pairs do, are put together up to the size of a full one.

    Examples:
        >>> divide([(1, 2), (1, 3), (1, 4), (2, 3), (2, 4), (3, 4)], 2)
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


def deal(parts: Sequence[list[IdPair]], processes: int) -> list[list[list[IdPair]]]:
    """Shares of about as many pairs for each process; fewer shares where there are fewer parts."""
    shares: list[list[list[IdPair]]] = [[] for _ in range(max(1, min(processes, len(parts))))]
    for part in sorted(parts, key=len, reverse=True):
        min(shares, key=lambda share: sum(map(len, share))).append(part)
    return shares


def _block_size(images: int, processes: int) -> int:
    """Images on a side of a part, so that all pairs of ``images`` fall into `PARTS_PER_PROCESS` for each process."""
    blocks = math.ceil(math.sqrt(2 * PARTS_PER_PROCESS * processes))  # k blocks of images make k (k + 1) / 2 parts
    return min(max(math.ceil(images / blocks), 2), MAX_BLOCK)


def _match_in_processes(jobs: Sequence[MatchingJob], count: int, progress: Progress) -> None:
    matched = [0] * len(jobs)

    def run(index: int) -> None:
        def all_together(phase: str, done: int, total: int | None, note: str = "") -> None:
            matched[index] = done
            progress(phase, sum(matched), count)

        run_with_progress(match_parts, jobs[index], all_together, what="matching")

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


def _insert(target: Path, source: Path, tables: Sequence[str], images: Sequence[int] | None = None) -> None:
    """Add the rows of ``tables`` of one database to another's; ``images``: only those of these images."""
    chosen = "" if images is None else f" WHERE image_id IN ({', '.join(map(str, images))})"
    with closing(sqlite3.connect(target)) as connection:
        connection.execute("ATTACH DATABASE ? AS source", (str(source),))
        with connection:
            for table in tables:
                connection.execute(f"INSERT INTO main.{table} SELECT * FROM source.{table}{chosen}")
