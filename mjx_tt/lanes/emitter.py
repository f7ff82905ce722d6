"""LLVM instructions for the lanes of a batch: one vector register holds one number of ``width`` episodes.

An element is a number of a batch's array: a constant, a scalar that all lanes share, a vector over the lanes, or
something that is made only if it is asked for. Arithmetic on constants is done here, on scalars once for all lanes;
what was computed once is not computed again.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np


class Unsupported(Exception):
    """A program that cannot be compiled lane by lane; the message names the operation."""


class Kind(Enum):
    CONSTANT = 0  # value: a NumPy scalar
    SCALAR = 1  # value: the name of an instruction's result
    VECTOR = 2  # the same
    LAZY = 3  # value: a function that returns an element


@dataclass(eq=False, slots=True)
class Element:
    """A number of each lane."""

    kind: Kind
    value: Any


TYPES = {"float32": "float", "int32": "i32", "uint32": "i32", "bool": "i1", "int8": "i8", "uint8": "i8"}
FLOAT = "contract"  # a product and a sum may be rounded once


def type_of(dtype: Any) -> str:
    """LLVM's type of a number. Raises Unsupported."""
    name = np.dtype(dtype).name
    if name not in TYPES:
        raise Unsupported(f"numbers of type {name}")
    return TYPES[name]


def constant(value: Any, dtype: Any) -> Element:
    return Element(Kind.CONSTANT, np.asarray(value).astype(dtype)[()])


def literal(value: Any) -> str:
    """A NumPy scalar as LLVM writes it: floats by the bits of the double of the same value."""
    if isinstance(value, np.bool_):
        return "true" if value else "false"
    if isinstance(value, np.floating):
        return f"0x{struct.unpack('>Q', struct.pack('>d', float(value)))[0]:016X}"
    return str(int(value))


class Emitter:
    """Instructions of one function, in order."""

    def __init__(self, width: int) -> None:
        self.width = width
        self.entry: list[str] = []  # reservations on the stack
        self.lines: list[str] = []
        self._names = 0
        self._known: dict[tuple, str] = {}

    def name(self) -> str:
        self._names += 1
        return f"%v{self._names}"

    def emit(self, instruction: str) -> str:
        """Name of the instruction's result; the same instruction is emitted once."""
        return self._emit(("", instruction), instruction)

    def again(self, instruction: str) -> str:
        """The same for an instruction whose result may differ from time to time."""
        name = self.name()
        self.lines.append(f"{name} = {instruction}")
        return name

    def do(self, instruction: str) -> None:
        """An instruction without a result."""
        self.lines.append(instruction)

    def reserve(self, size: int, align: int = 64) -> str:
        """Bytes on the stack for the whole function."""
        name = self.name()
        self.entry.append(f"{name} = alloca [{size} x i8], align {align}")
        return name

    def _emit(self, key: tuple, instruction: str) -> str:
        if key not in self._known:
            self._known[key] = self.again(instruction)
        return self._known[key]

    def vector_type(self, dtype: Any) -> str:
        return f"<{self.width} x {type_of(dtype)}>"

    def forced(self, element: Element) -> Element:
        """The element, made if it was not yet."""
        while element.kind is Kind.LAZY:
            made = self.forced(element.value())
            element.kind, element.value = made.kind, made.value
        return element

    def scalar(self, element: Element, dtype: Any) -> str:
        """An operand of the scalar type. Raises Unsupported for a vector."""
        element = self.forced(element)
        if element.kind is Kind.VECTOR:
            raise Unsupported("a number of a lane where one for all is needed")
        return literal(element.value) if element.kind is Kind.CONSTANT else element.value

    def vector(self, element: Element, dtype: Any) -> str:
        """An operand of the vector type."""
        element = self.forced(element)
        if element.kind is Kind.VECTOR:
            return element.value
        one = type_of(dtype)
        if element.kind is Kind.CONSTANT:
            return f"splat ({one} {literal(element.value)})"
        kind = self.vector_type(dtype)
        first = self.emit(f"insertelement {kind} poison, {one} {element.value}, i64 0")
        return self.emit(f"shufflevector {kind} {first}, {kind} poison, <{self.width} x i32> zeroinitializer")

    def apply(
        self, template: str, fold: Callable, elements: list[Element], dtypes: list[Any], out: Any
    ) -> Element:
        """``template`` with {0}, {1}, ... for the operands, {t0}, ... for their types and {t} for the result's.

        fold: what does the same to NumPy scalars.
        """
        elements = [self.forced(e) for e in elements]
        if all(e.kind is Kind.CONSTANT for e in elements):
            with np.errstate(all="ignore"):
                return constant(fold(*(e.value for e in elements)), out)
        vector = any(e.kind is Kind.VECTOR for e in elements)
        operand = self.vector if vector else self.scalar
        kind = self.vector_type if vector else type_of
        names = [operand(e, d) for e, d in zip(elements, dtypes, strict=True)]
        types = {f"t{i}": kind(d) for i, d in enumerate(dtypes)} | {"t": kind(out)}
        suffix = {"float": "f32", "i32": "i32"}.get(type_of(dtypes[-1]), "")
        types["s"] = f"v{self.width}{suffix}" if vector else suffix
        return Element(Kind.VECTOR if vector else Kind.SCALAR, self.emit(template.format(*names, **types)))
