"""JAX programs over the lanes of a batch, traced and emitted as instructions on one vector of lanes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jax.extend import core

from mjx_tt.lanes import arithmetic, functions
from mjx_tt.lanes.emitter import Element, Emitter, Kind, Unsupported, constant, type_of

LANES = 10007  # the number of lanes while tracing: a prime that no other axis has
MOST_CONSTANTS = 4096  # in one array; each becomes an operand of its own
_INLINED = {"jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "remat", "checkpoint"}

# Where arrays lie and what may be computed again means nothing for numbers in registers.
_INERT = {"optimization_barrier", "reshard", "sharding_constraint", "pvary", "pcast"}


@dataclass(eq=False)
class Value:
    """An array: shape without the lanes' axis, its elements in the order of rows."""

    dtype: Any
    shape: tuple[int, ...]
    elements: list[Element]
    # Of a value that is another one with some elements replaced: (value, first place [scalar], replacing elements).
    update: tuple[Value, Element, list[Element]] | None = None

    def pick(self, index: np.ndarray) -> Value:
        return Value(self.dtype, index.shape, [self.elements[i] for i in index.ravel()])

    @property
    def places(self) -> np.ndarray:
        return np.arange(len(self.elements)).reshape(self.shape)


def shape_of(aval: Any) -> tuple[tuple[int, ...], bool]:
    """Shape without the lanes' axis, and whether it has one. Raises Unsupported where that is not the last one."""
    shape = tuple(aval.shape)
    laned = bool(shape) and shape[-1] == LANES
    shape = shape[:-1] if laned else shape
    if LANES in shape or any(n % LANES == 0 and n for n in shape):
        raise Unsupported("the lanes' axis is not the last one")
    return shape, laned


def of_constants(array: Any) -> Value:
    if isinstance(array, jax.core.Tracer):
        raise Unsupported("an array of the program around the loop that is no argument")
    array = np.asarray(array)
    if array.size > MOST_CONSTANTS:
        raise Unsupported(f"a constant of {array.size} numbers")
    if LANES in array.shape:
        raise Unsupported("an array over the lanes that is no argument")
    return Value(array.dtype, array.shape, [constant(x, array.dtype) for x in array.ravel()])


def emit(e: Emitter, jaxpr: core.Jaxpr, constants: list[Any], arguments: list[Value]) -> list[Value]:
    """Results of a traced program. Raises Unsupported."""
    known: dict[Any, Value] = {}

    def read(atom: Any) -> Value:
        return of_constants(np.asarray(atom.val, atom.aval.dtype)) if isinstance(atom, core.Literal) else known[atom]

    for variable, value in zip(jaxpr.constvars, constants, strict=True):
        known[variable] = value if isinstance(value, Value) else of_constants(value)
    known |= dict(zip(jaxpr.invars, arguments, strict=True))
    for equation in jaxpr.eqns:
        operands = [read(atom) for atom in equation.invars]
        results = _apply(e, equation, operands)
        for variable, result in zip(equation.outvars, results, strict=True):
            known[variable] = result
    return [read(atom) for atom in jaxpr.outvars]


def _apply(e: Emitter, equation: Any, operands: list[Value]) -> list[Value]:
    name, params = equation.primitive.name, equation.params
    if name in _INLINED:
        inner = params.get("jaxpr") or params.get("call_jaxpr") or params.get("fun_jaxpr")
        closed = inner if hasattr(inner, "consts") else None
        return emit(e, closed.jaxpr, list(closed.consts), operands) if closed else emit(e, inner, [], operands)
    if name in _INERT:
        return operands
    if name == "scan":
        return _scan(e, params, operands)
    avals = [v.aval for v in equation.outvars]
    shape, laned = shape_of(avals[0])
    dtype = np.dtype(avals[0].dtype)
    if name in _STRUCTURAL:
        in_avals = [v.aval for v in equation.invars]
        return [_STRUCTURAL[name](operands, in_avals, shape, laned, dtype, params, e)]
    if name in functions.EXPANSIONS:
        if dtype != np.float32:
            raise Unsupported(f"{name} of {dtype}")
        traced = jax.make_jaxpr(functions.EXPANSIONS[name])(jax.ShapeDtypeStruct(avals[0].shape, dtype))
        return emit(e, traced.jaxpr, list(traced.consts), operands)
    if len(avals) != 1:
        raise Unsupported(f"the operation {name}")
    spread = [_spread(x, shape) for x in operands]
    dtypes = [np.dtype(x.dtype) for x in operands]
    made = [arithmetic.elementwise(e, name, list(each), dtypes, dtype, params) for each in zip(*spread, strict=True)]
    return [Value(dtype, shape, made)]


