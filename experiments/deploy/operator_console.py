"""The operator's terminal at the robot: keys in, a live view out."""

from __future__ import annotations

import math
import os
import re
import select
import sys
import termios
import time
import tty
from collections.abc import Mapping
from dataclasses import dataclass

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from robot_io.control import messages

COLOURS = {"disarmed": "white", "ready": "green", "active": "bold green", "stopping": "yellow", "fault": "bold red"}
QUIT, PAUSE, RECOVER = "q", "h", "c"
STOP = " "
MOVING = "parc+-"  # keys after which something moves, or may
ESCAPE = "\x1b"
# A whole escape sequence (ECMA-48; and a Linux console's function keys, two brackets and one), a string, or Alt.
SEQUENCE = re.compile(
    r"(?<!\x1b)\x1b(?:\[(?:\[[^@-~]*|(?!\[)[^@-~]*)[@-~]|O[^@-~]*[@-~]|[]PX^_].*?(?:\a|\x1b\\)|[^][OPX^_\x1b])",
    re.DOTALL,
)
LONGEST_READ = 4096  # bytes; a terminal keeps no more


@dataclass(frozen=True)
class Key:
    """A key's effect in words, and the request that it sends; None where the program decides."""

    text: str
    request: messages.Request | None = None


KEYS = {
    "p": Key("switch on and home the linear axes", messages.Prepare()),
    "a": Key("arm: the robot goes to its home pose", messages.Arm()),
    STOP: Key("stop", messages.Stop()),
    "r": Key("reset a fault", messages.Reset()),
    RECOVER: Key("continue after a fault: switch on, reset, home and arm"),
    "d": Key("discard this ball", messages.Discard()),
    PAUSE: Key("pause: take no new balls, or resume"),
    QUIT: Key("stop and end"),
}


class EscapeFilter:
    """Takes escape sequences out of what a terminal sends: arrow keys, function keys, Alt with a key, reports.

    A sequence goes on in the next piece when a read ends inside it, unless ``BROKEN_OFF`` seconds lie between them:
    then what began it was the Esc key itself, which must not swallow the keys that follow.
    """

    BROKEN_OFF = 0.5  # [s]; a terminal sends a sequence at once

    def __init__(self) -> None:
        self._rest = ""  # what has come of a sequence that has not ended
        self._last = -math.inf

    def keys(self, text: str, now: float) -> str:
        """The characters of a piece, read at ``now`` [s], that belong to no sequence."""
        if now - self._last > self.BROKEN_OFF:
            self._rest = ""
        self._last = now
        keys, escape, rest = SEQUENCE.sub("", self._rest + text).partition(ESCAPE)
        self._rest = escape + rest
        return keys


class Keyboard:
    """Single keys without Enter; nothing where the input is no terminal. Use as a context manager."""

    def __enter__(self) -> Keyboard:
        self._terminal, self._filter = sys.stdin.isatty(), EscapeFilter()
        if self._terminal:
            self._before = termios.tcgetattr(sys.stdin)
            tty.setcbreak(sys.stdin)
        return self

    def __exit__(self, *exc_info: object) -> None:
        if self._terminal:
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._before)

    def pressed(self) -> str | None:
        """The key that counts of all that wait, so that none queues behind the repetitions of another.

        The stop key goes before everything, even inside an escape sequence, then the one that ends. Of others the last
        counts; where they are different ones at once, as in a paste, only of those after which nothing moves.
        """
        if not self._terminal or not select.select([sys.stdin], [], [], 0.0)[0]:
            return None
        text = os.read(sys.stdin.fileno(), LONGEST_READ).decode(errors="ignore")
        keys = self._filter.keys(text, time.monotonic())
        if STOP in text:
            return STOP
        if QUIT in keys:
            return QUIT
        if len(set(keys)) > 1:
            keys = "".join(key for key in keys if key not in MOVING)
        return keys[-1:] or None


