"""Arrays over the lanes of a batch as lists of elements, and moving their elements about, which costs nothing.

While a program is traced its batch has ``LANES`` lanes, a number that no other axis has, so the lanes' axis is known
wherever it goes. What is moved along the lanes themselves is not supported.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any, TypeAlias

import jax
import numpy as np

from mjx_tt.lanes.arithmetic import elementwise
from mjx_tt.lanes.emitter import Element, Emitter, Kind, Unsupported, constant

LANES = 10007  # a prime
MOST_CONSTANTS = 4096  # of one array: each becomes an operand of its own


@dataclass(eq=False)
class Value:
    """An array: its shape without the lanes' axis and its elements in the order of rows."""

    dtype: Any
    shape: tuple[int, ...]
    elements: list[Element]
    # Of another array with one row replaced: (that array, the row's number, what is in it).
    update: tuple[Value, Element, list[Element]] | None = None

    def pick(self, places: np.ndarray) -> Value:
        return Value(self.dtype, places.shape, [self.elements[i] for i in places.ravel()])

    @property
    def places(self) -> np.ndarray:
        """The elements' numbers in the array's shape."""
        return np.arange(len(self.elements)).reshape(self.shape)


@dataclass(frozen=True)
class Form:
    """Shape of an array without the lanes' axis, and where that is; None: all lanes share the array."""

    shape: tuple[int, ...]
    axis: int | None
    dtype: Any

    @classmethod
    def of(cls, aval: Any) -> Form:
        """Raises Unsupported where lanes and another axis became one."""
        shape = tuple(aval.shape)
        axis = shape.index(LANES) if LANES in shape else None
        rest = shape if axis is None else shape[:axis] + shape[axis + 1 :]
        if any(n and n % LANES == 0 for n in rest):
            raise Unsupported("an array in which the lanes are not one axis")
        return cls(rest, axis, np.dtype(aval.dtype))

    @property
    def laned(self) -> bool:
        return self.axis is not None

    @property
    def whole(self) -> tuple[int, ...]:
        """The shape with the lanes' axis."""
        return self.shape if self.axis is None else (*self.shape[: self.axis], LANES, *self.shape[self.axis :])

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    def without(self, axis: int) -> int:
        """The number of an axis among those that are not the lanes'. Raises Unsupported for the lanes'."""
        if axis == self.axis:
            raise Unsupported("an operation along the lanes")
        return axis if self.axis is None or axis < self.axis else axis - 1

    def kept(self, entries: Sequence) -> tuple:
        """One entry for each axis, the lanes' left out."""
        return tuple(entry for i, entry in enumerate(entries) if i != self.axis)


def of_constants(array: Any) -> Value:
    """Raises Unsupported for an array that is known only when the program runs, or a large one."""
    if isinstance(array, jax.core.Tracer):
        raise Unsupported("an array of the program around the loop which is not among its arguments")
    array = np.asarray(array)
    if array.size > MOST_CONSTANTS:
        raise Unsupported(f"a constant of {array.size} numbers")
    return Value(array.dtype, array.shape, [constant(x, array.dtype) for x in array.ravel()])


def spread(x: Value, was: Form, to: Form) -> list[Element]:
    """The elements as JAX broadcasts them for an operation: axes of length 1 to longer ones, a scalar to any shape."""
    if x.shape == to.shape:
        return x.elements
    places = x.places
    if places.ndim > len(to.shape) and not was.laned and to.axis is not None:
        places = places.squeeze(to.axis)  # one number for all lanes
    return x.pick(np.broadcast_to(places, to.shape)).elements


Rule: TypeAlias = Callable[[Emitter, list[Value], list[Form], Form, dict], Value]


def _broadcast(e: Emitter, operands: list[Value], forms: list[Form], to: Form, params: dict) -> Value:
    x, was, dims = operands[0], forms[0], list(params["broadcast_dimensions"])
    if was.axis is not None and dims[was.axis] != to.axis:
        raise Unsupported("lanes that become another axis")
    full = [1] * (len(to.shape) + to.laned)
    for i, d in enumerate(dims):
        if i != was.axis:
            full[d] = x.shape[was.without(i)]
    return x.pick(np.broadcast_to(x.places.reshape(to.kept(full)), to.shape))


def _reshape(e: Emitter, operands: list[Value], forms: list[Form], to: Form, params: dict) -> Value:
    x, was = operands[0], forms[0]

    def before(form: Form) -> int:
        return math.prod(form.shape[: form.axis])

    if was.laned != to.laned or (was.laned and before(was) != before(to)):
        raise Unsupported("a reshape that moves the lanes")
    return Value(to.dtype, to.shape, x.elements)


def _slice(e: Emitter, operands: list[Value], forms: list[Form], to: Form, params: dict) -> Value:
    if forms[0].laned != to.laned:
        raise Unsupported("some of the lanes")
    starts, limits = params["start_indices"], params["limit_indices"]
    cuts = map(slice, starts, limits, params["strides"] or [1] * len(starts))
    return operands[0].pick(operands[0].places[forms[0].kept(list(cuts))])


def _joined(combine: Callable, axis: str) -> Rule:
    def rule(e: Emitter, operands: list[Value], forms: list[Form], to: Form, params: dict) -> Value:
        elements = [element for x in operands for element in x.elements]
        begins = np.cumsum([0, *(len(x.elements) for x in operands)])
        parts = [x.places + begin for x, begin in zip(operands, begins, strict=False)]
        return Value(to.dtype, to.shape, elements).pick(combine(parts, axis=to.without(params[axis])))

    return rule


def _transpose(e: Emitter, operands: list[Value], forms: list[Form], to: Form, params: dict) -> Value:
    order = [forms[0].without(a) for a in params["permutation"] if a != forms[0].axis]
    return operands[0].pick(operands[0].places.transpose(order))


