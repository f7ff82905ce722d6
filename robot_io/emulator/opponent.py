"""Somebody who puts balls into play: throws one after the other, or answers what the robot plays."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from robot_io.emulator.config import RigParams
from robot_io.emulator.world import World

NEAR_HOME = 0.05  # [m], [rad]
STILL = 0.05  # [m/s], [rad/s]
READY = 0.06  # [s] between the bounce and the earliest contact, as in the simulator
OVER_TABLE = 0.10  # [m] lowest contact over the table
HALF_LENGTH, HALF_WIDTH = 1.37, 0.7625  # [m]
BEHIND, BELOW = -2.9, -0.6  # [m] y and z beyond which a ball is out of the robot's reach
LONGEST = 2.5  # [s] that a ball is waited for


@dataclass(frozen=True)
class Throws:
    """Balls to throw in turn: positions (3, n) [m], velocities (3, n) [m/s] and spins (3, n) [rad/s]."""

    position: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray

    def __post_init__(self) -> None:
        shape = self.position.shape
        if len(shape) != 2 or shape[0] != 3 or not shape[1] or {self.velocity.shape, self.spin.shape} != {shape}:
            raise ValueError(
                f"throws: position {shape}, velocity {self.velocity.shape}, spin {self.spin.shape}; each must be (3, n)"
            )


class Quiet:
    """Waits until the robot has stood at its home pose, with no ball in play, for ``pause`` [s]."""

    def __init__(self, pause: float) -> None:
        self._pause, self._since = pause, math.inf

    def lasted(self, world: World, now: float) -> bool:
        """One look at ``now`` [s]; True when it was quiet for so long, which then begins anew."""
        away, moving = np.abs(world.qpos - world.home) >= NEAR_HOME, np.abs(world.qvel) >= STILL
        self._since = math.inf if world.in_play or away.any() or moving.any() else min(self._since, now)
        if self._since == math.inf or now - self._since < self._pause:
            return False
        self._since = math.inf
        return True


class Thrower:
    """Throws one ball after the other, from number ``first`` and from the start again when all are thrown.

    pause  [s] that robot and ball must have been still
    """

    def __init__(self, throws: Throws, pause: float = 0.6, first: int = 0) -> None:
        self._throws, self._quiet, self._next = throws, Quiet(pause), first
        self.thrown = 0

    def update(self, world: World, now: float) -> None:
        """Throws when it is time."""
        if self._quiet.lasted(world, now):
            i = self._next % self._throws.position.shape[1]
            world.throw(self._throws.position[:, i], self._throws.velocity[:, i], self._throws.spin[:, i])
            self._next, self.thrown = i + 1, self.thrown + 1


@dataclass(frozen=True)
class Stroke:
    """A ball as it leaves a paddle, or comes to one: position, velocity and spin, (3,) each; SI units."""

    position: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray


class Opponent(Protocol):
    """Decisions of a player; the ball's motion is the world's."""

    def prepare(self) -> None:
        """Do what takes long before time counts."""

    def serve(self) -> Stroke:
        """The first ball of a rally."""

    def wish(self) -> tuple[float, float]:
        """Plane y and height z [m] at which the next return is to be taken."""

    def answer(self, ball: Stroke, landing: np.ndarray, seconds: float) -> Stroke | None:
        """The stroke at a return; None when it is missed.

        ball: at the contact; landing (2,) [m] on the human's half; seconds since the robot's hit.
        """

    def rest(self) -> None:
        """The rally is over."""


@dataclass
class PlayedRally:
    """A rally as the world saw it: paddle touches, and [s] of its first ball; touched counts the robot's."""

    began: float
    touches: int = 1
    ended: float = 0.0


