"""Explicit SIMD in numba kernels: vectors of 16 float32, and masks of 16 truth values.

The auto-vectorisation of numba loops is fragile: one unsuitable index type makes an inner loop
scalar. Here a vector is an ordinary value. ``load`` and ``store`` move it; ``+ - * /``, ``-x`` and
comparisons work lane by lane, and Python or numpy numbers are broadcast. Comparisons give a mask
for ``&``, ``|``, ``~`` and ``select``. LLVM maps a vector to one AVX-512 register, two of AVX2, or
four of SSE or NEON. Results do not depend on this, except that ``fma`` is fused only on hosts with
that instruction.

Indices count array elements; they are not checked and must not be negative. Arrays are contiguous.
"""

import math
import operator
from collections.abc import Callable
from inspect import Parameter, Signature, signature

from llvmlite import ir
from numba.core import cgutils, types
from numba.core import extending as numba_extending
from numba.core.extending import lower_builtin, models, register_model
from numba.core.typing.templates import AbstractTemplate, infer_global
from numba.core.typing.templates import signature as numba_signature

LANES = 16  # of float32


class Vector(types.Type):
    """The numba type of 16 float32."""

    def __init__(self) -> None:
        self.ir = ir.VectorType(ir.FloatType(), LANES)
        self.bits_ir = ir.VectorType(ir.IntType(32), LANES)
        super().__init__(name=f"float32x{LANES}")

    def constant(self, value: float) -> ir.Constant:
        return ir.Constant(self.ir, [ir.Constant(self.ir.element, value)] * LANES)

    def bits(self, value: int) -> ir.Constant:
        return ir.Constant(self.bits_ir, [ir.Constant(self.bits_ir.element, value)] * LANES)


class Mask(types.Type):
    """The numba type of 16 truth values."""

    def __init__(self) -> None:
        self.ir = ir.VectorType(ir.IntType(1), LANES)
        super().__init__(name=f"maskx{LANES}")


VECTOR = Vector()
MASK = Mask()
BINARY = [(Vector, Vector), (Vector, types.Number), (types.Number, Vector)]


@register_model(Vector)
@register_model(Mask)
class _Model(models.PrimitiveModel):
    def __init__(self, manager, frontend_type):
        super().__init__(manager, frontend_type, frontend_type.ir)


def whole(number, bits=32):
    """An integer as a constant of LLVM."""
    return ir.Constant(ir.IntType(bits), number)


def lane_indices(lanes):
    """The numbers of lanes as a constant for LLVM's shuffles."""
    return ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), [*map(whole, lanes)])


def broadcast(builder, scalar, kind):
    """The LLVM value ``scalar`` in all lanes of a vector of the LLVM type ``kind``."""
    undefined = ir.Constant(kind, ir.Undefined)
    first = builder.insert_element(undefined, scalar, whole(0))
    return builder.shuffle_vector(first, undefined, lane_indices([0] * kind.count))


def as_vectors(context, builder, values, kinds):
    """``values``, of the numba types ``kinds``, as vectors; numbers are broadcast to all lanes."""
    return [
        broadcast(builder, context.cast(builder, value, kind, types.float32), VECTOR.ir)
        if isinstance(kind, types.Number)
        else value
        for value, kind in zip(values, kinds, strict=True)
    ]


def lowering(gives, names: str, check: Callable[..., None] = lambda *kinds: None):
    """Make numba call a function ``emit(context, builder, sig, args)`` where a kernel calls it.

    ``names`` are the kernel's arguments, ``gives`` is the numba type of the result, and ``check``
    raises TypeError for types of arguments that the function does not take.
    """

    def decorate(emit):
        def define(typing_context, *kinds):
            check(*kinds)
            return gives(*kinds), emit

        define.__name__, define.__doc__ = emit.__name__, emit.__doc__
        # numba reads the number of arguments here
        parameters = [
            Parameter(name, Parameter.POSITIONAL_OR_KEYWORD)
            for name in ("typing_context", *names.split())
        ]
        define.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
        return numba_extending.intrinsic(define)

    return decorate


def of_vectors(emit):
    """`lowering` of a function ``emit(builder, *operands)`` of vectors and numbers to a vector."""

    def check(*kinds):
        if not all(isinstance(kind, Vector | types.Number) for kind in kinds):
            raise TypeError(f"vectors and numbers are needed, got {kinds}")

    def codegen(context, builder, sig, args):
        return emit(builder, *as_vectors(context, builder, args, sig.args))

    codegen.__name__, codegen.__doc__ = emit.__name__, emit.__doc__
    _, *names = signature(emit).parameters
    return lowering(VECTOR, " ".join(names), check)(codegen)


