"""The types of the arguments of every kernel that each training calls.

With them, kernels can be compiled before their first call. Arrays are contiguous.
"""

from typing import Any

from numba import types

from gsbench.raster.base import CameraNumbers
from gsbench.raster.cpu import layout as at
from gsbench.raster.cpu.adam import adam_rows
from gsbench.raster.cpu.binning import (
    balance_tiles,
    fill_shards,
    pair_shards,
    sort_by_depth,
    start_tiles,
)
from gsbench.raster.cpu.composite import composite_backward_tiles, composite_tiles
from gsbench.raster.cpu.projection import backproject_shards, project_shards

INT, FLOAT = types.int64, types.float32
FLOATS, INTS, KEYS, RECORDS = FLOAT[::1], INT[::1], types.uint64[::1], types.int32[::1]
FLOAT_ROWS, INT_ROWS, KEY_ROWS = FLOAT[:, ::1], INT[:, ::1], types.uint64[:, ::1]

CAMERA = types.NamedTuple([INT] * 4 + [types.float64] * 20, CameraNumbers)
PARAMETERS = types.NamedUniTuple(FLOAT_ROWS, 6, at.Parameters)
FRAME = types.NamedTuple(
    [
        *(CAMERA, FLOATS, FLOATS, RECORDS, INTS, RECORDS, types.uint16[::1]),
        *(INTS, FLOATS, FLOATS, INTS, types.uint8[::1]),
    ],
    at.CpuFrame,
)
MEMORY = types.Tuple((FLOATS, INTS))
SHARDS = INT, INT  # first and past the last
GRADIENTS = types.Tuple((PARAMETERS, FLOAT_ROWS, FLOAT_ROWS, FLOAT_ROWS))
ADAM = types.NamedTuple([PARAMETERS, PARAMETERS, FLOAT_ROWS, INT], at.AdamStep)

KERNELS: tuple[tuple[Any, tuple[Any, ...]], ...] = (
    (
        project_shards,
        (MEMORY, *SHARDS, INTS, PARAMETERS, INT, CAMERA, FLOATS, RECORDS, KEYS, RECORDS, INT_ROWS),
    ),
    (sort_by_depth, (INTS, INTS, KEYS, KEYS, KEYS, INT_ROWS)),
    (
        pair_shards,
        (*SHARDS, INTS, KEYS, FLOATS, RECORDS, INT, FLOAT, INT_ROWS, KEY_ROWS, INTS),
    ),
    (start_tiles, (INT_ROWS, INTS)),
    (fill_shards, (*SHARDS, INTS, KEY_ROWS, INT_ROWS, RECORDS)),
    (balance_tiles, (INTS, INT, INTS, types.uint8[::1])),
    (composite_tiles, (MEMORY, *SHARDS, FRAME, FLOATS, FLOATS)),
    (
        composite_backward_tiles,
        (MEMORY, *SHARDS, FRAME, FLOATS, FLOATS, FLOAT_ROWS, types.none),
    ),
    (
        backproject_shards,
        (MEMORY, *SHARDS, INTS, INTS, PARAMETERS, INT, FRAME, FLOATS, GRADIENTS, ADAM),
    ),
    (adam_rows, (FLOATS, *SHARDS, *[FLOAT_ROWS] * 4, INT, FLOAT, FLOAT)),
)
