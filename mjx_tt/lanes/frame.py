"""The frame of a call by XLA, in LLVM's text: a loop's arrays, by the offsets of structures of xla/ffi/api/c_api.h."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import jax

from mjx_tt.lanes.emitter import type_of
from mjx_tt.lanes.values import Form

# Offsets in bytes of XLA_FFI_CallFrame: extension_start, args.args, rets.rets; of XLA_FFI_Buffer: data, dims; of
# XLA_FFI_Metadata_Extension: metadata; of XLA_FFI_Metadata: api_version's major and minor, traits.
_EXTENSION, _ARGS, _RETS = 8, 72, 112
_DATA, _DIMS = 24, 40
_METADATA, _MAJOR, _MINOR, _TRAITS = 24, 24, 28, 32


@dataclass(frozen=True)
class Operand:
    """An array of the call.

    kind: "state" and "lane" (lanes L as the last axis), "column" (P columns as the last, lane l has column l mod P) or
    "shared"; begin: its first slot among those of its place ("state", "own" for lane and column, or "shared").
    """

    kind: str
    form: Form
    begin: int

    @property
    def place(self) -> str:
        return {"state": "state", "shared": "shared"}.get(self.kind, "own")

    @property
    def bits(self) -> int:
        """Of a number in the array."""
        return 8 if type_of(self.form.dtype) in ("i1", "i8") else 32


def opened(operands: list[Operand]) -> list[str]:
    """The beginning of a handler with the frame %frame, which answers questions about itself.

    After it %a0, %a1, ... are the operands' data, %r0, ... the results' (the states come first), %lanes and %columns
    the lengths of their last axes. The block that it leaves open is "execute".
    """
    major, minor = _api_version()
    lines = [
        *field("extension", "frame", _EXTENSION),
        "%asked = icmp ne ptr %extension, null",
        "br i1 %asked, label %about, label %execute",
        "about:",
        *field("metadata", "extension", _METADATA),
    ]
    for name, offset, value in (("major", _MAJOR, major), ("minor", _MINOR, minor), ("traits", _TRAITS, 0)):
        lines += [f"%{name} = getelementptr i8, ptr %metadata, i64 {offset}", f"store i32 {value}, ptr %{name}"]
    lines += ["ret ptr null", "execute:", *field("args", "frame", _ARGS), *field("rets", "frame", _RETS)]
    for i, operand in enumerate(operands):
        lines += _buffer(f"a{i}", "args", i)
        if operand.kind == "state":
            lines += _buffer(f"r{i}", "rets", i)
    lines += _last_axis("lanes", operands, 0)
    columns = next((i for i, o in enumerate(operands) if o.kind == "column"), 0)
    return lines + _last_axis("columns", operands, columns)


def field(name: str, structure: str, offset: int) -> list[str]:
    """%name as the pointer at an offset of %structure."""
    at = f"%{name}_at"
    return [f"{at} = getelementptr i8, ptr %{structure}, i64 {offset}", f"%{name} = load ptr, ptr {at}"]


def _buffer(name: str, table: str, i: int) -> list[str]:
    return [*field(f"{name}_buffer", table, 8 * i), *field(name, f"{name}_buffer", _DATA)]


def _last_axis(name: str, operands: list[Operand], i: int) -> list[str]:
    form = operands[i].form
    rank = len(form.shape) + form.laned
    at = f"%{name}_at"
    return [
        *field(f"{name}_dims", f"a{i}_buffer", _DIMS),
        f"{at} = getelementptr i64, ptr %{name}_dims, i64 {rank - 1}",
        f"%{name} = load i64, ptr {at}",
    ]


@cache
def _api_version() -> tuple[int, int]:
    """Of the installed jaxlib's header: XLA refuses handlers of another one."""
    header = Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"
    found = dict(re.findall(r"#define XLA_FFI_API_(MAJOR|MINOR) (\d+)", header.read_text(encoding="utf-8")))
    return int(found["MAJOR"]), int(found["MINOR"])