def _register_operator(functions, operands, emit, gives=VECTOR):
    """Make numba compile ``functions`` to ``emit(builder, *operands)``.

    ``operands`` lists the combinations of types that they take, ``gives`` is the type of the
    result.
    """

    class _Template(AbstractTemplate):
        def generic(self, args, kws):
            fits = any(
                len(args) == len(kinds) and all(map(isinstance, args, kinds)) for kinds in operands
            )
            return numba_signature(gives, *args) if fits else None

    def lower(context, builder, sig, args):
        return emit(builder, *as_vectors(context, builder, args, sig.args))

    for function in functions:
        infer_global(function)(type("_Template", (_Template,), {}))
        for kinds in operands:
            lower_builtin(function, *kinds)(lower)


def _emits(instruction, *options):
    """A function (builder, *operands) that emits one LLVM instruction."""
    return lambda builder, *operands: getattr(builder, instruction)(*options, *operands)


# Python's operators by their names in ``operator``, with LLVM's instruction for each.
for _name, _instruction in (("add", "fadd"), ("sub", "fsub"), ("mul", "fmul"), ("truediv", "fdiv")):
    _both = [getattr(operator, _name), getattr(operator, f"i{_name}")]
    _register_operator(_both, BINARY, _emits(_instruction))
for _name, _sign in (("lt", "<"), ("le", "<="), ("gt", ">"), ("ge", ">=")):
    _register_operator([getattr(operator, _name)], BINARY, _emits("fcmp_ordered", _sign), MASK)
_register_operator([operator.and_, operator.iand], [(Mask, Mask)], _emits("and_"), MASK)
_register_operator([operator.or_, operator.ior], [(Mask, Mask)], _emits("or_"), MASK)
_register_operator([operator.neg], [(Vector,)], _emits("fneg"))
_register_operator([operator.invert], [(Mask,)], _emits("not_"), MASK)


# Memory


def address(context, builder, sig, args):
    """Address of element ``args[1]`` of the array ``args[0]``."""
    data = context.make_array(sig.args[0])(context, builder, args[0]).data
    return builder.gep(data, [context.cast(builder, args[1], sig.args[1], types.intp)])


def pointer_to(context, builder, sig, args, kind=VECTOR.ir):
    """`address` as a pointer to a value of the LLVM type ``kind``."""
    return builder.bitcast(address(context, builder, sig, args), kind.as_pointer())


def _is_array(kind, dtype):
    return isinstance(kind, types.Array) and kind.layout == "C" and kind.dtype == dtype


def _check_array(array, *others):
    if not _is_array(array, types.float32):
        raise TypeError(f"a contiguous float32 array is needed, got {array}")


def _check_numbers(array, index):
    if not _is_array(array, types.uint8):
        _check_array(array)


@lowering(VECTOR, "array index", _check_numbers)
def load(context, builder, sig, args):
    """The vector ``array.flat[index : index + 16]`` of a float32 or uint8 array."""
    # LLVM aligns the stack to 16 bytes only. Vectors that it spills to the stack could then cross
    # cache lines, in some processes and threads but not in others, which would cost a quarter of a
    # kernel's time.
    builder.function.attributes.alignstack = 4 * LANES
    builder.function.attributes.add("nounwind")
    if sig.args[0].dtype == types.float32:
        return builder.load(pointer_to(context, builder, sig, args), align=4)
    numbers = pointer_to(context, builder, sig, args, ir.VectorType(ir.IntType(8), LANES))
    return builder.uitofp(builder.load(numbers, align=1), VECTOR.ir)


@lowering(types.void, "array index value", _check_array)
def store(context, builder, sig, args):
    """Write the vector ``value`` to ``array.flat[index : index + 16]``."""
    (operand,) = as_vectors(context, builder, args[2:], sig.args[2:])
    builder.store(operand, pointer_to(context, builder, sig, args), align=4)
    return context.get_dummy_value()


def _rows(context, builder, sig, args, width):
    """The addresses of the rows ``indices[k]`` of an array [N, ``width``], one for each lane k.

    ``args`` starts with the array and ``indices``.
    """
    data, indices = (
        context.make_array(sig.args[k])(context, builder, args[k]).data for k in range(2)
    )
    numbers = [builder.load(builder.gep(indices, [whole(lane, 64)])) for lane in range(LANES)]
    return [builder.gep(data, [builder.mul(number, whole(width, 64))]) for number in numbers]