def _spread(x: Value, shape: tuple[int, ...]) -> list[Element]:
    """The elements as NumPy broadcasts them to ``shape``, to which an axis of one number for all lanes may follow."""
    if len(x.shape) > len(shape):
        x = Value(x.dtype, x.shape[:-1], x.elements)
    return x.elements if x.shape == shape else x.pick(np.broadcast_to(x.places, shape)).elements


# Moving elements about costs nothing: they have names, not places.


def _broadcast(operands, avals, shape, laned, dtype, params, e):
    (x,), dims = operands, list(params["broadcast_dimensions"])
    _, was = shape_of(avals[0])
    if was and dims[-1] != len(shape):
        raise Unsupported("lanes that are broadcast to another axis")
    source = [d for d in dims if d < len(shape)]
    flat = x.places.reshape(x.shape[: len(source)])
    if flat.size != len(x.elements):
        raise Unsupported("broadcasting along the lanes")
    full = [1] * len(shape)
    for d, n in zip(source, flat.shape, strict=True):
        full[d] = n
    return x.pick(np.broadcast_to(flat.reshape(full), shape))


def _reshape(operands, avals, shape, laned, dtype, params, e):
    x = operands[0]
    if shape_of(avals[0])[1] != laned or math.prod(shape) != len(x.elements):
        raise Unsupported("a reshape of the lanes")
    return Value(dtype, shape, x.elements)


def _slice(operands, avals, shape, laned, dtype, params, e):
    x = operands[0]
    n = len(x.shape)
    strides = params["strides"] or (1,) * len(params["start_indices"])
    if laned != shape_of(avals[0])[1]:
        raise Unsupported("a slice of the lanes")
    index = tuple(
        slice(a, b, s)
        for a, b, s in zip(params["start_indices"][:n], params["limit_indices"][:n], strides[:n], strict=True)
    )
    return x.pick(x.places[index])


def _concatenate(operands, avals, shape, laned, dtype, params, e):
    if params["dimension"] >= len(shape):
        raise Unsupported("concatenation of lanes")
    elements = [element for x in operands for element in x.elements]
    begins = np.cumsum([0, *(len(x.elements) for x in operands)])
    index = np.concatenate([x.places + b for x, b in zip(operands, begins, strict=False)], axis=params["dimension"])
    return Value(dtype, shape, [elements[i] for i in index.ravel()])


def _stack(operands, avals, shape, laned, dtype, params, e):
    axis = params["axis"] if "axis" in params else params["dimension"]
    if axis < 0:
        axis += len(shape) + laned
    if axis >= len(shape):
        raise Unsupported("stacking along the lanes")
    elements = [element for x in operands for element in x.elements]
    begins = np.cumsum([0, *(len(x.elements) for x in operands)])
    index = np.stack([x.places + b for x, b in zip(operands, begins, strict=False)], axis=axis)
    return Value(dtype, shape, [elements[i] for i in index.ravel()])


def _transpose(operands, avals, shape, laned, dtype, params, e):
    order = list(params["permutation"])
    if laned:
        if order[-1] != len(shape):
            raise Unsupported("a transpose of the lanes")
        order = order[:-1]
    return operands[0].pick(operands[0].places.transpose(order))


def _reverse(operands, avals, shape, laned, dtype, params, e):
    if any(d >= len(shape) for d in params["dimensions"]):
        raise Unsupported("reversed lanes")
    return operands[0].pick(np.flip(operands[0].places, params["dimensions"]))


def _iota(operands, avals, shape, laned, dtype, params, e):
    d = params["dimension"]
    if d >= len(shape):
        raise Unsupported("the numbers of the lanes")
    index = np.broadcast_to(np.arange(shape[d]).reshape([-1 if i == d else 1 for i in range(len(shape))]), shape)
    return of_constants(index.astype(dtype))


def _reduce(combine: str) -> Callable:
    def rule(operands, avals, shape, laned, dtype, params, e):
        x, axes = operands[0], params["axes"]
        if any(a >= len(x.shape) for a in axes):
            raise Unsupported("a sum over the lanes")
        places = np.moveaxis(x.places, axes, range(len(axes))).reshape(-1, math.prod(shape))
        made = []
        for column in places.T:
            total = x.elements[column[0]]
            for i in column[1:]:
                total = arithmetic.elementwise(e, combine, [total, x.elements[i]], [dtype, dtype], dtype, {})
            made.append(total)
        return Value(dtype, shape, made)

    return rule


