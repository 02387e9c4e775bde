"""SIMD vectors for numba: 32 numbers side by side, on which one instruction works at once.

The compiler vectorises plain loops by itself; where a loop reads and writes many arrays it must prove that none
overlaps another, and gives up. Here the vectors are explicit: 32 bytes or 32 two-byte numbers, which LLVM splits into
registers of the processor's own width. They work in compiled code only; nothing is checked, so the caller must keep the
32 numbers from ``at`` on inside the array.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types
from numba.extending import intrinsic, models, register_model

#: How many numbers stand side by side.
SIMD_WIDTH = 32


class SimdVector(types.Type):
    """The type of a vector of unsigned numbers of so many bits."""

    def __init__(self, bits: int) -> None:
        """Set the name of the type."""
        super().__init__(name=f"simd{bits}x{SIMD_WIDTH}")
        self.bits = bits

    @property
    def shape(self) -> ir.VectorType:
        """The type in LLVM."""
        return ir.VectorType(ir.IntType(self.bits), SIMD_WIDTH)


@register_model(SimdVector)
class _Model(models.PrimitiveModel):
    """A vector is kept in registers as it is."""

    def __init__(self, manager: Any, kind: SimdVector) -> None:  # noqa: ANN401
        super().__init__(manager, kind, kind.shape)  # type: ignore[no-untyped-call]


@intrinsic
def _start(typing: Any, array: Any) -> Any:  # noqa: ANN401
    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ANN401
        return context.make_array(signature.args[0])(context, builder, arguments[0]).data

    return types.CPointer(array.dtype)(array), emit  # type: ignore[no-untyped-call]


def _address(builder: Any, kind: SimdVector, start: Any, at: Any) -> Any:  # noqa: ANN401
    """Return the address of 32 numbers."""
    return builder.bitcast(builder.gep(start, [at]), kind.shape.as_pointer())


@intrinsic
def _load(typing: Any, start: Any, at: Any) -> Any:  # noqa: ANN401
    kind = SimdVector(start.dtype.bitwidth)

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ANN401
        return builder.load(_address(builder, kind, *arguments), align=kind.bits // 8)

    return kind(start, types.uintp), emit


@intrinsic
def _store(typing: Any, start: Any, at: Any, v: Any) -> Any:  # noqa: ANN401
    kind = SimdVector(start.dtype.bitwidth)

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ANN401
        builder.store(arguments[2], _address(builder, kind, *arguments[:2]), align=kind.bits // 8)
        return context.get_dummy_value()

    return types.none(start, types.uintp, kind), emit


@intrinsic
def _spread(typing: Any, x: Any) -> Any:  # noqa: ANN401
    kind = SimdVector(x.bitwidth)

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ANN401
        one = builder.insert_element(ir.Constant(kind.shape, ir.Undefined), arguments[0], ir.IntType(32)(0))
        mask = ir.Constant(ir.VectorType(ir.IntType(32), SIMD_WIDTH), [0] * SIMD_WIDTH)
        return builder.shuffle_vector(one, one, mask)

    return kind(x), emit


@intrinsic
def _count_up(typing: Any, x: Any) -> Any:  # noqa: ANN401
    kind = SimdVector(x.bitwidth)

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ANN401
        one = builder.insert_element(ir.Constant(kind.shape, ir.Undefined), arguments[0], ir.IntType(32)(0))
        mask = ir.Constant(ir.VectorType(ir.IntType(32), SIMD_WIDTH), [0] * SIMD_WIDTH)
        return builder.add(builder.shuffle_vector(one, one, mask), ir.Constant(kind.shape, list(range(SIMD_WIDTH))))

    return kind(x), emit


def _pairwise(operation: Any) -> Any:  # noqa: ANN401
    """Return an intrinsic of two vectors of one kind."""

    @intrinsic
    def work(typing: Any, a: Any, b: Any) -> Any:  # noqa: ANN401
        def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ANN401
            return operation(builder, *arguments)

        return a(a, b), emit

    return work


def _llvm(name: str) -> Any:  # noqa: ANN401
    """Return a function that emits a call of one of LLVM's own functions."""

    def emit(builder: Any, *arguments: Any) -> Any:  # noqa: ANN401
        kind = arguments[0].type
        signature_type = ir.FunctionType(kind, [a.type for a in arguments])
        full = f"{name}.v{kind.count}i{kind.element.width}"
        function = cgutils.get_or_insert_function(builder.module, signature_type, full)  # type: ignore[no-untyped-call]
        return builder.call(function, arguments)

    return emit


@intrinsic
def _bits_set(typing: Any, v: Any) -> Any:  # noqa: ANN401
    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ANN401
        return _llvm("llvm.ctpop")(builder, arguments[0])

    return v(v), emit


@intrinsic
def _half(typing: Any, v: Any) -> Any:  # noqa: ANN401
    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ANN401
        return builder.lshr(arguments[0], ir.Constant(v.shape, [1] * SIMD_WIDTH))

    return v(v), emit


@intrinsic
def _as_in(typing: Any, v: Any, start: Any) -> Any:  # noqa: ANN401
    kind = SimdVector(start.dtype.bitwidth)

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ANN401
        return arguments[0] if kind.bits == v.bits else builder.zext(arguments[0], kind.shape)

    return kind(v, start), emit


@intrinsic
def _where_less(typing: Any, a: Any, b: Any, yes: Any, no: Any) -> Any:  # noqa: ANN401
    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ANN401
        return builder.select(builder.icmp_unsigned("<", *arguments[:2]), *arguments[2:])

    return yes(a, b, yes, no), emit


#: ``start(array)``: the address of the numbers of an array of one dimension. Vectors are loaded from there, not from
#: the array: an array that is passed between functions counts its references, which costs more than the vector's work.
start: Any = _start
#: ``load(start, at)``: 32 numbers from ``at`` on; ``store(start, at, v)`` writes them.
load: Any = _load
store: Any = _store
#: ``spread(x)``: a number in all positions; ``count_up(x)``: x, x + 1, x + 2, ...
spread: Any = _spread
count_up: Any = _count_up
#: Sum and difference, cut to the numbers' bits; least; bits that differ; difference, but not below zero.
plus: Any = _pairwise(lambda builder, a, b: builder.add(a, b))
minus: Any = _pairwise(lambda builder, a, b: builder.sub(a, b))
least: Any = _pairwise(_llvm("llvm.umin"))
differing: Any = _pairwise(lambda builder, a, b: builder.xor(a, b))
above: Any = _pairwise(_llvm("llvm.usub.sat"))
#: Bits that are set in each; half of each.
bits_set: Any = _bits_set
half: Any = _half
#: ``as_in(v, start)``: with as many bits as the numbers there have, no fewer than before.
as_in: Any = _as_in
#: ``where_less(a, b, yes, no)``: of ``yes`` where a < b, else of ``no``.
where_less: Any = _where_less