def _gathering(width):
    @lowering(types.UniTuple(VECTOR, width), "array indices", _check_array)
    def gather(context, builder, sig, args):
        """Load the rows ``indices`` [16] of an array: a vector for each column."""
        rows, columns = _rows(context, builder, sig, args, width), []
        for column in range(width):
            vector = ir.Constant(VECTOR.ir, ir.Undefined)
            for lane, row in enumerate(rows):
                value = builder.load(builder.gep(row, [whole(column, 64)]))
                vector = builder.insert_element(vector, value, whole(lane))
            columns.append(vector)
        return context.make_tuple(builder, sig.return_type, columns)

    return gather


gather_numbers, gather_vectors, gather_fours = map(_gathering, (1, 3, 4))


@lowering(types.void, "array indices columns", _check_array)
def scatter(context, builder, sig, args):
    """Write the rows ``indices`` [16] of an array; ``columns`` are a vector each.

    If indices are equal, the last lane is kept.
    """
    width = sig.args[2].count
    rows = _rows(context, builder, sig, args, width)
    for column in range(width):
        vector = builder.extract_value(args[2], column)
        for lane, row in enumerate(rows):
            place = builder.gep(row, [whole(column, 64)])
            builder.store(builder.extract_element(vector, whole(lane)), place)
    return context.get_dummy_value()


def _prefetching(caches):
    @lowering(types.void, "array index")
    def prefetch(context, builder, sig, args):
        """Prefetch the cache line of ``array.flat[index]``; never faults."""
        byte_pointer, word = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte_pointer, word, word, word])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        pointer = pointer_to(context, builder, sig, args, ir.IntType(8))
        read, data = 0, 1
        builder.call(function, [pointer, *map(whole, (read, caches, data))])
        return context.get_dummy_value()

    return prefetch


prefetch = _prefetching(3)  # into all caches
# Into all but the first level, for what streams from memory: few lines can be on their way to the
# first level at once; to the second, several times as many.
prefetch_far = _prefetching(2)


# Functions of vectors and masks


def _call(builder, name, *operands):
    kind = ir.FunctionType(VECTOR.ir, [VECTOR.ir] * len(operands))
    return builder.call(
        cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f32"), operands
    )


@of_vectors
def splat(builder, scalar):
    """A vector with ``scalar`` in all lanes."""
    return scalar


@of_vectors
def fma(builder, a, b, c):
    """``a * b + c``, fused if that is fast on the host."""
    return _call(builder, "fmuladd", a, b, c)


# `minimum` and `maximum` are one instruction of x86, where LLVM's minnum takes several.


@of_vectors
def minimum(builder, a, b):
    """``a if a < b else b``, which is b if either is NaN."""
    return builder.select(builder.fcmp_ordered("<", a, b), a, b)


@of_vectors
def maximum(builder, a, b):
    """``a if a > b else b``, which is b if either is NaN."""
    return builder.select(builder.fcmp_ordered(">", a, b), a, b)


@of_vectors
def absolute(builder, a):
    return _call(builder, "fabs", a)


@of_vectors
def square_root(builder, a):
    return _call(builder, "sqrt", a)


@of_vectors
def floor(builder, a):
    return _call(builder, "floor", a)


@of_vectors
def ceil(builder, a):
    return _call(builder, "ceil", a)


@lowering(VECTOR, "mask a b")
def select(context, builder, sig, args):
    """``a`` where ``mask`` is True, else ``b``; one of the two may be a number."""
    return builder.select(args[0], *as_vectors(context, builder, args[1:], sig.args[1:]))


@lowering(types.uint64, "mask")
def mask_bits(context, builder, sig, args):
    """The mask as an integer with lane k in bit k."""
    return builder.zext(builder.bitcast(args[0], ir.IntType(LANES)), ir.IntType(64))


@lowering(MASK, "bits")
def mask_from_bits(context, builder, sig, args):
    """The mask whose lane k is bit k of an integer."""
    wide_bits = context.cast(builder, args[0], sig.args[0], types.uint64)
    return builder.bitcast(builder.trunc(wide_bits, ir.IntType(LANES)), MASK.ir)


@lowering(types.uint64, "masks index bit")
def lanes_with_bit(context, builder, sig, args):
    """A 64-bit word whose bit k is 1 if ``masks.flat[index + k] & bit`` is not 0.

    ``masks`` is a uint16 array.
    """
    lanes = 64
    kind = ir.VectorType(ir.IntType(16), lanes)
    values = builder.load(pointer_to(context, builder, sig, args, kind), align=2)
    wanted = broadcast(builder, context.cast(builder, args[2], sig.args[2], types.uint16), kind)
    none = ir.Constant(kind, [0] * lanes)
    found = builder.icmp_unsigned("!=", builder.and_(values, wanted), none)
    return builder.bitcast(found, ir.IntType(lanes))


