"""COLMAP's SIFT features, their matching, and the verification of matched pairs.

All of it calls native code that can abort: run it isolated.

Matching uses several cores by processes instead of threads, since COLMAP's matcher is not safe with
two threads in one process. Its nearest-neighbour search (faiss) calls a BLAS that pycolmap's wheels
build for one thread and without locks. Two simultaneous calls can corrupt each other's numbers:
rarely, and mostly on a busy machine, a pair loses some or most of its matches. With one thread for
each process, matches are repeatable to the bit. (COLMAP's brute force, which is repeatable on
threads, takes 21 times as long, and 3 % of its matches are others.) Each call builds a search index
for each of its images, which costs more than matching a pair, so the pairs are divided into parts
with few images.
"""

from __future__ import annotations

import math
import shutil
import sqlite3
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from itertools import chain, groupby
from pathlib import Path

import pycolmap

from gsbench.init.colmap.database import DatabaseTask, image_ids, writable
from gsbench.init.options import ColmapOptions, SiftOptions
from gsbench.logs import Progress
from gsbench.system.isolate import run_isolated

MAX_BLOCK = 16  # images on each side of a part; with more, progress would be reported too rarely
PARTS_PER_PROCESS = 6  # enough that processes end at about the same time
FEATURE_TABLES = ("keypoints", "descriptors")
DROP_FEATURES = [f"DELETE FROM {table}" for table in FEATURE_TABLES]
COPY = "INSERT INTO main.{0} SELECT * FROM source.{0}"
MATCHES = [COPY.format(table) for table in ("matches", "two_view_geometries")]

IdPair = tuple[int, int]


def match_sift(
    database: Path,
    pairs: Sequence[tuple[str, str]],
    sift: SiftOptions,
    progress: Progress,
) -> None:
    """Match ``pairs`` of image names in ``num_threads`` processes, and verify them.

    The result does not depend on the number of processes or on the division into parts: a pair's
    matches depend on its descriptors alone, and its RANSAC starts from the seed.
    """
    folder = database.parent / "matching"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    ids, processes = image_ids(database), sift.num_threads
    empty = folder / "empty.db"
    shutil.copyfile(database, empty)
    _run_sql(empty, *DROP_FEATURES)
    _run_sql(empty, "VACUUM")
    with writable(empty) as opened:
        for image in opened.read_all_images():
            # COLMAP splits the lines of its pair lists at spaces, which names often contain
            image.name = str(image.image_id)
            opened.update_image(image)
    numbers = [(ids[first], ids[second]) for first, second in pairs]
    shares = divide_pairs(numbers, _block_size(len(ids), processes), processes)
    results = [Path(shutil.copyfile(empty, folder / f"{k}.db")) for k in range(len(shares))]
    matched = [0] * len(shares)

    def run(index: int) -> None:
        def report_sum(phase: str, done: int, total: int | None, note: str = "") -> None:
            matched[index] = done
            progress(phase, sum(matched), len(pairs))

        run_isolated(
            match_parts,
            database,
            results[index],
            shares[index],
            sift,
            what="matching",
            progress=report_sum,
        )

    progress("match", 0, len(pairs))
    if len(shares) == 1:
        match_parts(database, results[0], shares[0], sift, progress)
    else:
        with ThreadPoolExecutor(len(shares)) as pool:
            list(pool.map(run, range(len(shares))))
    for result in results:
        _run_sql(database, *MATCHES, source=result)
    shutil.rmtree(folder)


def match_parts(
    features: Path,
    result: Path,
    parts: Sequence[Sequence[IdPair]],
    sift: SiftOptions,
    progress: Progress,
) -> None:
    """Match and verify ``parts``, lists of pairs of ids, in turn, into the database ``result``.

    It is a copy, without features, of the database ``features``. Calls native code that can abort:
    run it isolated.
    """
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.WARNING)
    options = pycolmap.FeatureMatchingOptions(
        {
            "use_gpu": False,
            "num_threads": 1,  # see the module's docstring
            "sift": {"max_ratio": sift.max_ratio},
        }
    )
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = result.with_suffix(".pairs.txt")
    done, total = 0, sum(map(len, parts))
    for part in parts:
        images = ", ".join(map(str, {*chain.from_iterable(part)}))
        copies = [f"{COPY.format(table)} WHERE image_id IN ({images})" for table in FEATURE_TABLES]
        _run_sql(result, *copies, source=features)
        lines = [f"{first} {second}\n" for first, second in part]
        pairing.match_list_path.write_text("".join(lines))
        pycolmap.match_image_pairs(
            result,
            matching_options=options,
            pairing_options=pairing,
            verification_options=verification_options(sift),
            device=pycolmap.Device.cpu,
        )
        _run_sql(result, *DROP_FEATURES)
        done += len(part)
        progress("match", done, total)