@dataclass
class Rallies:
    """Plays rallies with the robot through an opponent: serves, answers, and begins anew.

    patient  waits until the robot has stood at home for ``pause`` [s]; else a random time up to that after the end of
             a rally, wherever the robot is
    """

    opponent: Opponent
    pause: float = 0.6
    patient: bool = True
    seed: int = 0
    thrown: int = 0
    played: list[PlayedRally] = field(default_factory=list)  # the rally in play is the last

    def __post_init__(self) -> None:
        self._random = np.random.default_rng(self.seed)
        self._state = self._waiting
        self._quiet = Quiet(self.pause)
        self._next_at = 0.0
        self._hit_at = self._struck_at = 0.0
        self._wish = (0.0, 0.0)

    def update(self, world: World, now: float) -> None:
        """Serve or answer when it is time, by the world's own clock."""
        self._state(world, world.time)

    def _waiting(self, world: World, now: float) -> None:
        if self._quiet.lasted(world, now) if self.patient else now >= self._next_at:
            ball = self.opponent.serve()
            world.throw(ball.position, ball.velocity, ball.spin)
            self.thrown += 1
            self.played.append(PlayedRally(now))
            self._state, self._struck_at = self._coming, now

    def _coming(self, world: World, now: float) -> None:
        """The human's ball is on its way to the robot."""
        bounces = 0
        for time, name, place in world.touches:
            if name == "rig_paddle" and bounces == 1:
                self.played[-1].touches += 1
                self._hit_at, self._wish, self._state = time, self.opponent.wish(), self._returning
                return
            bounces += name == "col_table"
            if name == "rig_paddle" or bounces > 1 or (name == "col_table" and place[1] > 0.0):
                return self._over(now)  # a volley, a second bounce, or one on the human's half
        _, y, z = world.ball
        if not world.in_play or y < BEHIND or z < BELOW or now - self._struck_at > LONGEST:
            self._over(now)

    def _returning(self, world: World, now: float) -> None:
        """The robot's return is on its way to the human."""
        bounces = self._bounces(world)
        x, y, z = ball = world.ball
        if not world.in_play or len(bounces) > 1 or z < -0.76 or now - self._hit_at > LONGEST:
            return self._over(now)
        if not bounces:
            return
        bounced_at, landing = bounces[0]
        if landing[1] <= 0.0:
            return self._over(now)
        plane, height = self._wish
        lowest = max(height, OVER_TABLE) if y < HALF_LENGTH and abs(x) < HALF_WIDTH else height
        velocity = world.ball_velocity
        fallen = z <= lowest and velocity[2] < 0.0
        if now - bounced_at <= READY or not (y >= plane or fallen):
            return
        answer = self.opponent.answer(Stroke(ball, velocity, world.ball_spin), landing[:2], now - self._hit_at)
        if answer is None:
            self._state = self._missed
            return
        world.strike(answer.velocity, answer.spin)
        self.played[-1].touches += 1
        self._state, self._struck_at = self._coming, now

    def _missed(self, world: World, now: float) -> None:
        """The human has missed the ball, which flies on."""
        late = now - self._hit_at > 2 * LONGEST
        if not world.in_play or len(self._bounces(world)) > 1 or world.ball[2] < BELOW or late:
            self._over(now)

    def _bounces(self, world: World) -> list[tuple[float, np.ndarray]]:
        """Times [s] and places since the robot's hit."""
        return [(time, place) for time, name, place in world.touches if name == "col_table" and time > self._hit_at]

    def _over(self, now: float) -> None:
        self.opponent.rest()
        self.played[-1].ended = now
        self._state = self._waiting
        self._next_at = now + self._random.uniform(0.0, self.pause)


def ball_source(balls: Throws | Opponent, params: RigParams, first: int = 0) -> Thrower | Rallies:
    """A thrower of single balls, from number ``first`` on, or rallies with an opponent, ready to play."""
    if isinstance(balls, Throws):
        return Thrower(balls, params.pause, first)
    balls.prepare()
    return Rallies(balls, params.pause, params.patient, params.seed + first)
