"""A study on the emulated robot: what its logs identify, rallies over several sessions, the choice among seeds."""

from __future__ import annotations

import io
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from ballmodel.trajectory import Trajectory
from experiments import measurements
from experiments.config import study as study_config
from experiments.config.study import PRIOR
from experiments.deploy import play, session_logs
from experiments.deploy.virtual_player import VirtualPlayer
from experiments.errors import RunError
from experiments.finetuning import loop
from experiments.finetuning.robot import LockStepRallies
from experiments.runs import load_policy
from experiments.runs.run_dir import Run
from experiments.study import identification
from experiments.study.analysis import scoring
from experiments.study.analysis.identified import LOGS, list_estimates
from experiments.study.target_domain import play_on_robot
from experiments.study.target_domain.lab_logs import AWAY, count_visible
from experiments.study.target_domain.play_on_robot import make_rally_step
from experiments.study.workflow import derive_seed
from experiments.training import sweep
from experiments.training.sweep import Job
from mjx_tt.diagnosis.logs import ROBOT_FILES
from mjx_tt.sim.model import ModelFile, SimModel
from robot_io import log
from robot_io.emulator.config import RigParams
from robot_io.errors import RefusedError
from robot_io.policy import artefact as artefacts
from tests.support.paths import ROOT

POLICY = ROOT / "experiments/shipped/policies/quickstart"
PLAYED, LATE = 40, 0.02  # balls of a session; [s] by which the second robot obeys later


def world() -> play_on_robot.RobotWorld:
    data = {"name": "x", "robot": "rig", "simulation": {"rounds": [{"simulated": 1, "real": 1}] * 3}}
    return play_on_robot.RobotWorld(study_config.parse(data, "study"), "rig", None)


def test_a_rallys_track_is_parted_at_the_persons_strokes():
    """To the robot and back twice, then away: a zigzag with noise; parts begin where the person hit."""
    places = [(0.0, 1.4), (0.5, -1.3), (1.0, 1.2), (1.5, -1.2), (2.0, 1.5), (2.2, 1.45)]
    time = np.arange(0.0, 2.2, 0.008)
    y = np.interp(time, *zip(*places, strict=True)) + np.random.default_rng(0).normal(0.0, 0.003, time.size)
    track = Trajectory("s", "1", time, np.stack([0.0 * y, y, 0.2 + 0.0 * y]))
    parts = session_logs.split_by_stroke(track)
    assert [round(float(p.time[0]), 1) for p in parts] == [0.0, 1.0] and sum(map(len, parts)) == time.size
    assert all(p.position[1].min() < -1.1 < 1.1 < p.position[1, 0] for p in parts)


def test_a_fine_tuning_without_a_log_is_told_so(tmp_path):
    with pytest.raises(RunError, match="holds no session's log"):
        world().hits("player3", tmp_path, tmp_path, "x")


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    path = tmp_path_factory.mktemp("served") / "D0.csv"
    balls = play_on_robot.serve_balls("player3", 40, 3, "D0")
    assert len(balls) == 40 and all(t.position[1, 0] > 0.5 and t.position[1].min() < 0.0 for t in balls)
    measurements.write_csv(path, balls)
    return path


def identified(folder, served, late: float):
    """Parameters that the logs decide, of a robot in rallies."""
    player, policy = VirtualPlayer("player3", 1), load_policy.load(POLICY).policy.astype(np.float32)
    player.prepare()
    with log.FileRecorder(folder, "session", {}, {}, 0.0, 0) as recorder:
        rallies = LockStepRallies(player, RigParams(action_delay=late), recorder=recorder)
        hit = sum(rallies.play(policy, k).summary.outcome != "missed" for k in range(PLAYED))
    found = world().hits("player3", folder, folder, "x")
    identification.write_hits(folder / "hits", found.balls, found.joints)
    logs = [served, *(folder / "hits" / file for file in ROBOT_FILES)]
    believed, before = ModelFile(SimModel()), identification.read_prior(PRIOR, "prior")
    made = identification.identify(logs, 400, believed, before, [folder / "hits"])
    # Of balls that were hit nearly all are used, and no others.
    assert 0.6 * hit < made.provenance["identified"]["hits"] <= hit + 1
    return {row["parameter"]: row for row in list_estimates(made) if row["decided by"] == LOGS}


