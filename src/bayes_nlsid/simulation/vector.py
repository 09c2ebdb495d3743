"""Eight samples side by side in one vector register: a number type for compiled code, so that a whole step stays in registers.

Import this module only where compiled code is about to run: it imports numba. Loops over short arrays cost more in checks than in
arithmetic; with a type of its own for eight doubles every operation is one instruction (or two, or four, on processors with narrower
registers), and nothing has to be proved to the compiler.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any, final

import numba.extending
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types
from numba.core.datamodel import models
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature

WIDTH = 8
"""Samples per vector."""
_DOUBLES, _WORDS, _BOOLS = (ir.VectorType(kind, WIDTH) for kind in (ir.DoubleType(), ir.IntType(64), ir.IntType(1)))
_intrinsic_of: Any = numba.extending.intrinsic
FAST = ("contract",)
"""Products and sums may be fused, nothing else."""


@final
class Vector(types.Type):
    """Eight doubles."""

    def __init__(self) -> None:
        super().__init__(name="EightDoubles")


@final
class Mask(types.Type):
    """Eight truth values."""

    def __init__(self) -> None:
        super().__init__(name="EightBools")


vector, mask = Vector(), Mask()


@numba.extending.register_model(Vector)
@final
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _DOUBLES)


@numba.extending.register_model(Mask)
@final
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _BOOLS)


def _constant(value: float) -> Any:
    return ir.Constant(_DOUBLES, [value] * WIDTH)


def _word(value: int) -> Any:
    return ir.Constant(_WORDS, [value] * WIDTH)


def _spread(builder: Any, value: Any) -> Any:
    """A double in all lanes; a vector as it is."""
    if value.type == _DOUBLES:
        return value
    one = builder.insert_element(ir.Constant(_DOUBLES, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(one, ir.Constant(_DOUBLES, ir.Undefined), ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH))


def _operator(symbol: Callable[..., Any], result: Any, build: Callable[..., Any]) -> None:
    """Give a binary operator to vectors, and to a vector and a double."""
    pairs = [(vector, vector), (vector, types.float64), (types.float64, vector)]

    @infer_global(symbol)
    @final
    class _Template(ConcreteTemplate):
        cases = [signature(result, *pair) for pair in pairs]

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return build(builder, *(_spread(builder, a) for a in args))

    for pair in pairs:
        numba.extending.lower_builtin(symbol, *pair)(lower)


for _symbol, _name in ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul"), (operator.truediv, "fdiv")):
    _operator(_symbol, vector, lambda builder, a, b, name=_name: getattr(builder, name)(a, b, flags=FAST))
for _symbol, _sign in ((operator.lt, "<"), (operator.gt, ">"), (operator.ge, ">="), (operator.le, "<=")):
    _operator(_symbol, mask, lambda builder, a, b, sign=_sign: builder.fcmp_ordered(sign, a, b))


@infer_global(operator.and_)
@final
class _And(ConcreteTemplate):
    cases = [signature(mask, mask, mask)]


@numba.extending.lower_builtin(operator.and_, mask, mask)
def _both(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.and_(*args)


def _intrinsic(result: Any, *arguments: Any) -> Any:
    """A function of vectors from one that writes its instructions; doubles given in place of vectors are spread over the lanes."""
    def make(build: Callable[..., Any]) -> Any:
        def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            ready = [_spread(builder, a) if kind is vector else a for a, kind in zip(args, arguments, strict=True)]
            return build(builder, *ready)

        if len(arguments) == 1:
            def typed(context: Any, a: Any) -> Any:
                return signature(result, a), lower
        elif len(arguments) == 2:
            def typed(context: Any, a: Any, b: Any) -> Any:  # type: ignore[misc]
                return signature(result, a, b), lower
        else:
            def typed(context: Any, a: Any, b: Any, c: Any) -> Any:  # type: ignore[misc]
                return signature(result, a, b, c), lower
        typed.__name__ = build.__name__
        return _intrinsic_of(typed)

    return make


def _call(builder: Any, name: str, *args: Any) -> Any:
    kind = ir.FunctionType(_DOUBLES, [_DOUBLES] * len(args))
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"{name}.v{WIDTH}f64"), args)


@_intrinsic(vector, vector)
def spread(builder: Any, value: Any) -> Any:
    """One double in all lanes."""
    return value


@_intrinsic(vector, vector)
def size(builder: Any, a: Any) -> Any:
    """|a|."""
    return _call(builder, "llvm.fabs", a)


@_intrinsic(vector, vector, vector)
def signed(builder: Any, magnitude: Any, sign: Any) -> Any:
    """|magnitude| with the sign of the second."""
    return _call(builder, "llvm.copysign", magnitude, sign)


@_intrinsic(vector, vector, vector)
def smaller(builder: Any, a: Any, b: Any) -> Any:
    """The smaller of both; the second where one is NaN."""
    return builder.select(builder.fcmp_ordered("<", a, b), a, b)


@_intrinsic(vector, vector, vector)
def larger(builder: Any, a: Any, b: Any) -> Any:
    """The larger of both; the second where one is NaN."""
    return builder.select(builder.fcmp_ordered(">", a, b), a, b)


@_intrinsic(vector, mask, vector, vector)
def choose(builder: Any, condition: Any, yes: Any, no: Any) -> Any:
    """Lane by lane."""
    return builder.select(condition, yes, no)


@_intrinsic(types.int64, mask)
def lanes_of(builder: Any, condition: Any) -> Any:
    """The truth values as the low bits of an integer, lane 0 first."""
    return builder.zext(builder.bitcast(condition, ir.IntType(WIDTH)), ir.IntType(64))


@_intrinsic(vector, vector, vector)
def power(builder: Any, r: Any, m: Any) -> Any:
    """r^m for 1e-300 ≤ r ≤ 2 and m ≥ 0; relative error below 2e-13, below 1e-15 (1 + |log2 r^m|) in general; 2^-1000 at least."""
    def polynomial(x: Any, coefficients: list[float]) -> Any:
        total = _constant(coefficients[-1])
        for c in coefficients[-2::-1]:
            total = builder.fadd(builder.fmul(total, x, flags=FAST), _constant(c), flags=FAST)
        return total

    # r = mantissa 2^whole with the mantissa between sqrt(1/2) and sqrt(2); its log2 by the series of artanh
    bits = builder.bitcast(r, _WORDS)
    raised = builder.add(bits, _word(0x3FF0000000000000 - 0x3FE6A09E667F3BCD))
    exponent = builder.and_(builder.lshr(raised, _word(52)), _word(0xFFF))
    counted = builder.bitcast(builder.or_(exponent, _word(0x4330000000000000)), _DOUBLES)
    whole = builder.fsub(counted, _constant(4503599627370496.0 + 1023.0))
    mantissa = builder.bitcast(builder.sub(bits, builder.shl(builder.sub(exponent, _word(1023)), _word(52))), _DOUBLES)
    s = builder.fdiv(builder.fsub(mantissa, _constant(1.0)), builder.fadd(mantissa, _constant(1.0)))
    series = polynomial(builder.fmul(s, s), [2.8853900817779268 / (2 * k + 1) for k in range(9)])
    log = builder.fadd(whole, builder.fmul(s, series, flags=FAST), flags=FAST)
    x = builder.fmul(m, log)
    x = builder.select(builder.fcmp_ordered(">", x, _constant(-1000.0)), x, _constant(-1000.0))
    # adding 1.5 * 2^52 rounds to an integer and leaves it in the low bits
    shifted = builder.fadd(x, _constant(6755399441055744.0))
    t = builder.fmul(builder.fsub(x, builder.fsub(shifted, _constant(6755399441055744.0))), _constant(0.6931471805599453))
    factorial, coefficients = 1.0, [1.0]
    for k in range(1, 13):
        factorial *= k
        coefficients.append(1 / factorial)
    doubled = builder.shl(builder.bitcast(shifted, _WORDS), _word(52))
    return builder.bitcast(builder.add(builder.bitcast(polynomial(t, coefficients), _WORDS), doubled), _DOUBLES)


def _place(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    """Pointer to the eight doubles number ``index`` of a contiguous array of any shape."""
    start = builder.mul(index, ir.Constant(index.type, WIDTH))
    return builder.bitcast(builder.gep(context.make_array(kind)(context, builder, array).data, [start]), _DOUBLES.as_pointer())


@_intrinsic_of
def load(context: Any, array: Any, index: Any) -> Any:
    """Eight neighbours of a contiguous array of any shape, beginning at 8 ``index``."""
    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_place(context, builder, sig.args[0], *args), align=8)
    return vector(array, types.int64), lower


@_intrinsic_of
def store(context: Any, array: Any, index: Any, value: Any) -> Any:
    """Put eight neighbours back, where ``load`` would find them."""
    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(_spread(builder, args[2]), _place(context, builder, sig.args[0], args[0], args[1]), align=8)
        return context.get_dummy_value()
    return types.void(array, types.int64, value), lower
