"""Explicit SIMD values inside numba kernels: 16 floats in one LLVM vector.

Auto-vectorisation of numba loops is fragile: an unlucky index type makes an inner loop scalar. Here a ``<16 x float>`` is
a value like any other: ``load`` and ``store`` move it, ``+ - * /``, ``-x`` and comparisons work lane by lane (a Python or
numpy number is broadcast), comparisons give a ``<16 x i1>`` mask for ``select``, ``&``, ``|`` and ``~``. LLVM maps the vector to
what the host has: one AVX-512 register, two of AVX2, four of SSE or NEON; the lanes' results do not depend on it,
apart from ``fma``, which is fused only where the host can.

Indices count array elements, are not checked and must not be negative. Arrays are contiguous, float32.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.extending import intrinsic, lower_builtin, models, register_model
from numba.core.typing.templates import AbstractTemplate, infer_global, signature

LANES = 16

_F32 = ir.FloatType()
_I32 = ir.IntType(32)
_VECTOR = ir.VectorType(_F32, LANES)
_INTEGERS = ir.VectorType(_I32, LANES)
_MASK = ir.VectorType(ir.IntType(1), LANES)


class _Vector(types.Type):
    """The numba type of 16 float32."""

    def __init__(self) -> None:
        super().__init__(name=f"float32x{LANES}")


class _Mask(types.Type):
    """The numba type of 16 truth values."""

    def __init__(self) -> None:
        super().__init__(name=f"bool{LANES}")


vector_type = _Vector()
mask_type = _Mask()


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, frontend_type: Any) -> None:
        super().__init__(manager, frontend_type, _VECTOR)


@register_model(_Mask)
class _MaskModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, frontend_type: Any) -> None:
        super().__init__(manager, frontend_type, _MASK)


# --- operators ----------------------------------------------------------------------------------------------------------


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_VECTOR, [ir.Constant(_F32, value)] * LANES)


def _integers(value: int) -> ir.Constant:
    return ir.Constant(_INTEGERS, [ir.Constant(_I32, value)] * LANES)


def _broadcast(builder: Any, scalar: Any) -> Any:
    first = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), scalar, ir.Constant(_I32, 0))
    return builder.shuffle_vector(first, ir.Constant(_VECTOR, ir.Undefined), ir.Constant(_INTEGERS, None))


def _as_vector(context: Any, builder: Any, value: Any, frontend_type: Any) -> Any:
    if isinstance(frontend_type, _Vector):
        return value
    return _broadcast(builder, context.cast(builder, value, frontend_type, types.float32))


def _register_binary(function: Any, operand: type, result: Any, emit: Callable[[Any, Any, Any], Any]) -> None:
    """Let ``function(a, b)`` of two ``operand`` values, or of a vector and a number, be what ``emit`` builds."""

    @infer_global(function)
    class _Template(AbstractTemplate):  # type: ignore[misc]
        def generic(self, args: Sequence[Any], kws: Any) -> Any:
            vectors = sum(isinstance(argument, operand) for argument in args)
            numbers = sum(isinstance(argument, types.Number) for argument in args) if operand is _Vector else 0
            return signature(result, *args) if len(args) == 2 and vectors and vectors + numbers == 2 else None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        if operand is _Vector:
            args = [_as_vector(context, builder, value, kind) for value, kind in zip(args, sig.args, strict=True)]
        return emit(builder, *args)

    lower_builtin(function, operand, operand)(lower)
    if operand is _Vector:
        lower_builtin(function, operand, types.Number)(lower)
        lower_builtin(function, types.Number, operand)(lower)


def _register_unary(function: Any, operand: type, result: Any, emit: Callable[[Any, Any], Any]) -> None:
    @infer_global(function)
    class _Template(AbstractTemplate):  # type: ignore[misc]
        def generic(self, args: Sequence[Any], kws: Any) -> Any:
            return signature(result, *args) if len(args) == 1 and isinstance(args[0], operand) else None

    lower_builtin(function, operand)(lambda context, builder, sig, args: emit(builder, args[0]))


for _function, _in_place, _method in (
    (operator.add, operator.iadd, "fadd"),
    (operator.sub, operator.isub, "fsub"),
    (operator.mul, operator.imul, "fmul"),
    (operator.truediv, operator.itruediv, "fdiv"),
):
    for _name in (_function, _in_place):
        _register_binary(_name, _Vector, vector_type, lambda builder, a, b, m=_method: getattr(builder, m)(a, b))
for _function, _symbol in ((operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">=")):
    _register_binary(
        _function, _Vector, mask_type, lambda builder, a, b, symbol=_symbol: builder.fcmp_ordered(symbol, a, b)
    )
for _name in (operator.and_, operator.iand):
    _register_binary(_name, _Mask, mask_type, lambda builder, a, b: builder.and_(a, b))
for _name in (operator.or_, operator.ior):
    _register_binary(_name, _Mask, mask_type, lambda builder, a, b: builder.or_(a, b))
_register_unary(operator.neg, _Vector, vector_type, lambda builder, a: builder.fneg(a))
_register_unary(operator.invert, _Mask, mask_type, lambda builder, a: builder.not_(a))


# --- memory -------------------------------------------------------------------------------------------------------------


def _address(context: Any, builder: Any, array_type: Any, array: Any, index_type: Any, index: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    offset = context.cast(builder, index, index_type, types.intp)
    return builder.gep(data, [offset])


def _check_array(array: Any) -> None:
    if not (isinstance(array, types.Array) and array.layout == "C" and array.dtype == types.float32):
        raise TypeError(f"a contiguous float32 array is needed, got {array}")


@intrinsic
def load(typing_context: Any, array: Any, index: Any) -> Any:
    """The vector ``array.flat[index : index + 16]``."""
    _check_array(array)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _address(context, builder, sig.args[0], args[0], sig.args[1], args[1])
        return builder.load(builder.bitcast(pointer, _VECTOR.as_pointer()), align=4)

    return vector_type(array, index), codegen


@intrinsic
def store(typing_context: Any, array: Any, index: Any, vector: Any) -> Any:
    """Write ``vector`` to ``array.flat[index : index + 16]``."""
    _check_array(array)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _address(context, builder, sig.args[0], args[0], sig.args[1], args[1])
        builder.store(args[2], builder.bitcast(pointer, _VECTOR.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, index, vector), codegen


@intrinsic
def prefetch(typing_context: Any, array: Any, index: Any) -> Any:
    """Ask for the cache line of ``array.flat[index]``; never faults."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _address(context, builder, sig.args[0], args[0], sig.args[1], args[1])
        byte_pointer = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [byte_pointer, _I32, _I32, _I32])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        read, keep_in_all_caches, data = (ir.Constant(_I32, value) for value in (0, 3, 1))
        builder.call(function, [builder.bitcast(pointer, byte_pointer), read, keep_in_all_caches, data])
        return context.get_dummy_value()

    return types.void(array, index), codegen


