"""LLVM's instructions for the lanes of a batch: a vector register holds one number of each of ``width`` lanes.

An element is one number of an array for every lane: a constant, a scalar that all lanes share, a vector over the lanes,
or something that is made only if it is asked for. Arithmetic on constants is done here and on scalars once for all
lanes; what was computed is not computed again.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np


class Unsupported(Exception):
    """The program cannot be compiled lane by lane; the message names what is in the way."""


class Kind(Enum):
    CONSTANT = 0  # value: a NumPy scalar
    SCALAR = 1  # value: the name of an instruction's result
    VECTOR = 2  # likewise
    LAZY = 3  # value: a function without arguments that returns an element


@dataclass(eq=False, slots=True)
class Element:
    """One number of an array, for every lane."""

    kind: Kind
    value: Any


_TYPES = {"float32": "float", "int32": "i32", "uint32": "i32", "bool": "i1", "int8": "i8", "uint8": "i8"}
_SUFFIXES = {"float": "f32"}  # of intrinsics' names
CONTRACT = "contract"  # a product and a sum may be rounded once


def type_of(dtype: Any) -> str:
    """LLVM's type of a number. Raises Unsupported."""
    name = np.dtype(dtype).name
    if name not in _TYPES:
        raise Unsupported(f"numbers of type {name}")
    return _TYPES[name]


def is_float(dtype: Any) -> bool:
    return bool(np.issubdtype(dtype, np.floating))


def is_signed(dtype: Any) -> bool:
    return bool(np.issubdtype(dtype, np.signedinteger))


def constant(value: Any, dtype: Any) -> Element:
    return Element(Kind.CONSTANT, np.asarray(value).astype(dtype)[()])


def literal(value: Any) -> str:
    """A NumPy scalar as LLVM writes it; floats by the bits of the double of the same value."""
    if isinstance(value, np.bool_):
        return "true" if value else "false"
    if isinstance(value, np.floating):
        return f"0x{struct.unpack('>Q', struct.pack('>d', float(value)))[0]:016X}"
    return str(int(value))


class Emitter:
    """The instructions of one function, in order.

    width: lanes of a vector, 1: plain numbers; entry: reservations on the stack; lines: the rest.
    """

    def __init__(self, width: int) -> None:
        self.width = width
        self.entry: list[str] = []
        self.lines: list[str] = []
        self._names = 0
        self._known: dict[str, str] = {}

    def name(self) -> str:
        self._names += 1
        return f"%v{self._names}"

    def emit(self, instruction: str) -> str:
        """The name of a result that depends on the operands alone: the same instruction is emitted once."""
        if instruction not in self._known:
            self._known[instruction] = self.again(instruction)
        return self._known[instruction]

    def again(self, instruction: str) -> str:
        """The name of a result that may differ from time to time."""
        name = self.name()
        self.lines.append(f"{name} = {instruction}")
        return name

    def do(self, instruction: str) -> None:
        """An instruction without a result."""
        self.lines.append(instruction)

    def reserve(self, size: int, align: int = 64) -> str:
        """A pointer to bytes on the stack, for the whole function."""
        name = self.name()
        self.entry.append(f"{name} = alloca [{max(size, 1)} x i8], align {align}")
        return name

    def packed(self, kind: str) -> str:
        """The type of a vector of a type."""
        return kind if self.width == 1 else f"<{self.width} x {kind}>"

    def vector_type(self, dtype: Any) -> str:
        return self.packed(type_of(dtype))

    def forced(self, element: Element) -> Element:
        """The element, made now if it was not yet."""
        while element.kind is Kind.LAZY:
            made = self.forced(element.value())
            element.kind, element.value = made.kind, made.value
        return element

    def scalar(self, element: Element) -> str:
        """An operand of the scalar type. Raises Unsupported for a vector."""
        element = self.forced(element)
        if element.kind is Kind.VECTOR:
            raise Unsupported("a number of each lane where one for all of them is needed")
        return literal(element.value) if element.kind is Kind.CONSTANT else element.value

    def vector(self, element: Element, dtype: Any) -> str:
        """An operand of the vector type."""
        element = self.forced(element)
        if element.kind is Kind.VECTOR:
            return element.value
        one = type_of(dtype)
        if self.width == 1:
            return self.scalar(element)
        if element.kind is Kind.CONSTANT:
            return f"splat ({one} {literal(element.value)})"
        kind = self.vector_type(dtype)
        first = self.emit(f"insertelement {kind} poison, {one} {element.value}, i64 0")
        return self.emit(f"shufflevector {kind} {first}, {kind} poison, <{self.width} x i32> zeroinitializer")

    def apply(
        self, template: str, fold: Callable, elements: Sequence[Element], dtypes: Sequence[Any], out: Any
    ) -> Element:
        """The result of an instruction of dtype ``out``.

        template: with {0}, {1}, ... for the operands, {t0}, {t1}, ... for their types, {t} for the result's, {s} for
        the result's in the name of an intrinsic
        fold: does the same to NumPy scalars
        """
        elements = [self.forced(e) for e in elements]
        if all(e.kind is Kind.CONSTANT for e in elements):
            with np.errstate(all="ignore"):
                return constant(fold(*(e.value for e in elements)), out)
        vector = any(e.kind is Kind.VECTOR for e in elements)
        if vector:
            names = [self.vector(e, d) for e, d in zip(elements, dtypes, strict=True)]
        else:
            names = [self.scalar(e) for e in elements]
        kind, prefix = (self.vector_type, f"v{self.width}" * (self.width > 1)) if vector else (type_of, "")

        def suffix(dtype: Any) -> str:
            return prefix + _SUFFIXES.get(type_of(dtype), type_of(dtype))

        fields = {f"t{i}": kind(d) for i, d in enumerate(dtypes)}
        fields |= {"t": kind(out), "s": suffix(out)}
        return Element(Kind.VECTOR if vector else Kind.SCALAR, self.emit(template.format(*names, **fields)))
