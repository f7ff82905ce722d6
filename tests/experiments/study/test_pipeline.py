"""The iterative loop: its plan, its hidden reality, its fine-tuning, and what a kill leaves of it."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from rich.console import Console
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from ballmodel.aerodynamics import drag_factor, magnus_factor
from ballmodel.state import BallState
from bgs import normalizer, strategy
from experiments.config import build, experiment, files
from experiments.config import study as study_config
from experiments.errors import ConfigError, RunError
from experiments.jobs.site import ALONE
from experiments.runs import load_policy
from experiments.study import blind_protocol, paths, schedule, session
from experiments.study.analysis import scoring
from experiments.study.analysis.paper import TEN
from experiments.study.pipeline import Pipeline, make_config
from experiments.study.schedule import Human, Identified, Real, Simulated
from experiments.study.target_domain import hidden_effects
from experiments.study.target_domain.play_on_robot import make_blind_steps
from experiments.study.target_domain.virtual import VirtualReality
from experiments.study.workflow import Journal, Step, Waiting, list_unfinished
from mjx_tt.env import reward_weights
from mjx_tt.env.policy import Policy, initial_theta
from mjx_tt.sim import model as models
from mjx_tt.sim.model import SimModel
from robot_io.contract import N_OBSERVATION
from tests.support.paths import ROOT

TINY = {
    "name": "tiny",
    "players": ["player3"],
    "first_balls": 60,
    "simulation": {
        "task": {"max_steps": 60, "sim_rate": 150.0},
        "optimiser": {"num_directions": 2, "repeats": 2, "step": {"schedule": {"kind": "constant"}}},
        "pool": 64,
        "seeds": 1,
        "devices": 1,
        "rounds": [{"simulated": 6, "real": 2}, {"simulated": 3, "real": 4}, {"simulated": 3, "real": 4}],
    },
    "fine_tuning": {"num_directions": 5, "repeats": 1},
    "reality": {"sim_rate": 75.0, "without": ["drives", "encoders"]},  # compiles in half the time
    "fresh": False,
    "ablation": None,
    "evaluation": {"rallies": 50, "lanes": 10, "max_touches": 8},
}
LATER = [{"simulated": 1, "real": 1}, {"simulated": 1, "real": 1, "later_rewards": {"after": 0.5, "rewards": "sim"}}]
LATER = [*LATER, LATER[0]]
DRIVER = """
import json, sys
from pathlib import Path
from mjx_tt import platform
platform.configure(devices=2, cache=Path(".cache/jax"))
from rich.console import Console
from experiments.config import site, study as config
from experiments.jobs.site import Workers
from experiments.study import session
workers = Workers(1, site.load(sys.argv[3])) if sys.argv[3:] else Workers(2)
session.run(config.parse(json.loads(sys.argv[1]), "test"), Path(sys.argv[2]), Console(), workers)
"""


def study(**changes) -> study_config.Study:
    return study_config.parse(TINY | changes, "test")


def quiet() -> Console:
    return Console(file=StringIO(), width=200)


def do_steps(folder: Path, steps: list[Step], console: Console | None = None) -> None:
    session.do_steps(study(), folder, steps, console or quiet(), ALONE)


def cosine(a: np.ndarray, b: np.ndarray) -> float:
    return float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))


# The YAML and the plan


@pytest.mark.parametrize("name", ["study_quick", "study_night", "study_full", "study_paper"])
def test_shipped_studies_have_the_papers_numbers_and_no_training_is_mistaken_for_one(name):
    shipped = study_config.load(files.find_shipped(name, "study"))
    assert [r.real for r in shipped.simulation.rounds] == [60, 70, 70]
    assert len(shipped.players) == 5
    tuning = shipped.fine_tuning
    assert (tuning.num_directions, tuning.repeats, tuning.elite_fraction) == (5, 3, 0.6)
    # Where the paper's are not needed perturbations are nearer; the step per perturbation is the same.
    assert tuning.step.learning_rate / tuning.sigma == pytest.approx(0.15) == 0.00375 / 0.025
    assert tuning.sigma == (0.025 if name in ("study_full", "study_paper") else 0.01)
    assert name not in files.shipped("train") and "quickstart" in files.shipped("train")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"players": ["player3", "player3"]}, "different entries"),
        ({"reality": {"without": ["magic"]}}, "got 'magic'"),
        ({"robot": "lockstep"}, "recordings of the first balls of player3"),
        ({"robot": "lockstep", "identification": {}}, "logs no session; take robot: rig"),
        ({"evaluation": {"rallies": 40, "lanes": 8}}, "evaluation.rallies 40 is less than 50"),
        (
            {"evaluation": {"rallies": 80, "lanes": 7}},
            "lanes 7 .*the nearest that is allowed: 77 or 84",
        ),
        ({"ablation": {"player": "player4"}}, "ablation.player 'player4' is none of the players of this study"),
        ({"identification": {"joints": "logs"}}, "identification.joints: the virtual reality records its own"),
        ({"baselines": False, "identification": {}}, "evaluation.cross: .* and baselines is false; leave it out"),
        (
            {"baselines": False, "evaluation": {"rallies": 50, "lanes": 5, "cross": False}},
            "leaves nothing to do without identification",
        ),
        (
            {"simulation": {"optimiser": {"gradient": "first_order"}, "rounds": LATER}},
            "simulation.rounds.1.later_rewards: simulation.optimiser.gradient first_order climbs an objective of its",
        ),
        ({"fine_tuning": {"rewards": "sim"}}, "rewards: expected weights based on real, got sim"),
        ({"fine_tuning": {"seed": 3}}, "test: fine_tuning.seed 3: each step's chance follows from its name"),
        ({"fine_tuning": {"evaluation_balls": 20}}, "test: fine_tuning.evaluation_balls 20: played on a robot alone"),
    ],
)
def test_mistakes_in_a_study_are_named(changes, message):
    with pytest.raises(ConfigError, match=message):
        study(**changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"robot": "rig", "recordings": {"player3": "nofile.csv"}}, "recordings.player3: nofile.csv: no such file"),
        (
            {"robot": "norobot.yaml", "recordings": {"player3": "nofile.csv"}},
            "robot: norobot.yaml: cannot be read",
        ),
        ({"simulation": TINY["simulation"] | {"model": {"bal": {"x": 1.0}}}}, "simulation: model: bal: expected .*"),
        ({"ablation": {"player": "player3", "balls": ["wide"]}}, "ablation.balls: expected .*, got 'wide'"),
    ],
)
def test_what_a_study_names_is_looked_up_before_it_begins(tmp_path, changes, message):
    with pytest.raises(ConfigError, match=message):
        session.run(study(**changes), tmp_path / "tiny", quiet())
    assert [path.name for path in (tmp_path / "tiny").iterdir()] == [".lock"]


def test_a_start_that_came_to_no_step_does_not_block_another(tmp_path):
    session._open(study(), tmp_path)
    session._open(study(first_balls=61), tmp_path)
    assert "first_balls: 61" in (tmp_path / paths.SETTINGS).read_text()
    Journal(tmp_path / "steps.jsonl").append("seed0/player3/D0", 1.0)
    with pytest.raises(RunError, match="first_balls: the study has 61, now 62"):
        session._open(study(first_balls=62), tmp_path)
    for content in (b"[1]", b"\x80", b"{"):
        (tmp_path / paths.SESSIONS).write_bytes(content)
        with pytest.raises((RunError, ConfigError), match="study.json"):
            session._open(study(first_balls=61), tmp_path)


def test_everything_is_made_after_what_it_needs_and_the_papers_ten_models_are_there():
    whole = study_config.load(files.find_shipped("study_full", "study"), ("identification={}",))
    needs = {
        Human: lambda i: i.data,
        Identified: lambda i: i.data,
        Simulated: lambda i: (i.balls, i.source, i.world),
        Real: lambda i: (i.source,),
    }
    for player in whole.players:
        made: set[str] = {"D0", "large", "medium", "narrow"}
        for item in schedule.list_items(whole, player):
            assert {n for n in needs[type(item)](item) if n is not None} <= made, item
            made |= (
                {item.name}
                if isinstance(item, Human | Identified)
                else {item.key} | ({item.data} if isinstance(item, Real) else set())
            )
        assert {"world2", "id-ft100"} <= made
        assert set(TEN) <= made
    # "fine-tuned for 70 updates per cycle for the last two cycles and 60 for the first": 200, oracle 35 %.
    by_key = {item.key: item for item in (*schedule.LOOP, *schedule.COMPARED) if not isinstance(item, Human)}
    spent = {}
    for key, item in by_key.items():
        before = spent.get(item.source, 0) if item.source else 0
        spent[key] = before + (schedule.count_updates(whole, item) if isinstance(item, Real) else 0)
    assert spent["is2r-ft100"] == spent["s2r-ft100"] == 200 and spent["oracle-ft"] == 0.35 * 200
    assert schedule.count_updates(whole, by_key["oracle-sim"]) == 40000


def test_every_player_evaluates_ten_own_models_and_three_of_two_others():
    whole = study_config.load(files.find_shipped("study_full", "study"), ("fresh=false", "ablation=null"))
    pairs = schedule.list_pairings(whole)
    for player in whole.players:
        assert sum(t == e == player for t, e, _ in pairs) == 10
        others = [(t, m) for t, e, m in pairs if e == player != t]
        assert len(others) == len(set(others)) == 6 and len({t for t, _ in others}) == 2


def test_a_rounds_training_has_its_recipe_and_starts_where_it_says(tmp_path):
    night = study_config.load(files.find_shipped("study_night", "study"))
    by_key = {item.key: item for item in (*schedule.LOOP, *schedule.COMPARED) if isinstance(item, Simulated)}
    first = make_config(night, by_key["is2r-sim1"], "player3/M0", None, 5)
    later = make_config(night, by_key["is2r-sim2"], "player3/M1", tmp_path, 6)
    oracle = make_config(night, by_key["oracle-sim"], "player3/M2", None, 7)
    assert first.training.updates + 2 * later.training.updates == oracle.training.updates
    assert (first.initial_policy, later.initial_policy, oracle.initial_policy) == (None, str(tmp_path), None)
    assert (
        later.optimiser.step.learning_rate < first.optimiser.step.learning_rate == oracle.optimiser.step.learning_rate
    )
    assert build.later_weights(later)[0] == 0


def test_the_papers_study_trains_as_the_papers_training():
    """With the settings of the shipped paper.yaml, which the tests of training hold against the paper."""
    study_ = study_config.load(files.find_shipped("study_paper", "study"))
    paper = experiment.load(files.find_shipped("paper", "train"))
    assert study_.simulation.optimiser == paper.optimiser
    assert study_.simulation.task == paper.task and study_.simulation.model == paper.model
    step = paper.optimiser.step
    assert (step.kind, step.learning_rate, step.schedule.kind) == ("sgd", 0.00375, "constant")
    assert [(r.simulated, r.real, r.step, r.later_rewards) for r in study_.simulation.rounds] == [
        (30000, 60, None, None),
        (5000, 70, None, None),
        (5000, 70, None, None),
    ]
    assert study_.simulation.rounds[0].simulated == paper.training.updates
    item = next(i for i in schedule.list_items(study_, "player1") if isinstance(i, Simulated))
    assert make_config(study_, item, "narrow", None, 0).training.later_rewards is None


# The hidden reality


def test_leaving_out_an_effect_changes_no_other_and_seeds_differ():
    everything = hidden_effects.list_differences(hidden_effects.draw(3))
    ranges = {path: bounds for group in hidden_effects.RANGES.values() for path, bounds in group.items()}
    assert everything.keys() == ranges.keys()
    assert all(low <= everything[path] <= high for path, (low, high) in ranges.items())
    for effect in hidden_effects.RANGES:
        left = hidden_effects.list_differences(hidden_effects.draw(3, (effect,)))
        assert left == {path: value for path, value in everything.items() if path not in hidden_effects.RANGES[effect]}
    assert tuple(hidden_effects.RANGES) == get_args(study_config.Effect)
    assert hidden_effects.draw(3, get_args(study_config.Effect)) == models.with_values(SimModel(), {})
    other = hidden_effects.list_differences(hidden_effects.draw(4))
    assert all(other[path] != value for path, value in everything.items())


def test_ranges_of_realities_hold_what_training_believes_and_lie_within_the_prior():
    nominal = models.paths()
    for effect, ranges in hidden_effects.RANGES.items():
        for path, (low, high) in ranges.items():
            wide = study_config.PRIOR[path]
            assert wide[0] <= low < high <= wide[1], path
            if effect != "noise":
                assert low <= nominal[path] <= high, path


def test_effects_from_outside_come_on_top_and_change_no_other():
    inside = hidden_effects.list_differences(hidden_effects.draw(3))
    for effect, ranges in hidden_effects.OUTSIDE.items():
        model = hidden_effects.draw(3, outside=(effect,))
        found = hidden_effects.list_differences(model)
        assert {p: v for p, v in found.items() if p not in ranges} == {
            p: v for p, v in inside.items() if p not in ranges
        }
        assert all(low <= found[path] <= high for path, (low, high) in ranges.items())
        # What no prior has: an identification cannot come upon it by chance.
        assert not set(ranges) <= set(study_config.PRIOR)
        assert hidden_effects.describe(model, 3, (), (effect,))["outside"] == [effect]
    assert "outside" not in hidden_effects.describe(hidden_effects.draw(3), 3, ())
    assert tuple(hidden_effects.OUTSIDE) == get_args(study_config.Outside)
    for said, given in (
        ("no effect is called 'magic'; there are rubber", {"without": ("magic",)}),
        ("outside of the model is called 'magic'; there are lift, bounce", {"outside": ("magic",)}),
    ):
        with pytest.raises(ValueError, match=said):
            hidden_effects.draw(3, **given)


def test_measured_balls_are_the_flight_as_the_camera_sees_it():
    """Against the equations of motion integrated by SciPy and a rotation by SciPy."""
    world = hidden_effects.draw(1)
    rng = np.random.default_rng(0)
    n, noise = 40, 0.002
    position = np.array([[0.3], [1.3], [0.3]]) + 0.05 * rng.normal(size=(3, n))
    velocity = np.array([[-0.2], [-5.0], [1.6]]) + 0.2 * rng.normal(size=(3, n))
    spin = 60.0 * rng.normal(size=(3, n))
    measured = hidden_effects.measure(world, BallState(position, velocity, spin), noise, jax.random.key(0))
    flight, sensor = world.ball.flight, world.sensing
    drag, lift = float(drag_factor(flight)), float(magnus_factor(flight))
    angles = [sensor.camera_rotation_x, sensor.camera_rotation_y, sensor.camera_rotation_z]
    camera = sensor.camera_scale * Rotation.from_euler("xyz", angles).as_matrix()
    offset = np.array([sensor.ball_offset_x, sensor.ball_offset_y, sensor.ball_offset_z])
    residuals = []
    for i in range(n):

        def motion(t, y, omega=spin[:, i]):
            turning = omega * np.exp(-flight.spin_decay * t)
            v = y[3:]
            return [*v, *(-drag * np.linalg.norm(v) * v + lift * np.cross(turning, v) + [0, 0, flight.gravity_z])]

        frames = 30  # before any of them bounces
        times = np.arange(frames) / hidden_effects.CAMERA_RATE
        path = solve_ivp(motion, (0, 1), [*position[:, i], *velocity[:, i]], t_eval=times, rtol=1e-9, atol=1e-9).y[:3]
        assert path[2].min() > 0.03
        residuals.append(measured.position[:frames, :, i].T - (camera @ path + offset[:, None]))
    residuals = np.array(residuals)
    assert abs(residuals.mean()) < 5 * noise / np.sqrt(residuals.size) + 1e-4
    assert residuals.std() == pytest.approx(noise, rel=0.05)
    tracks = measured.trajectories("session")
    assert len(tracks) == n and all(t.time[1] - t.time[0] == pytest.approx(1 / 125) for t in tracks)
    assert all(0.3 < t.time[-1] < 1.2 for t in tracks)


# Fine-tuning


@pytest.fixture(scope="module")
def virtual() -> VirtualReality:
    return VirtualReality(study(), 0)


@pytest.mark.slow
def test_an_update_is_the_papers_formula_of_valid_balls(virtual):
    """The parameters after the first chunk of updates, computed anew in NumPy from the same balls."""
    person, theta = virtual.player("player3"), np.asarray(initial_theta(jax.random.key(0), 0.3))
    person = replace(person, first=replace(person.first, service=0.2))  # that many come down on their own side
    statistics = normalizer.ObservationStatistics(
        jnp.array([0, 100], jnp.int32), jnp.zeros(N_OBSERVATION), jnp.full(N_OBSERVATION, 25.0)
    )
    key = jax.random.key(5)
    cycle = virtual.fine_tune(person, theta, statistics, 2, key, "test")
    ask_key, rally_key, play_key, _ = jax.random.split(key, 4)
    tuning = study().fine_tuning
    pairs, lanes = tuning.num_directions, tuning.episodes_per_update
    settings = build.bgs_config(tuning.optimiser(), 2)
    frozen = [np.repeat(np.asarray(x)[:, None], lanes, axis=1) for x in normalizer.normaliser(statistics)]
    rally = virtual.simulator.start(person, virtual.known, rally_key, lanes)
    weights = np.array(list(reward_weights.REAL_WEIGHTS.values()))
    now = theta.astype(np.float64)
    for number in range(2):
        state = strategy.init(jnp.asarray(now, jnp.float32), settings)
        delta = np.asarray(strategy.ask(jax.random.fold_in(ask_key, number), state, settings).directions, np.float64)
        members = np.concatenate([now[:, None] + 0.025 * delta, now[:, None] - 0.025 * delta], axis=1)
        shot_key = jax.random.fold_in(play_key, number)
        policy = Policy(np.repeat(members, tuning.repeats, axis=1).astype(np.float32), *frozen)
        replays = 0
        rally, shots = virtual.simulator.shots(policy, person, virtual.known, rally, shot_key)
        # Who brings no ball over plays another one, as on the robot.
        while not (valid := np.asarray(shots.valid | shots.fault)).all():
            replays += 1
            key_again = jax.random.fold_in(shot_key, replays)
            played = virtual.simulator.shots(policy, person, virtual.known, rally, key_again)
            rally, shots = jax.tree.map(lambda old, new, v=valid: np.where(v, old, new), (rally, shots), played)
        assert replays > 0
        assert np.asarray(shots.finite).all()
        terms = np.array(shots.terms, np.float64)
        terms[reward_weights.TERMS.index("fault")] = np.where(shots.fault, -2.0, 0.0)
        returns = (weights @ terms).reshape(2 * pairs, tuning.repeats).mean(axis=1)
        difference = returns[:pairs] - returns[pairs:]
        elites = np.argsort(-np.abs(difference))[: int(0.6 * pairs)]
        spread = np.std(np.concatenate([returns[:pairs][elites], returns[pairs:][elites]]))
        now = now + 0.00375 * delta[:, elites] @ difference[elites] / (len(elites) * spread)
        assert cycle.rows[number]["mean_return"] == pytest.approx((weights @ terms).mean(), abs=1e-3)
        assert cycle.rows[number]["fault_rate"] == pytest.approx(float(np.mean(np.asarray(shots.fault))), abs=1e-6)
    np.testing.assert_allclose(cycle.state.bgs.theta, now, atol=2e-5)
    assert np.abs(now - theta).max() > 1e-3
    assert len(cycle.balls) == 2 * lanes and all(ball.position[1].min() < 0.0 for ball in cycle.balls)
    np.testing.assert_array_equal(cycle.state.statistics.mean, statistics.mean)


# Steps


def toy_steps(folder: Path, done: list[str], fail: str | None = None) -> list[Step]:
    """a -> b -> d, a -> c -> d, each writing what it read and its name."""

    def step(name: str, *sources: str) -> Step:
        def run() -> str:
            if name == fail:
                raise KeyboardInterrupt
            done.append(name)
            (folder / name).write_text("".join((folder / s).read_text() for s in sources) + name)
            return "made"

        return Step(name, tuple(folder / s for s in sources), (folder / name,), run)

    return [step("a"), step("b", "a"), step("c", "a"), step("d", "b", "c")]


def test_steps_go_on_where_they_were_stopped_and_follow_what_is_made_anew(tmp_path):
    done: list[str] = []
    path = tmp_path / "steps.jsonl"
    with pytest.raises(KeyboardInterrupt):
        do_steps(tmp_path, toy_steps(tmp_path, done, fail="c"))
    with open(path, "ab") as file:
        file.write(b'{"step": "c", "kin')  # killed while it wrote
    do_steps(tmp_path, toy_steps(tmp_path, done))
    assert done == ["a", "b", "c", "d"] and (tmp_path / "d").read_text() == "abacd"
    do_steps(tmp_path, toy_steps(tmp_path, done))
    assert len(done) == 4
    (tmp_path / "b").unlink()
    assert [s.name for s in list_unfinished(toy_steps(tmp_path, done), Journal(path))] == ["b", "d"]
    with pytest.raises(KeyboardInterrupt):  # b is made anew, and then it is killed: d is older than b
        do_steps(tmp_path, toy_steps(tmp_path, done, fail="d"))
    assert [s.name for s in list_unfinished(toy_steps(tmp_path, done), Journal(path))] == ["d"]
    path.write_text("nonsense\n" + path.read_text())
    with pytest.raises(RunError, match="line 1 is no step"):
        Journal(path)


# The whole loop


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("study") / "tiny"
    loop(study(), folder)
    return folder


def loop(what: study_config.Study, folder: Path) -> None:
    """The study without its report, which has tests of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    session._open(what, folder)
    do_steps(folder, Pipeline(what, folder, quiet()).steps_of_play(), quiet())


