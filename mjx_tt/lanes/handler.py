"""The function that XLA calls: it brings a vector of lanes after the other into slots, runs their steps, stores them.

An XLA_FFI_Handler of xla/ffi/api/c_api.h, in LLVM's text.
"""

from __future__ import annotations

from mjx_tt.lanes import frame
from mjx_tt.lanes.frame import Operand


def handler(operands: list[Operand], slots: dict[str, int], live: int, limit: int, width: int) -> str:
    """The module's text besides @step(state, own, shared, tick).

    slots: number of slots by place; live: number of the operand that says which lanes go on; limit: most ticks.
    """
    size = width * 4
    lines = frame.opened(operands)
    # The slots, at a multiple of 64 bytes.
    total = sum(slots.values()) * size
    lines += [
        f"%memory = call ptr @malloc(i64 {total + 64})",
        "%number = ptrtoint ptr %memory to i64",
        "%up = add i64 %number, 63",
        "%even = and i64 %up, -64",
        "%slots = inttoptr i64 %even to ptr",
    ]
    begin = 0
    for place, count in slots.items():
        lines.append(f"%{place} = getelementptr i8, ptr %slots, i64 {begin}")
        begin += count * size
    for name in ("lane", "column", "zeros"):
        lines.append(f"%{name} = alloca [{width} x i64], align 64")
    lines.append(f"call void @llvm.memset.p0.i64(ptr %zeros, i8 0, i64 {width * 8}, i1 false)")
    for i, o in enumerate(operands):
        lines.append(f"%g{i} = getelementptr i8, ptr %{o.place}, i64 {o.begin * size}")
        if o.kind == "shared":
            lines.append(f"call void @in{o.bits}(ptr %g{i}, ptr %a{i}, i64 {o.form.size}, i64 1, ptr %zeros)")
    lines += [
        "%last = sub i64 %lanes, 1",
        "br label %groups",
        "groups:",
        "%first = phi i64 [0, %execute], [%first_next, %leave]",
        "%finished = icmp sge i64 %first, %lanes",
        "br i1 %finished, label %end, label %count",
        # The last vector is filled up with its last lane, whose copies are not stored.
        "count:",
        "%k = phi i64 [0, %groups], [%k_next, %count]",
        "%ahead = add i64 %first, %k",
        "%l = call i64 @llvm.smin.i64(i64 %ahead, i64 %last)",
        "%l_at = getelementptr i64, ptr %lane, i64 %k",
        "store i64 %l, ptr %l_at",
        "%c = urem i64 %l, %columns",
        "%c_at = getelementptr i64, ptr %column, i64 %k",
        "store i64 %c, ptr %c_at",
        "%k_next = add i64 %k, 1",
        f"%counted = icmp sge i64 %k_next, {width}",
        "br i1 %counted, label %enter, label %count",
        "enter:",
    ]
    for i, o in enumerate(operands):
        if o.kind != "shared":
            index, stride = ("column", "columns") if o.kind == "column" else ("lane", "lanes")
            arguments = f"ptr %g{i}, ptr %a{i}, i64 {o.form.size}, i64 %{stride}, ptr %{index}"
            lines.append(f"call void @in{o.bits}({arguments})")
    lines += [
        "br label %ticks",
        "ticks:",
        "%tick = phi i32 [0, %enter], [%tick_next, %advance]",
        f"%live = load <{width} x i8>, ptr %g{live}",
        f"%some = call i8 @llvm.vector.reduce.or.v{width}i8(<{width} x i8> %live)",
        "%any = icmp ne i8 %some, 0",
        f"%early = icmp slt i32 %tick, {limit}",
        "%go = and i1 %any, %early",
        "br i1 %go, label %advance, label %leave",
        "advance:",
        "call void @step(ptr %state, ptr %own, ptr %shared, i32 %tick)",
        "%tick_next = add i32 %tick, 1",
        "br label %ticks",
        "leave:",
        "%left = sub i64 %lanes, %first",
        f"%stored = call i64 @llvm.smin.i64(i64 %left, i64 {width})",
    ]
    for i, o in enumerate(operands):
        if o.kind == "state":
            arguments = f"ptr %g{i}, ptr %r{i}, i64 {o.form.size}, i64 %lanes, i64 %first, i64 %stored"
            lines.append(f"call void @out{o.bits}({arguments})")
    lines += [f"%first_next = add i64 %first, {width}", "br label %groups", "end:"]
    lines += ["call void @free(ptr %memory)", "ret ptr null"]
    body = "\n".join(lines)
    return f"{_DECLARED}{_copies(width)}define ptr @handler(ptr %frame) nounwind {{\n{body}\n}}\n"


_DECLARED = """
declare ptr @malloc(i64)
declare void @free(ptr)
"""


# Rows of a batch's array, one for each element, from and to slots.
_COPY = """
define internal void @{name}(ptr noalias %slots, ptr noalias %array, i64 %n, i64 %stride, {extra}) nounwind noinline {{
  br label %rows
rows:
  %e = phi i64 [0, %0], [%e_next, %next]
  %done = icmp sge i64 %e, %n
  br i1 %done, label %end, label %row
row:
  %base = mul i64 %e, %stride
  %offset = mul i64 %e, {size}
  %slot = getelementptr i8, ptr %slots, i64 %offset
  br label %lanes
lanes:
  %k = phi i64 [0, %row], [%k_next, %lanes]
  {place}
  %there = add i64 %base, %place
  %outside = getelementptr {type}, ptr %array, i64 %there
  %inside = getelementptr {type}, ptr %slot, i64 %k
  %x = load {type}, ptr %{source}
  store {type} %x, ptr %{target}
  %k_next = add i64 %k, 1
  %more = icmp slt i64 %k_next, {count}
  br i1 %more, label %lanes, label %next
next:
  %e_next = add i64 %e, 1
  br label %rows
end:
  ret void
}}
"""


def _copies(width: int) -> str:
    """@in8, @in32 and @out8, @out32, by the size of a number."""
    into = {
        "extra": "ptr noalias %index",
        "place": "%place_at = getelementptr i64, ptr %index, i64 %k\n  %place = load i64, ptr %place_at",
        "count": str(width),
        "source": "outside",
        "target": "inside",
    }
    out = {
        "extra": "i64 %first, i64 %count",
        "place": "%place = add i64 %first, %k",
        "count": "%count",
        "source": "inside",
        "target": "outside",
    }
    return "".join(
        _COPY.format(name=f"{name}{bits}", type=f"i{bits}", size=width * 4, **fields)
        for bits in (8, 32)
        for name, fields in (("in", into), ("out", out))
    )
