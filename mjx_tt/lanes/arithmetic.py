"""Element-wise operations of JAX as LLVM's instructions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mjx_tt.lanes.emitter import FLOAT, Element, Emitter, Kind, Unsupported, constant

Rule = Callable[[Emitter, list[Element], list[Any], Any, dict], Element]

_COMPARE = {
    "eq": ("oeq", "eq", "eq", np.equal),
    "ne": ("une", "ne", "ne", np.not_equal),
    "lt": ("olt", "slt", "ult", np.less),
    "le": ("ole", "sle", "ule", np.less_equal),
    "gt": ("ogt", "sgt", "ugt", np.greater),
    "ge": ("oge", "sge", "uge", np.greater_equal),
}
_ARITHMETIC = {
    "add": ("fadd", "add", np.add),
    "add_any": ("fadd", "add", np.add),
    "sub": ("fsub", "sub", np.subtract),
    "mul": ("fmul", "mul", np.multiply),
}
_BITS = {
    "and": ("and", np.bitwise_and),
    "or": ("or", np.bitwise_or),
    "xor": ("xor", np.bitwise_xor),
    "shift_left": ("shl", np.left_shift),
    "shift_right_arithmetic": ("ashr", np.right_shift),
}
_FUNCTIONS = {
    "sqrt": ("sqrt", np.sqrt),
    "abs": ("fabs", np.abs),
    "floor": ("floor", np.floor),
    "ceil": ("ceil", np.ceil),
    "round": ("roundeven", np.rint),
}


def is_float(dtype: Any) -> bool:
    return np.issubdtype(dtype, np.floating)


def _compare(e: Emitter, name: str, a: list[Element], d: list[Any]) -> Element:
    real, signed, unsigned, fold = _COMPARE[name]
    if is_float(d[0]):
        code = f"fcmp {real}"
    else:
        code = f"icmp {signed if np.issubdtype(d[0], np.signedinteger) else unsigned}"
    return e.apply(code + " {t0} {0}, {1}", fold, a, d, np.bool_)


def _arithmetic(e: Emitter, name: str, a: list[Element], d: list[Any], out: Any) -> Element:
    real, whole, fold = _ARITHMETIC[name]
    code = f"{real} {FLOAT}" if is_float(out) else whole
    return e.apply(code + " {t} {0}, {1}", fold, a, d, out)


def _divide(e: Emitter, a: list[Element], d: list[Any], out: Any) -> Element:
    if is_float(out):
        return e.apply(f"fdiv {FLOAT}" + " {t} {0}, {1}", np.divide, a, d, out)
    code = "sdiv" if np.issubdtype(out, np.signedinteger) else "udiv"
    return e.apply(code + " {t} {0}, {1}", lambda x, y: np.fix(x / y), a, d, out)


def _remainder(e: Emitter, a: list[Element], d: list[Any], out: Any) -> Element:
    if is_float(out):
        raise Unsupported("rem of floats")
    divisor = e.forced(a[1])
    if np.issubdtype(out, np.signedinteger) and divisor.kind is Kind.CONSTANT and e.forced(a[0]).kind is Kind.VECTOR:
        return _small_remainder(e, a[0], divisor, d, out)
    code = "srem" if np.issubdtype(out, np.signedinteger) else "urem"
    return e.apply(code + " {t} {0}, {1}", np.fmod, a, d, out)


def _small_remainder(e: Emitter, a: Element, divisor: Element, d: list[Any], out: Any) -> Element:
    return e.apply("srem {t} {0}, {1}", np.fmod, [a, divisor], d, out)


def _extreme(e: Emitter, name: str, a: list[Element], d: list[Any], out: Any) -> Element:
    """min or max; NaN if one of both is."""
    least = name == "min"
    fold = np.minimum if least else np.maximum
    a = [e.forced(x) for x in a]
    if not is_float(out):
        code = {True: ("smin", "smax"), False: ("umin", "umax")}[bool(np.issubdtype(out, np.signedinteger))][not least]
        if out == np.bool_:
            return e.apply(("and" if least else "or") + " {t} {0}, {1}", fold, a, d, out)
        return e.apply("call {t} @llvm." + code + ".{s}({t} {0}, {t} {1})", fold, a, d, out)
    if a[1].kind is Kind.CONSTANT:
        a = a[::-1]
    # The processor's own instruction: the second operand where one is NaN.
    test = e.apply(f"fcmp {'olt' if least else 'ogt'}" + " {t0} {0}, {1}", np.less if least else np.greater, a, d, np.bool_)
    best = _select(e, test, a[0], a[1], out)
    if a[0].kind is Kind.CONSTANT:
        if a[1].kind is Kind.CONSTANT:
            return constant(fold(a[0].value, a[1].value), out)
        return best
    return _select(e, e.apply("fcmp uno {t0} {0}, {0}", np.isnan, a[:1], d[:1], np.bool_), a[0], best, out)


def _select(e: Emitter, test: Element, yes: Element, no: Element, out: Any) -> Element:
    test = e.forced(test)
    if test.kind is Kind.CONSTANT:
        return e.forced(yes if test.value else no)
    yes, no = e.forced(yes), e.forced(no)
    if test.kind is Kind.SCALAR and Kind.VECTOR in (yes.kind, no.kind):
        kind = e.vector_type(out)
        return Element(
            Kind.VECTOR, e.emit(f"select i1 {test.value}, {kind} {e.vector(yes, out)}, {kind} {e.vector(no, out)}")
        )
    return e.apply("select {t0} {0}, {t} {1}, {t} {2}", np.where, [test, yes, no], [np.bool_, out, out], out)


def _convert(e: Emitter, a: Element, source: Any, target: Any) -> Element:
    if source == target:
        return a
    a = e.forced(a)

    def apply(code: str) -> Element:
        return e.apply(code + " {t0} {0} to {t}", lambda x: np.asarray(x).astype(target), [a], [source], target)

    if target == np.bool_:
        code = "fcmp une {t0} {0}, zeroinitializer" if is_float(source) else "icmp ne {t0} {0}, zeroinitializer"
        if a.kind is not Kind.VECTOR:
            code = code.replace("zeroinitializer", "0.0" if is_float(source) else "0")
        return e.apply(code, lambda x: x != 0, [a], [source], target)
    if is_float(source):
        signed = np.issubdtype(target, np.signedinteger)
        return e.apply(
            "call {t} @llvm." + ("fptosi" if signed else "fptoui") + ".sat.{r}({t0} {0})"
            if False
            else ("fptosi" if signed else "fptoui") + " {t0} {0} to {t}",
            lambda x: np.asarray(x).astype(target),
            [a],
            [source],
            target,
        )
    if is_float(target):
        signed = np.issubdtype(source, np.signedinteger)
        return apply("sitofp" if signed else "uitofp")
    here, there = np.dtype(source).itemsize, np.dtype(target).itemsize
    if source == np.bool_:
        return apply("zext")
    if here == there:
        return Element(a.kind, a.value if a.kind is not Kind.CONSTANT else np.asarray(a.value).astype(target)[()])
    if here > there:
        return apply("trunc")
    return apply("sext" if np.issubdtype(source, np.signedinteger) else "zext")


def _sign(e: Emitter, a: list[Element], d: list[Any], out: Any) -> Element:
    zero, one = constant(0, out), constant(1, out)
    up = _select(e, _compare(e, "gt", [a[0], zero], [out, out]), one, a[0], out)
    return _select(e, _compare(e, "lt", [a[0], zero], [out, out]), constant(-1, out), up, out)


def elementwise(e: Emitter, name: str, a: list[Element], d: list[Any], out: Any, params: dict) -> Element:
    """The result of the primitive ``name`` for one element of each operand. Raises Unsupported.

    d: the operands' dtypes; out: the result's.
    """
    if name in _COMPARE:
        return _compare(e, name, a, d)
    if name in _ARITHMETIC:
        return _arithmetic(e, name, a, d, out)
    if name in _BITS:
        code, fold = _BITS[name]
        return e.apply(code + " {t} {0}, {1}", fold, a, d, out)
    if name == "abs" and not is_float(out):
        return e.apply("call {t} @llvm.abs.{s}({t} {0}, i1 false)", np.abs, a, d, out)
    if name in _FUNCTIONS and is_float(out):
        if name == "round" and int(params.get("rounding_method", 1)) != 1:
            raise Unsupported("rounding away from zero")
        code, fold = _FUNCTIONS[name]
        return e.apply("call {t} @llvm." + code + ".{s}({t} {0})", fold, a, d, out)
    match name:
        case "div":
            return _divide(e, a, d, out)
        case "rem":
            return _remainder(e, a, d, out)
        case "min" | "max":
            return _extreme(e, name, a, d, out)
        case "neg":
            if is_float(out):
                return e.apply("fneg {t} {0}", np.negative, a, d, out)
            return _arithmetic(e, "sub", [constant(0, out), a[0]], [out, out], out)
        case "not":
            return e.apply("xor {t} {0}, {1}", lambda x, y: np.invert(x), [a[0], constant(-1 if out != np.bool_ else 1, out)], [out, out], out)
        case "select_n":
            if len(a) != 3 or d[0] != np.bool_:
                raise Unsupported("select_n of more than two")
            return _select(e, a[0], a[2], a[1], out)
        case "convert_element_type":
            return _convert(e, a[0], d[0], out)
        case "bitcast_convert_type":
            if is_float(out) == is_float(d[0]):
                return a[0]
            return e.apply("bitcast {t0} {0} to {t}", lambda x: np.asarray(x).view(out)[()], a, d, out)
        case "is_finite":
            size = e.apply("call {t0} @llvm.fabs.{s}({t0} {0})", np.abs, a, d, d[0])
            return e.apply("fcmp olt {t0} {0}, {1}", np.less, [size, constant(np.inf, d[0])], [d[0]] * 2, np.bool_)
        case "square":
            return _arithmetic(e, "mul", [a[0], a[0]], [out, out], out)
        case "rsqrt":
            root = elementwise(e, "sqrt", a, d, out, {})
            return _divide(e, [constant(1, out), root], [out, out], out)
        case "integer_pow":
            return _power(e, a[0], int(params["y"]), out)
        case "sign":
            return _sign(e, a, d, out)
        case "clamp":
            low = _extreme(e, "max", [a[0], a[1]], [out, out], out)
            return _extreme(e, "min", [low, a[2]], [out, out], out)
        case "shift_right_logical":
            return e.apply("lshr {t} {0}, {1}", _logical_shift, a, d, out)
        case "copy" | "copy_p" | "stop_gradient":
            return a[0]
    raise Unsupported(f"the operation {name}")


def _logical_shift(x: Any, y: Any) -> Any:
    return np.right_shift(np.asarray(x).astype(np.uint32), np.asarray(y).astype(np.uint32)).astype(np.asarray(x).dtype)


def _power(e: Emitter, x: Element, n: int, out: Any) -> Element:
    if n < 0:
        return _divide(e, [constant(1, out), _power(e, x, -n, out)], [out, out], out)
    result, square = None, x
    while n:
        if n & 1:
            result = square if result is None else _arithmetic(e, "mul", [result, square], [out, out], out)
        n >>= 1
        if n:
            square = _arithmetic(e, "mul", [square, square], [out, out], out)
    return constant(1, out) if result is None else result
