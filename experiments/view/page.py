"""The page: what plays, when, and how fast; curves and rewards beside it."""

from __future__ import annotations

import html
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import viser
from viser.uplot import Scale
from viser.uplot import Series as Line

from experiments.view.film import Film, Series
from experiments.view.programme import Programme
from experiments.view.scene import COLOURS, Scene

FRAME = 1.0 / 60.0  # [s]
REST = 0.6  # [s] on the last frame before the next ball
NEAR_CONTACT, CONTACT_SPEED = 0.12, 0.12  # [s] around the paddle's contact; share of the speed there
PLOTTED_EVERY = 0.2  # [s]
LINES = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f")
PANEL = 360  # [pixels]
LISTED = 5  # events


class Viewer:
    """Plays a programme. Everything happens in the thread of ``run``: callbacks of the page only leave word."""

    def __init__(self, server: viser.ViserServer, scene: Scene, programme: Programme) -> None:
        self.server, self.scene, self.programme = server, scene, programme
        self.number, self.t, self.playing = 0, 0.0, True
        self.shown: Sequence[Film] = ()
        self.frames = 0
        self.on_load: Callable[[], None] = lambda: None
        self.controls: Any = None
        self.every: list[Callable[[], None]] = []  # called about once a second
        self._waiting: dict[str, Callable[[], None]] = {}
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._plotted = self._asked = 0.0
        self._plots: dict[str, viser.GuiUplotHandle] = {}
        self._dirty, self._detailed = True, False
        gui = server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL)
        self._caption = gui.add_markdown("")
        self._events = gui.add_markdown("")
        self._time = gui.add_slider("time [s]", 0.0, 1.0, 0.001, 0.0)
        self.play_button = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        self._steps = gui.add_button_group("step", ("◀ ball", "◀", "▶", "ball ▶"))
        self.speed = gui.add_slider("speed", 0.02, 1.0, 0.02, 1.0)
        self._slow = gui.add_checkbox("contact in slow motion", True)
        self.tabs = gui.add_tab_group()
        self._listen()

    def _listen(self) -> None:
        self.play_button.on_click(lambda _: self.later("play", self.toggle))
        self._steps.on_click(lambda event: self.later("step", lambda: self._step(event.target.value)))

        @self._time.on_update
        def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                self.later("time", lambda: self._seek(event.target.value))

    def add_details(self) -> None:
        """Adds the tabs of curves and rewards, behind those that were added before."""
        self._curves = self.tabs.add_tab("Policy")
        with self._curves:
            names = tuple(dict.fromkeys(film.title for film in self.shown)) or ("",)
            self._whose = self.server.gui.add_dropdown("of", names, visible=len(names) > 1)
            self._whose.on_update(lambda _: self.later("whose", self._replot))
        with self.tabs.add_tab("Rewards"):
            self._rewards = self.server.gui.add_html("")
        self._detailed = True
        self._replot()

    # -- what the page asks for ----------------------------------------------------------------------------------------

    def later(self, key: str, action: Callable[[], None]) -> None:
        """Leaves an action to ``run``; a newer one of the same key takes its place."""
        with self._lock:
            self._waiting[key] = action

    def toggle(self) -> None:
        self.playing = not self.playing
        self.play_button.label = "Pause" if self.playing else "Play"
        self.play_button.icon = viser.Icon.PLAYER_PAUSE if self.playing else viser.Icon.PLAYER_PLAY

    def _seek(self, t: float) -> None:
        self.t, self._dirty = t, True

    def _step(self, button: str) -> None:
        if "ball" in button:
            self.go(self.number + (1 if "▶" in button else -1))
            return
        if self.playing:
            self.toggle()
        t = min(self.t, self.seconds) + (1.0 if button == "▶" else -1.0) / 75.0  # from the frame that is seen
        self._seek(float(np.clip(t, 0.0, self.seconds)))

    def go(self, number: int) -> None:
        """Shows entry ``number`` of the programme from its start."""
        count = self.programme.count
        self.number = max(number, 0) if count is None else number % count
        self.t = 0.0
        self.reload()

    def reload(self) -> None:
        """Takes the entry's films anew, as the programme makes them now."""
        self.shown = self.programme.films(self.number)
        self.scene.load(self.shown)
        self.t, self._dirty = min(self.t, self.seconds), True
        self._time.max = round(self.seconds, 2)
        self._caption.content = f"**{self.programme.caption(self.number)}**"
        self.on_load()
        if self._detailed:
            self._replot()

    def say(self, text: str) -> None:
        """Puts a line above the controls until the next ball."""
        self._caption.content = f"**{text}**"
        self.server.flush()

    @property
    def seconds(self) -> float:
        """Length [s] of what is shown: of the longest film."""
        return max((film.seconds for film in self.shown), default=0.0)

    # -- time ----------------------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Plays until ``stop``; without anybody who looks, time stands still."""
        if not self.shown:
            self.go(0)
        before = time.perf_counter()
        while not self._stop.is_set():
            self._answer()
            now = time.perf_counter()
            if self.server.get_clients():
                self.advance(now - before)
            before = now
            if now - self._asked > 1.0:
                self._asked = now
                for ask in self.every:
                    ask()
            self._stop.wait(max(0.0, FRAME - (time.perf_counter() - now)))

    def stop(self) -> None:
        self._stop.set()

    def _answer(self) -> None:
        with self._lock:
            waiting, self._waiting = self._waiting, {}
        for action in waiting.values():
            action()

    def advance(self, seconds: float) -> None:
        """Lets ``seconds`` of the viewer's time pass and draws what is new."""
        if self.playing:
            near = any(abs(self.t - film.contact) < NEAR_CONTACT for film in self.shown)
            self.t += seconds * self.speed.value * (CONTACT_SPEED if near and self._slow.value else 1.0)
            self._dirty = True
            if self.t > self.seconds + REST:
                self.go(self.number + 1)
        if self._dirty:
            self._dirty = False
            self.frames += 1
            self.scene.show(self.t)
            self._plot()

    # -- curves and rewards --------------------------------------------------------------------------------------------

    def _film(self) -> Film:
        return next((film for film in self.shown if film.title == self._whose.value), self.shown[0])

    def _replot(self) -> None:
        """Puts the film's curves into the plots that are there, or into new ones where the headings differ."""
        if not self.shown:
            return
        film = self._film()
        if self._plots.keys() != film.series.keys():
            for handle in self._plots.values():
                handle.remove()
            with self._curves:
                self._plots = {heading: self._add_plot(heading, curves) for heading, curves in film.series.items()}
        for heading, curves in film.series.items():
            scales = {"x": Scale(time=False, range=(0.0, film.seconds)), "y": Scale(range=_range(curves))}
            self._plots[heading].scales = scales
        self._rewards.content = ""
        self._plotted = 0.0

    def _add_plot(self, heading: str, curves: Series) -> viser.GuiUplotHandle:
        strokes = [
            "#{:02x}{:02x}{:02x}".format(*COLOURS[name]) if name in COLOURS else LINES[i % len(LINES)]
            for i, name in enumerate(curves.names)
        ]
        lines = (Line(label=name, stroke=s, width=1.5) for name, s in zip(curves.names, strokes, strict=True))
        return self.server.gui.add_uplot(_until(curves, 0.0), (Line(label="s"), *lines), title=heading, height=210)

    def _plot(self) -> None:
        now = time.perf_counter()
        put(self._time, float(min(self.t, self.seconds)))
        if now - self._plotted < PLOTTED_EVERY or not self.shown or not self._detailed:
            return
        self._plotted, film = now, self._film()
        for heading, handle in self._plots.items():
            handle.data = _until(film.series[heading], self.t)
        decided = all(self.t >= f.decided for f in self.shown)
        self._rewards.content = _table(self.shown) if decided else '<p style="margin:0.8em">after the ball</p>'
        past = [f"- {t:.2f} s: {html.escape(text)}" for f in self.shown for t, text in f.events if t <= self.t]
        self._events.content = "\n".join([*self._outcomes(), *past[-LISTED:]])

    def _outcomes(self) -> list[str]:
        """Of films side by side: whose each is, and how its ball ended; a single one has it in the picture."""
        if len(self.shown) < 2:
            return []
        ends = [f": {f.outcome}" if f.outcome and self.t >= f.decided else "" for f in self.shown]
        return [
            f"{i}. {html.escape(f.title + end)}" for i, (f, end) in enumerate(zip(self.shown, ends, strict=True), 1)
        ]


