"""Rallies of virtual players with a policy, many at once, to their ends, with the paper's attribution of those ends.

Every lane holds one player, one policy and one world. Its turns are the task's episodes: the player's ball, the robot's
part of it as ``task`` plays it, the outgoing ball to the player's next contact. A turn is a pure function of all lanes;
rallies that ended begin anew in the next turn, until every lane has played its number, in one compiled call.

After a hit the robot goes home as the bridge drives it, and starts the next episode as far on its way as the time
allowed. A fault of the robot (it touches itself or the table, or an episode is not finite) stops it in the arm's own
home pose: the rally is over, and the next ball is a dummy that only brings it back to the start pose.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from ballmodel.partial_params import without_nominal
from ballmodel.registry import Balls, box_of
from ballmodel.state import BallState, where
from mjx_tt.env.episode import HIT, MISSED, RETURNED, Episodes
from mjx_tt.env.policy import Policy
from mjx_tt.env.policy import controller as controller_of
from mjx_tt.env.return_flight import fly_return
from mjx_tt.env.task import Task, TaskConfig, evaluate_rewards
from mjx_tt.pytrees import pytree
from mjx_tt.rally import ball_flights, human_player
from mjx_tt.rally.ball_flights import drive_home, make_column
from mjx_tt.rally.end_reasons import End, find_end
from mjx_tt.rally.human_player import Player, PlayerState
from mjx_tt.sim import model as models
from mjx_tt.sim.model import SimModel

ENDLESS = 1_000_000  # touches
IDLE = 0.05  # share of the policy's velocity limits that a robot which "did not react" stays under
BLIND = 0.003  # probability that the tracker loses a first ball and the robot does not react (estimate)
BY_HAND = 0.5  # share of the dummy balls that are thrown by hand


@pytree
class Box:
    """Bounds of a ball distribution: position (3), velocity (3), landing (2); (8,) or (8, L)."""

    low: Float[Array, "8 *#lanes"]
    high: Float[Array, "8 *#lanes"]

    @staticmethod
    def of(distribution: Balls) -> Box:
        """Bounds of a box or of a mixture."""
        d = box_of(distribution)
        return Box(
            jnp.array([*d.position_min, *d.velocity_min, *d.landing_min]),
            jnp.array([*d.position_max, *d.velocity_max, *d.landing_max]),
        )

    def holds(self, ball: BallState, landing: Float[Array, "2 *batch"]) -> Bool[Array, "*batch"]:
        """True for balls that lie inside with their landing points."""
        values = jnp.concatenate([ball.position, ball.velocity, landing])
        low, high = (x.reshape(x.shape + (1,) * (values.ndim - x.ndim)) for x in (self.low, self.high))
        return jnp.all((values >= low) & (values <= high), axis=0)


@pytree
class RallyState:
    """Lanes between two turns; the next ball is about to leave the player's paddle."""

    player: PlayerState
    ball: BallState  # (3, L)
    touches: Int[Array, " L"]  # paddle touches of this rally so far, the coming ball's included
    start: Float[Array, "joints L"]  # joint positions of the robot
    dummy: Bool[Array, " L"]  # the robot stands in the arm's own home pose


@pytree
class ShotResult:
    """One turn of every lane."""

    ball: BallState  # (3, L) the player's ball as it left the paddle
    first: Bool[Array, " L"]  # it started a rally
    touch: Int[Array, " L"]  # its number in the rally, 1 for the first
    valid: Bool[Array, " L"]  # it came onto the robot's side, as a ball in play has to
    landing: Float[Array, "2 L"]  # [m] where it bounced there, NaN where it did not
    terms: Float[Array, "11 L"]  # unweighted reward terms, the fault among them
    finite: Bool[Array, " L"]
    outcome: Int[Array, " L"]  # task.MISSED, HIT, RETURNED
    fault: Bool[Array, " L"]  # the robot stopped itself
    end: Int[Array, " L"]  # End; NONE where the rally goes on
    return_landing: Float[Array, "2 L"]  # [m] where the robot's ball came down, NaN where it hit none
    seconds: Float[Array, " L"]  # [s] until the player's next contact, or until the ball was over
    steps: Int[Array, " L"]  # of the policy
    observed: Float[Array, "2 observed L"]  # sums over them of what it saw less its mean, and of the squares


@pytree
class RallyResult:
    """Rallies of all lanes."""

    length: Int[Array, "rallies L"]  # paddle touches of human and robot
    end: Int[Array, "rallies L"]  # End
    seconds: Float[Array, "rallies L"]  # [s] of play
    player: PlayerState  # (L,) as the session left them