@pytest.mark.slow
def test_a_study_leaves_what_it_says(finished):
    player = finished / "seed0" / "player3"
    for key in TEN:
        kept = Policy.load(player / key / paths.POLICY)
        assert kept.theta.shape == (976,) and kept.mean.shape == kept.inv_std.shape == (N_OBSERVATION,)
        assert np.isfinite(kept.theta).all()
    # Weights are carried on: from simulation to reality and back.
    tuned, trained, other = (
        Policy.load(player / key / paths.POLICY).theta for key in ("is2r-ft35", "is2r-sim1", "oracle-sim")
    )
    assert cosine(tuned, trained) > 0.9 and abs(cosine(other, trained)) < 0.3
    started = load_policy.load(player / "is2r-sim2" / "training" / "seed0").config.initial_policy
    assert started == str((player / "is2r-ft35").resolve())
    rallies = scoring.read(finished / "evaluations.csv")
    assert set(rallies.model.tolist()) == set(TEN) and len(rallies) == 50 * 10
    opened = (finished / "seed0" / "reality.yaml").read_text()
    drawn = hidden_effects.draw(0, ("drives", "encoders"))
    assert f"ball.paddle.restitution: {drawn.ball.paddle.restitution}" in opened


@pytest.mark.slow
def test_a_second_training_uses_the_first_ones_program(finished, tmp_path):
    """Compilations counted by JAX itself; other balls."""
    steps = {step.name: step for step in Pipeline(study(), tmp_path, quiet()).steps()}
    step, compiled = steps["seed0/player3/is2r-sim1"], []
    human = tmp_path / "seed0" / "player3" / "balls" / "human_M0.yaml"
    human.parent.mkdir(parents=True)
    shutil.copyfile(finished / "seed0" / "player3" / "balls" / "human_M2.yaml", human)
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, *_, **__: compiled.append(event) if event.endswith("backend_compile_duration") else None
    )
    assert step.run().startswith("6 updates")
    assert not compiled
    places = step.outputs[0].parent, finished / "seed0" / "player3" / "is2r-sim1"
    one, two = (Policy.load(place / paths.POLICY).theta for place in places)
    assert np.abs(one - two).max() > 1e-3  # other balls


