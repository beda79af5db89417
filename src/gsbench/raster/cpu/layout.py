"""Memory layout of the data that kernels exchange: records and gradient rows."""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from gsbench.raster.base import CameraNumbers
from gsbench.raster.cpu.shuffle import REST
from gsbench.raster.cpu.simd import LANES, SUM_LANES

# px; a tile is 4x4 blocks, row by row. Fixed by the 16-bit masks; must equal RasterConstants.tile
TILE = 16
TILE_PIXELS = TILE * TILE

# A record has what compositing needs of one visible Gaussian: 16 float32, one cache line. With
# (dx, dy) = pixel - mean, u = U_X dx + U_Y dy and v = V_Y dy,
#     log2(alpha) = LOG2_OPACITY - u^2 - v^2.
# The conic [[a, b], [b, c]] is a sum of squares here: unlike a dx^2 + 2b dx dy + c dy^2, it has no
# cancellation for needles, and the exponent is never positive.
RECORD = LANES
MEAN_X, MEAN_Y = 0, 1  # px, integer pixel centres
U_X, U_Y, V_Y = 2, 3, 4  # sqrt(log2(e)/2 a), U_X b / a, sqrt(log2(e)/2 (c - b^2/a))
LOG2_OPACITY = 5
RED, GREEN, BLUE = 6, 7, 8
SLOPE = 9  # -b / c: dy / dx of the highest point of a vertical line
RIGHTMOST_Y = 10  # px; dy of the rightmost point of the contour alpha = 1/255
DEPTH = 11  # view z
FIRST_ROW = 11  # in its place for the backward pass: see `binning.place_rows`
# The remaining entries are int32.
TILES_X, TILES_Y = 12, 13  # tiles that the contour can touch: first + 65536 past-the-last
INDEX = 14  # of the Gaussian
CLAMPED = 15  # bit c: colour channel c was below 0

# A row has the gradient sums of one Gaussian over the pixels of one shard of tiles, with h = d loss
# / d log(alpha). A record has rows for the shards from that of its first tile to that of its last.
ROW = LANES
SUM_H, SUM_H_U, SUM_H_V, SUM_H_UU, SUM_H_UV, SUM_H_VV = SUM_LANES[:6]
SUM_RED, SUM_GREEN, SUM_BLUE = SUM_LANES[6:9]
SUM_ABS_U, SUM_ABS_Y = SUM_LANES[9:11]  # |h u|, |h (U_Y u + V_Y v)|


SCRATCH = 24 * TILE_PIXELS  # float32; the forward pass needs 3 * 256 + 64 * 80


def kernel_memory(shards: int) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Scratch memory for ``shards``: a call of a kernel uses the row of its first one.

    Kernels cannot allocate memory (see `gsbench.system.jit.kernel`).
    """
    floats = torch.empty(shards, SCRATCH, dtype=torch.float32).numpy()
    return floats, np.empty((shards, 2 * LANES), np.int64)


class Parameters(NamedTuple):
    """The tensors of Gaussians, or their gradients, as numpy arrays on the same memory."""

    means: NDArray[np.float32]  # [N, 3]
    log_scales: NDArray[np.float32]  # [N, 3]
    quaternions: NDArray[np.float32]  # [N, 4]
    logits: NDArray[np.float32]  # [N, 1]
    sh_dc: NDArray[np.float32]  # [N, 3]
    sh_rest: NDArray[np.float32]  # [N, 45]


COLUMNS = (3, 3, 4, 1, 3, REST)  # of `Parameters`
SH_REST = 5  # its place

CHUNK = 512  # Gaussians whose gradients, 120 kB, stay in the cache until Adam reads them


def new_parameters(count: int) -> Parameters:
    """Uninitialised arrays for ``count`` Gaussians."""
    return Parameters(*(np.empty((count, columns), np.float32) for columns in COLUMNS))


class AdamStep(NamedTuple):
    """State of Adam besides parameters and gradients, which are those of one step."""

    first: Parameters  # moments
    second: Parameters
    # [6, 2] of each parameter, `ParameterState.factors`; [0, 2]: no step
    factors: NDArray[np.float32]
    active: int  # columns of ``sh_rest`` that can have a gradient


NO_STEP = AdamStep(new_parameters(0), new_parameters(0), np.empty((0, 2), np.float32), 0)


class CpuFrame(NamedTuple):
    """Arrays of one render: the forward pass fills them, the backward pass reads them."""

    camera: CameraNumbers
    background: NDArray[np.float32]  # [3]
    records: NDArray[np.float32]  # [N * RECORD]
    record_ints: NDArray[np.int32]  # the same memory as ``records``
    starts: NDArray[np.int64]  # [tiles + 1] first entry of each tile's list
    entries: NDArray[np.int32]  # [pairs] records, by tile, front to back
    masks: NDArray[np.uint16]  # [pairs] bit b: the record may touch block b of the tile
    processed: NDArray[np.int64]  # [tiles] end of the entries that compositing has read
    transmittance: NDArray[np.float32]  # [tiles * TILE_PIXELS] final, by tile, block and lane
    # [tiles * TILE_PIXELS] number of entries before the one that stopped the pixel
    last: NDArray[np.float32]
    bounds: NDArray[np.int64]  # [shards + 1] first tile of each shard
    tile_shard: NDArray[np.uint8]  # [tiles] shard of each tile
