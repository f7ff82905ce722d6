"""Controls of simulated play: which balls, by whom, and under what physics."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from ballmodel import registry
from experiments.view.page import Viewer, put
from experiments.view.programme import Play
from experiments.view.studio import DRIVES, Parameter, groups
from mjx_tt.rally import human_player

ONE_BALL, RALLY = "one ball", "rally with "
FASTEST, MOST_SPIN = 12.0, 400.0  # [m/s], [rad/s] at the sliders' ends
SPACE = ((-1.5, 1.5), (-1.3, 2.5), (0.03, 1.2))  # [m] in which the ball may start


class Controls:
    """The tabs "Ball" and "Physics" of a viewer that shows simulated play."""

    def __init__(self, viewer: Viewer, play: Play) -> None:
        self._viewer, self._play = viewer, play
        gui = viewer.server.gui
        self.sliders: dict[str, viser.GuiSliderHandle] = {}
        self.numbers: list[viser.GuiSliderHandle] = []
        with viewer.tabs.add_tab("Ball"):
            rallies = tuple(RALLY + name for name in human_player.names())
            own = () if play.own.name in registry.names() else (play.balls or "",)
            choices: tuple[str, ...] = (*own, *registry.names(), ONE_BALL, *rallies)
            self.balls = gui.add_dropdown("balls", choices, initial_value=play.balls)
            self.misses = gui.add_button("Give me the balls that it misses", icon=viser.Icon.TARGET)
            with gui.add_folder("One ball"):
                gui.add_markdown("Drag the arrows at its start, or:")
                for i, name in enumerate(("x", "y", "z")):
                    self._number(f"start {name} [m]", *SPACE[i], 0.01)
                for name in ("x", "y", "z"):
                    self._number(f"velocity {name} [m/s]", -FASTEST, FASTEST, 0.05)
                for name in ("x", "y", "z"):
                    self._number(f"spin {name} [rad/s]", -MOST_SPIN, MOST_SPIN, 5.0)
        with viewer.tabs.add_tab("Physics"):
            reset = gui.add_button("As the model has it", icon=viser.Icon.RESTORE)
            for group, parameters in groups(play.studio.joints).items():
                with gui.add_folder(group, expand_by_default=group != DRIVES):
                    for parameter in parameters:
                        self._slider(parameter)
        self.gizmo = viewer.server.scene.add_transform_controls(
            "/start", scale=0.22, disable_rotations=True, disable_sliders=True, translation_limits=SPACE, line_width=3.0
        )
        reset.on_click(lambda _: viewer.later("reset", self._reset))
        self.misses.on_click(lambda _: viewer.later("misses", self._misses))
        self._when(self.balls, lambda: viewer.later("balls", self._choose))
        self.gizmo.on_update(lambda _: viewer.later("ball", self._dragged))
        viewer.on_load = self._loaded

    def _when(self, handle: Any, action: Callable[[], None]) -> None:
        """Calls the action when somebody at the page changes the input, and not when the program does."""
        handle.on_update(lambda event: action() if event.client is not None else None)

    def _number(self, label: str, low: float, high: float, step: float) -> None:
        handle = self._viewer.server.gui.add_slider(label, low, high, step, max(low, 0.0))
        self.numbers.append(handle)
        self._when(handle, lambda: self._viewer.later("ball", self._set_ball))

    def _slider(self, p: Parameter) -> None:
        value = round(self._play.values[p.path] / p.unit, 6)
        hint = p.path if np.isfinite(value) else f"{p.path}: drawn anew for every ball until it is moved"
        value = value if np.isfinite(value) else (p.low + p.high) / 2
        low, high = min(p.low, value), max(p.high, value)
        handle = self._viewer.server.gui.add_slider(p.label, low, high, p.step, value, hint=hint)
        self.sliders[p.path] = handle
        self._when(handle, lambda: self._viewer.later(p.path, lambda: self._set(p, handle.value)))

    def _set(self, p: Parameter, value: float) -> None:
        self._play.values[p.path] = value * p.unit
        self._again()

    def _reset(self) -> None:
        self._play.values = self._play.studio.nominal()
        for group in groups(self._play.studio.joints).values():
            for p in group:
                if np.isfinite(value := self._play.values[p.path]):
                    put(self.sliders[p.path], round(value / p.unit, 6))
        self._again()

    def _again(self) -> None:
        self._play.changed()
        self._viewer.t = 0.0
        self._viewer.reload()

    def _choose(self) -> None:
        chosen, play = self.balls.value, self._play
        play.missed = []
        if chosen == ONE_BALL:
            play.ball = play.state(self._viewer.number).copy()
        play.player = chosen.removeprefix(RALLY) if chosen.startswith(RALLY) else None
        play.balls = None if chosen == ONE_BALL else chosen if play.player is None else play.balls
        if play.player is not None:
            self._viewer.say("compiling the player ...")
        play.changed()
        self._viewer.go(0)

    def _misses(self) -> None:
        if self._play.balls is None or self._play.player is not None:
            self._viewer.say("Choose a distribution of balls first")
            return
        self._viewer.say("looking for them ...")
        if self._play.find_missed():
            self._viewer.go(0)
        else:
            self._viewer.say("It returns them all")

    def _set_ball(self) -> None:
        self._one_ball(np.array([handle.value for handle in self.numbers]))

    def _dragged(self) -> None:
        state = self._play.state(self._viewer.number).copy()
        state[:3] = self.gizmo.position
        self._one_ball(state)

    def _one_ball(self, state: np.ndarray) -> None:
        self._play.ball, self._play.balls, self._play.player, self._play.missed = state, None, None, []
        put(self.balls, ONE_BALL)
        self._again()

    def _loaded(self) -> None:
        """Shows the state of the ball that is played now."""
        state = self._play.state(self._viewer.number)
        for handle, value in zip(self.numbers, state, strict=True):
            put(handle, float(np.clip(value, handle.min, handle.max)))
        if np.abs(np.asarray(self.gizmo.position) - state[:3]).max() > 1e-4:
            self.gizmo.position = state[:3]
