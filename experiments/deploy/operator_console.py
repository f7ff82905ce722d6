"""The operator's terminal at the robot: keys in, a live view out."""

from __future__ import annotations

import os
import select
import sys
import termios
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


@dataclass(frozen=True)
class Key:
    """A key's effect in words, and the request that it sends; None where the program decides."""

    text: str
    request: messages.Request | None = None


KEYS = {
    "p": Key("switch on and home the linear axes", messages.Prepare()),
    "a": Key("arm: the robot goes to its home pose", messages.Arm()),
    " ": Key("stop", messages.Stop()),
    "r": Key("reset a fault", messages.Reset()),
    RECOVER: Key("continue after a fault: switch on, home what lost its reference, reset and arm"),
    "d": Key("discard this ball", messages.Discard()),
    PAUSE: Key("pause: take no new balls, or resume"),
    QUIT: Key("stop and end"),
}


class Keyboard:
    """Single keys without Enter; nothing where the input is no terminal. Use as a context manager."""

    def __enter__(self) -> Keyboard:
        self._terminal = sys.stdin.isatty()
        if self._terminal:
            self._before = termios.tcgetattr(sys.stdin)
            tty.setcbreak(sys.stdin)
        return self

    def __exit__(self, *exc_info: object) -> None:
        if self._terminal:
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._before)

    def pressed(self) -> str | None:
        """The next key that waits."""
        if not self._terminal or not select.select([sys.stdin], [], [], 0.0)[0]:
            return None
        return os.read(sys.stdin.fileno(), 1).decode(errors="ignore")


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
            "  in thought" if s.dry else "  holding" if s.paused else "",
            "  at home" if s.at_home else "",
        )
        lines = [head]
        lines += [Text(f"FAULT {f.cause}: {f.text}", "red") for f in s.faults]
        lines += [Text(f"STOPPED: {s.stopped}", "yellow")] if s.stopped else []
        if not s.faults:
            lines += [Text(f"waiting: {text}", "yellow") for text in s.present.values()]
        outcomes = ", ".join(f"{n} {name}" for name, n in s.outcomes.items()) or "none yet"
        lines.append(Text(f"balls {s.balls}: {outcomes}"))
        rallies = (
            f"rally {s.rally} touches; {s.rallies} rallies, {s.mean_rally:.1f} on average, longest {s.longest_rally}"
        )
        lines.append(Text(f"{rallies}; last: {s.last_rally}" if s.last_rally else rallies))
        ball = "no ball" if s.ball is None else "ball {:+.3f} {:+.3f} {:+.3f} m in the table frame".format(*s.ball)
        clock = f"tracker's clock {-1e6 * s.clock['drift']:+z.1f} ppm over {s.clock['seconds']} s" if s.clock else ""
        lines.append(Text(f"{ball}; {clock}"))
        joints = Table(box=None, pad_edge=False)
        for name in ("joint", "position", "command"):
            joints.add_column(name, justify="left" if name == "joint" else "right")
        for name, unit, position, velocity in s.joints:
            joints.add_row(name, f"{position:+.3f} {unit}", f"{velocity:+.2f} {unit}/s")
        timing = Table(box=None, pad_edge=False)
        for name in ("", "p50", "p99", "max [ms]"):
            timing.add_column(name, justify="left" if not name else "right")
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
