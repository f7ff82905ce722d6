"""Elements in memory: one after the other, each in a slot of ``width`` x 4 bytes, a shared one at its beginning."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mjx_tt.lanes.emitter import Element, Emitter, Kind, type_of
from mjx_tt.lanes.values import Form, Value


class Slots:
    """Slots from ``pointer``, the name of an address, on."""

    def __init__(self, e: Emitter, pointer: str) -> None:
        self._e, self._pointer = e, pointer

    def address(self, slot: int) -> str:
        return self._e.emit(f"getelementptr inbounds i8, ptr {self._pointer}, i64 {slot * self._e.width * 4}")

    def value(self, form: Form, begin: int) -> Value:
        """An array in the slots from ``begin`` on; each element is read when it is first asked for."""
        elements = [self._loaded(begin + i, form) for i in range(form.size)]
        return Value(form.dtype, form.shape, elements)

    def _loaded(self, slot: int, form: Form) -> Element:
        e, kind = self._e, type_of(form.dtype)

        def made() -> Element:
            stored = "i8" if kind == "i1" else kind
            if form.laned:
                stored = e.packed(stored)
            name = e.again(f"load {stored}, ptr {self.address(slot)}, align {self._align(form.laned)}")
            if kind == "i1":
                name = e.again(f"trunc {stored} {name} to {e.vector_type(form.dtype) if form.laned else 'i1'}")
            return Element(Kind.VECTOR if form.laned else Kind.SCALAR, name)

        return Element(Kind.LAZY, made)

    def store(self, slot: int | str, element: Element, dtype: Any, laned: bool) -> None:
        """slot: its number, or the name of its address."""
        e, kind = self._e, type_of(dtype)
        kind, name = (e.vector_type(dtype), e.vector(element, dtype)) if laned else (kind, e.scalar(element))
        if type_of(dtype) == "i1":
            stored = e.packed("i8") if laned else "i8"
            name, kind = e.again(f"zext {kind} {name} to {stored}"), stored
        address = slot if isinstance(slot, str) else self.address(slot)
        e.do(f"store {kind} {name}, ptr {address}, align {self._align(laned)}")

    def _align(self, laned: bool) -> int:
        """Of an address in bytes, at least."""
        return min(64, self._e.width * 4) if laned else 4

    def replace(self, old: list[Value], new: list[Value], forms: list[Form], begins: list[int]) -> None:
        """Stores arrays in the slots of those before them. All elements are made before the first is stored."""
        writes: list[Callable[[], None]] = []
        for was, value, form, begin in zip(old, new, forms, begins, strict=True):
            if value.update is not None and value.update[0] is was and form.laned:
                writes.append(self._row_write(value, begin))
                continue
            for i, (before, element) in enumerate(zip(was.elements, value.elements, strict=True)):
                if element is before:
                    continue
                _ = self._e.vector(element, value.dtype) if form.laned else self._e.scalar(element)
                writes.append(self._write(begin + i, element, form))
        for write in writes:
            write()

    def _write(self, slot: int, element: Element, form: Form) -> Callable[[], None]:
        return lambda: self.store(slot, element, form.dtype, form.laned)

    def _row_write(self, value: Value, begin: int) -> Callable[[], None]:
        """Of an array with one row replaced only that row is stored."""
        assert value.update is not None
        e, (_, at, row) = self._e, value.update
        for element in row:
            e.vector(element, value.dtype)

        def write() -> None:
            number = e.again(f"zext i32 {e.scalar(at)} to i64")
            offset = e.again(f"mul i64 {number}, {len(row) * e.width * 4}")
            first = e.again(f"getelementptr inbounds i8, ptr {self.address(begin)}, i64 {offset}")
            for i, element in enumerate(row):
                here = e.again(f"getelementptr inbounds i8, ptr {first}, i64 {i * e.width * 4}")
                self.store(here, element, value.dtype, laned=True)

        return write


def begins_of(forms: list[Form]) -> list[int]:
    """The first slots of arrays one after the other, and the number of all slots."""
    return [int(n) for n in np.cumsum([0, *(form.size for form in forms)])]
