"""Virtual people who rally with the robot: five players whose balls and rallies are like those of the paper's five.

A player lobs first balls; answers a return with a stroke that depends on it; errs the more, the harder the ball is to
play; tires; gets used to the robot. The shape of the behaviour is ours (the paper measured balls and rally lengths,
not behaviour); its numbers, one YAML per player in ``assets/virtual_players``, are calibrated so that balls and rallies
come near the paper's tables (docs/results/virtual-players.md). Instructions to the players: appendix "Instructions for
Human Players" of Abeyruwan et al. 2022: lobs from the left-hand quadrant of the human's half (x > 0 for the human, who
looks along -y) to the robot's right-hand quadrant (x > 0), returns to there as well.

Component axis first, batch axes last; a player's leaves are scalars or of the batch shape. SI units.
"""

from __future__ import annotations

import dataclasses
import os
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, PRNGKeyArray
from pydantic import GetCoreSchemaHandler
from pydantic_core import core_schema

from ballmodel import constants as c
from ballmodel.aerodynamics import FlightParams
from ballmodel.io import yaml
from ballmodel.io.ranges import FINITE
from ballmodel.io.validation import Finite, Increasing, find, validate
from ballmodel.state import BallState
from ballmodel.vec import Scalars, row
from mjx_tt.pytrees import pytree
from mjx_tt.rally.shots import aim_stroke, estimate_fall_seconds, estimate_stroke_seconds, perturb_stroke

Number: TypeAlias = Annotated[jax.Array | float, FINITE]  # a file has one number

FOLDER = Path(__file__).parents[1] / "assets" / "virtual_players"
NOTES = ("name", "level", "source")
REACTION = 0.2  # [s] before a player moves towards a return
COMFORTABLE_HEIGHT, HEIGHT_RANGE = 0.3, 0.6  # [m] contact height over the table that is easiest; one unit of difficulty
LEAN, LEAN_RANGE = 0.9, 0.8  # [m] contacts at smaller y are leant for; one unit of difficulty
OVER_TABLE = 0.10  # [m] lowest contact over the table
SURPRISE = (0.35, 0.45, 2.0)  # [m], [m], [m/s] of a return's x, y, speed that differ from the expected: one unit
NARROW, WIDE = 1.8, 3.3  # standard deviations to the ends of first balls' spreads and of answers'
LOB_CLEARANCE = 0.06  # [m] over the net that a lob has at least
LOB_ERROR = 0.4  # share of an easy answer's errors that a lob has
LOB_SPIN = 0.3  # share of a stroke's spin that a lob has
SPIN_UNIT = 100.0  # [rad/s] of incoming spin: one unit


@pytree
class Spread:
    """A quantity that varies from ball to ball: half a normal distribution to each side of the usual value, cut off."""

    low: jax.Array | float
    usual: jax.Array | float
    high: jax.Array | float

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        """In a file: [low, usual, high]."""
        ends = handler(Annotated[tuple[Finite, Finite, Finite], Increasing])
        return core_schema.no_info_after_validator_function(lambda values: cls(*values), ends)

    def draw(
        self, key: PRNGKeyArray, shape: tuple[int, ...], steadiness: Scalars, cut: float
    ) -> Float[Array, "*batch"]:
        """Values (*shape), whose ends are ``cut`` standard deviations away.

        steadiness: power to which the share of the way to an end is raised; above 1 most balls are near the usual value
        and odd ones as far from it as ever.
        """
        n = jax.random.truncated_normal(key, -cut, cut, shape) / cut
        share = jnp.sign(n) * jnp.abs(n) ** steadiness
        return self.usual + share * jnp.where(n > 0.0, self.high - self.usual, self.usual - self.low)


@pytree
class FirstBalls:
    """First balls of a player. The way to the landing point and the speed ask for a climb; the bounds come
    after."""

    x: Spread  # [m] where the ball is hit
    y: Spread
    z: Spread
    sideways: Spread  # [m/s] velocity along x
    forward: Spread  # [m/s] speed towards the robot; its ends are bounds
    climb: Spread  # [m/s] its ends bound the vertical velocity
    landing: Spread  # [m] y that is aimed at on the robot's side
    side: Spread  # [m] its ends bound the x that is aimed at there
    service: Number  # share of balls that bounce on the player's own side first
    mishit: Number  # share of balls with four times the errors


