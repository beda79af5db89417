"""Memory layout of the data that kernels exchange: blocks, borders, records, gradient rows."""

from __future__ import annotations

import math

import triton.language as tl

from gsbench.raster.base import CONSTANTS

# One program of one warp composites one block: half a tile of 3DGS, four pixels per lane. Lane l
# has row l // LANE_COLUMNS, and in it every LANE_COLUMNS-th pixel from column l % LANE_COLUMNS on.
TILE = tl.constexpr(16)  # px
BLOCK_WIDTH = tl.constexpr(16)  # px; as wide as a tile
BLOCK_HEIGHT = tl.constexpr(8)  # px
BLOCK_ROWS = tl.constexpr(2)  # blocks in a tile
LANES = tl.constexpr(32)
LANE_COLUMNS = tl.constexpr(4)
STEPS = tl.constexpr(4)  # pixels per lane
BLOCK_PIXELS = tl.constexpr(128)

# The backward pass divides a list into segments of SEGMENT entries, one program each. If
# compositing continued behind a segment, a border stores the state that a program needs to start
# there. The border of the segment that starts at entry e has the number e // SEGMENT. These numbers
# are unique: borders of one list are SEGMENT entries apart, and the first segment of the next list
# starts behind them.
SEGMENT = tl.constexpr(256)  # entries; a multiple of UNROLL and UNROLL_BACK
# float32 numbers: the four quantities below of each pixel, by lane and step
BORDER = tl.constexpr(4 * 128)
TRANSMITTANCE = tl.constexpr(0)
# light that was blended behind the border
BEHIND_RED, BEHIND_GREEN, BEHIND_BLUE = tl.constexpr(128), tl.constexpr(256), tl.constexpr(384)

# A record has what compositing needs of one Gaussian: 16 float32. With (dx, dy) = pixel - mean and
# t = dx + SHEAR dy,
#     log2(alpha) = LOG2_OPACITY + CURVE_T t^2 + CURVE_Y dy^2.
# The conic is a sum of squares here: unlike a dx^2 + 2b dx dy + c dy^2, it has no cancellation for
# needles, and the exponent is never positive.
RECORD = tl.constexpr(16)
MEAN_X, MEAN_Y = tl.constexpr(0), tl.constexpr(1)  # px, integer pixel centres
SHEAR = tl.constexpr(2)  # b / a
CURVE_T, CURVE_Y = tl.constexpr(3), tl.constexpr(4)  # -log2(e)/2 a and -log2(e)/2 (c - b^2/a)
LOG2_OPACITY = tl.constexpr(5)
# 6, 7, 8: red, green, blue
RIGHTMOST_Y = tl.constexpr(9)  # px; dy of the rightmost point of the contour alpha = 1/255
# The remaining entries are int32.
COLUMNS = tl.constexpr(10)  # of blocks that the contour can touch: first + 65536 past-the-last
FIRST_ROW = tl.constexpr(11)  # of blocks that the contour can touch
CLAMPED = tl.constexpr(12)  # bit c: colour channel c was below 0

# A row has the gradient sums of one Gaussian over the pixels of one block: 16 float32. With
# h = d loss / d log(alpha), these are the sums of h, h t, h dy, h t^2, h t dy, h dy^2, red, green
# and blue; and, if requested, of |h t| and |h (d power / d dy)|. Or a row has a footprint: number
# of pixels, sum of values, sum of distances.
ROW = tl.constexpr(16)

# derivatives of red by x, y, z of the direction; then of green; then of blue
COLOR_SLOPES = tl.constexpr(9)

LOG2_E = tl.constexpr(1 / math.log(2.0))
ALPHA_MIN = tl.constexpr(CONSTANTS.alpha_min)
LOG2_ALPHA_MIN = tl.constexpr(math.log2(CONSTANTS.alpha_min))


def count_borders(pairs: int) -> int:
    """The largest number of borders of lists with ``pairs`` entries in all."""
    return max(pairs - 1, 0) // SEGMENT.value