class View:
    """The status of the control process, redrawn in place; on a terminal only."""

    def __init__(self, console: Console, title: str, keys: Mapping[str, Key] = KEYS) -> None:
        self._title, self._keys = title, keys
        self._live = Live(console=console, auto_refresh=False, transient=True) if console.is_terminal else None
        self._last = ""

    def __enter__(self) -> View:
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *exc_info: object) -> None:
        if self._live:
            self._live.stop()

    def say(self, text: str) -> None:
        """The last line of the view: what was refused, what was asked for."""
        self._last = text

    def take(self, message: messages.Message) -> None:
        """Draw a status anew; put a refusal into the last line."""
        if isinstance(message, messages.Status) and self._live:
            self._live.update(self._draw(message), refresh=True)
        elif isinstance(message, messages.Refused):
            self.say(message.sentence)

    def _draw(self, s: messages.Status) -> Group:
        head = Text.assemble(
            (f"{self._title}  ", "bold"),
            (s.state.upper(), COLOURS[s.state]),
            "  dry run" if s.dry else "  holding" if s.paused else "",
            "  at home" if s.at_home else "",
        )
        lines = [head]
        lines += [Text(f"FAULT {f.cause}: {f.text}", "red") for f in s.faults]
        lines += [Text(f"STOPPED: {s.stopped}", "yellow")] if s.stopped else []
        if not s.faults:
            waiting = [*s.present.values(), *([s.unproven] if s.unproven and s.state == "disarmed" else [])]
            lines += [Text(f"waiting: {text}", "yellow") for text in dict.fromkeys(waiting)]
        outcomes = ", ".join(f"{n} {name}" for name, n in s.outcomes.items()) or "none yet"
        lines.append(Text(f"balls {s.balls}: {outcomes}"))
        rallies = (
            f"rally {s.rally} touches; {s.rallies} rallies, {s.mean_rally:.1f} on average, longest {s.longest_rally}"
        )
        lines.append(Text(f"{rallies}; last: {s.last_rally}" if s.last_rally else rallies))
        ball = "no ball" if s.ball is None else "ball {:+.3f} {:+.3f} {:+.3f} m in the table frame".format(*s.ball)
        clock = f"tracker's clock {-1e6 * s.clock['drift']:+z.1f} ppm over {s.clock['seconds']} s" if s.clock else ""
        lines.append(Text(f"{ball}; {clock}"))
        joints = _table("joint", "position", "command")
        for name, unit, position, velocity in s.joints:
            joints.add_row(name, f"{position:+.3f} {unit}", f"{velocity:+.2f} {unit}/s")
        timing = _table("", "p50", "p99", "max [ms]")
        for name, t in s.timings.items():
            if isinstance(t, dict):
                timing.add_row(name, f"{t['p50_ms']:.3f}", f"{t['p99_ms']:.3f}", f"{t['max_ms']:.3f}")
        missed = s.timings.get("missed_ticks", 0)
        egm, frames = s.egm, s.tracker_counts
        wire = Text(
            f"EGM {egm['accepted']:,} taken, {sum(egm['rejected'].values()):,} refused, {egm['lost']:,} lost; "
            f"tracker {frames.get('accepted', 0):,} taken, {frames.get('lost', 0):,} lost; "
            f"axes {s.axes_cycles:,} cycles, {s.axes_late:,} late; "
            f"ticks missed {missed}; log lost {s.log_dropped}"
        )
        grid = Table.grid(padding=(0, 4))
        grid.add_row(joints, timing)
        keys = "   ".join(f"[{'space' if k == ' ' else k}] {key.text}" for k, key in self._keys.items())
        return Group(*lines, grid, wire, Text(keys, "dim"), Text(self._last, "yellow"))


def _table(first: str, *others: str) -> Table:
    table = Table(first, box=None, pad_edge=False)
    for name in others:
        table.add_column(name, justify="right")
    return table