@pytest.mark.slow
@pytest.mark.optimised
def test_sessions_of_the_emulated_robot_show_by_how_much_it_obeys_later(tmp_path, served):
    (tmp_path / "as_built").mkdir()
    (tmp_path / "late").mkdir()
    built, late = identified(tmp_path / "as_built", served, 0.0), identified(tmp_path / "late", served, LATE)
    # The arm's alone. The axes play little and their drives are stiff: there the interval misses the truth, -0.03 s
    # (-0.07 to 0.01) for 0.02 s, which is an open fault of the identification.
    rows = [robot["latency.abb_action"] for robot in (built, late)]
    change = sum(rows[1][end] - rows[0][end] for end in ("low", "high")) / 2.0
    open_ = sum(row["high"] - row["low"] for row in rows)
    assert abs(change - LATE) < open_ / 2.0 + 0.001 and open_ / 2.0 < 0.003, (change, open_)
    assert all(row["low"] < row["high"] for row in (built["ball.paddle.restitution"], late["drives.joint_2.lag"]))
    # The rig's ball is lifted by no spin.
    lift = built["ball.flight.magnus_coefficient"]
    assert abs(lift["low"] + lift["high"]) < 0.2


@pytest.mark.slow
@pytest.mark.optimised
def test_without_a_log_of_the_joints_the_drives_are_drawn_from_the_prior(served):
    before = identification.read_prior(PRIOR, "prior")
    made = identification.identify([served], 60, ModelFile(SimModel()), before)
    rows = {row["parameter"]: row for row in list_estimates(made)}
    assert made.provenance["identified"]["joints"] == {} and rows["drives.joint_2.lag"]["decided by"] == "prior"
    for path in ("drives.joint_2.lag", "latency.abb_action", "latency.abb_observation"):
        assert [rows[path]["low"], rows[path]["high"]] == PRIOR[path]
    assert rows["ball.table.restitution"]["decided by"] == LOGS


class Sessions:
    """Stands in for the rig: plays rallies of growing length in sessions that end as they are told.

    plan: of each session (rallies that count, its end): an exit status, an exception, or None, killed without a report
    """

    def __init__(self, plan) -> None:
        self.plan, self.chances, self.asked, self.length = list(plan), [], [], 0

    def run(self, artefact, robot, folder, console, setup, rallies):
        assert setup.backend == "auto"  # the jitted policy, as mjx-tt run
        self.chances.append(setup.seed)
        self.asked.append(rallies)
        count, end = self.plan.pop(0)
        told = [self._rally("FIRST_NET", True)]  # each session has one that is filtered
        told += [self._rally("ROBOT_MISSED", False) for _ in range(min(count, rallies))]
        if end is not None:
            report = {"artefact_sha256": artefacts.load(artefact).digest, "rallies": {"list": told}}
            name = f"20260101-00000{len(self.chances)}"
            (folder / f"{name}.json").write_text(json.dumps(report))
            (folder / f"{name}.layout.json").write_text("{}")
        if not isinstance(end, int):
            raise end or RefusedError("killed")
        return end

    def _rally(self, end: str, filtered: bool) -> dict:
        self.length += 1
        return {"length": self.length, "end": end, "filtered": filtered}


@pytest.fixture
def run(tmp_path):
    """A policy that is exported already, and the folder of its evaluation."""
    (tmp_path / "rallies").mkdir()
    return Path(shutil.copytree(POLICY, tmp_path / "run"))


def step_of(run, monkeypatch, plan, rallies=10):
    """The step of a zero-shot policy, and the sessions that it will have."""
    rig, folder = Sessions(plan), run.parent / "rallies"
    monkeypatch.setattr(play, "run", rig.run)
    monkeypatch.setattr(play_on_robot, "export_once", lambda trained, console: run)
    who = (0, "player3", "player3", "zero_shot")
    return make_rally_step(folder, who, lambda: run, (), rallies, Console(file=io.StringIO())), rig


def test_a_failed_evaluation_goes_on_with_what_it_played(run, monkeypatch):
    step, rig = step_of(run, monkeypatch, [(3, 1), (2, 1), (2, 1), (5, 0)])
    with pytest.raises(RunError, match="3 are missing.*goes on with those that were played"):
        step.run()
    assert rig.asked == [10, 7, 5]
    step.run()
    assert rig.asked[3:] == [3] and not rig.plan
    assert rig.chances == [derive_seed(step.name) + k for k in range(4)]
    counted = scoring.read(step.outputs[0])
    np.testing.assert_array_equal(counted.length, np.arange(1, 15))  # every rally once, in the order of play
    assert (~counted.filtered).sum() == 10


