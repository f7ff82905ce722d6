"""A loop over time as a CUDA kernel: a thread for each lane, from the lane's first tick to its last.

The state is the thread's own memory, which the hardware interleaves among the threads of a warp; what the loop only
reads stays in its array, where neighbouring threads read neighbouring numbers.
"""

from __future__ import annotations

from jax.extend import core

from mjx_tt.lanes.emitter import Emitter
from mjx_tt.lanes.frame import Operand
from mjx_tt.lanes.memory import Slots
from mjx_tt.lanes.programs import emit_step

# Few lanes: blocks of one warp, which spread over all multiprocessors, with all the registers there are. Many: fewer
# registers, so that more warps hide one another's waits (benchmarks.accelerator on an H200: 36 ms in place of 44 for
# 96,000 episodes).
FEW, MANY = (32, None), (64, 168)  # threads of a block, most registers of a thread
MANY_LANES = 65_536


class Rows(Slots):
    """A lane's numbers in an operand's array, one row for each."""

    def __init__(self, e: Emitter, operand: Operand, array: str, lanes: int, columns: int) -> None:
        super().__init__(e, array)
        self._bytes = operand.bits // 8
        self._stride = {"column": columns, "shared": 1}.get(operand.kind, lanes)
        number = {"column": "%column", "shared": "0"}.get(operand.kind, "%lane")
        # The lane first, then the row's constant distance: that is part of the instruction that reads.
        self._first = e.emit(f"getelementptr inbounds i{operand.bits}, ptr {array}, i64 {number}")

    def address(self, slot: int) -> str:
        return self._e.emit(f"getelementptr inbounds i8, ptr {self._first}, i64 {slot * self._stride * self._bytes}")

    def _align(self, laned: bool) -> int:
        return self._bytes


def module(traced: core.ClosedJaxpr, operands: list[Operand], lanes: int, columns: int, live: int, limit: int) -> str:
    """LLVM's text of ``@lane(a0, ..., r0, ..., lane)``, which runs one lane, for any processor.

    live: number of the operand that says which lanes go on; limit: most ticks
    """
    e = Emitter(1)

    def rows(operand: Operand, array: str) -> Rows:
        return Rows(e, operand, array, lanes, columns)

    states = [(i, o) for i, o in enumerate(operands) if o.kind == "state"]
    forms, begins = [o.form for _, o in states], [o.begin for _, o in states]
    own = Slots(e, e.reserve(4 * sum(form.size for form in forms)))
    for i, o in states:
        for k, element in enumerate(rows(o, f"%a{i}").value(o.form, 0).elements):
            own.store(o.begin + k, element, o.form.dtype, True)
    enter, e.lines = e.lines, []

    values = [
        own.value(o.form, o.begin) if o.kind == "state" else rows(o, f"%a{i}").value(o.form, 0)
        for i, o in enumerate(operands)
    ]
    results = emit_step(e, traced, values)
    own.replace(values[: len(states)], results, forms, begins)
    advance, e.lines = e.lines, []

    for i, o in states:
        for k, element in enumerate(own.value(o.form, o.begin).elements):
            rows(o, f"%r{i}").store(k, element, o.form.dtype, True)
    lines = [
        "%tick_at = alloca i32",
        *e.entry,
        f"%column = urem i64 %lane, {columns}",
        *enter,
        "store i32 0, ptr %tick_at",
        "br label %ticks",
        "ticks:",
        "%tick = load i32, ptr %tick_at",
        f"%live = load i8, ptr {own.address(operands[live].begin)}",
        "%alive = icmp ne i8 %live, 0",
        f"%early = icmp slt i32 %tick, {limit}",
        "%go = and i1 %alive, %early",
        "br i1 %go, label %advance, label %leave",
        "advance:",
        *advance,
        "%tick_next = add i32 %tick, 1",
        "store i32 %tick_next, ptr %tick_at",
        "br label %ticks",
        "leave:",
        *e.lines,
        "ret void",
    ]
    parameters = ", ".join([*_arrays(operands), "i64 %lane"])
    return "\n".join([f"define void @lane({parameters}) alwaysinline nounwind {{", *lines, "}", ""])


def launch(lanes: int) -> tuple[int, int | None]:
    """Threads of a block, and the most registers of a thread; None: all."""
    return MANY if lanes >= MANY_LANES else FEW


def entry(operands: list[Operand], lanes: int) -> str:
    """LLVM's text of the kernel ``@run(a0, ..., r0, ...)``: @lane for every thread's own lane."""
    parameters = ", ".join(_arrays(operands))
    threads, registers = launch(lanes)
    limits = f'"nvvm.maxntid"="{threads}"' + (f' "nvvm.maxnreg"="{registers}"' if registers else "")
    special = "call i32 @llvm.nvvm.read.ptx.sreg."
    return f"""
declare i32 @llvm.nvvm.read.ptx.sreg.tid.x()
declare i32 @llvm.nvvm.read.ptx.sreg.ctaid.x()
define ptx_kernel void @run({parameters}) #0 {{
  %thread = {special}tid.x()
  %block = {special}ctaid.x()
  %begin = mul i32 %block, {threads}
  %number = add i32 %begin, %thread
  %lane = zext i32 %number to i64
  %mine = icmp slt i64 %lane, {lanes}
  br i1 %mine, label %run, label %end
run:
  call void @lane({parameters}, i64 %lane)
  br label %end
end:
  ret void
}}
attributes #0 = {{ nounwind {limits} }}
"""


def _arrays(operands: list[Operand]) -> list[str]:
    results = [f"ptr noalias %r{i}" for i, o in enumerate(operands) if o.kind == "state"]
    return [f"ptr noalias readonly %a{i}" for i in range(len(operands))] + results
