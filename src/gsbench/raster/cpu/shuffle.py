"""Rearrangement of vectors: transposition, blocks of pixels, integers in lanes, harmonics.

Kernels hold one quantity of 16 Gaussians in a vector, but in memory the values of one Gaussian
(record, gradient row, coefficients) are adjacent. These functions convert between the two layouts.
"""

from llvmlite import ir
from numba.core import types

from gsbench.gaussians.model import NUM_SH_REST
from gsbench.raster.cpu.simd import (
    LANES,
    VECTOR,
    address,
    broadcast,
    lane_indices,
    lowering,
    whole,
)

CHANNELS = 3
BLOCK = 4  # px, the sides of the 16 pixels of a vector
REST = CHANNELS * NUM_SH_REST  # numbers of one Gaussian in ``sh_rest``: r g b of each coefficient
# starts of the three vectors that hold them; the last two overlap by three
REST_STARTS = (0, LANES, REST - LANES)


THREE_VECTORS = types.UniTuple(VECTOR, CHANNELS)
NEIGHBOURS = LANES // CHANNELS  # neighbours of a pixel, on each side, that `neighbour_sums` reaches


def _load(builder, pointer, place):
    at = builder.gep(pointer, [whole(place, 64)])
    return builder.load(builder.bitcast(at, VECTOR.ir.as_pointer()), align=4)


def _store(builder, value, pointer, place):
    at = builder.gep(pointer, [whole(place, 64)])
    builder.store(value, builder.bitcast(at, VECTOR.ir.as_pointer()), align=4)


def _store_transposed(context, builder, pointer, rows):
    """Write the columns of a matrix, given by its 16 ``rows``, to ``pointer``."""
    half = LANES // 2
    while half:  # swap the off-diagonal squares of size ``half``
        own = [lane - half + LANES if lane & half else lane for lane in range(LANES)]
        other = [lane + LANES if lane & half else lane + half for lane in range(LANES)]
        for k in range(LANES):
            if not k & half:
                a, b = rows[k], rows[k + half]
                rows[k] = builder.shuffle_vector(a, b, lane_indices(own))
                rows[k + half] = builder.shuffle_vector(a, b, lane_indices(other))
        half //= 2
    for k, row in enumerate(rows):
        _store(builder, row, pointer, LANES * k)
    return context.get_dummy_value()


@lowering(types.void, "array index")
def transpose(context, builder, sig, args):
    """Transpose the 16x16 matrix at ``array.flat[index : index + 256]`` in place."""
    pointer = address(context, builder, sig, args)
    rows = [_load(builder, pointer, LANES * k) for k in range(LANES)]
    return _store_transposed(context, builder, pointer, rows)


@lowering(types.void, "array index vectors")
def store_columns(context, builder, sig, args):
    """Write 16 ``vectors`` as the columns of the matrix at ``array.flat[index : index + 256]``."""
    rows = [builder.extract_value(args[2], k) for k in range(LANES)]
    return _store_transposed(context, builder, address(context, builder, sig, args), rows)


@lowering(types.UniTuple(VECTOR, NEIGHBOURS), "before own after")
def neighbour_sums(context, builder, sig, args):
    """The sums of the left and the right neighbours of 16 numbers of an interleaved row.

    ``own`` are the numbers, ``before`` and ``after`` the 16 numbers beside them. Vector k has the
    neighbours k + 1 pixels away. Loads of them would cross cache lines.
    """
    before, own, after = args
    sums = []
    for shift in range(CHANNELS, LANES, CHANNELS):
        left = builder.shuffle_vector(
            before, own, lane_indices(range(LANES - shift, 2 * LANES - shift))
        )
        right = builder.shuffle_vector(own, after, lane_indices(range(shift, LANES + shift)))
        sums.append(builder.fadd(left, right))
    return context.make_tuple(builder, sig.return_type, sums)