# --- functions ----------------------------------------------------------------------------------------------------------


def _call(builder: Any, name: str, *args: Any) -> Any:
    kind = ir.FunctionType(_VECTOR, [_VECTOR] * len(args))
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"{name}.v{LANES}f32"), args)


def _vector_intrinsic(typing_context: Any, emit: Callable[..., Any], *argument_types: Any) -> Any:
    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vectors = [_as_vector(context, builder, value, kind) for value, kind in zip(args, sig.args, strict=True)]
        return emit(builder, *vectors)

    return vector_type(*argument_types), codegen


@intrinsic
def splat(typing_context: Any, scalar: Any) -> Any:
    """``scalar`` in every lane."""
    return _vector_intrinsic(typing_context, lambda builder, a: a, scalar)


@intrinsic
def fma(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """``a * b + c``, fused where the host can do so fast."""
    return _vector_intrinsic(typing_context, lambda builder, *v: _call(builder, "llvm.fmuladd", *v), a, b, c)


@intrinsic
def minimum(typing_context: Any, a: Any, b: Any) -> Any:
    """``a if a < b else b``: b where either is NaN."""

    def emit(builder: Any, x: Any, y: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", x, y), x, y)

    return _vector_intrinsic(typing_context, emit, a, b)


@intrinsic
def maximum(typing_context: Any, a: Any, b: Any) -> Any:
    """``a if a > b else b``: b where either is NaN."""

    def emit(builder: Any, x: Any, y: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">", x, y), x, y)

    return _vector_intrinsic(typing_context, emit, a, b)


@intrinsic
def absolute(typing_context: Any, a: Any) -> Any:
    """``|a|``."""
    return _vector_intrinsic(typing_context, lambda builder, x: _call(builder, "llvm.fabs", x), a)


@intrinsic
def select(typing_context: Any, mask: Any, a: Any, b: Any) -> Any:
    """``a`` where ``mask``, else ``b``."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        x = _as_vector(context, builder, args[1], sig.args[1])
        y = _as_vector(context, builder, args[2], sig.args[2])
        return builder.select(args[0], x, y)

    return vector_type(mask, a, b), codegen


@intrinsic
def mask_bits(typing_context: Any, mask: Any) -> Any:
    """The mask as an integer: lane k is bit k."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.zext(builder.bitcast(args[0], ir.IntType(LANES)), ir.IntType(64))

    return types.uint64(mask), codegen


@intrinsic
def mask_from_bits(typing_context: Any, bits: Any) -> Any:
    """The mask whose lane k is bit k of an integer."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        wide = context.cast(builder, args[0], sig.args[0], types.uint64)
        return builder.bitcast(builder.trunc(wide, ir.IntType(LANES)), _MASK)

    return mask_type(bits), codegen


@intrinsic
def lowest_bit(typing_context: Any, bits: Any) -> Any:
    """The place of the lowest set bit of an integer that is not zero."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        wide = context.cast(builder, args[0], sig.args[0], types.uint64)
        return builder.cttz(wide, ir.Constant(ir.IntType(1), 1))

    return types.uint64(bits), codegen


# 2^f on [-1/2, 1/2], constant term first: relative least-squares fit at 200 Chebyshev nodes, exact at 0, error 1.0e-7.
_EXP2_POLYNOMIAL = (1.0, 0.69314688444, 0.24022237957, 0.05550893024, 0.00967169832, 0.00132186722)
_ROUND_MAGIC = 12582912.0  # 1.5 * 2^23: adding it leaves the nearest integer in the low mantissa bits


@intrinsic
def exp2(typing_context: Any, a: Any) -> Any:
    """``2^a`` within 2.5e-7 relative, for -126 <= a < 127.5; any value elsewhere."""

    def emit(builder: Any, x: Any) -> Any:
        shifted = builder.fadd(x, _constant(_ROUND_MAGIC))
        fraction = builder.fsub(x, builder.fsub(shifted, _constant(_ROUND_MAGIC)))
        value = _constant(_EXP2_POLYNOMIAL[-1])
        for coefficient in _EXP2_POLYNOMIAL[-2::-1]:
            value = _call(builder, "llvm.fmuladd", value, fraction, _constant(coefficient))
        exponent = builder.shl(builder.bitcast(shifted, _INTEGERS), _integers(23))
        return builder.bitcast(builder.add(builder.bitcast(value, _INTEGERS), exponent), _VECTOR)

    return _vector_intrinsic(typing_context, emit, a)


# Lane of ``lane_sums`` that holds the sum of its k-th argument: the bits of k reversed.
SUM_LANES = tuple(int(f"{k:04b}"[::-1], 2) for k in range(LANES))


@intrinsic
def lane_sums(typing_context: Any, vectors: Any) -> Any:
    """One vector with the 16-lane sums of a tuple of up to 16 vectors; the k-th in lane ``SUM_LANES[k]``, the rest zero.

    A tree of shuffles and additions: each level joins two vectors into one, so that the sum of eleven vectors costs about
    as much as three single sums.
    """
    if not (isinstance(vectors, types.UniTuple) and isinstance(vectors.dtype, _Vector)):
        return None

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        level = [builder.extract_value(args[0], k) for k in range(sig.args[0].count)]
        half = LANES // 2
        while half:
            if len(level) % 2:
                level.append(_constant(0.0))
            low = [lane + source * LANES for lane, source in _halves(half)]
            high = [lane + half for lane in low]
            level = [
                builder.fadd(_shuffle(builder, a, b, low), _shuffle(builder, a, b, high))
                for a, b in zip(level[::2], level[1::2], strict=True)
            ]
            half //= 2
        return level[0]

    return vector_type(vectors), codegen


def _halves(half: int) -> list[tuple[int, int]]:
    """For every lane: the lane and the operand that its lower summand comes from, for groups of 2 * ``half`` lanes."""
    return [(lane // (2 * half) * 2 * half + lane % half, lane // half % 2) for lane in range(LANES)]


def _shuffle(builder: Any, a: Any, b: Any, lanes: list[int]) -> Any:
    return builder.shuffle_vector(a, b, ir.Constant(_INTEGERS, [ir.Constant(_I32, lane) for lane in lanes]))