def _reverse(e: Emitter, operands: list[Value], forms: list[Form], to: Form, params: dict) -> Value:
    return operands[0].pick(np.flip(operands[0].places, tuple(to.without(d) for d in params["dimensions"])))


def _iota(e: Emitter, operands: list[Value], forms: list[Form], to: Form, params: dict) -> Value:
    d = to.without(params["dimension"])
    column = np.arange(to.shape[d]).reshape([-1 if i == d else 1 for i in range(len(to.shape))])
    return of_constants(np.broadcast_to(column, to.shape).astype(to.dtype))


def _reduce(combine: str) -> Rule:
    def rule(e: Emitter, operands: list[Value], forms: list[Form], to: Form, params: dict) -> Value:
        axes = [forms[0].without(a) for a in params["axes"]]
        columns = np.moveaxis(operands[0].places, axes, range(len(axes))).reshape(-1, to.size).T
        chosen = ([operands[0].elements[i] for i in column] for column in columns)
        return Value(to.dtype, to.shape, [_folded(e, combine, elements, to.dtype) for elements in chosen])

    return rule


def _folded(e: Emitter, combine: str, elements: Sequence[Element], d: Any) -> Element:
    return reduce(lambda total, other: elementwise(e, combine, [total, other], [d, d], d), elements)


def _dot(e: Emitter, operands: list[Value], forms: list[Form], to: Form, params: dict) -> Value:
    """dot_general: batch axes first, then what is left of each operand."""
    contracted, batched = params["dimension_numbers"]
    tables = []
    for x, form, over, along in zip(operands, forms, contracted, batched, strict=True):
        along = [form.without(a) for a in along if a != form.axis]
        over = [form.without(a) for a in over]
        rest = [a for a in range(len(x.shape)) if a not in (*over, *along)]
        table = x.places.transpose([*along, *rest, *over])
        sizes = [math.prod(x.shape[a] for a in group) for group in (along, rest, over)]
        tables.append(table.reshape(sizes))
    left, right = tables
    if to.size and not left.shape[2]:
        raise Unsupported("a product over nothing")
    d, made = to.dtype, []
    if any(x.dtype != d for x in operands):
        raise Unsupported("a product of numbers of different types")
    one, other = (x.elements for x in operands)
    for rows, columns in zip(left, right, strict=True):
        for row, column in itertools.product(rows, columns):
            pairs = zip(row, column, strict=True)
            terms = [elementwise(e, "mul", [one[i], other[j]], [d, d], d) for i, j in pairs]
            made.append(_folded(e, "add", terms, d))
    # Where only one operand has lanes, they come out behind what is left of the operands before: the same order.
    return Value(d, to.shape, made)


_INDEX, _BOOL = np.dtype(np.int32), np.dtype(bool)


def _row(e: Emitter, x: Value, part: tuple[int, ...], starts: Sequence[Value]) -> Element:
    """The number of a row, of shape ``part``, that a program reads or writes by its number."""
    if not x.shape or part != (1, *x.shape[1:]) or any(s.dtype != _INDEX for s in starts):
        raise Unsupported("a part of an array, by its number, that is not one row")
    first, *others = (e.forced(s.elements[0]) for s in starts)
    if any(s.kind is not Kind.CONSTANT or s.value for s in others):
        raise Unsupported("a part of an array by several numbers")
    bounds = [constant(0, _INDEX), first, constant(x.shape[0] - 1, _INDEX)]
    return elementwise(e, "clamp", bounds, [_INDEX] * 3, _INDEX)


def _chosen(e: Emitter, at: Element, row: int, there: Element, else_: Element, d: Any) -> Element:
    here = elementwise(e, "eq", [at, constant(row, _INDEX)], [_INDEX, _INDEX], _BOOL)
    return elementwise(e, "select_n", [here, else_, there], [_BOOL, d, d], d)


def _read(e: Emitter, operands: list[Value], forms: list[Form], to: Form, params: dict) -> Value:
    """dynamic_slice of one row."""
    x, *starts = operands
    at, size = _row(e, x, to.shape, forms[0].kept(starts)), to.size
    elements = x.elements[:size]
    for row in range(1, x.shape[0]):
        rows = zip(x.elements[row * size : (row + 1) * size], elements, strict=True)
        elements = [_chosen(e, at, row, there, before, to.dtype) for there, before in rows]
    return Value(to.dtype, to.shape, elements)


def _update(e: Emitter, operands: list[Value], forms: list[Form], to: Form, params: dict) -> Value:
    x, new, *starts = operands
    at = _row(e, x, new.shape, to.kept(starts))
    size = len(new.elements)

    def element(i: int) -> Element:
        return Element(Kind.LAZY, lambda: _chosen(e, at, i // size, new.elements[i % size], x.elements[i], to.dtype))

    return Value(to.dtype, to.shape, [element(i) for i in range(len(x.elements))], (x, at, new.elements))


RULES: dict[str, Rule] = {
    "broadcast_in_dim": _broadcast,
    "reshape": _reshape,
    "squeeze": _reshape,
    "expand_dims": _reshape,
    "slice": _slice,
    "concatenate": _joined(np.concatenate, "dimension"),
    "stack": _joined(np.stack, "axis"),
    "transpose": _transpose,
    "rev": _reverse,
    "iota": _iota,
    "reduce_sum": _reduce("add"),
    "reduce_prod": _reduce("mul"),
    "reduce_max": _reduce("max"),
    "reduce_min": _reduce("min"),
    "reduce_and": _reduce("and"),
    "reduce_or": _reduce("or"),
    "dot_general": _dot,
    "dynamic_slice": _read,
    "dynamic_update_slice": _update,
}
