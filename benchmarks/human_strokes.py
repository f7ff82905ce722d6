"""Policies on people's measured strokes, spin included: ``python -m benchmarks.human_strokes STATES --out FOLDER``.

STATES is DeepMind's rallies.json (D'Ambrosio et al. 2025, CC-BY-4.0), read where it lies. The first call fits a box and
a mixture to all but 1,500 of the strokes and writes their YAMLs with the model whose lift the authors estimated the
spins by; ``mjx-tt train`` takes them. A call with ``--policies RUN...`` throws the strokes that were held
out, each once, with the spin it had, those that bounce twice apart; ``--reachable N`` seeks motions for N of the others
ball by ball.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from mjx_tt.env.reachability import reachable as find_reachable

from ballmodel.distribution import save_distribution
from ballmodel.fit_distribution import fit_human
from ballmodel.io import read
from ballmodel.io.deepmind import MeasuredStates
from ballmodel.mixture import fit_mixture, save_mixture, start_states
from ballmodel.sampling import KEPT, ROBOT_SIDE, SECOND_BOUNCE, BallPool, throw
from ballmodel.state import BallState
from benchmarks.harness import run
from experiments.evaluation.evaluate import return_rate
from experiments.runs import load_policy
from experiments.stats import wilson
from mjx_tt import platform
from mjx_tt.env.evaluator import Evaluator
from mjx_tt.env.rollout import Simulator
from mjx_tt.env.task import TaskConfig
from mjx_tt.sim.model import ModelFile, SimModel

HELD_OUT = 1500
LIFT = 1.33  # Magnus coefficient by which the authors estimated the spins (D'Ambrosio et al. 2025)
SIM_RATE = 300.0  # Hz


def main(
    states: Path,
    *,
    out: Path,
    policies: list[str] | None = None,
    reachable: int = 0,
    short_balls: bool = False,
    seed: int = 0,
) -> None:
    """Fits, or plays and prints.

    Args:
        out: folder of the fitted distributions
        policies: runs or artefacts
        reachable: strokes for which motions are sought
        short_balls: strokes that bounce twice are drawn as well
        seed: of the strokes that are held out
    """
    platform.configure()
    out.mkdir(parents=True, exist_ok=True)
    world = out / "lift.yaml"
    world.write_text(f"ball: {{flight: {{magnus_coefficient: {LIFT}}}}}\n")
    model = ModelFile.load(world).model
    _, report = fit_human(read(states), model.ball)
    rows = start_states(report.landed)
    order = np.random.default_rng(seed).permutation(len(rows))
    held, known = rows[order[:HELD_OUT]], rows[order[HELD_OUT:]]
    if not policies and not reachable:
        fit(known, out, model, short_balls)
        return
    simulator = Simulator(TaskConfig(sim_rate=SIM_RATE), jax.local_device_count())
    key = jax.random.key(seed)
    loaded = {path: load_policy.load(path).policy for path in policies or ()}
    kinds = {"bounce once": pool(held, model, KEPT), "are short and bounce twice": pool(held, model, SECOND_BOUNCE)}
    for kind, balls in kinds.items():
        print(f"{balls.arrival.size:,} of {len(held):,} held-out strokes that land {kind}")
        evaluator = Evaluator(simulator, balls, model, ())
        for path, policy in loaded.items():
            rate = return_rate(evaluator.play(policy, key))
            print(f"  {path}: {rate.value:.1%} ({rate.low:.1%} to {rate.high:.1%}) of them returned")
    if reachable:
        last = next(reversed(loaded.values()), None)
        found = find_reachable(simulator, kinds["bounce once"], model, key, reachable, last)
        low, high = wilson(found.returned, found.balls)
        print(f"in reach, at least: {found.rate:.1%} ({low:.1%} to {high:.1%}) of {found.balls}")


def fit(known: np.ndarray, out: Path, model: SimModel, short_balls: bool) -> None:
    """Writes box.yaml and mixture.yaml of strokes (n, 9)."""
    state = BallState(known[:, :3].T, known[:, 3:6].T, known[:, 6:].T)
    strokes = MeasuredStates(np.arange(len(known)), state, f"{len(known):,} measured strokes")
    box, _ = fit_human(strokes, model.ball, name="box", short_balls=short_balls)
    save_distribution(out / "box.yaml", box)
    mixture, choice = fit_mixture(state, "mixture", strokes.source)
    save_mixture(out / "mixture.yaml", replace(mixture, short_balls=short_balls))
    print(f"{out}: lift.yaml, box.yaml and mixture.yaml ({choice.chosen} components) of {len(known):,} strokes")


def as_state(rows: np.ndarray) -> BallState:
    """Start states (n, 9) as the simulator takes them, (3, n) each."""
    return BallState(*(jnp.asarray(rows[:, i : i + 3].T, jnp.float32) for i in (0, 3, 6)))


def pool(rows: np.ndarray, model: SimModel, outcome: int) -> BallPool:
    """Those of the strokes (n, 9) with that outcome before they pass the robot as balls to be thrown."""
    state = as_state(rows)
    thrown = throw(model.ball, state, *ROBOT_SIDE)
    kept = np.asarray(thrown.outcome) == outcome
    state, thrown = jax.tree.map(lambda a: a[..., kept] if a.ndim else a, (state, thrown))
    return BallPool(state, thrown.arrival, thrown.landing, jnp.ones(()), jnp.ones(1))


if __name__ == "__main__":
    run(main)
