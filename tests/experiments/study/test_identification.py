"""A study's world as it is identified: from logs of other code, beside a prior, without the reality."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

from ballmodel.partial_params import without_nominal
from ballmodel.trajectory import Dataset, Trajectory
from experiments import measurements
from experiments.config import study as study_config
from experiments.config.study import PRIOR
from experiments.runs import load_policy
from experiments.study import identification
from experiments.study.analysis import delays
from experiments.study.analysis.identified import PRIOR as DRAWN
from experiments.study.analysis.identified import list_estimates
from experiments.study.target_domain import lab_logs
from experiments.study.target_domain.virtual import VirtualReality
from mjx_tt import diagnosis
from mjx_tt.diagnosis.together.hits import SEEN_HIGH
from mjx_tt.env.task import Task, TaskConfig
from mjx_tt.robot import mjcf
from mjx_tt.sim import model as models
from mjx_tt.sim.model import ModelFile, SimModel
from robot_io.limits import LIMITS
from tests.exam.generator.world import World, fly
from tests.support.paths import ROOT

pytestmark = pytest.mark.optimised
QUICKSTART = ROOT / "experiments" / "shipped" / "policies" / "quickstart"


@pytest.fixture(scope="module")
def task():
    return Task(TaskConfig(sim_rate=300.0))


def swept(task, model: SimModel, seed: int = 0):
    return lab_logs.record_joints(task, without_nominal(model), jax.random.key(seed), 30.0)


def balls(world: World, n: int = 120) -> Dataset:
    """Balls of one speed range over the table by the exam's physics, with 3 mm of noise."""
    rng = np.random.default_rng(7)
    position = rng.uniform([[-0.4], [1.0], [0.2]], [[0.4], [1.6], [0.4]], (3, n))
    velocity = rng.uniform([[-0.6], [-6.0], [0.5]], [[0.6], [-4.5], [1.5]], (3, n))
    time = np.arange(56) / 125.0
    path = fly(world, np.concatenate([position, velocity, np.zeros((3, n))]), time[-1] + 0.01)
    seen = path.at(np.repeat(time[:, None], n, axis=1)) + rng.normal(0.0, 0.003, (3, time.size, n))
    return Dataset(tuple(Trajectory("day", str(i), time, seen[:, :, i]) for i in range(n)), "test")


def test_sweeps_stay_within_the_limits_and_near_home():
    rng, period = np.random.default_rng(1), 1.0 / 75.0
    actions = lab_logs.multisine(rng, 4500, period)
    assert np.abs(actions).max() <= 1.0 and not actions[:37].any()
    moved = np.cumsum(actions * LIMITS.policy_velocity, axis=0) * period
    home = np.asarray(mjcf.home_qpos(mjcf.load_model()))
    assert np.all(home + moved < LIMITS.upper) and np.all(home + moved > LIMITS.lower)
    assert np.all(np.ptp(moved, axis=0) > 0.03 * (np.array(LIMITS.upper) - LIMITS.lower))


@pytest.mark.slow
def test_the_nominal_robots_own_log_shows_nothing(task):
    found = diagnosis.diagnose(diagnosis.Logs((), swept(task, SimModel()), {}))
    assert found.verdict.verdict == "none"


@pytest.fixture(scope="module")
def identified(task, tmp_path_factory):
    """The world after balls of other code on a table of friction 0.19, 6 mm high or seen 6 mm high, and a sweep."""
    folder, slow = tmp_path_factory.mktemp("logs"), {"drives.joint_2.lag": 0.018, "drives.gantry_x.velocity_gain": 0.95}
    identification.write_joints(folder / "joints", swept(task, models.with_values(SimModel(), slow)))
    measurements.write_csv(folder / "D0.csv", balls(World(friction=0.19, height=0.006)))
    logs, before = [folder / "D0.csv", folder / "joints"], identification.read_prior(PRIOR, "prior")
    found = identification.identify(logs, 100, ModelFile(SimModel()), before)
    truth = {**slow, "ball.table.friction": 0.19, SEEN_HIGH: 0.006}
    return folder, found, truth