@lowering(types.uint64, "bits")
def lowest_bit(context, builder, sig, args):
    """The number of the lowest set bit of an integer, which must not be 0."""
    wide_bits = context.cast(builder, args[0], sig.args[0], types.uint64)
    return builder.cttz(wide_bits, ir.Constant(ir.IntType(1), 1))


def _polynomial(builder, x, coefficients):
    """``sum_k coefficients[k] x^k``."""
    value = VECTOR.constant(coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = _call(builder, "fmuladd", value, x, VECTOR.constant(coefficient))
    return value


MANTISSA_BITS = 23
# 2^f on [-1/2, 1/2]: least-squares fit of the relative error at 200 Chebyshev nodes; exact at 0,
# error 1.0e-7.
_EXP2 = (1.0, 0.69314688444, 0.24022237957, 0.05550893024, 0.00967169832, 0.00132186722)
# log2(m) = 2 / ln 2 artanh(s), s = (m - 1) / (m + 1), as a series in s^2; error 2e-8 for m in
# [sqrt(1/2), sqrt(2)].
_LOG2_SERIES = tuple(2.0 / math.log(2.0) / (2 * k + 1) for k in range(5))
_BITS_OF_ROOT_HALF = 0x3F3504F3


@of_vectors
def exp2(builder, a):
    """``2^a`` with an error of at most 2.5e-7 for -126 <= a < 127.5; undefined elsewhere.

    2^a = 2^n 2^f. Adding 1.5 * 2^23 to a leaves the nearest integer n in the low bits of the
    mantissa.
    """
    magic = VECTOR.constant(1.5 * 2.0**MANTISSA_BITS)
    shifted = builder.fadd(a, magic)
    fraction = builder.fsub(a, builder.fsub(shifted, magic))
    value = builder.bitcast(_polynomial(builder, fraction, _EXP2), VECTOR.bits_ir)
    exponent = builder.shl(builder.bitcast(shifted, VECTOR.bits_ir), VECTOR.bits(MANTISSA_BITS))
    return builder.bitcast(builder.add(value, exponent), VECTOR.ir)


@of_vectors
def log2(builder, a):
    """``log2(a)`` of positive normal numbers, with an error of at most 2e-7 max(1, |log2(a)|).

    The result for other numbers is undefined.
    """
    # a = 2^n m with m from sqrt(1/2) to sqrt(2): n is the difference of the bits and those of
    # sqrt(1/2), shifted.
    bits, digits = builder.bitcast(a, VECTOR.bits_ir), VECTOR.bits(MANTISSA_BITS)
    exponent = builder.ashr(builder.sub(bits, VECTOR.bits(_BITS_OF_ROOT_HALF)), digits)
    mantissa = builder.bitcast(builder.sub(bits, builder.shl(exponent, digits)), VECTOR.ir)
    one = VECTOR.constant(1.0)
    s = builder.fdiv(builder.fsub(mantissa, one), builder.fadd(mantissa, one))
    series = _polynomial(builder, builder.fmul(s, s), _LOG2_SERIES)
    return _call(builder, "fmuladd", s, series, builder.sitofp(exponent, VECTOR.ir))


# The lane of ``lane_sums`` with the sum of its k-th argument: the four bits of k, reversed.
SUM_LANES = tuple(int(f"{k:04b}"[::-1], 2) for k in range(LANES))


@lowering(VECTOR, "vectors")
def lane_sums(context, builder, sig, args):
    """Sum the 16 lanes of each of up to 16 vectors.

    Returns a vector with the k-th sum in lane ``SUM_LANES[k]`` and 0 in the other lanes. A tree of
    shuffles and additions merges pairs of vectors at each level, so the sums of eleven vectors take
    about as long as three single sums.
    """
    level = [builder.extract_value(args[0], k) for k in range(sig.args[0].count)]
    half = LANES // 2
    while half:
        if len(level) % 2:
            level.append(VECTOR.constant(0.0))
        # In each group of 2 * half lanes, the first half sums a, the second b. Lanes that stay at
        # their place are blended, which is cheaper than a second shuffle.
        own = [lane + LANES if lane & half else lane for lane in range(LANES)]
        other = [lane - half + LANES if lane & half else lane + half for lane in range(LANES)]
        stays, moves = lane_indices(own), lane_indices(other)
        level = [
            builder.fadd(builder.shuffle_vector(a, b, stays), builder.shuffle_vector(a, b, moves))
            for a, b in zip(level[::2], level[1::2], strict=True)
        ]
        half //= 2
    return level[0]
