"""The numba type of 16 float32 in one LLVM vector, that of 16 truth values, and their operators.

``+ - * /``, ``-x`` and comparisons work lane by lane (a Python or numpy number is broadcast), comparisons give a mask
for ``&``, ``|`` and ``~``. What kernels do with vectors besides stands in `gsbench.raster.cpu.simd`.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.core.extending import lower_builtin, models, register_model
from numba.core.typing.templates import AbstractTemplate, infer_global, signature

LANES = 16  # of float32


class Vector(types.Type):
    """The numba type of 16 float32."""

    def __init__(self) -> None:
        self.element, self.lanes = types.float32, LANES
        self.scalar_ir = ir.FloatType()
        self.ir = ir.VectorType(self.scalar_ir, LANES)
        self.bits_ir = ir.VectorType(ir.IntType(32), LANES)
        self.suffix = f"v{LANES}f32"  # of LLVM's intrinsic functions
        super().__init__(name=f"float32x{LANES}")

    def constant(self, value: float) -> ir.Constant:
        return ir.Constant(self.ir, [ir.Constant(self.scalar_ir, value)] * self.lanes)

    def bits(self, value: int) -> ir.Constant:
        return ir.Constant(self.bits_ir, [ir.Constant(self.bits_ir.element, value)] * self.lanes)


class Mask(types.Type):
    """The numba type of 16 truth values."""

    def __init__(self) -> None:
        self.ir = ir.VectorType(ir.IntType(1), LANES)
        super().__init__(name=f"maskx{LANES}")


VECTOR = Vector()
MASK = Mask()


@register_model(Vector)
@register_model(Mask)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, frontend_type: Any) -> None:
        super().__init__(manager, frontend_type, frontend_type.ir)


def lane_indices(lanes: Sequence[int]) -> ir.Constant:
    """Numbers of lanes, as LLVM's shuffles want them."""
    return ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), [ir.Constant(ir.IntType(32), lane) for lane in lanes])


def as_vector(context: Any, builder: Any, value: Any, kind: Any, vector: Vector) -> Any:
    """The operand ``value`` of the numba type ``kind`` as a vector: itself, or a number in all lanes."""
    if isinstance(kind, Vector):
        return value
    scalar = context.cast(builder, value, kind, vector.element)
    undefined = ir.Constant(vector.ir, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(first, undefined, lane_indices([0] * vector.lanes))


def common_vector(kinds: Sequence[Any]) -> Vector | None:
    """The vector type of arguments of which each is that vector or a number; None if they are anything else."""
    vectors = {kind for kind in kinds if isinstance(kind, Vector)}
    fits = len(vectors) == 1 and all(isinstance(kind, Vector | types.Number) for kind in kinds)
    return vectors.pop() if fits else None


def _register_operator(functions: Sequence[Any], arity: int, emit: Callable[..., Any], compares: bool = False) -> None:
    """Let ``functions`` of vectors (or vectors and numbers) be what ``emit(builder, *operands)`` builds."""

    class _Template(AbstractTemplate):
        def generic(self, args: Sequence[Any], kws: Any) -> Any:
            vector = common_vector(args) if len(args) == arity else None
            return signature(MASK if compares else vector, *args) if vector else None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vector: Any = common_vector(sig.args)
        return emit(builder, *(as_vector(context, builder, v, k, vector) for v, k in zip(args, sig.args, strict=True)))

    for function in functions:
        infer_global(function)(type("_Template", (_Template,), {}))
        combinations = [(Vector,)] if arity == 1 else [(Vector, Vector), (Vector, types.Number), (types.Number, Vector)]
        for combination in combinations:
            lower_builtin(function, *combination)(lower)


def _register_mask_operator(functions: Sequence[Any], arity: int, emit: Callable[..., Any]) -> None:
    class _Template(AbstractTemplate):
        def generic(self, args: Sequence[Any], kws: Any) -> Any:
            fits = len(args) == arity and isinstance(args[0], Mask) and set(args) == {args[0]}
            return signature(args[0], *args) if fits else None

    for function in functions:
        infer_global(function)(type("_Template", (_Template,), {}))
        lower_builtin(function, *[Mask] * arity)(lambda context, builder, sig, args: emit(builder, *args))


_register_operator([operator.add, operator.iadd], 2, lambda builder, a, b: builder.fadd(a, b))
_register_operator([operator.sub, operator.isub], 2, lambda builder, a, b: builder.fsub(a, b))
_register_operator([operator.mul, operator.imul], 2, lambda builder, a, b: builder.fmul(a, b))
_register_operator([operator.truediv, operator.itruediv], 2, lambda builder, a, b: builder.fdiv(a, b))
_register_operator([operator.neg], 1, lambda builder, a: builder.fneg(a))
_register_operator([operator.lt], 2, lambda builder, a, b: builder.fcmp_ordered("<", a, b), compares=True)
_register_operator([operator.le], 2, lambda builder, a, b: builder.fcmp_ordered("<=", a, b), compares=True)
_register_operator([operator.gt], 2, lambda builder, a, b: builder.fcmp_ordered(">", a, b), compares=True)
_register_operator([operator.ge], 2, lambda builder, a, b: builder.fcmp_ordered(">=", a, b), compares=True)
_register_mask_operator([operator.and_, operator.iand], 2, lambda builder, a, b: builder.and_(a, b))
_register_mask_operator([operator.or_, operator.ior], 2, lambda builder, a, b: builder.or_(a, b))
_register_mask_operator([operator.invert], 1, lambda builder, a: builder.not_(a))