@pytest.mark.slow
def test_a_world_is_what_the_logs_say_and_the_prior_for_the_rest(identified, tmp_path):
    _, world, truth = identified
    made_of = world.provenance["identified"]
    assert made_of["flights"] <= 100 and made_of["hits"] == 0 and max(made_of["joints"].values()) < 1e-3
    values, drawn = models.paths(world.model), {path for one in world.randomise for path in one.paths}
    for path, value in truth.items():
        assert values[path] == pytest.approx(value, rel=0.08), path
    assert values["ball.table.height"] == 0.0 and "ball.table.height" not in drawn
    # What no log of this kind shows is drawn as before; the arm's measurement, which fixes the clock, is as believed.
    hidden = {"ball.paddle.restitution", "sensing.ball_offset_x", "drives.joint_1.joint_offset"}
    rows = {row["parameter"]: row for row in list_estimates(world, truth)}
    for path in hidden:
        assert [rows[path]["low"], rows[path]["high"]] == PRIOR[path] and rows[path]["decided by"] == DRAWN
    assert drawn == set(PRIOR) - {delays.ARM}
    # Ball and axes are measured as late against the arm as two independent draws of the prior: 90 % of a trapezium.
    for path in (delays.BALL, delays.AXES):
        arm = np.random.default_rng(5).uniform(*PRIOR[delays.ARM], 100_000) - values[delays.ARM]
        wanted = np.percentile(np.random.default_rng(6).uniform(*PRIOR[path], 100_000) - arm, [5, 95])
        assert [rows[path]["low"], rows[path]["high"]] == pytest.approx(list(wanted), abs=0.004)
        assert rows[path]["decided by"] == DRAWN
    for path in ("drives.joint_1.lag", "latency.abb_action", delays.AXES_COMMAND):
        assert rows[path]["high"] - rows[path]["low"] < 0.002
    friction = rows["ball.table.friction"]
    assert friction["low"] < 0.19 < friction["high"] < friction["low"] + 0.02 and friction["truth"] == 0.19
    # Training takes it as it stands, with all that is drawn.
    world.save(tmp_path / "world.yaml")
    loaded = ModelFile.load(tmp_path / "world.yaml")
    shape = (7,)
    one = models.draw(jax.random.key(0), loaded.model, loaded.randomise, shape)
    assert np.ptp(np.asarray(one.ball.paddle.restitution)) > 0.0 and one.ball.table.friction.shape == shape


@pytest.mark.slow
def test_hits_of_real_play_decide_the_rubber_and_the_delay(tmp_path):
    """In a reality of the same simulator, camera and delays of each ball included; the rubber is none of training's."""
    data = {"name": "x", "simulation": {"rounds": [{"simulated": 1, "real": 1}] * 3}, "reality": {}}
    reality = VirtualReality(study_config.parse(data, "study"), 2)
    player, policy = reality.player("player3"), load_policy.load(QUICKSTART).policy
    measurements.write_csv(tmp_path / "D0.csv", reality.first_balls(player, 300, jax.random.key(0), "D0"))
    identification.write_joints(tmp_path / "joints", swept(reality.simulator.task, reality.known))
    log = lab_logs.record_hits(reality.simulator, reality.known, player, policy, jax.random.key(1), "hits", 0.003, 0.04)
    # The clock is one: a ball's track and its joints cover the same time.
    assert all(log.joints[0].state_time[0] < t.time[-1] < log.joints[0].state_time[-1] for t in log.balls)
    identification.write_hits(tmp_path / "hits", log.balls, log.joints)
    logs, before = [tmp_path / "D0.csv", tmp_path / "joints"], identification.read_prior(PRIOR, "prior")
    found = identification.identify(logs, 400, ModelFile(SimModel()), before, [tmp_path / "hits"])
    assert found.provenance["identified"]["hits"] > 40
    rows = {row["parameter"]: row for row in list_estimates(found)}
    truth, middle = models.paths(reality.model), models.paths(found.model)
    delay = "latency.ball_observation"  # against the joints' delay, which is left as believed
    truth[delay] += models.paths()["latency.abb_observation"] - truth["latency.abb_observation"]
    for path in ("ball.paddle.restitution", "ball.paddle.tangential_gain", delay):
        open_ = PRIOR[path][1] - PRIOR[path][0]
        assert abs(middle[path] - truth[path]) < open_ / 6.0 and rows[path]["high"] - rows[path]["low"] < open_ / 3.0


def test_a_prior_with_an_unknown_path_is_refused():
    with pytest.raises(ValueError, match="identification.prior.*did you mean 'ball.table.friction'"):
        identification.read_prior({"ball.table.fricton": [0.1, 0.2]}, "identification.prior")


def test_rows_of_a_world_name_what_moved_or_is_drawn():
    world = ModelFile(
        models.with_values(SimModel(), {"ball.table.friction": 0.2}),
        identification.read_prior({"ball.paddle.restitution": [0.8, 0.9]}, "prior"),
    )
    rows = {row["parameter"]: (row["low"], row["high"]) for row in list_estimates(world)}
    assert rows == {"ball.table.friction": (0.2, 0.2), "ball.paddle.restitution": (0.8, 0.9)}
    nothing = replace(world, model=SimModel(), randomise=())
    assert list_estimates(nothing) == []