@pytree
class Strokes:
    """Answers of a player to returns."""

    plane: Spread  # [m] y at which a ball is taken that has not fallen yet
    height: Spread  # [m] z to which a ball falls at most before it is taken
    aim_x: Spread  # [m] where the answer is to land
    aim_y: Spread
    speed: Spread  # [m/s] horizontal; its ends are bounds
    clearance: Spread  # [m] of the ball over the net
    steadiness: Number  # of all these spreads
    climb: Number  # [m/s] highest vertical velocity
    counter: Number  # share of the incoming speed beyond 3.5 m/s that is added to the answer's
    attack: Number  # [1/s] speed added per height of the contact over COMFORTABLE_HEIGHT


@pytree
class Ability:
    """Ability of a player. Errors are those of an easy ball, as standard deviations."""

    direction: Number  # [rad] error of the stroke's direction, to the side
    elevation: Number  # [rad] and upwards
    pace: Number  # error of the speed, as a share
    growth: Number  # errors grow by this share per unit of difficulty
    miss: Number  # probability of missing an easy ball altogether
    limit: Number  # difficulty at which every second ball is missed
    stand: Number  # [m] x where the player waits
    reach: Number  # [m] to each side without a step
    feet: Number  # [m/s] speed to the side
    easy_speed: Number  # [m/s] of a return; each further metre per second is half a unit of difficulty
    misread: Number  # [rad] error upwards per SPIN_UNIT of incoming topspin that the player is not used to


@pytree
class Spin:
    """Spin that a player's strokes give [rad/s]."""

    top: Number  # mean topspin; backspin is negative
    top_spread: Number  # standard deviations from stroke to stroke
    side_spread: Number


@pytree
class Person:
    """Changes of a player in the course of a session."""

    tiring: Number  # share of the strength that is left lost per stroke
    rest: Number  # share of the tiredness that a pause between rallies takes away
    weariness: Number  # errors of a wholly tired player grow by this share
    adapting: Number  # share of what is new about the robot's returns that each of them teaches
    strangeness: Number  # difficulty per unit of surprise by a return


@pytree
class Player:
    """One virtual person; leaves are scalars, or of the lanes' shape when several are stacked."""

    first: FirstBalls
    strokes: Strokes
    ability: Ability
    spin: Spin
    person: Person


@pytree
class PlayerState:
    """State of a player from ball to ball."""

    tiredness: Float[Array, "*batch"]  # 0 fresh to 1
    familiarity: Float[Array, "*batch"]  # 0 never met this robot to 1
    expected: Float[Array, "3 *batch"]  # [m], [m], [m/s] landing x, y and speed of the robot's returns so far


@pytree
class Incoming:
    """A robot's return as the player meets it."""

    ball: BallState  # (3, ...) at the moment of contact
    landing: Float[Array, "2 *batch"]  # [m] of the bounce on the human's half
    seconds: Float[Array, "*batch"]  # from the robot's hit to the contact


@pytree
class Answer:
    """A player's stroke."""

    ball: BallState  # (3, ...) as it leaves the paddle, or as it came where it was missed
    hit: Bool[Array, "*batch"]
    state: PlayerState


def fresh(shape: tuple[int, ...] = ()) -> PlayerState:
    """Rested players who have never met this robot and expect balls to the middle of their half."""
    # Not of a weak type, which an answer's result has not: everything would be compiled a second time, in mid-play.
    expected = jnp.stack([jnp.zeros(shape) + value for value in (0.0, 0.7, 3.5)])
    return PlayerState(jnp.zeros(shape), jnp.zeros(shape), expected)


def without_spin(player: Player) -> Player:
    """The same player, whose strokes give no spin."""
    return replace(player, spin=Spin(0.0, 0.0, 0.0))


def rested(player: Player, state: PlayerState) -> PlayerState:
    """The players after the pause between two rallies."""
    return replace(state, tiredness=state.tiredness * (1.0 - player.person.rest))