def _row_pointers(context, builder, sig, args, numbers):
    """Pointers to the four rows of a block in the array ``args[0]``.

    Each row has ``numbers`` float32. The first starts at index ``args[1]``; rows are ``args[2]``
    numbers apart.
    """
    first = address(context, builder, sig, args)
    stride = context.cast(builder, args[2], sig.args[2], types.intp)
    kind = ir.VectorType(ir.FloatType(), numbers).as_pointer()
    places = [builder.mul(stride, whole(row, 64)) for row in range(LANES // BLOCK)]
    return [builder.bitcast(builder.gep(first, [place]), kind) for place in places]


@lowering(types.void, "array index stride values")
def store_block(context, builder, sig, args):
    """Write the 16 pixels of a block to an image with one number per pixel.

    The rows of the image are ``stride`` numbers apart.
    """
    for row, pointer in enumerate(_row_pointers(context, builder, sig, args, BLOCK)):
        lanes = lane_indices(range(BLOCK * row, BLOCK * (row + 1)))
        builder.store(builder.shuffle_vector(args[3], args[3], lanes), pointer, align=4)
    return context.get_dummy_value()


@lowering(types.void, "array index stride red green blue")
def store_colors(context, builder, sig, args):
    """Write the 16 pixels of a block to an image with three numbers per pixel.

    The rows of the image are ``stride`` numbers apart.
    """
    red, green, blue = args[3:]
    for row, pointer in enumerate(_row_pointers(context, builder, sig, args, CHANNELS * BLOCK)):
        lanes = list(range(BLOCK * row, BLOCK * (row + 1)))
        both = [*lanes, *(LANES + lane for lane in lanes), *[0] * (LANES - 2 * BLOCK)]
        red_green = builder.shuffle_vector(red, green, lane_indices(both))
        mixed = [place for k, lane in enumerate(lanes) for place in (k, BLOCK + k, LANES + lane)]
        row_of_colors = builder.shuffle_vector(red_green, blue, lane_indices(mixed))
        builder.store(row_of_colors, pointer, align=4)
    return context.get_dummy_value()


@lowering(THREE_VECTORS, "array index stride")
def load_colors(context, builder, sig, args):
    """The inverse of ``store_colors``: red, green and blue of the 16 pixels of a block."""
    pointers = _row_pointers(context, builder, sig, args, CHANNELS * BLOCK)
    rows = [builder.load(pointer, align=4) for pointer in pointers]
    channels = []
    for channel in range(CHANNELS):
        # places of this channel in two rows side by side
        places = lane_indices([CHANNELS * k + channel for k in range(2 * BLOCK)])
        upper, lower = (builder.shuffle_vector(rows[k], rows[k + 1], places) for k in (0, 2))
        channels.append(builder.shuffle_vector(upper, lower, lane_indices(range(LANES))))
    return context.make_tuple(builder, sig.return_type, channels)


@lowering(VECTOR, "value")
def as_integers(context, builder, sig, args):
    """Convert whole numbers to int32, kept as the bits of float32 lanes.

    Only store them, or read them as int32.
    """
    return builder.bitcast(builder.fptosi(args[0], VECTOR.bits_ir), VECTOR.ir)


@lowering(VECTOR, "first past")
def as_span(context, builder, sig, args):
    """``first + past * 65536`` as int32, kept as the bits of float32 lanes."""
    low, high = (builder.fptosi(value, VECTOR.bits_ir) for value in args)
    return builder.bitcast(builder.or_(low, builder.shl(high, VECTOR.bits(16))), VECTOR.ir)


@lowering(VECTOR, "start")
def index_bits(context, builder, sig, args):
    """``start`` + lane as int32, kept as the bits of float32 lanes."""
    first = context.cast(builder, args[0], sig.args[0], types.int32)
    everywhere = broadcast(builder, first, VECTOR.bits_ir)
    return builder.bitcast(builder.add(everywhere, lane_indices(range(LANES))), VECTOR.ir)


@lowering(THREE_VECTORS, "array index")
def load_rest(context, builder, sig, args):
    """Load ``array.flat[index : index + 45]`` as three vectors that start at ``REST_STARTS``."""
    pointer = address(context, builder, sig, args)
    vectors = [_load(builder, pointer, start) for start in REST_STARTS]
    return context.make_tuple(builder, sig.return_type, vectors)


@lowering(types.void, "array index values")
def store_rest(context, builder, sig, args):
    """The inverse of ``load_rest``."""
    pointer = address(context, builder, sig, args)
    for k, start in enumerate(REST_STARTS):
        _store(builder, builder.extract_value(args[2], k), pointer, start)
    return context.get_dummy_value()


@lowering(THREE_VECTORS, "rest")
def by_channel(context, builder, sig, args):
    """Split the result of ``load_rest`` into red, green and blue, with coefficient k in lane k.

    Lane 15 repeats lane 14.
    """
    first, second, third = (builder.extract_value(args[0], k) for k in range(CHANNELS))
    channels = []
    for channel in range(CHANNELS):
        places = [CHANNELS * min(k, NUM_SH_REST - 1) + channel for k in range(LANES)]
        front = [place if place < 2 * LANES else 0 for place in places]
        whole = [k if p < 2 * LANES else p - REST_STARTS[2] + LANES for k, p in enumerate(places)]
        joined = builder.shuffle_vector(first, second, lane_indices(front))
        channels.append(builder.shuffle_vector(joined, third, lane_indices(whole)))
    return context.make_tuple(builder, sig.return_type, channels)


@lowering(THREE_VECTORS, "basis red green blue")
def outer_rest(context, builder, sig, args):
    """``basis[k]`` times a colour, in the layout of ``load_rest``.

    ``basis`` has coefficient k in lane k.
    """
    row, *colors = args
    undefined = ir.Constant(VECTOR.ir, ir.Undefined)
    color = undefined
    for channel, value in enumerate(colors):
        scalar = context.cast(builder, value, sig.args[channel + 1], types.float32)
        color = builder.insert_element(color, scalar, whole(channel))

    def spread(vector, lanes):
        return builder.shuffle_vector(vector, undefined, lane_indices(lanes))

    products = []
    for start in REST_STARTS:
        numbers = range(start, start + LANES)
        factor = spread(row, [number // CHANNELS for number in numbers])
        products.append(
            builder.fmul(factor, spread(color, [number % CHANNELS for number in numbers]))
        )
    return context.make_tuple(builder, sig.return_type, products)