def divide_pairs(pairs: Sequence[IdPair], block: int, processes: int) -> list[list[list[IdPair]]]:
    """Divide ``pairs`` into parts with few images, and these among at most ``processes`` shares.

    A part has the pairs of two groups of ``block`` neighbours; small parts are merged up to the
    size of a full one. Shares have about equally many pairs.

    Examples:
        >>> divide_pairs([(1, 2), (1, 3), (1, 4), (2, 3), (2, 4), (3, 4)], 2, 1)
        [[[(1, 3), (1, 4), (2, 3), (2, 4)], [(1, 2)], [(3, 4)]]]
    """

    def groups(pair: IdPair) -> list[int]:
        return [(number - 1) // block for number in pair]

    parts: list[list[IdPair]] = []
    for _, members in groupby(sorted(pairs, key=groups), groups):
        part = list(members)
        if parts and len(parts[-1]) + len(part) <= block * block:
            parts[-1] += part
        else:
            parts.append(part)
    parts.sort(key=len, reverse=True)
    return [parts[start::processes] for start in range(max(1, min(processes, len(parts))))]


def _block_size(images: int, processes: int) -> int:
    """Images on each side of a part, so that each process gets about `PARTS_PER_PROCESS` parts."""
    # k blocks of images make k (k + 1) / 2 parts
    blocks = math.ceil(math.sqrt(2 * PARTS_PER_PROCESS * processes))
    return min(max(math.ceil(images / blocks), 2), MAX_BLOCK)


def _run_sql(path: Path, *statements: str, source: Path | None = None) -> None:
    """Run SQL on a database, in one transaction, with another attached as ``source``."""
    with closing(sqlite3.connect(path)) as connection:
        if source:
            connection.execute("ATTACH DATABASE ? AS source", (str(source),))
        with connection:
            for statement in statements:
                connection.execute(statement)


def verification_options(options: ColmapOptions) -> pycolmap.TwoViewGeometryOptions:
    """The options of COLMAP's geometric verification of a pair."""
    return pycolmap.TwoViewGeometryOptions(
        {
            "ransac": {"random_seed": options.seed},
            "min_num_inliers": options.min_inliers,
            "min_inlier_ratio": options.min_inlier_ratio,
        }
    )


def verify_pairs(path: Path, options: ColmapOptions, progress: Progress) -> None:
    """Run COLMAP's geometric verification on all stored matches."""
    progress("verify", 0, 1)
    pycolmap.geometric_verification(path, two_view_geometry_options=verification_options(options))
    progress("verify", 1, 1)


# COLMAP reports no progress within a call, so it is called for a few images at a time
IMAGES_PER_CALL = 8
IMAGES_PER_THREAD = 2  # least number in a call, so that all threads have work


def extract_sift(
    task: DatabaseTask, sift: SiftOptions, progress: Progress, masks: Path | None = None
) -> None:
    """Detect and describe keypoints in the task's images.

    ``masks`` is a folder of masks, named as COLMAP expects. Black pixels get no keypoints.
    """
    names = ("max_num_features", "peak_threshold", "edge_threshold", "first_octave")
    options = pycolmap.FeatureExtractionOptions(
        {
            "use_gpu": False,
            "num_threads": sift.num_threads,
            "max_image_size": sift.max_image_size,
            "sift": {name: getattr(sift, name) for name in names},
        }
    )
    reading = pycolmap.ImageReaderOptions({"mask_path": masks or ""})
    progress("extract", 0, len(task.names))
    batch_size = max(IMAGES_PER_CALL, IMAGES_PER_THREAD * sift.num_threads)
    for start in range(0, len(task.names), batch_size):
        batch = task.names[start : start + batch_size]
        pycolmap.extract_features(
            task.database,
            task.images,
            image_names=batch,
            reader_options=reading,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
        progress("extract", start + len(batch), len(task.names))