def first_ball(player: Player, state: PlayerState, key: PRNGKeyArray, shape: tuple[int, ...]) -> BallState:
    """Balls (3, *shape) that start a rally, as they leave the paddle; aimed as if their little spin did nothing."""
    first = player.first
    keys = iter(jax.random.split(key, 12))
    x, y, z, sideways, forward, landing = (
        spread.draw(next(keys), shape, 1.0, NARROW)
        for spread in (first.x, first.y, first.z, first.sideways, first.forward, first.landing)
    )
    start, ground = jnp.stack([x, y, z]), jnp.full(shape, c.BALL_RADIUS)
    straight = jnp.stack([x, landing, ground])
    seconds = estimate_stroke_seconds(start, straight, forward, LOB_CLEARANCE)
    seconds = jnp.clip(seconds, estimate_fall_seconds(first.climb.low, z), estimate_fall_seconds(first.climb.high, z))
    flight, still = FlightParams(), jnp.zeros_like(start)
    velocity = aim_stroke(flight, start, straight, seconds, still)
    sideways = jnp.clip(sideways, (first.side.low - x) / seconds, (first.side.high - x) / seconds)
    velocity = jnp.stack([sideways, jnp.clip(velocity[1], -first.forward.high, -first.forward.low), velocity[2]])
    # A service: down at two fifths of the way to the net.
    own = jnp.stack([x, 0.6 * y, ground])
    serving = jax.random.uniform(next(keys), shape) < first.service
    velocity = jnp.where(serving, aim_stroke(flight, start, own, 0.4 * y / 4.5, still), velocity)
    mishit = jax.random.uniform(next(keys), shape) < first.mishit
    errors = _errors(player, state, LOB_ERROR * jnp.where(mishit, 4.0, 1.0))
    velocity = perturb_stroke(next(keys), velocity, *errors)
    return BallState(start, velocity, LOB_SPIN * _spin(player.spin, next(keys), velocity))