@pytest.mark.parametrize("end", [play.INTERRUPTED, OSError("the pipe broke"), None])
def test_a_session_that_is_stopped_or_raises_counts_if_it_has_a_report(run, monkeypatch, end):
    step, rig = step_of(run, monkeypatch, [(4, end), (9, 0), (1, 0)])
    with pytest.raises((KeyboardInterrupt, OSError, RefusedError)):
        step.run()
    if end is None:
        rig.plan = [(10, 0)]
    step.run()
    assert rig.asked == [10, 10 if end is None else 6]
    assert rig.chances == [derive_seed(step.name), derive_seed(step.name) + (end is not None)]
    assert (~scoring.read(step.outputs[0]).filtered).sum() == 10


def test_a_policy_that_was_trained_anew_is_evaluated_anew(run, monkeypatch):
    step, rig = step_of(run, monkeypatch, [(4, 1), (0, 0), (10, 0)])
    with pytest.raises(RunError):
        step.run()
    folder = run.parent / "rallies"
    for path in folder.glob("2*[0-9].json"):
        path.write_text(path.read_text().replace(artefacts.load(run).digest, "another"))
    step.run()
    assert rig.asked == [10, 6, 10]


BALLS = 3  # by which a test chooses


def score(trained, robot, balls, seed, console) -> float:
    assert robot == "lockstep" and balls == 50  # the paper's number, of which a test plays fewer
    return play_on_robot.score(trained, robot, BALLS, seed, console)


@pytest.mark.slow
def test_the_seed_that_plays_best_on_the_emulated_robot_is_chosen(tmp_path, monkeypatch):
    """The shipped policy against the same with its commands turned round; by hand from the robot's own words."""
    monkeypatch.setattr(loop, "LOCK_STEP_BALLS", 64)
    good = load_policy.load(POLICY)
    bad = replace(good, policy=replace(good.policy, theta=-good.policy.theta))
    robot = loop.lock_step_robot(loop.experiment_of(POLICY), seed=good.config.evaluation.seed + 1)
    worth = []
    for trained in (good, bad):
        played = [robot.play(trained.policy.astype(np.float32), n).summary for n in range(BALLS)]
        points = {"missed": 0, "hit": 1, "returned": 2}
        worth.append(sum(-2 if one.fault else points[one.outcome] for one in played) / BALLS)
    assert worth[0] > worth[1]
    assert play_on_robot.score(bad, "lockstep", BALLS, good.config.evaluation.seed + 1, Console()) == worth[1]
    jobs = [Job(good.config, Run(tmp_path / "seed0"), "test")]
    shutil.copytree(POLICY, jobs[0].run.folder)
    sweep.select(tmp_path, jobs, Console(file=io.StringIO()), "lockstep", score)
    selection = json.loads((tmp_path / "selection.json").read_text())
    assert selection["robot"] == "lockstep" and selection["scores"] == {"seed0": worth[0]}


RATE = 125.0  # [Hz]


def thrown(height: float, up: float, seconds: float = 1.4) -> np.ndarray:
    """A parabola from behind the player's end of the table, (3, T) [m]."""
    t = np.arange(round(seconds * RATE)) / RATE
    return np.stack([0.0 * t, 1.7 - 3.0 * t, height + up * t - 4.905 * t**2])


@pytest.mark.parametrize(("height", "up"), [(0.3, 1.0), (-0.07, 2.5), (-0.4, 3.5)])
def test_a_ball_is_seen_until_it_falls_below_the_table_however_low_it_was_struck(height, up):
    low = -0.03  # under the table's plane
    falls_below = (up + (up**2 + 4.0 * 4.905 * (height - low)) ** 0.5) / 9.81  # [s]
    assert count_visible(thrown(height, up)) / RATE == pytest.approx(falls_below, abs=1.01 / RATE)


def test_a_ball_is_seen_until_it_passes_the_robot_or_comes_back_past_the_player():
    passing = thrown(0.3, 7.0)
    assert count_visible(passing) / RATE == pytest.approx(4.0 / 3.0, abs=1.01 / RATE)
    back, t = passing.copy(), np.arange(passing.shape[1]) / RATE
    back[1] = np.where(t < 0.3, 1.7 - 3.0 * t, 0.8 + 3.0 * (t - 0.3))  # where it was struck again after 0.6 s
    assert count_visible(back) / RATE == pytest.approx(0.6 + AWAY / 3.0, abs=1.01 / RATE)
