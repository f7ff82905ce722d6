"""Operations and bytes of a compiled program, with loops as often as they run.

XLA's own analysis (``compiled.cost_analysis()``) counts the body of a loop once. Here every loop's body is given to the
same analysis as a program of its own, and counts as often as XLA found that the loop runs. Barriers against
optimisation move nothing and count nothing; the analysis takes them for copies.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import jax
from jax._src.lib import hlo, xla_client  # the parser and the analysis have no public name
from jax.stages import Compiled

_COMPUTATION = re.compile(r"^(?:ENTRY )?%(\S+) \(.*?^}", re.MULTILINE | re.DOTALL)
_OPCODE = re.compile(r"^ +(?:ROOT )?%\S+ = .*? ([a-z][\w-]*)\(", re.MULTILINE)
_NOT_STARTED = {"parameter", "constant", "tuple", "get-tuple-element", "bitcast", "while", "call"}
_CALL = re.compile(r" call\(.*to_apply=%([^\s,]+)")
_LOOP = re.compile(r" while\(.*condition=%([^\s,]+), body=%([^\s,]+)(?:.*\"known_trip_count\":\{\"n\":\"(\d+)\"\})?")


@dataclass(frozen=True)
class Counts:
    """Amounts of one run.

    operations       additions, multiplications, comparisons, selections, ...: one for each number computed, two for a
                     multiplication and addition in one
    transcendentals  square roots, exponentials, hyperbolic tangents, ...
    bytes            read and written by the program's kernels, wherever they are kept
    kernels          loops of fused operations, copies and the like, each of which is started by itself
    """

    operations: float
    transcendentals: float
    bytes: float
    kernels: float

    def __add__(self, other: Counts) -> Counts:
        return Counts(
            self.operations + other.operations,
            self.transcendentals + other.transcendentals,
            self.bytes + other.bytes,
            self.kernels + other.kernels,
        )

    def __rmul__(self, factor: float) -> Counts:
        values = (self.operations, self.transcendentals, self.bytes, self.kernels)
        return Counts(*(factor * value for value in values))


def count(compiled: Compiled) -> Counts:
    """Amounts of one run of the program. Raises ValueError for a loop whose number of rounds is not known."""
    text = re.sub(r", metadata=\{[^}]*\}", "", compiled.as_text() or "").replace(" opt-barrier(", " bitcast(")
    entry = re.search(r"^ENTRY %(\S+) ", text, re.MULTILINE)
    if entry is None:
        raise ValueError("the compiled program's text has no entry")
    bodies = {match[1]: match[0] for match in _COMPUTATION.finditer(text)}
    return _total(entry[1], bodies)


_BLOCK = re.compile(r"^(\S+):.*?\n(.*?)(?=^\S+:|\Z)", re.MULTILINE | re.DOTALL)
_VECTOR = re.compile(r"= (?:tail )?(?:call )?(.*?) ?<(\d+) x (?:float|i32|i8|i1)>(.*)")
_NO_OPERATION = {"load", "bitcast", "shufflevector", "insertelement", "freeze", "phi", "trunc", "zext"}


def count_lanes(text: str, rounds: int) -> Counts:
    """Amounts of one run of @step of an optimised module of ``mjx_tt.lanes``, for one lane.

    rounds: of each block that branches to itself. Bytes are those that the program itself loads and stores, without
    what the compiler puts aside for want of registers.
    """
    body = re.search(r"^define internal[^\n]* @step\(.*?^}", text, re.MULTILINE | re.DOTALL)
    if body is None:
        raise ValueError("the module has no function @step")
    code = re.sub(r"\A[^\n]*\n(?!\S+:)", "entry:\n", body[0])
    total = Counts(0.0, 0.0, 0.0, 1.0)
    for label, lines in _BLOCK.findall(code.rstrip("}\n") + "\n"):
        again = rounds if re.search(rf"br .*%{re.escape(label)}\b", lines) else 1
        total = total + float(again) * _vectors(lines)
    return total


def _vectors(lines: str) -> Counts:
    operations = transcendentals = bytes_ = 0.0
    for line in lines.splitlines():
        if re.search(r"\bload <|\bstore <", line):
            bytes_ += 1.0 if "x i8>" in line else 4.0
        found = _VECTOR.search(line)
        if not found:
            continue
        words = found[1].split()
        operation = words[0] if words else ""
        if operation in _NO_OPERATION:
            continue
        operations += 2.0 if "@llvm.fma" in line else 1.0
        transcendentals += "@llvm.sqrt" in line
    return Counts(operations, transcendentals, bytes_, 0.0)


def _total(name: str, bodies: dict[str, str]) -> Counts:
    """Amounts of one run of a computation: XLA's, in which its loops run once, and their further rounds."""
    counts = _once(name, bodies)
    for condition, body, rounds in _loops(name, bodies):
        if not rounds:
            raise ValueError(f"the compiled program does not say how often its loop {body} runs")
        counts = counts + int(rounds) * (_total(body, bodies) + _total(condition, bodies))
        counts = counts + -1.0 * (_once(body, bodies) + _once(condition, bodies))
    return counts


def _loops(name: str, bodies: dict[str, str]) -> list[tuple[str, str, str]]:
    """Condition, body and number of rounds of each loop in a computation and those it calls, loops in loops aside."""
    called = [loop for other in _CALL.findall(bodies[name]) for loop in _loops(other, bodies)]
    return [*_LOOP.findall(bodies[name]), *called]


def _kernels(name: str, bodies: dict[str, str]) -> int:
    """Kernels of a computation in which loops run once."""
    inner = _CALL.findall(bodies[name])
    for condition, body, _ in _LOOP.findall(bodies[name]):
        inner += [condition, body]
    own = sum(opcode not in _NOT_STARTED for opcode in _OPCODE.findall(bodies[name]))
    return own + sum(_kernels(other, bodies) for other in inner)


def _once(name: str, bodies: dict[str, str]) -> Counts:
    """XLA's analysis of a computation as a program of its own."""
    before = list(bodies)[: list(bodies).index(name)]  # a computation stands behind those that it calls
    text = "\n\n".join([*(bodies[other] for other in before), f"ENTRY {bodies[name].removeprefix('ENTRY ')}"])
    module = hlo.hlo_module_from_text(f"HloModule part\n\n{text}\n")
    found = xla_client._xla.hlo_module_cost_analysis(jax.devices()[0].client, module)
    amounts = (float(found.get(key, 0.0)) for key in ("flops", "transcendentals", "bytes accessed"))
    return Counts(*amounts, kernels=_kernels(name, bodies))
