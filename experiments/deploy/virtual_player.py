"""The virtual players of ``mjx_tt.rally`` as opponents in the rig."""

from __future__ import annotations

from contextlib import suppress
from functools import cached_property
from types import SimpleNamespace

import numpy as np

from robot_io.emulator.opponent import Stroke


class VirtualPlayer:
    """A virtual person, "player1" to "player5", who decides as in the simulator's rallies; tires and gets used to it.

    It travels to the rig's process by name, and compiles there.
    """

    def __init__(self, name: str, seed: int = 0) -> None:
        self._name, self._seed = name, seed
        self._turn = 0

    def __getstate__(self) -> dict[str, object]:
        return {"_name": self._name, "_seed": self._seed, "_turn": 0}

    @cached_property
    def _jax(self) -> SimpleNamespace:
        """Compiled functions, the person and their state."""
        import jax  # only where somebody plays: it takes a second

        from ballmodel.aerodynamics import FlightParams
        from ballmodel.state import BallState
        from mjx_tt import platform
        from mjx_tt.rally import human_player

        with suppress(RuntimeError):  # JAX runs already
            platform.configure(1)
        person, flight = human_player.load(self._name), FlightParams(integrator="midpoint")

        def answer(state, key, position, velocity, spin, landing, seconds):  # type: ignore[no-untyped-def]
            incoming = human_player.Incoming(BallState(position, velocity, spin), landing, seconds)
            return human_player.answer(person, state, key, incoming, flight)

        return SimpleNamespace(
            key=jax.random.key(self._seed),
            fold=jax.jit(jax.random.fold_in),
            serve=jax.jit(lambda state, key: human_player.first_ball(person, state, key, ())),
            wish=jax.jit(lambda key: human_player.wish(person, key, ())),
            answer=jax.jit(answer),
            rest=jax.jit(lambda state: human_player.rested(person, state)),
            fresh=human_player.fresh(),
        )

    def prepare(self) -> None:
        """Compile everything, and begin fresh."""
        nothing = np.zeros(3)
        self._state = self._jax.fresh
        self.serve()
        self.wish()
        self.answer(Stroke(nothing + 0.5, nothing + 1.0, nothing), nothing[:2] + 0.5, 0.5)
        self.rest()
        self._state, self._turn = self._jax.fresh, 0

    def serve(self) -> Stroke:
        return _stroke(self._jax.serve(self._state, self._key()))

    def wish(self) -> tuple[float, float]:
        plane, height = self._jax.wish(self._key())
        return float(plane), float(height)

    def answer(self, ball: Stroke, landing: np.ndarray, seconds: float) -> Stroke | None:
        numbers = [np.asarray(x, np.float32) for x in (ball.position, ball.velocity, ball.spin, landing, seconds)]
        found = self._jax.answer(self._state, self._key(), *numbers)
        self._state = found.state
        return _stroke(found.ball) if bool(found.hit) else None

    def rest(self) -> None:
        self._state = self._jax.rest(self._state)

    def _key(self):  # type: ignore[no-untyped-def]
        self._turn += 1
        return self._jax.fold(self._jax.key, self._turn)


def _stroke(ball) -> Stroke:  # type: ignore[no-untyped-def]
    return Stroke(*(np.asarray(x, np.float64) for x in (ball.position, ball.velocity, ball.spin)))