def put(handle: Any, value: Any) -> None:
    """Sets an input of the page."""
    handle.value = value


def _until(series: Series, t: float) -> tuple[np.ndarray, ...]:
    """The curves up to a time [s], two points at least."""
    end = max(2, int(np.searchsorted(series.time, t, side="right")))
    return (series.time[:end], *series.values[:end].T)


def _range(series: Series) -> tuple[float, float]:
    finite = series.values[np.isfinite(series.values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    margin = 0.05 * (high - low) + 1e-3
    return low - margin, high + margin


def _table(films: Sequence[Film]) -> str:
    """The reward terms, weighted, with a bar for each film."""
    rows = []
    for name in films[0].terms:
        cells = "".join(_cell(value * weight) for value, weight in (film.terms[name] for film in films))
        rows.append(f"<tr><td>{name.replace('_', ' ')} × {films[0].terms[name][1]:g}</td>{cells}</tr>")
    sums = "".join(f"<td><b>{sum(v * w for v, w in film.terms.values()):.2f}</b></td>" for film in films)
    heads = "".join(f"<th>{html.escape(film.title)}</th>" for film in films)
    style = "width:100%;font-size:0.85em;border-spacing:0.3em 0.15em;text-align:left"
    return f'<table style="{style}"><tr><th></th>{heads}</tr>{"".join(rows)}<tr><td><b>sum</b></td>{sums}</tr></table>'


def _cell(value: float) -> str:
    width, colour = min(abs(value) / 5.0, 1.0) * 60, "#2ca02c" if value >= 0.0 else "#d62728"
    bar = f'<span style="display:inline-block;height:0.6em;width:{width:.0f}px;background:{colour}"></span>'
    return f"<td>{value + 0.0:.2f} {bar}</td>"
