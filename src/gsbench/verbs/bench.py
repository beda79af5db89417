"""``gsbench bench``: time rasterizers and the training step, side by side."""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gsbench.errors import InputError
from gsbench.raster.executors import AUTO, EXECUTORS
from gsbench.scene.options import MIN_SIZE
from gsbench.system.own_modules import allow_modules
from gsbench.verbs.arguments import ArgumentParser, path

COLUMNS = (  # of the table
    "raster",
    "size",
    "count",
    "forward_ms",
    "loss_ms",
    "backward_ms",
    "adam_ms",
    "step_ms",
    "step_ratio",
    "cpu_ms",
    "steps_per_second",
    "fps",
    "peak_memory_mb",
)
RATIO_DIGITS = 2
MAX_SIDE = 16_384  # px
MAX_COUNT = 1_000_000_000


def _parser() -> ArgumentParser:
    names = ", ".join(executor.name for executor in EXECUTORS)
    parser = ArgumentParser(
        prog="gsbench bench",
        description="Time rasterizers and the training step side by side: medians of steps that take turns.",
    )
    parser.add_argument(
        "--raster",
        default="cpu",
        help=f"names, comma between: {names}, or your own, mine.MyRasterizer",
    )
    parser.add_argument("--size", default="500x375", help="image sizes, comma between")
    parser.add_argument("--count", default="100000", help="numbers of Gaussians, comma between")
    parser.add_argument(
        "--scene",
        default="trained",
        choices=("trained", "random", "skewed"),
        help="like a trained model (default), like one at the start, or like one with its detail at few places",
    )
    parser.add_argument("--ply", type=path, help="time this model instead of a synthetic scene")
    parser.add_argument("--repeats", type=_count, default=5, help="turns that count (default 5)")
    parser.add_argument("--threads", type=_count, help="CPU threads (default: as many as torch takes)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument(
        "--no-memory", action="store_true", help="do not measure peak memory, which needs one process each"
    )
    return parser


def main(argv: Sequence[str], _runs: Path | None = None) -> int:
    """Print the table, or with ``--json`` the list of results."""
    options = _parser().parse_args(argv)
    try:
        sizes = [_size(text) for text in options.size.split(",")]
        counts = [_count(text) for text in options.count.split(",")]
    except argparse.ArgumentTypeError as error:
        raise InputError(str(error)) from error
    if options.ply is not None and not options.ply.is_file():
        raise InputError(f"--ply: {options.ply} does not exist")
    rasters = options.raster.split(",")
    if AUTO in rasters:
        raise InputError(f"--raster {AUTO} is a choice among executors: name those to time")
    allow_modules([raster for raster in rasters if "." in raster])  # the user typed them, which allows them

    from gsbench.bench import run_bench

    rows = run_bench(
        rasters,
        sizes,
        counts,
        options.ply,
        options.repeats,
        options.threads,
        not options.no_memory,
        options.scene,
    )
    print(json.dumps(rows, indent=2) if options.json else table(rows))
    return 0


def table(rows: list[dict[str, Any]]) -> str:
    """The results as aligned columns of text. Columns that no result has are left out."""
    used = [key for key in COLUMNS if any(row.get(key) is not None for row in rows)]
    cells = [used] + [[_cell(key, row.get(key)) for key in used] for row in rows]
    widths = [max(len(line[k]) for line in cells) for k in range(len(used))]
    lines = ["  ".join(text.rjust(width) for text, width in zip(line, widths, strict=True)) for line in cells]
    return "\n".join(lines)


def _cell(key: str, value: Any) -> str:
    digits = RATIO_DIGITS if key == "step_ratio" else 1
    return f"{value:.{digits}f}" if isinstance(value, float) else "-" if value is None else str(value)


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not all(side.isascii() and side.isdigit() and MIN_SIZE <= int(side) <= MAX_SIDE for side in (width, height)):
        raise argparse.ArgumentTypeError(
            f"a size is WIDTHxHEIGHT, sides from {MIN_SIZE} to {MAX_SIDE} px, for example 500x375, got {text!r}"
        )
    return int(width), int(height)


def _count(text: str) -> int:
    if not (text.isascii() and text.isdigit() and 1 <= int(text) <= MAX_COUNT):
        raise argparse.ArgumentTypeError(f"a count is at least 1 and at most {MAX_COUNT}, got {text!r}")
    return int(text)
