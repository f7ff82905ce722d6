"""The page: what plays, when, and how fast; curves and rewards beside it; and the page that needs no server."""

from __future__ import annotations

import html
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import viser
from rich.console import Console
from viser.uplot import Scale
from viser.uplot import Series as Line

from experiments.config import build
from experiments.runs import load_policy
from experiments.runs.run_dir import CONFIG, Run
from experiments.view.auth import Server
from experiments.view.controls import Controls
from experiments.view.playlist import Playlist, PolicyPlaylist
from experiments.view.recorder import Recorder
from experiments.view.replay import Replay, Series
from experiments.view.scene import COLOURS, Scene

FRAME = 1.0 / 60.0  # [s]
REST = 0.6  # [s] on the last frame before the next ball
NEAR_CONTACT, CONTACT_SPEED = 0.12, 0.12  # [s] around the paddle's contact; share of the speed there
PLOTTED_EVERY = 0.2  # [s]
POLLED_EVERY = 1.0  # [s]
EXPORTED_RATE = 30.0  # [Hz]
LINES = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f")
PANEL = 360  # [pixels]
LISTED = 5  # events


class Viewer:
    """Plays a playlist. Everything happens in the thread of ``run``; callbacks of the page only enqueue actions.

    poll  called about once a second
    """

    def __init__(self, server: viser.ViserServer, playlist: Playlist) -> None:
        self.server, self.playlist = server, playlist
        self.scene = Scene(server, len(playlist.replays(0)), playlist.robot)
        self.number, self.t, self.playing = 0, 0.0, True
        self.shown: Sequence[Replay] = ()
        self.poll: Callable[[], None] = lambda: None
        self._queue: dict[str, Callable[[], None]] = {}
        self._lock, self._stop = threading.Lock(), threading.Event()
        self._plotted = self._polled = 0.0
        self._plots: dict[str, viser.GuiUplotHandle] = {}
        self._dirty = True
        self._add_player()
        tabs = server.gui.add_tab_group()
        self.controls = Controls(self, tabs, playlist) if isinstance(playlist, PolicyPlaylist) else None
        self._add_details(tabs)
        self.go(0)

    def _add_player(self) -> None:
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL)
        self._caption = gui.add_markdown("")
        self._events = gui.add_markdown("")
        self._time: Any = gui.add_slider("time [s]", 0.0, 1.0, 0.001, 0.0)
        self._play = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        steps = gui.add_button_group("step", ("◀ ball", "◀", "▶", "ball ▶"))
        self._speed = gui.add_slider("speed", 0.02, 1.0, 0.02, 1.0)
        self._slow = gui.add_checkbox("contact in slow motion", True)
        self._play.on_click(lambda _: self.enqueue("play", self.toggle))
        steps.on_click(lambda event: self.enqueue("step", lambda: self._step(event.target.value)))

        @self._time.on_update
        def _(event: viser.GuiEvent) -> None:
            if event.client is not None:  # moved by hand
                self.enqueue("time", lambda: self._seek(event.target.value))

    def _add_details(self, tabs: viser.GuiTabGroupHandle) -> None:
        self._curves = tabs.add_tab("Policy")
        with self._curves:
            self._whose = self.server.gui.add_dropdown("of", ("",), visible=False)
            self._whose.on_update(lambda _: self.enqueue("whose", self._replot))
        with tabs.add_tab("Rewards"):
            self._rewards = self.server.gui.add_html("")

    # -- what the page asks for ----------------------------------------------------------------------------------------

    def enqueue(self, key: str, action: Callable[[], None]) -> None:
        """Leaves an action to ``run``; a newer one of the same key takes its place."""
        with self._lock:
            self._queue[key] = action

    def toggle(self) -> None:
        self.playing = not self.playing
        self._play.label = "Pause" if self.playing else "Play"
        self._play.icon = viser.Icon.PLAYER_PAUSE if self.playing else viser.Icon.PLAYER_PLAY

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
        """Shows entry ``number`` of the playlist from its start."""
        count = self.playlist.count
        self.number = max(number, 0) if count is None else number % count
        self.t = 0.0
        self.reload()

    def reload(self) -> None:
        """Takes the entry's replays anew, as the playlist makes them now."""
        self.shown = self.playlist.replays(self.number)
        self.scene.load(self.shown)
        self.t, self._dirty = min(self.t, self.seconds), True
        self._time.max = round(self.seconds, 2)
        self._caption.content = f"**{self.playlist.caption(self.number)}**"
        if self.controls is not None:
            self.controls.update(self.number)
        names = tuple(dict.fromkeys(replay.title for replay in self.shown))
        if self._whose.options != names:
            self._whose.options, self._whose.visible = names, len(names) > 1
        self._replot()

    def say(self, text: str) -> None:
        """Puts a line above the controls until the next ball."""
        self._caption.content = f"**{text}**"
        self.server.flush()

    @property
    def seconds(self) -> float:
        """Length [s] of what is shown: of the longest replay."""
        return max(replay.seconds for replay in self.shown)

    # -- time ----------------------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Plays until ``stop``; while nobody looks, time stands still."""
        before = time.perf_counter()
        while not self._stop.is_set():
            with self._lock:
                queue, self._queue = self._queue, {}
            for action in queue.values():
                action()
            now = time.perf_counter()
            if self.server.get_clients():
                self.advance(now - before)
            before = now
            if now - self._polled > POLLED_EVERY:
                self._polled = now
                self.poll()
            self._stop.wait(max(0.0, FRAME - (time.perf_counter() - now)))

    def stop(self) -> None:
        self._stop.set()

    def advance(self, seconds: float) -> None:
        """Lets ``seconds`` of the viewer's time pass and draws what is new."""
        if self.playing:
            near = any(abs(self.t - replay.contact) < NEAR_CONTACT for replay in self.shown)
            self.t += seconds * self._speed.value * (CONTACT_SPEED if near and self._slow.value else 1.0)
            self._dirty = True
            if self.t > self.seconds + REST:
                self.go(self.number + 1)
        if self._dirty:
            self._dirty = False
            self.scene.show(self.t)
            self._time.value = float(min(self.t, self.seconds))
            self._plot()

    # -- curves and rewards --------------------------------------------------------------------------------------------

    def _plotted_replay(self) -> Replay:
        return next((replay for replay in self.shown if replay.title == self._whose.value), self.shown[0])

    def _replot(self) -> None:
        """Puts the replay's curves into the plots that are there, or into new ones where the headings differ."""
        replay = self._plotted_replay()
        if self._plots.keys() != replay.series.keys():
            for handle in self._plots.values():
                handle.remove()
            with self._curves:
                self._plots = {heading: self._add_plot(heading, curves) for heading, curves in replay.series.items()}
        for heading, curves in replay.series.items():
            scales = {"x": Scale(time=False, range=(0.0, replay.seconds)), "y": Scale(range=_range(curves))}
            self._plots[heading].scales = scales
        self._rewards.content = ""
        self._plotted = 0.0

    def _add_plot(self, heading: str, curves: Series) -> viser.GuiUplotHandle:
        lines = [Line(label="s")]
        for i, name in enumerate(curves.names):
            stroke = "#{:02x}{:02x}{:02x}".format(*COLOURS[name]) if name in COLOURS else LINES[i % len(LINES)]
            lines.append(Line(label=name, stroke=stroke, width=1.5))
        return self.server.gui.add_uplot(_until(curves, 0.0), tuple(lines), title=heading, height=210)

    def _plot(self) -> None:
        now = time.perf_counter()
        if now - self._plotted < PLOTTED_EVERY:
            return
        self._plotted, replay = now, self._plotted_replay()
        for heading, handle in self._plots.items():
            handle.data = _until(replay.series[heading], self.t)
        decided = all(self.t >= r.decided for r in self.shown)
        self._rewards.content = _reward_table(self.shown) if decided else '<p style="margin:0.8em">after the ball</p>'
        past = [f"- {t:.2f} s: {html.escape(text)}" for r in self.shown for t, text in r.events if t <= self.t]
        self._events.content = "\n".join([*self._outcomes(), *past[-LISTED:]])

    def _outcomes(self) -> list[str]:
        """Titles and outcomes of replays side by side; a single one has them in the picture."""
        if len(self.shown) < 2:
            return []
        ends = [f"{r.title}: {r.outcome}" if r.outcome and self.t >= r.decided else r.title for r in self.shown]
        return [f"{i}. {html.escape(end)}" for i, end in enumerate(ends, 1)]