def wish(
    player: Player, key: PRNGKeyArray, shape: tuple[int, ...]
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """Plane y and height z [m] at which the players mean to take the next return."""
    strokes, (plane_key, height_key) = player.strokes, jax.random.split(key)
    plane = strokes.plane.draw(plane_key, shape, strokes.steadiness, WIDE)
    return plane, strokes.height.draw(height_key, shape, strokes.steadiness, WIDE)


def answer(player: Player, state: PlayerState, key: PRNGKeyArray, incoming: Incoming, flight: FlightParams) -> Answer:
    """The player's stroke at a return. flight: of the world in which the player has learnt to aim."""
    ability, strokes, ball = player.ability, player.strokes, incoming.ball
    shape = ball.position.shape[1:]
    keys = iter(jax.random.split(key, 12))
    speed = jnp.sqrt(jnp.sum(ball.velocity**2, axis=0))
    met = jnp.stack([incoming.landing[0], incoming.landing[1], speed])
    strange = 1.0 - state.familiarity
    hard = difficulty(player, state, incoming)
    far = jax.nn.sigmoid((stretch(ability, incoming) - 1.0) / 0.08)
    p_miss = jnp.clip(ability.miss + jax.nn.sigmoid((hard - ability.limit) / (0.12 * ability.limit)) + far, 0.0, 1.0)
    hit = jax.random.uniform(next(keys), shape) >= p_miss

    def draw(spread: Spread) -> Array:
        return spread.draw(next(keys), shape, strokes.steadiness, WIDE)

    target = jnp.stack([draw(strokes.aim_x), draw(strokes.aim_y), jnp.full(shape, c.BALL_RADIUS)])
    wanted = draw(strokes.speed) + strokes.counter * (speed - 3.5)
    wanted = wanted + strokes.attack * jnp.maximum(ball.position[2] - COMFORTABLE_HEIGHT, 0.0)
    wanted = jnp.clip(wanted, strokes.speed.low, strokes.speed.high)
    seconds = estimate_stroke_seconds(ball.position, target, wanted, draw(strokes.clearance))
    seconds = jnp.minimum(seconds, estimate_fall_seconds(strokes.climb, ball.position[2]))
    spin = _spin(player.spin, next(keys), target - ball.position)
    velocity = aim_stroke(flight, ball.position, target, seconds, spin)
    # Topspin of the incoming ball (about +x cross its direction) climbs off the paddle of who does not expect it.
    horizontal = jnp.sqrt(ball.velocity[0] ** 2 + ball.velocity[1] ** 2) + 1e-6
    topspin = (ball.spin[1] * ball.velocity[0] - ball.spin[0] * ball.velocity[1]) / horizontal
    bias = ability.misread * strange * topspin / SPIN_UNIT
    velocity = perturb_stroke(next(keys), velocity, *_errors(player, state, 1.0 + ability.growth * hard), bias)

    person = player.person
    after = PlayerState(
        tiredness=state.tiredness + person.tiring * (1.0 - state.tiredness),
        familiarity=state.familiarity + person.adapting * strange,
        expected=state.expected + row(jnp.maximum(person.adapting, 0.1)) * (met - state.expected),
    )
    left = BallState(ball.position, jnp.where(hit, velocity, ball.velocity), jnp.where(hit, spin, ball.spin))
    return Answer(left, hit, after)


def difficulty(player: Player, state: PlayerState, incoming: Incoming) -> Float[Array, "*batch"]:
    """Difficulty of a return: the sum of units of stretch, lean, height, speed, spin and surprise."""
    ability, ball = player.ability, incoming.ball
    _, y, z = ball.position
    speed = jnp.sqrt(jnp.sum(ball.velocity**2, axis=0))
    lean = jnp.maximum(LEAN - y, 0.0) / LEAN_RANGE
    height = jnp.abs(z - COMFORTABLE_HEIGHT) / HEIGHT_RANGE
    fast = 0.5 * jnp.maximum(speed - ability.easy_speed, 0.0)
    spin = 0.3 * jnp.sqrt(jnp.sum(ball.spin**2, axis=0)) / SPIN_UNIT
    met = (incoming.landing[0], incoming.landing[1], speed)
    away = sum(((m - e) / unit) ** 2 for m, e, unit in zip(met, state.expected, SURPRISE, strict=True))
    strange = 1.0 - 0.7 * state.familiarity
    surprise = strange * (spin + player.person.strangeness * jnp.sqrt(away))
    return stretch(ability, incoming) + lean + height + fast + surprise


def stretch(ability: Ability, incoming: Incoming) -> Float[Array, "*batch"]:
    """Way to the side that the player has to go, as a share of what the time allows; 1: just reached."""
    way = jnp.maximum(jnp.abs(incoming.ball.position[0] - ability.stand) - ability.reach, 0.0)
    return way / (ability.feet * jnp.maximum(incoming.seconds - REACTION, 0.1))


def _spin(spin: Spin, key: PRNGKeyArray, way: Float[Array, "3 *batch"]) -> Float[Array, "3 *batch"]:
    """Spin [rad/s] of a stroke along ``way``: topspin about z x direction, sidespin about z."""
    top_key, side_key = jax.random.split(key)
    shape = way.shape[1:]
    length = jnp.hypot(way[0], way[1]) + 1e-6
    top = spin.top + spin.top_spread * jax.random.truncated_normal(top_key, -2.5, 2.5, shape)
    side = spin.side_spread * jax.random.truncated_normal(side_key, -2.5, 2.5, shape)
    return jnp.stack([-top * way[1] / length, top * way[0] / length, side])


def _errors(player: Player, state: PlayerState, scale: Scalars) -> tuple[Scalars, Scalars, Scalars]:
    """Deviations of direction, elevation and pace, ``scale`` times those of an easy ball to a rested player."""
    scale = scale * (1.0 + player.person.weariness * state.tiredness)
    ability = player.ability
    return scale * ability.direction, scale * ability.elevation, scale * ability.pace


@cache
def names() -> tuple[str, ...]:
    """The virtual players, "player1" to "player5"."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.yaml")))


def load(name: str) -> Player:
    """The virtual player of that name. Raises ValueError listing the valid names."""
    return read(find({known: FOLDER / f"{known}.yaml" for known in names()}, name, "virtual player"))


def read(path: str | os.PathLike) -> Player:
    """A player from a YAML file: the tree of field names, a spread as [low, usual, high].

    Raises ValueError naming file and key.
    """
    data = yaml.read(path)
    if isinstance(data, dict):
        data = {key: value for key, value in data.items() if key not in NOTES}
    return validate(Player, data, str(path))


def to_dict(player: Player) -> dict[str, Any]:
    """The YAML form of a player with scalar leaves."""

    def plain(part: Any) -> Any:
        if not dataclasses.is_dataclass(part):
            return round(float(part), 4)
        values = {f.name: plain(getattr(part, f.name)) for f in dataclasses.fields(part)}
        return list(values.values()) if isinstance(part, Spread) else values

    return plain(player)


def stack(players: list[Player]) -> Player:
    """One Player whose leaves are (n,), one lane for each given."""
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf, jnp.float32) for leaf in leaves]), *players)
