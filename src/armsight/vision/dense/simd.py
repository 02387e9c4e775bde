"""Vectors for numba: 32 numbers side by side, on which one instruction works at once.

The compiler finds vectors by itself where a loop is plain; where a loop reads and writes many arrays it must prove that
none overlaps another, and gives up. Here the program says what it wants: 32 bytes or 32 two-byte numbers, which LLVM
cuts into registers of the machine's own width. Works in compiled code only; nothing is checked, so that who calls keeps
the 32 places from ``at`` on inside the array.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types
from numba.extending import intrinsic, models, register_model

#: How many numbers stand side by side.
LANES = 32


class Lanes(types.Type):
    """The type of a vector of unsigned numbers of so many bits."""

    def __init__(self, bits: int) -> None:
        """Name it."""
        super().__init__(name=f"lanes{bits}x{LANES}")
        self.bits = bits

    @property
    def shape(self) -> ir.VectorType:
        """What it is to LLVM."""
        return ir.VectorType(ir.IntType(self.bits), LANES)


@register_model(Lanes)
class _Model(models.PrimitiveModel):
    """A vector is kept in registers as it is."""

    def __init__(self, manager: Any, kind: Lanes) -> None:  # noqa: ANN401
        super().__init__(manager, kind, kind.shape)  # type: ignore[no-untyped-call]


@intrinsic
def _start(typing: Any, array: Any) -> Any:  # noqa: ANN401
    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ANN401
        return context.make_array(signature.args[0])(context, builder, arguments[0]).data

    return types.CPointer(array.dtype)(array), emit  # type: ignore[no-untyped-call]


def _place(builder: Any, kind: Lanes, start: Any, at: Any) -> Any:  # noqa: ANN401
    """Return the address of 32 numbers."""
    return builder.bitcast(builder.gep(start, [at]), kind.shape.as_pointer())


@intrinsic
def _load(typing: Any, start: Any, at: Any) -> Any:  # noqa: ANN401
    kind = Lanes(start.dtype.bitwidth)

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ANN401
        return builder.load(_place(builder, kind, *arguments), align=kind.bits // 8)

    return kind(start, types.uintp), emit


@intrinsic
def _store(typing: Any, start: Any, at: Any, v: Any) -> Any:  # noqa: ANN401
    kind = Lanes(start.dtype.bitwidth)

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ANN401
        builder.store(arguments[2], _place(builder, kind, *arguments[:2]), align=kind.bits // 8)
        return context.get_dummy_value()

    return types.none(start, types.uintp, kind), emit


@intrinsic
def _spread(typing: Any, x: Any) -> Any:  # noqa: ANN401
    kind = Lanes(x.bitwidth)

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ANN401
        one = builder.insert_element(ir.Constant(kind.shape, ir.Undefined), arguments[0], ir.IntType(32)(0))
        mask = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
        return builder.shuffle_vector(one, one, mask)

    return kind(x), emit


@intrinsic
def _count_up(typing: Any, x: Any) -> Any:  # noqa: ANN401
    kind = Lanes(x.bitwidth)

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ANN401
        one = builder.insert_element(ir.Constant(kind.shape, ir.Undefined), arguments[0], ir.IntType(32)(0))
        mask = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
        return builder.add(builder.shuffle_vector(one, one, mask), ir.Constant(kind.shape, list(range(LANES))))

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
    """Return what emits one of LLVM's own functions."""

    def emit(builder: Any, *arguments: Any) -> Any:  # noqa: ANN401
        kind = arguments[0].type
        wanted = ir.FunctionType(kind, [a.type for a in arguments])
        full = f"{name}.v{kind.count}i{kind.element.width}"
        function = cgutils.get_or_insert_function(builder.module, wanted, full)  # type: ignore[no-untyped-call]
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
        return builder.lshr(arguments[0], ir.Constant(v.shape, [1] * LANES))

    return v(v), emit


@intrinsic
def _as_in(typing: Any, v: Any, start: Any) -> Any:  # noqa: ANN401
    kind = Lanes(start.dtype.bitwidth)

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ANN401
        return arguments[0] if kind.bits == v.bits else builder.zext(arguments[0], kind.shape)

    return kind(v, start), emit


@intrinsic
def _where_less(typing: Any, a: Any, b: Any, yes: Any, no: Any) -> Any:  # noqa: ANN401
    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ANN401
        return builder.select(builder.icmp_unsigned("<", *arguments[:2]), *arguments[2:])

    return yes(a, b, yes, no), emit


#: ``start(array)``: where the numbers of an array of one dimension are. Vectors are loaded from there, not from the
#: array: an array that goes in and out of functions counts who holds it, which costs more than the vector's work.
start: Any = _start
#: ``load(start, at)``: 32 numbers from ``at`` on; ``store(start, at, v)`` writes them.
load: Any = _load
store: Any = _store
#: ``spread(x)``: a number in all places; ``count_up(x)``: x, x + 1, x + 2, ...
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
