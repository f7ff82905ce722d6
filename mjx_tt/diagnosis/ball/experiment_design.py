"""Design of the next experiment: the throws that would tell apart what these flights cannot, by expected evidence.

A kind of throw is worth the squared error, in units of the noise, by which the rival's best imitation of the chosen
cause would miss on twenty such balls. Instrument readings come from the catalogue.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ballmodel.trajectory import Trajectory
from mjx_tt.diagnosis.ball.diagnose import BallFindings
from mjx_tt.diagnosis.ball.flights.forward_model import grid
from mjx_tt.diagnosis.ball.flights.linearization import BallProblem, Situation, project
from mjx_tt.diagnosis.ball.flights.noise import Noise, flight_frame
from mjx_tt.diagnosis.verdict import Experiment

BALLS, SAMPLES, RATE = 20, 75, 125.0


@dataclass(frozen=True)
class Throw:
    """A kind of throw: middle and spread of its start."""

    what: str
    position: tuple[float, float, float]
    velocity: tuple[float, float, float]
    spread: float = 0.1  # of the speed
    spin: tuple[float, float, float] = (0.0, 0.0, 0.0)


THROWS = (
    Throw("fast, flat balls from the human's side", (0.0, 1.4, 0.35), (0.0, -8.0, 0.3)),
    Throw("slow, high balls from the human's side", (0.0, 1.3, 0.3), (0.0, -2.6, 3.2)),
    Throw("balls the other way, from the robot's side", (0.0, -1.4, 0.3), (0.0, 5.5, 1.3)),
    Throw("diagonal balls from both corners", (0.6, 1.3, 0.3), (-2.2, -5.0, 1.3), 0.2),
    Throw("balls dropped from 1.5 m onto the table", (0.1, -0.7, 1.5), (0.0, -0.3, 0.0)),
    Throw("long balls that meet no table", (0.9, 1.4, 0.8), (0.1, -4.5, 2.5)),
    Throw("balls with strong topspin", (0.0, 1.4, 0.3), (0.0, -5.0, 1.8), 0.1, (100.0, 0.0, 0.0)),
    Throw("balls with strong sidespin", (0.0, 1.4, 0.3), (0.0, -5.0, 1.2), 0.1, (0.0, 0.0, 100.0)),
    Throw("balls of many speeds, 3 to 9 m/s", (0.0, 1.4, 0.4), (0.0, -6.0, 0.8), 0.5),
)


def experiments(
    found: BallFindings, pairs: list[tuple[int, int]], hidden: list[int], most: int = 4
) -> tuple[Experiment, ...]:
    """The best throws to separate pairs (chosen effect, rival), and to show effects that nothing excited."""
    if not pairs and not hidden:
        return ()
    effects = found.problem.effects
    out = []
    for throw in THROWS:
        gram = _gram(found, throw)
        separates, worth = [], 0.0
        for chosen, rival in pairs:
            size = found.search.at.theta[chosen]
            left = gram[chosen, chosen] - gram[chosen, rival] ** 2 / max(gram[rival, rival], 1e-300)
            if size**2 * left > 10.0:
                separates.append(f"{effects[chosen].name} from {effects[rival].name}")
                worth += float(size**2 * left)
        for j in hidden:
            value = gram[j, j] * effects[j].scale ** 2
            if value > 20.0:
                separates.append(f"whether there is {effects[j].name}")
                worth += float(np.sqrt(value))
        if separates:
            out.append(Experiment(f"{BALLS} {throw.what}", tuple(separates), worth))
    return tuple(sorted(out, key=lambda e: (-len(e.separates), -e.gain))[:most])


def _gram(found: BallFindings, throw: Throw) -> np.ndarray:
    """(K, K) information of BALLS such balls about the effects, their starts unknown."""
    rng = np.random.default_rng(0)
    speed = np.linalg.norm(throw.velocity)
    position = np.array(throw.position)[:, None] + rng.normal(0.0, 0.05, (3, BALLS))
    velocity = np.array(throw.velocity)[:, None] * (1.0 + throw.spread * rng.normal(0.0, 1.0, BALLS))
    velocity = velocity + rng.normal(0.0, 0.05 * speed, (3, BALLS))
    spin = np.array(throw.spin)[:, None] * rng.normal(1.0, 0.3, BALLS)
    time = np.arange(SAMPLES) / RATE
    flat = [Trajectory("", str(i), time, np.zeros((3, SAMPLES))) for i in range(BALLS)]
    g = grid(flat)
    problem = BallProblem(g, found.problem.model, found.problem.effects, velocity)
    at = Situation(found.search.at.theta, np.concatenate([position, velocity, spin, np.zeros_like(spin)]))
    linear = problem.linearise(at)
    frame = flight_frame(linear.base.velocity[:, :, 0])
    noise = Noise(
        frame,
        np.repeat(np.median(found.search.noise.scale, axis=1, keepdims=True), BALLS, axis=1),
        found.search.noise.memory,
        found.search.noise.interval,
        found.search.noise.scatter,
    )
    p = project(linear, at, noise, np.ones((BALLS, SAMPLES)), g)
    return p.gram.sum(axis=0)
