"""Controls of simulated play: which balls, by whom, and under what physics."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import viser

from ballmodel import registry
from experiments.view.playlist import PolicyPlaylist
from experiments.view.recorder import DRIVES, Slider, slider_groups
from mjx_tt.rally import human_player

if TYPE_CHECKING:
    from experiments.view.viewer import Viewer

ONE_BALL, RALLY = "one ball", "rally with "
SPACE = ((-1.5, 1.5), (-1.3, 2.5), (0.03, 1.2))  # [m] in which the ball may start
# Sliders of one ball: label, low, high, step.
STATE = (
    *((f"start {axis} [m]", *SPACE[i], 0.01) for i, axis in enumerate("xyz")),
    *((f"velocity {axis} [m/s]", -12.0, 12.0, 0.05) for axis in "xyz"),
    *((f"spin {axis} [rad/s]", -400.0, 400.0, 5.0) for axis in "xyz"),
)


class Controls:
    """The tabs "Ball" and "Physics" of a viewer that shows simulated play."""

    def __init__(self, viewer: Viewer, tabs: viser.GuiTabGroupHandle, play: PolicyPlaylist) -> None:
        self._viewer, self._play = viewer, play
        gui = viewer.server.gui
        with tabs.add_tab("Ball"):
            rallies = tuple(RALLY + name for name in human_player.names())
            own = () if play.distribution.name in registry.names() else (play.balls or "",)
            choices: tuple[str, ...] = (*own, *registry.names(), ONE_BALL, *rallies)
            # Any: viser declares the values of its inputs as read-only.
            self._balls: Any = gui.add_dropdown("balls", choices, initial_value=play.balls)
            misses = gui.add_button("Give me the balls that it misses", icon=viser.Icon.TARGET)
            with gui.add_folder("One ball"):
                gui.add_markdown("Drag the arrows at its start, or:")
                self._state: list[Any] = [gui.add_slider(*given, max(given[1], 0.0)) for given in STATE]
        with tabs.add_tab("Physics"):
            reset = gui.add_button("As the model has it", icon=viser.Icon.RESTORE)
            self._sliders: dict[str, tuple[Slider, Any]] = {}
            for group, sliders in slider_groups(play.recorder.joints).items():
                with gui.add_folder(group, expand_by_default=group != DRIVES):
                    for slider in sliders:
                        self._sliders[slider.path] = (slider, self._add_slider(slider))
        self.gizmo = viewer.server.scene.add_transform_controls(
            "/start", scale=0.22, disable_rotations=True, disable_sliders=True, translation_limits=SPACE, line_width=3.0
        )
        reset.on_click(lambda _: viewer.enqueue("reset", self._reset))
        misses.on_click(lambda _: viewer.enqueue("misses", self._find_misses))
        self.gizmo.on_update(lambda _: viewer.enqueue("ball", self._drag))
        self._on_hand(self._balls, "balls", self._choose_balls)
        for handle in self._state:
            self._on_hand(handle, "ball", lambda: self._play_one(np.array([h.value for h in self._state])))

    def _on_hand(self, handle: Any, key: str, action: Callable[[], None]) -> None:
        """Enqueues the action when somebody at the page changes the input, and not when the program does."""
        handle.on_update(lambda event: self._viewer.enqueue(key, action) if event.client is not None else None)

    def _add_slider(self, s: Slider) -> Any:
        value = round(self._play.values[s.path] / s.unit, 6)
        hint = s.path if np.isfinite(value) else f"{s.path}: drawn anew for every ball until it is moved"
        value = value if np.isfinite(value) else (s.low + s.high) / 2
        low, high = min(s.low, value), max(s.high, value)
        handle = self._viewer.server.gui.add_slider(s.label, low, high, s.step, value, hint=hint)

        def move() -> None:
            self._play.values[s.path] = handle.value * s.unit
            self._replay()

        self._on_hand(handle, s.path, move)
        return handle

    def _reset(self) -> None:
        self._play.values = self._play.recorder.nominal()
        for path, (slider, handle) in self._sliders.items():
            if np.isfinite(value := self._play.values[path]):
                handle.value = round(value / slider.unit, 6)
        self._replay()

    def _replay(self) -> None:
        self._play.clear()
        self._viewer.t = 0.0
        self._viewer.reload()

    def _choose_balls(self) -> None:
        chosen, play = self._balls.value, self._play
        if chosen == ONE_BALL:
            play.ball = play.state(self._viewer.number).copy()
        play.missed = []
        play.player = chosen.removeprefix(RALLY) if chosen.startswith(RALLY) else None
        if play.player is not None:
            self._viewer.say("compiling the player ...")
        else:
            play.balls = None if chosen == ONE_BALL else chosen
        play.clear()
        self._viewer.go(0)

    def _find_misses(self) -> None:
        if self._play.balls is None or self._play.player is not None:
            self._viewer.say("Choose a distribution of balls first")
            return
        self._viewer.say("looking for them ...")
        if self._play.find_missed():
            self._viewer.go(0)
        else:
            self._viewer.say("It returns them all")

    def _drag(self) -> None:
        state = self._play.state(self._viewer.number).copy()
        state[:3] = self.gizmo.position
        self._play_one(state)

    def _play_one(self, state: np.ndarray) -> None:
        self._play.ball, self._play.balls, self._play.player, self._play.missed = state, None, None, []
        self._balls.value = ONE_BALL
        self._replay()

    def update(self, number: int) -> None:
        """Shows the state with which ball ``number`` starts."""
        state = self._play.state(number)
        for handle, value in zip(self._state, state, strict=True):
            handle.value = float(np.clip(value, handle.min, handle.max))
        if np.abs(np.asarray(self.gizmo.position) - state[:3]).max() > 1e-4:
            self.gizmo.position = state[:3]