def _until(series: Series, t: float) -> tuple[np.ndarray, ...]:
    """The curves up to a time [s], two points at least."""
    end = max(2, int(np.searchsorted(series.time, t, side="right")))
    return (series.time[:end], *series.values[:end].T)


def _range(series: Series) -> tuple[float, float]:
    finite = series.values[np.isfinite(series.values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    margin = 0.05 * (high - low) + 1e-3
    return low - margin, high + margin


def _reward_table(replays: Sequence[Replay]) -> str:
    """The reward terms, weighted, with a bar for each replay."""
    rows = []
    for name, (_, weight) in replays[0].terms.items():
        cells = "".join(_reward_cell(value * weight) for value, weight in (r.terms[name] for r in replays))
        rows.append(f"<tr><td>{name.replace('_', ' ')} × {weight:g}</td>{cells}</tr>")
    sums = "".join(f"<td><b>{sum(v * w for v, w in r.terms.values()):.2f}</b></td>" for r in replays)
    heads = "".join(f"<th>{html.escape(r.title)}</th>" for r in replays)
    style = "width:100%;font-size:0.85em;border-spacing:0.3em 0.15em;text-align:left"
    return f'<table style="{style}"><tr><th></th>{heads}</tr>{"".join(rows)}<tr><td><b>sum</b></td>{sums}</tr></table>'


def _reward_cell(value: float) -> str:
    width, colour = min(abs(value) / 5.0, 1.0) * 60, "#2ca02c" if value >= 0.0 else "#d62728"
    bar = f'<span style="display:inline-block;height:0.6em;width:{width:.0f}px;background:{colour}"></span>'
    return f"<td>{value + 0.0:.2f} {bar}</td>"


# -- what can be shown -------------------------------------------------------------------------------------------------


def play_policies(
    experiment: build.Experiment, trained: Sequence[load_policy.TrainedPolicy], seed: int
) -> PolicyPlaylist:
    """Policies in the world of an experiment."""
    names = [title_of(one) for one in trained]
    titles = [name if names.count(name) == 1 else f"{name} ({i})" for i, name in enumerate(names, 1)]
    recorder = Recorder(experiment.task, experiment.model)
    return PolicyPlaylist(recorder, titles, [one.policy for one in trained], experiment.distribution, seed)


def title_of(trained: load_policy.TrainedPolicy) -> str:
    """Name of a policy as the page shows it: of its run, with the update that it was taken at."""
    folder = trained.source.absolute()
    if (folder / CONFIG).is_file():
        return f"{folder.name}, update {trained.notes['update']}"
    return folder.parent.name if folder.name == "artefact" else folder.name


def follow_training(folder: Path, viewer: Viewer) -> None:
    """Makes a viewer of one policy play each new checkpoint of its run."""
    run, playlist = Run(folder), viewer.playlist
    if not isinstance(playlist, PolicyPlaylist):
        raise TypeError(f"expected a playlist of policies, got {playlist}")
    seen = run.newest_checkpoint()

    def look() -> None:
        nonlocal seen
        if (name := run.newest_checkpoint()) != seen:
            seen = name
            trained = load_policy.load(folder)
            playlist.policies[0], playlist.names[0] = trained.policy, title_of(trained)
            playlist.clear()
            viewer.reload()

    viewer.poll = look


def wait_for_checkpoint(folder: Path, console: Console) -> None:
    """Returns when a training has written its first checkpoint."""
    run = Run(folder)
    if not run.newest_checkpoint():
        console.print(f"{folder}: waiting for the first checkpoint")
    while not run.newest_checkpoint():
        time.sleep(0.5)


def export(server: Server, playlist: Playlist, entries: int, path: Path) -> int:
    """Writes a page with the first ``entries`` entries that needs no server; returns its size in bytes."""
    scene = Scene(server, len(playlist.replays(0)), playlist.robot)
    recording = server.get_scene_serializer()
    for number in range(entries if playlist.count is None else min(entries, playlist.count)):
        replays = playlist.replays(number)
        scene.load(replays)
        for frame in range(round((max(replay.seconds for replay in replays) + REST) * EXPORTED_RATE)):
            scene.show(frame / EXPORTED_RATE)
            recording.insert_sleep(1.0 / EXPORTED_RATE)
    page = recording.as_html()
    path.write_text(page, encoding="utf-8")
    return len(page.encode())