def _update(operands, avals, shape, laned, dtype, params, e):
    x, new, *start = operands
    starts = [e.forced(s.elements[0]) for s in start]
    inner = starts[1:]
    whole = new.shape[1:] == x.shape[1:]
    if not x.shape or not whole or new.shape[0] != 1:
        raise Unsupported("an update of a part of a row")
    if any(s.kind is not Kind.CONSTANT or s.value != 0 for s in inner):
        raise Unsupported("an update at several places")
    rows, size = x.shape[0], len(new.elements)
    index_type = np.dtype(start[0].dtype)
    zero, last = constant(0, index_type), constant(rows - 1, index_type)
    at = arithmetic.elementwise(e, "clamp", [zero, starts[0], last], [index_type] * 3, index_type, {})

    def element(i: int) -> Element:
        def made() -> Element:
            here = arithmetic.elementwise(e, "eq", [at, constant(i // size, index_type)], [index_type] * 2, np.bool_, {})
            three = [here, x.elements[i], new.elements[i % size]]
            return arithmetic.elementwise(e, "select_n", three, [np.dtype(bool), dtype, dtype], dtype, {})

        return Element(Kind.LAZY, made)

    return Value(dtype, shape, [element(i) for i in range(rows * size)], (x, at, new.elements))


_STRUCTURAL: dict[str, Callable] = {
    "broadcast_in_dim": _broadcast,
    "reshape": _reshape,
    "squeeze": _reshape,
    "expand_dims": _reshape,
    "slice": _slice,
    "concatenate": _concatenate,
    "stack": _stack,
    "transpose": _transpose,
    "rev": _reverse,
    "iota": _iota,
    "reduce_sum": _reduce("add"),
    "reduce_prod": _reduce("mul"),
    "reduce_max": _reduce("max"),
    "reduce_min": _reduce("min"),
    "reduce_and": _reduce("and"),
    "reduce_or": _reduce("or"),
    "dynamic_update_slice": _update,
}


class Slots:
    """Numbers in memory, one after the other, each in a slot of ``width`` x 4 bytes (a scalar at its beginning)."""

    def __init__(self, e: Emitter, pointer: str) -> None:
        self._e, self._pointer = e, pointer

    def address(self, slot: int) -> str:
        return self._e.emit(f"getelementptr inbounds i8, ptr {self._pointer}, i64 {slot * self._e.width * 4}")

    def load(self, slot: int, dtype: Any, laned: bool, again: bool = False) -> Element:
        """An element that is read when it is first asked for."""

        def made() -> Element:
            e, here = self._e, self.address(slot)
            kind = type_of(dtype)
            stored = "i8" if kind == "i1" else kind
            if laned:
                stored = f"<{e.width} x {stored}>"
            name = e.again(f"load {stored}, ptr {here}, align {min(64, e.width * 4) if laned else 4}")
            if kind == "i1":
                name = e.again(f"trunc {stored} {name} to {e.vector_type(dtype) if laned else 'i1'}")
            return Element(Kind.VECTOR if laned else Kind.SCALAR, name)

        return Element(Kind.LAZY, made)

    def store(self, slot: int | str, element: Element, dtype: Any, laned: bool) -> None:
        """slot: its number, or the name of its address."""
        e = self._e
        kind = e.vector_type(dtype) if laned else type_of(dtype)
        name = e.vector(element, dtype) if laned else e.scalar(element, dtype)
        if type_of(dtype) == "i1":
            wider = f"<{e.width} x i8>" if laned else "i8"
            name, kind = e.again(f"zext {kind} {name} to {wider}"), wider
        here = slot if isinstance(slot, str) else self.address(slot)
        e.do(f"store {kind} {name}, ptr {here}, align {min(64, e.width * 4) if laned else 4}")


def _scan(e: Emitter, params: dict, operands: list[Value]) -> list[Value]:
    """A loop of a known number of rounds, as a loop: its body is emitted once."""
    length, n_const, n_carry = params["length"], params["num_consts"], params["num_carry"]
    closed = params["jaxpr"]
    jaxpr, inner = closed.jaxpr, list(closed.consts)
    constants, carry, rows = operands[:n_const], operands[n_const : n_const + n_carry], operands[n_const + n_carry :]
    carried = jaxpr.invars[n_const : n_const + n_carry]
    if len(jaxpr.outvars) > n_carry:
        raise Unsupported("a scan that stacks results")
    laned = [shape_of(v.aval)[1] for v in carried]
    sizes = [len(v.elements) for v in carry]
    begins = np.cumsum([0, *sizes])
    slots = Slots(e, e.reserve(int(begins[-1]) * e.width * 4))
    for value, begin, lane in zip(carry, begins, laned, strict=False):
        for i, element in enumerate(value.elements):
            slots.store(int(begin) + i, element, value.dtype, lane)
    # What the rounds read by their number.
    tables = []
    for value, variable in zip(rows, jaxpr.invars[n_const + n_carry :], strict=True):
        lane = shape_of(variable.aval)[1]
        table = Slots(e, pointer := e.reserve(len(value.elements) * e.width * 4))
        for i, element in enumerate(value.elements):
            table.store(i, element, value.dtype, lane)
        tables.append((pointer, len(value.elements) // length, value.dtype, shape_of(variable.aval)[0], lane))

    counter = e.reserve(8, 8)
    e.do(f"store i64 0, ptr {counter}")
    label = e.name()[1:]
    e.do(f"br label %loop_{label}")
    e.do(f"loop_{label}:")
    number = e.again(f"load i64, ptr {counter}")
    if params["reverse"]:
        number = e.again(f"sub i64 {length - 1}, {number}")
    arguments = [*constants]
    for variable, begin, lane in zip(carried, begins, laned, strict=False):
        shape, _ = shape_of(variable.aval)
        dtype = np.dtype(variable.aval.dtype)
        loaded = [slots.load(int(begin) + i, dtype, lane) for i in range(math.prod(shape))]
        arguments.append(Value(dtype, shape, loaded))
    before = arguments[n_const:]
    for pointer, size, dtype, shape, lane in tables:
        offset = e.again(f"mul i64 {number}, {size * e.width * 4}")
        row = Slots(e, e.again(f"getelementptr inbounds i8, ptr {pointer}, i64 {offset}"))
        arguments.append(Value(dtype, shape, [row.load(i, dtype, lane) for i in range(size)]))
    results = emit(e, jaxpr, inner, arguments)
    store_all(e, slots, results, before, [int(b) for b in begins], laned)
    now = e.again(f"load i64, ptr {counter}")
    after = e.again(f"add i64 {now}, 1")
    e.do(f"store i64 {after}, ptr {counter}")
    more = e.again(f"icmp slt i64 {after}, {length}")
    e.do(f"br i1 {more}, label %loop_{label}, label %after_{label}")
    e.do(f"after_{label}:")
    out = []
    for variable, begin, lane in zip(carried, begins, laned, strict=False):
        shape, _ = shape_of(variable.aval)
        dtype = np.dtype(variable.aval.dtype)
        loaded = [slots.load(int(begin) + i, dtype, lane) for i in range(math.prod(shape))]
        out.append(Value(dtype, shape, loaded))
    return out


def store_all(
    e: Emitter, slots: Slots, results: list[Value], before: list[Value], begins: list[int], laned: list[bool]
) -> None:
    """The results in the places of what was there before: first everything is made, then it is stored."""
    writes: list[Callable[[], None]] = []
    for value, old, begin, lane in zip(results, before, begins, laned, strict=False):
        if value.update is not None and value.update[0] is old and lane:
            writes.append(_update_write(e, slots, value, begin))
            continue
        for i, (new, was) in enumerate(zip(value.elements, old.elements, strict=True)):
            if new is was:
                continue
            _ = e.vector(new, value.dtype) if lane else e.scalar(new, value.dtype)
            writes.append(lambda i=i, new=new, b=begin, d=value.dtype, lane=lane: slots.store(b + i, new, d, lane))
    for write in writes:
        write()


def _update_write(e: Emitter, slots: Slots, value: Value, begin: int) -> Callable[[], None]:
    _, at, new = value.update
    for element in new:
        e.vector(element, value.dtype)

    def write() -> None:
        row = e.again(f"zext i32 {e.scalar(at, np.int32)} to i64")
        offset = e.again(f"mul i64 {row}, {len(new) * e.width * 4}")
        first = e.again(f"getelementptr inbounds i8, ptr {slots.address(begin)}, i64 {offset}")
        for i, element in enumerate(new):
            here = e.again(f"getelementptr inbounds i8, ptr {first}, i64 {i * e.width * 4}")
            slots.store(here, element, value.dtype, True)

    return write
