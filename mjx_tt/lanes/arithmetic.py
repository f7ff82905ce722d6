"""JAX's element-wise operations as LLVM's instructions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mjx_tt.lanes.emitter import CONTRACT, Element, Emitter, Kind, Unsupported, constant, is_float, is_signed

Elements = Sequence[Element]
Dtypes = Sequence[Any]

_BOOL = np.dtype(bool)
# Instructions with two operands: what they do to NumPy scalars, and LLVM's names of them for floats, signed and
# unsigned numbers. With NaN of the comparisons only "ne" is true.
_PAIRS: dict[str, tuple[Callable, str, str, str]] = {
    "eq": (np.equal, "fcmp oeq", "icmp eq", "icmp eq"),
    "ne": (np.not_equal, "fcmp une", "icmp ne", "icmp ne"),
    "lt": (np.less, "fcmp olt", "icmp slt", "icmp ult"),
    "le": (np.less_equal, "fcmp ole", "icmp sle", "icmp ule"),
    "gt": (np.greater, "fcmp ogt", "icmp sgt", "icmp ugt"),
    "ge": (np.greater_equal, "fcmp oge", "icmp sge", "icmp uge"),
    "add": (np.add, f"fadd {CONTRACT}", "add", "add"),
    "add_any": (np.add, f"fadd {CONTRACT}", "add", "add"),
    "sub": (np.subtract, f"fsub {CONTRACT}", "sub", "sub"),
    "mul": (np.multiply, f"fmul {CONTRACT}", "mul", "mul"),
    "div": (lambda x, y: x / y if is_float(x.dtype) else np.trunc(x / y), f"fdiv {CONTRACT}", "sdiv", "udiv"),
    "rem": (np.fmod, "", "srem", "urem"),
    "and": (np.bitwise_and, "", "and", "and"),
    "or": (np.bitwise_or, "", "or", "or"),
    "xor": (np.bitwise_xor, "", "xor", "xor"),
    "shift_left": (np.left_shift, "", "shl", "shl"),
    "shift_right_arithmetic": (np.right_shift, "", "ashr", "ashr"),
    "shift_right_logical": (
        lambda x, y: np.right_shift(x.view(np.uint32), y.view(np.uint32)).view(x.dtype), "", "lshr", "lshr"
    ),
}  # fmt: skip
# Intrinsics of one float.
_SINGLES: dict[str, tuple[Callable, str]] = {
    "sqrt": (np.sqrt, "sqrt"),
    "abs": (np.abs, "fabs"),
    "floor": (np.floor, "floor"),
    "ceil": (np.ceil, "ceil"),
    "round": (np.rint, "roundeven"),
}
_TO_EVEN = 1  # jax.lax.RoundingMethod.TO_NEAREST_EVEN


def known(name: str) -> bool:
    """True for a primitive of ``elementwise``."""
    return any(name in table for table in (_PAIRS, _SINGLES, _OTHERS))


def elementwise(e: Emitter, name: str, a: Elements, d: Dtypes, out: Any, params: dict | None = None) -> Element:
    """The result, of dtype ``out``, of JAX's primitive ``name`` for one element of each operand. Raises Unsupported.

    d: the operands' dtypes; params: the primitive's.
    """
    real = is_float(d[0])
    if name in _PAIRS:
        fold, *codes = _PAIRS[name]
        code = codes[0 if real else 1 if is_signed(d[0]) else 2]
        if not code:
            raise Unsupported(f"{name} of floats")
        if not real:
            _check_second(e, name, a[1], out)
        return e.apply(code + " {t0} {0}, {1}", fold, a, d, out)
    if name in _SINGLES and real:
        if name == "round" and int((params or {}).get("rounding_method", _TO_EVEN)) != _TO_EVEN:
            raise Unsupported("rounding halves away from zero")
        fold, code = _SINGLES[name]
        return e.apply("call {t} @llvm." + code + ".{s}({t} {0})", fold, a, d, out)
    return _OTHERS[name](e, a, d, out, params or {})


def _check_second(e: Emitter, name: str, second: Element, out: Any) -> None:
    """The processor stops at whole divisions by 0, and by -1 of the least number; shifts are by less than the bits."""
    if name in ("div", "rem"):
        second = e.forced(second)
        if second.kind is not Kind.CONSTANT or second.value in (0, -1):
            raise Unsupported("a whole division by anything but a constant")
    if name.startswith("shift"):
        second = e.forced(second)
        if second.kind is not Kind.CONSTANT or not 0 <= second.value < 32 or np.dtype(out).itemsize != 4:
            raise Unsupported(f"{name} by anything but a constant below 32")


def _extreme(least: bool) -> Callable:
    """min or max; NaN if one of both is NaN."""
    fold, test = (np.minimum, "olt") if least else (np.maximum, "ogt")

    def rule(e: Emitter, a: Elements, d: Dtypes, out: Any, _: dict) -> Element:
        if out == _BOOL:
            return e.apply(("and" if least else "or") + " {t} {0}, {1}", fold, a, d, out)
        if not is_float(out):
            code = ("s" if is_signed(out) else "u") + ("min" if least else "max")
            return e.apply("call {t} @llvm." + code + ".{s}({t} {0}, {t} {1})", fold, a, d, out)
        one, other = (e.forced(x) for x in a)
        if other.kind is Kind.CONSTANT:
            one, other = other, one
        if other.kind is Kind.CONSTANT:
            return constant(fold(one.value, other.value), out)
        # Compare and select are the processor's own min and max, which give the second operand where one is NaN.
        first = e.apply(f"fcmp {test}" + " {t0} {0}, {1}", fold, [one, other], d, _BOOL)
        best = _select(e, first, one, other, out)
        if one.kind is Kind.CONSTANT:
            return best
        return _select(e, e.apply("fcmp uno {t0} {0}, {0}", np.isnan, [one], d[:1], _BOOL), one, best, out)

    return rule


def _select(e: Emitter, test: Element, yes: Element, no: Element, out: Any) -> Element:
    test = e.forced(test)
    if test.kind is Kind.CONSTANT:
        return e.forced(yes if test.value else no)
    yes, no = e.forced(yes), e.forced(no)
    if test.kind is Kind.SCALAR and Kind.VECTOR in (yes.kind, no.kind):
        t = e.vector_type(out)
        made = e.emit(f"select i1 {test.value}, {t} {e.vector(yes, out)}, {t} {e.vector(no, out)}")
        return Element(Kind.VECTOR, made)
    return e.apply("select {t0} {0}, {t1} {1}, {t2} {2}", np.where, [test, yes, no], [_BOOL, out, out], out)


def _select_n(e: Emitter, a: Elements, d: Dtypes, out: Any, _: dict) -> Element:
    if len(a) != 3 or d[0] != _BOOL:
        raise Unsupported("a selection between more than two")
    return _select(e, a[0], a[2], a[1], out)


def _convert(e: Emitter, a: Elements, d: Dtypes, out: Any, _: dict) -> Element:
    source, x = d[0], e.forced(a[0])
    if source == out:
        return x
    if x.kind is Kind.CONSTANT:
        return constant(x.value, out)
    if out == _BOOL:
        return elementwise(e, "ne", [x, constant(0, source)], [source, source], _BOOL)
    if is_float(source) and is_float(out):
        raise Unsupported(f"a conversion from {source} to {out}")
    if is_float(source):
        # Some number for NaN and for what no whole number is near enough to; XLA's limits cost a twentieth of a step.
        whole = e.apply(("fptosi" if is_signed(out) else "fptoui") + " {t0} {0} to {t}", lambda v: v, [x], d, out)
        return e.apply("freeze {t} {0}", lambda v: v, [whole], [out], out)
    if is_float(out):
        template = ("sitofp" if is_signed(source) else "uitofp") + " {t0} {0} to {t}"
    elif source != _BOOL and np.dtype(source).itemsize == np.dtype(out).itemsize:
        return x
    elif source != _BOOL and np.dtype(source).itemsize > np.dtype(out).itemsize:
        template = "trunc {t0} {0} to {t}"
    else:
        template = ("sext" if is_signed(source) else "zext") + " {t0} {0} to {t}"
    return e.apply(template, lambda v: v, [x], [source], out)


def _bitcast(e: Emitter, a: Elements, d: Dtypes, out: Any, _: dict) -> Element:
    x = e.forced(a[0])
    if x.kind is Kind.CONSTANT:
        return Element(Kind.CONSTANT, np.asarray(x.value).view(out)[()])
    if is_float(out) == is_float(d[0]):
        return x
    return e.apply("bitcast {t0} {0} to {t}", lambda v: v, [x], d, out)


def _power(e: Emitter, a: Elements, d: Dtypes, out: Any, params: dict) -> Element:
    n, square, result = abs(int(params["y"])), a[0], constant(1, out)
    while n:
        if n & 1:
            result = square if e.forced(result).kind is Kind.CONSTANT else _times(e, result, square, out)
        n >>= 1
        square = _times(e, square, square, out) if n else square
    return result if int(params["y"]) >= 0 else elementwise(e, "div", [constant(1, out), result], [out, out], out)


def _times(e: Emitter, x: Element, y: Element, out: Any) -> Element:
    return elementwise(e, "mul", [x, y], [out, out], out)


def _clamp(e: Emitter, a: Elements, d: Dtypes, out: Any, _: dict) -> Element:
    low, x, high = a
    return elementwise(e, "min", [elementwise(e, "max", [low, x], [out] * 2, out), high], [out] * 2, out)


def _sign(e: Emitter, a: Elements, d: Dtypes, out: Any, _: dict) -> Element:
    zero = constant(0, out)
    above, below = (elementwise(e, test, [a[0], zero], [out, out], _BOOL) for test in ("gt", "lt"))
    return _select(e, above, constant(1, out), _select(e, below, constant(-1, out), a[0], out), out)


def _is_finite(e: Emitter, a: Elements, d: Dtypes, out: Any, _: dict) -> Element:
    size = elementwise(e, "abs", a, d, d[0])
    return elementwise(e, "lt", [size, constant(np.inf, d[0])], [d[0], d[0]], _BOOL)


def _negate(e: Emitter, a: Elements, d: Dtypes, out: Any, _: dict) -> Element:
    if is_float(out):
        return e.apply("fneg {t} {0}", np.negative, a, d, out)
    return elementwise(e, "sub", [constant(0, out), a[0]], [out, out], out)


def _not(e: Emitter, a: Elements, d: Dtypes, out: Any, _: dict) -> Element:
    ones = constant(True if out == _BOOL else np.invert(np.zeros((), out)), out)
    return elementwise(e, "xor", [a[0], ones], [out, out], out)


def _absolute(e: Emitter, a: Elements, d: Dtypes, out: Any, _: dict) -> Element:
    return e.apply("call {t} @llvm.abs.{s}({t} {0}, i1 false)", np.abs, a, d, out)


_OTHERS: dict[str, Callable[[Emitter, Elements, Dtypes, Any, dict], Element]] = {
    "min": _extreme(True),
    "max": _extreme(False),
    "select_n": _select_n,
    "convert_element_type": _convert,
    "bitcast_convert_type": _bitcast,
    "integer_pow": _power,
    "clamp": _clamp,
    "sign": _sign,
    "is_finite": _is_finite,
    "neg": _negate,
    "not": _not,
    "abs": _absolute,
    "square": lambda e, a, d, out, _: _times(e, a[0], a[0], out),
    "rsqrt": lambda e, a, d, out, _: elementwise(
        e, "div", [constant(1, out), elementwise(e, "sqrt", a, d, out)], [out, out], out
    ),
    "copy": lambda e, a, d, out, _: a[0],
    "copy_p": lambda e, a, d, out, _: a[0],
    "stop_gradient": lambda e, a, d, out, _: a[0],
}