@pytest.mark.slow
def test_a_study_stopped_and_killed_ends_as_one_that_nobody_touched(finished, tmp_path):
    """Two processes are stopped as a batch system does, then killed; Parsl goes on, is killed, and ends the study."""
    folder, site = tmp_path / "tiny", tmp_path / "here.yaml"
    player = folder / "seed0" / "player3"
    site.write_text(yaml.safe_dump({"provider": {"kind": "local"}, "workers_per_node": 1, "memory_per_worker": 1.0}))
    command = [sys.executable, "-c", DRIVER, json.dumps(TINY), str(folder)]

    def steps_done() -> list[str]:
        return Journal(folder / "steps.jsonl").steps

    def start_and_end(sign: Path, number: int, *more: str) -> tuple[int, str]:
        """Exit status and message of a session that gets a signal when ``sign`` is there."""
        streams = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL if more else subprocess.PIPE}
        process = subprocess.Popen([*command, *more], cwd=ROOT, text=True, **streams)
        while not sign.exists() and process.poll() is None:
            time.sleep(0.005)
        time.sleep(0.1)
        assert process.poll() is None, more or process.stderr.read()
        os.kill(process.pid, number)
        _, message = process.communicate(timeout=120)  # its end means that no worker lives: each holds the pipe
        return process.returncode, message

    status, message = start_and_end(player / "is2r-sim1" / "training" / "seed0" / "metrics.jsonl", signal.SIGTERM)
    assert status != 0 and re.search(r"is2r-sim1.*: stopped after update \d", message), message
    assert f"{folder}: stopped; the same command continues the study" in message
    assert steps_done()[-1] == "seed0/player3/M0"
    status, message = start_and_end(player / "is2r-ft35" / "checkpoints", signal.SIGKILL)
    assert status == -signal.SIGKILL, message
    training_ = player / "is2r-sim2" / "training" / "seed0" / "metrics.jsonl"
    assert start_and_end(training_, signal.SIGKILL, str(site))[0] == -signal.SIGKILL
    before = steps_done()
    assert "seed0/player3/M1" in before and len(before) < 14  # of 20
    done = subprocess.run([*command, str(site)], cwd=ROOT, capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0, done.stdout + done.stderr
    entries = steps_done()
    assert entries[: len(before)] == before and len(entries) == len(set(entries))  # nothing was done twice
    assert_same_bits(folder, finished)


def assert_same_bits(folder: Path, finished: Path) -> None:
    for path in sorted(finished.rglob("*")):
        if path.suffix in (".csv", ".npz", ".yaml") and path.name != "config.yaml":
            mine = folder / path.relative_to(finished)
            if path.suffix == ".npz":
                with np.load(path) as a, np.load(mine) as b:
                    names = [n for n in a.files if n != "notes"]
                    assert names == [n for n in b.files if n != "notes"]
                    for name in names:
                        np.testing.assert_array_equal(a[name], b[name], err_msg=f"{path}: {name}")
            else:
                assert path.read_bytes() == mine.read_bytes(), path


# On a robot


@pytest.mark.slow
def test_on_a_robot_the_study_waits_for_its_people(finished, tmp_path):
    """The emulated robot in lock-step; then the scoring sheet, by hand."""
    tuning = {"num_directions": 1, "repeats": 1, "evaluation_balls": 2}
    small = [{"simulated": 2, "real": 1}] * 3
    what = study(
        robot="lockstep",
        fine_tuning=tuning,
        simulation=TINY["simulation"] | {"rounds": small},
        recordings={"player3": str(finished / "seed0" / "player3" / "balls" / "D0.csv")},
    )
    console, folder = quiet(), tmp_path / "robot"
    steps = Pipeline(what, folder, console).steps_of_play()
    names = [step.name for step in steps]
    assert "seed0/reality" not in names and names[-1] == "evaluations"
    first = names.index("seed0/player3/is2r-ft35") + 1
    folder.mkdir()
    do_steps(folder, steps[:first], console)
    measured = (folder / "seed0" / "player3" / "balls" / "D1.csv").read_text().splitlines()
    assert measured[0] == "session,trajectory,t,x,y,z" and len(measured) > 20
    assert (folder / "seed0" / "player3" / "is2r-ft35" / "journal.jsonl").read_text().count("\n") == 2 + 2 + 2
    theta = Policy.load(folder / "seed0" / "player3" / "is2r-ft35" / paths.POLICY).theta
    assert np.isfinite(theta).all()


@pytest.mark.slow
def test_people_play_under_code_names_and_the_key_opens_when_the_sheet_is_full(finished, tmp_path):
    folder, player = tmp_path / "blind", finished / "seed0" / "player3"
    runs_of = {key: (lambda key=key: player / key) for key in ("is2r-ft35", "is2r-ft65")}
    make, count = make_blind_steps(folder, 0, "player3", "player4", runs_of, (), "robot.yaml", quiet())
    with pytest.raises(Waiting, match=r"player4 plays rallies with .*policies/CODE --robot robot.yaml.*A has 0 of 50"):
        do_steps(tmp_path, [make, count])
    sheet = folder / blind_protocol.SHEET
    lines = sheet.read_text().splitlines()
    length = {"A": 3, "B": 8}
    filled = [f"{line[:-2]},{length[line[0]]},13" if line.endswith(",,") else line for line in lines]
    sheet.write_text("\n".join(filled) + "\n")
    assert [step.name for step in list_unfinished([make, count], Journal(tmp_path / "steps.jsonl"))] == [count.name]
    do_steps(tmp_path, [make, count])
    rallies = scoring.read(folder / blind_protocol.EVALUATIONS)
    codes = blind_protocol.unseal(folder / blind_protocol.KEY)["codes"]
    for model, code in codes.items():
        assert set(rallies.length[rallies.model == model].tolist()) == {length[code]}
    played = load_policy.load(folder / blind_protocol.POLICIES / codes["is2r-ft65"])
    np.testing.assert_array_equal(played.policy.theta, Policy.load(player / "is2r-ft65" / paths.POLICY).theta)