class RallySimulator:
    """Plays rallies under one task configuration, all lanes on the default device."""

    def __init__(self, config: TaskConfig) -> None:
        self.config = config
        self.task = Task(config)
        self._play = jax.jit(self._play_all, static_argnames=("rallies", "max_touches"))
        self._shots = jax.jit(self._turn)
        self._start = jax.jit(self._start_lanes, static_argnames="lanes")

    def start(self, player: Player, model: SimModel, key: PRNGKeyArray, lanes: int) -> RallyState:
        """Fresh players about to hit a first ball, the robot at home."""
        return self._start(player, without_nominal(model), key, lanes=lanes)

    def shots(
        self,
        policy: Policy,
        player: Player,
        model: SimModel,
        state: RallyState,
        key: PRNGKeyArray,
        box: Box | None = None,
    ) -> tuple[RallyState, ShotResult]:
        """Every lane plays one ball: the player's answer where the rally goes on, else a new first ball.

        policy: theta (976, L), normaliser (11, L) or (11,); player and model with leaves scalar or (L,); box: None, or
        the ``Box`` beyond which balls are out of distribution. Returns the next state and the ShotResult. A lane whose
        robot stands still after a fault gets its dummy ball unseen, between two turns.
        """
        state, result, _ = self._shots(policy, player, without_nominal(model), state, key, box)
        return replace(state, dummy=jnp.zeros_like(state.dummy)), result

    def episodes(self, key: PRNGKeyArray, model: SimModel, state: RallyState) -> Episodes:
        """Episodes of the robot in the turn that ``shots`` plays with this key."""
        return self._episodes(jax.random.split(key, 8)[0], without_nominal(model), state.ball, state.start)

    def play(
        self,
        policy: Policy,
        player: Player,
        model: SimModel,
        key: PRNGKeyArray,
        rallies: int,
        box: Box | Balls | None = None,
        max_touches: int = 400,
    ) -> RallyResult:
        """``rallies`` rallies of every lane, one after the other, in one compiled call.

        policy: theta (976, L), normaliser (11, L) or (11,); player and model: leaves scalar or (L,). box: what is out
        of distribution, None: nothing is. A rally is broken off (End.NONE) at max_touches.
        """
        box = box if box is None or isinstance(box, Box) else Box.of(box)
        return self._play(policy, player, without_nominal(model), key, box, rallies=rallies, max_touches=max_touches)

    # -- turns ---------------------------------------------------------------------------------------------------------

    def _start_lanes(self, player: Player, model: SimModel, key: PRNGKeyArray, lanes: int) -> RallyState:
        fresh = human_player.fresh((lanes,))
        ball = human_player.first_ball(player, fresh, key, (lanes,))
        home = jnp.broadcast_to(jnp.asarray(self.task.home, jnp.float32)[:, None], (self.task.contract.n_joints, lanes))
        return RallyState(fresh, ball, jnp.ones(lanes, jnp.int32), home, jnp.zeros(lanes, bool))

    def _turn(
        self,
        policy: Policy,
        player: Player,
        model: SimModel,
        state: RallyState,
        key: PRNGKeyArray,
        box: Box | None,
        max_touches: int = ENDLESS,
    ) -> tuple[RallyState, ShotResult, Int[Array, " L"]]:
        """One ball of every lane. Returns the next state, the result and the paddle touches of each rally so far."""
        lanes, limits = state.touches.shape[0], self.task.contract.limits
        keys = iter(jax.random.split(key, 8))
        ball, first = state.ball, state.touches == 1
        sent = ball_flights.fly_serve(model.ball, ball, self.config.period)
        robot = self.task.play(controller_of(policy), self._episodes(next(keys), model, ball, state.start))
        blind = first & (jax.random.uniform(next(keys), (lanes,)) < BLIND)
        finite = robot.finite
        fault = ((robot.accumulators.terms["collision"] > 0.0) | ~finite) & ~blind
        hit = robot.hit & finite & ~fault & ~blind
        played = replace(robot, hit=hit)
        back = fly_return(self.config, robot.ball, hit, model)
        returned = hit & back.returned
        terms = evaluate_rewards(self.config.rewards, played, back, fault)
        outcome = jnp.where(returned, RETURNED, jnp.where(hit, HIT, MISSED)).astype(jnp.int32)

        plane, height = human_player.wish(player, next(keys), (lanes,))
        met = ball_flights.fly_to_player(model.ball, robot.ball, returned, plane, height, self.config.period)
        answer = human_player.answer(player, state.player, next(keys), met.incoming, model.ball.flight)
        answered = returned & met.reached & answer.hit
        goes_on = answered & (state.touches + 2 <= max_touches)
        idle = jnp.all(robot.accumulators.peak_velocity < IDLE * make_column(limits.policy_velocity), axis=0)
        inside = jnp.ones(lanes, bool) if box is None else box.holds(ball, jnp.where(sent.valid, sent.landing, 0.0))
        end = find_end(first, sent, outcome, fault, answered, met, blind | idle, inside)

        learnt = jax.tree.map(partial(jnp.where, returned & met.reached), answer.state, state.player)
        rested = human_player.rested(player, learnt)
        fresh_ball = human_player.first_ball(player, rested, next(keys), (lanes,))
        pose = drive_home(self.task.home, robot.qpos, met.incoming.seconds, limits)
        after = RallyState(
            player=jax.tree.map(partial(jnp.where, goes_on), learnt, rested),
            ball=where(goes_on, answer.ball, fresh_ball),
            touches=jnp.where(goes_on, state.touches + 2, 1),
            start=jnp.where(goes_on, pose, make_column(self.task.home)),
            dummy=fault,
        )
        steps = robot.accumulators.steps * self.config.period
        nowhere = jnp.full((2, lanes), jnp.nan)
        result = ShotResult(
            ball=ball,
            first=first,
            touch=state.touches,
            valid=sent.valid,
            landing=jnp.where(sent.valid, sent.landing, nowhere),
            terms=terms,
            finite=finite,
            outcome=outcome,
            fault=fault,
            end=end.astype(jnp.int8),
            return_landing=jnp.where(hit, back.landing, nowhere),
            seconds=steps + jnp.where(returned, met.incoming.seconds, 0.0),
            steps=robot.accumulators.steps.astype(jnp.int32),
            observed=jnp.stack([robot.accumulators.observation, robot.accumulators.observation_sq]),
        )
        return after, result, state.touches + hit.astype(jnp.int32)

    def _episodes(
        self, key: PRNGKeyArray, model: SimModel, ball: BallState, start: Float[Array, "joints L"]
    ) -> Episodes:
        latency_key, seed_key = jax.random.split(key)
        lanes = ball.position.shape[1:]
        longest = jnp.array([self.config.max_observation_latency] * 3 + [self.config.max_action_latency] * 2)[:, None]
        return Episodes(
            ball=ball,
            latency=models.draw_latencies(latency_key, model.latency, lanes, longest),
            seed=jax.random.bits(seed_key, lanes, jnp.uint32),
            model=model,
            start=start,
        )

    # -- sessions ------------------------------------------------------------------------------------------------------

    def _play_all(
        self,
        policy: Policy,
        player: Player,
        model: SimModel,
        key: PRNGKeyArray,
        box: Box | None,
        *,
        rallies: int,
        max_touches: int,
    ) -> RallyResult:
        lanes = policy.theta.shape[-1]
        start_key, key = jax.random.split(key)
        lane = jnp.arange(lanes)
        state = self._start_lanes(player, model, start_key, lanes)
        table = (
            jnp.zeros((rallies, lanes), jnp.int32),
            jnp.full((rallies, lanes), End.NONE, jnp.int8),
            jnp.zeros((rallies, lanes)),
        )

        def unfinished(carry: tuple) -> Array:
            turn, _, done, *_ = carry
            return jnp.any(done < rallies) & (turn < rallies * (max_touches + 2))

        def advance(carry: tuple) -> tuple:
            turn, state, done, seconds, (length, end, spent) = carry
            key_turn, key_dummy = jax.random.split(jax.random.fold_in(key, turn))
            after, shot, touches = self._turn(policy, player, model, state, key_turn, box, max_touches)
            # A dummy ball is a turn of its own in which nobody plays: the ball that waits is thrown afterwards.
            dummy, playing = state.dummy, done < rallies
            by_hand = jax.random.uniform(key_dummy, dummy.shape) < BY_HAND
            over = playing & (dummy | (after.touches == 1))
            why = jnp.where(
                dummy, jnp.where(by_hand, End.DUMMY_BY_HAND, End.DUMMY_WITH_PADDLE), shot.end.astype(jnp.int32)
            )
            touches = jnp.where(dummy, jnp.where(by_hand, 0, 1), touches)
            seconds = seconds + jnp.where(dummy, 0.0, shot.seconds)
            row = jnp.where(over, done, rallies)  # a row past the end: nothing is written
            length = length.at[row, lane].set(touches, mode="drop")
            end = end.at[row, lane].set(why.astype(jnp.int8), mode="drop")
            spent = spent.at[row, lane].set(seconds, mode="drop")
            state = replace(jax.tree.map(partial(jnp.where, dummy), state, after), dummy=after.dummy & ~dummy)
            seconds = jnp.where(over, 0.0, seconds)
            return turn + 1, state, done + over.astype(jnp.int32), seconds, (length, end, spent)

        carry = (jnp.int32(0), state, jnp.zeros(lanes, jnp.int32), jnp.zeros(lanes), table)
        _, state, _, _, (length, end, spent) = jax.lax.while_loop(unfinished, advance, carry)
        return RallyResult(length, end, spent, state.player)
