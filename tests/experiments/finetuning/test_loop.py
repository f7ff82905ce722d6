"""Fine-tuning: what an update does, what a kill leaves, what the operator may do, what comes out at the end."""

from __future__ import annotations

import csv
import json
import math
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from io import StringIO
from pathlib import Path

import jax
import numpy as np
import pytest
import yaml
from rich.console import Console

from bgs import strategy
from experiments.config import build
from experiments.config import experiment as config
from experiments.config.finetuning import FineTuning
from experiments.errors import RunError
from experiments.finetuning import loop
from experiments.finetuning.journal import TRAINING, Entry, Journal
from experiments.finetuning.robot import LockStepRobot, Operator, PlayedBall
from experiments.runs import checkpoint, load_policy, metrics
from experiments.runs.run_dir import Run
from mjx_tt.env.policy import Policy, initial_theta
from robot_io import contract
from robot_io.control.episode import EpisodeSummary
from robot_io.emulator.opponent import Throws
from robot_io.policy import artefact as artefacts
from robot_io.policy import export
from tests.support.paths import ROOT

MEAN = np.linspace(-0.3, 0.4, contract.N_OBSERVATION, dtype=np.float32)
INVERSE_SCALE = np.linspace(1.0, 3.0, contract.N_OBSERVATION, dtype=np.float32)
BALLS = 12
LOCK_STEP_DRIVER = """
import sys
from pathlib import Path
from mjx_tt import platform
platform.configure(1, cache=Path(".cache/jax"))
from tests.experiments.finetuning import test_loop
test_loop.lock_step_run(sys.argv[1], sys.argv[2])
"""


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    """An artefact of a policy that knows nothing yet."""
    folder = tmp_path_factory.mktemp("policy") / "artefact"
    experiment = config.parse({"name": "source", "balls": "player3/M0"}, "test")
    theta = np.asarray(initial_theta(jax.random.key(3), 0.1))
    export.write(folder, Policy(theta, MEAN, INVERSE_SCALE), {"config": experiment.to_dict()})
    return folder


class Toy:
    """A "robot" that is the better, the nearer three parameters are to their optimum; keeps what it plays."""

    repeatable = True

    def __init__(self, fault_at: int | None = None) -> None:
        self.played: list[tuple[np.ndarray, np.ndarray, np.ndarray, int]] = []
        self.fault_at = fault_at

    def play(self, policy, episode_number) -> PlayedBall:
        theta = policy.theta
        self.played.append((theta.copy(), policy.mean.copy(), policy.inv_std.copy(), episode_number))
        noise = np.random.default_rng(episode_number).normal()
        closest = 0.2 + float(np.linalg.norm(theta[:3] - 0.3)) + 0.002 * noise
        fault = "limit" if episode_number == self.fault_at else None
        return PlayedBall(summary(closest=closest, number=episode_number, fault=fault), flight(episode_number))

    def describe(self) -> dict:
        return {"robot": "toy"}


def summary(outcome: str = "missed", closest: float = 0.2, number: int = 1, **changes) -> EpisodeSummary:
    made = EpisodeSummary(number, number, 1.0, 2.0, 40, outcome, closest, False, 0.0, (0.0, -1.37))
    return replace(made, **changes)


def flight(seed: int = 0, n: int = 5) -> np.ndarray:
    return np.column_stack([np.arange(n) * 0.008, np.random.default_rng(seed).normal(size=(n, 3))])


def quiet() -> Console:
    return Console(file=StringIO(), width=120)


def tune(source: Path, folder: Path, robot, operator=None, **settings):
    wanted = {"updates": 3, "num_directions": 3, "repeats": 2, "evaluation_balls": 4} | settings
    return loop.finetune(source, FineTuning(**wanted), Run(folder), robot, quiet(), operator)


def entries(folder: Path) -> list[Entry]:
    return Journal(folder / loop.JOURNAL).entries


def last_theta(folder: Path) -> np.ndarray:
    return checkpoint.read_latest(folder / "checkpoints")[0]["bgs.theta"]


@pytest.fixture(scope="module")
def whole(source, tmp_path_factory) -> Path:
    """A run that nothing disturbed."""
    tune(source, folder := tmp_path_factory.mktemp("runs") / "whole", Toy())
    return folder


# Settings and rewards


def test_reward_terms_of_a_real_episode():
    at_target = summary("returned", crossed=True, net_height=0.35, landing=(0.0, 0.685))
    assert loop.reward_terms(at_target) == pytest.approx(
        {"state_transition": 5.0, "net_clearance": 1.0, "hit_and_land": 1.0, "fault": 0.0}, abs=1e-6
    )
    beside = loop.reward_terms(summary("hit", crossed=True, net_height=0.60, landing=(0.7, 0.685)))
    assert beside["state_transition"] == pytest.approx(3.0 + 0.5 + 0.5 * math.exp(-1.0), abs=1e-6)
    assert beside["net_clearance"] == pytest.approx(math.exp(-1.0), abs=1e-6)
    missed = loop.reward_terms(summary("missed", closest=0.25, fault="clearance"))
    assert missed["state_transition"] == pytest.approx(3.0 * math.exp(-1.0), abs=1e-6)
    assert (missed["net_clearance"], missed["hit_and_land"], missed["fault"]) == (0.0, 0.0, -2.0)


# Updates


def test_an_update_follows_the_journal_by_the_papers_rule(source, tmp_path):
    """theta and every member are computed again in NumPy from the returns in the journal."""
    toy, settings = Toy(fault_at=9), FineTuning(updates=2, num_directions=3, repeats=2, evaluation_balls=2)
    tune(source, tmp_path / "run", toy, updates=2, evaluation_balls=2)
    theta = load_policy.load(source).policy.theta.astype(np.float32)
    bgs = build.bgs_config(settings.optimiser(), 2)
    trained = [entry for entry in entries(tmp_path / "run") if entry.phase == TRAINING]
    assert [entry.episode for entry in trained] == list(range(24))
    assert trained[9].terms["fault"] == -2.0
    thetas = {number: played for played, _, _, number in toy.played}
    for update in (1, 2):
        key = jax.random.fold_in(build.key(0, build.INITIAL_STATE), update - 1)
        directions = np.asarray(strategy.ask(key, strategy.init(theta, bgs), bgs).directions)
        assert directions.T @ directions == pytest.approx(976 * np.eye(3), abs=0.01)
        returns = np.zeros((6, 2))
        for entry in (entry for entry in trained if entry.update == update):
            sign = 1 if entry.member < 3 else -1
            member = theta + sign * np.float32(0.025) * directions[:, entry.member % 3]
            np.testing.assert_allclose(thetas[entry.episode], member, atol=1e-6)
            assert entry.returns == pytest.approx(
                entry.terms["state_transition"]
                + entry.terms["net_clearance"]
                + 0.1 * entry.terms["hit_and_land"]
                + entry.terms["fault"]
            )
            returns[entry.member, entry.repeat] = entry.returns
        plus, minus = np.split(returns.mean(axis=1), 2)
        elite = np.argsort(-np.abs(plus - minus))[: int(0.6 * 3)]
        std = np.concatenate([plus[elite], minus[elite]]).std()
        theta = theta + 0.00375 / (len(elite) * std) * directions[:, elite] @ (plus - minus)[elite]
        theta = theta.astype(np.float32)
    np.testing.assert_allclose(last_theta(tmp_path / "run"), theta, atol=1e-5)


class Observing(Toy):
    """Says what the policy saw, and keeps it."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[np.ndarray] = []

    def play(self, policy, episode_number) -> PlayedBall:
        played = super().play(policy, episode_number)
        self.seen.append(np.random.default_rng(episode_number).normal(1.0, 2.0, (40, contract.N_OBSERVATION)))
        sums = self.seen[-1].sum(axis=0), (self.seen[-1] ** 2).sum(axis=0)
        return replace(played, summary=replace(played.summary, observed=tuple(np.concatenate(sums).tolist())))


def test_observations_of_an_update_are_merged_where_it_is_asked_for(source, tmp_path):
    """By NumPy over all that was seen in training, with the two observations that an artefact counts for."""
    robot = Observing()
    tune(source, tmp_path / "run", robot, observation_statistics="merged", updates=2)
    half = 1.0 / INVERSE_SCALE / np.sqrt(2.0)
    seen = np.concatenate([[MEAN - half, MEAN + half], *robot.seen[4:16]])
    for number in (4, 15):
        np.testing.assert_allclose(robot.played[number][1], MEAN, rtol=1e-6)
    for number in (16, 27):
        np.testing.assert_allclose(robot.played[number][1], seen.mean(axis=0), atol=1e-5)
        np.testing.assert_allclose(robot.played[number][2], 1.0 / seen.std(axis=0, ddof=1), rtol=1e-4)
    exported = artefacts.load(tmp_path / "run" / "artefact").policy
    seen = np.concatenate([seen, *robot.seen[16:28]])
    np.testing.assert_allclose(exported.mean, seen.mean(axis=0), atol=1e-5)


def test_it_climbs_and_the_report_says_so(source, tmp_path):
    easy = {"updates": 150, "num_directions": 8, "repeats": 1, "elite_fraction": 1.0, "evaluation_balls": 10}
    report = tune(source, tmp_path / "run", Toy(), **easy)
    assert report["difference"]["paired"] and report["difference"]["significant"]
    assert report["difference"]["low"] > 0
    assert json.loads((tmp_path / "run" / "evaluation.json").read_text()) == report
    rows = metrics.read(tmp_path / "run" / "metrics.jsonl")
    assert [row["update"] for row in rows] == list(range(1, 151))
    assert all(row["low"] <= row["mean_return"] <= row["high"] for row in rows)
    assert list((tmp_path / "run" / "tensorboard").iterdir())
    assert (tmp_path / "run" / "plots" / loop.CURVE).stat().st_size > 10_000


def test_the_artefact_is_what_the_robot_played_last(source, tmp_path):
    toy = Toy()
    tune(source, tmp_path / "run", toy, ema_decay=0.5)
    exported = artefacts.load(tmp_path / "run" / "artefact")
    theta, mean, inverse_scale, _ = toy.played[-1]
    np.testing.assert_array_equal(exported.policy.mean, mean)
    np.testing.assert_array_equal(exported.policy.inv_std, inverse_scale)
    np.testing.assert_array_equal(exported.policy.theta, theta)
    np.testing.assert_array_equal(
        toy.played[0][0], load_policy.load(source).policy.theta
    )  # before: the policy as it came
    np.testing.assert_allclose(mean, MEAN, rtol=1e-6)
    np.testing.assert_allclose(inverse_scale, INVERSE_SCALE, rtol=1e-6)


def test_the_run_can_be_trained_from_and_tuned_again(whole, tmp_path):
    loaded = load_policy.load(whole)
    theta, _ = load_policy.load_statistics(whole)
    np.testing.assert_array_equal(theta, last_theta(whole))
    assert loaded.config.name == "whole" and loaded.config.balls == "player3/M0"
    again = Toy()
    tune(whole, tmp_path / "second", again, updates=1)
    np.testing.assert_array_equal(again.played[0][0], theta)


# Interruptions


@pytest.mark.slow
def test_killed_at_random_moments_it_ends_in_the_same_parameters(source, tmp_path):
    """The emulated robot, SIGKILL three times; against a run that nothing disturbs."""
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    command = [sys.executable, "-c", LOCK_STEP_DRIVER, str(source)]
    chance = random.Random(5)
    for mark in (2, 5, 8):
        process = subprocess.Popen([*command, str(killed)], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        while process.poll() is None and _lines(killed / loop.JOURNAL) < mark:
            time.sleep(0.02)
        assert process.poll() is None, process.stdout.read().decode()
        time.sleep(0.3 * chance.random())
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        assert _lines(killed / loop.JOURNAL) >= mark
    done = subprocess.run([*command, str(killed)], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    lock_step_run(str(source), str(whole))
    np.testing.assert_array_equal(last_theta(killed), last_theta(whole))
    assert (killed / "human_balls.csv").read_text().replace("killed", "whole") == (
        whole / "human_balls.csv"
    ).read_text()
    assert [_plain(entry) for entry in entries(killed)] == [_plain(entry) for entry in entries(whole)]


def lock_step_run(source: str, folder: str) -> None:
    """In a process of its own: a few balls on the emulated robot."""
    settings = FineTuning(updates=2, num_directions=2, repeats=1, evaluation_balls=2)
    loop.finetune(source, settings, Run(folder), LockStepRobot(throws()), Console())


def throws(n: int = BALLS) -> Throws:
    """Balls of a person without much imagination."""
    chance = np.random.default_rng(2)
    low, high = np.array([[-0.2, 0.9, 0.2, -0.2, -4.8, 1.2], [0.2, 1.1, 0.3, 0.2, -4.4, 1.5]])
    balls = chance.uniform(low, high, (n, 6)).T
    return Throws(balls[:3], balls[3:], np.zeros((3, n)))


def _lines(path: Path) -> int:
    return path.read_bytes().count(b"\n") if path.exists() else 0


def _plain(entry: Entry) -> dict:
    return asdict(entry) | {"trajectory": entry.trajectory.tolist()}


def test_a_run_of_an_earlier_version_goes_on(source, tmp_path):
    tune(source, tmp_path / "run", Toy(), updates=1)
    file = tmp_path / "run" / loop.SETTINGS
    recorded = yaml.safe_load(file.read_text())
    del recorded["settings"]["observation_statistics"]
    file.write_text(yaml.safe_dump(recorded))
    tune(source, tmp_path / "run", Toy(), updates=2)
    with pytest.raises(RunError, match="observation_statistics"):
        tune(source, tmp_path / "run", Toy(), updates=2, observation_statistics="merged")


class Interrupted(Exception):
    """Stands for a power cut."""


class Failing(Toy):
    """Loses power in an episode."""

    def __init__(self, after: int) -> None:
        super().__init__()
        self.left = after

    def play(self, *arguments) -> PlayedBall:
        if not self.left:
            raise Interrupted
        self.left -= 1
        return super().play(*arguments)


@pytest.mark.parametrize("after", [0, 4, 9, 16])
def test_no_more_than_the_episode_in_play_is_lost(source, whole, tmp_path, after):
    with pytest.raises(Interrupted):
        tune(source, tmp_path / "cut", Failing(after))
    assert len(entries(tmp_path / "cut")) == after
    rest = Toy()
    tune(source, tmp_path / "cut", rest)
    assert len(rest.played) == 3 * 12 + 2 * 4 - after
    np.testing.assert_array_equal(last_theta(tmp_path / "cut"), last_theta(whole))
    assert len(metrics.read(tmp_path / "cut" / "metrics.jsonl")) == 3


def test_it_continues_from_the_journal_when_checkpoints_are_gone(source, whole, tmp_path):
    run = shutil.copytree(whole, tmp_path / "whole")
    shutil.rmtree(run / "checkpoints")
    rest = Toy()
    tune(source, run, rest)
    assert not rest.played
    np.testing.assert_array_equal(last_theta(run), last_theta(whole))


@pytest.fixture
def journal(source, tmp_path) -> Path:
    """The journal of a run that lost power in its ninth episode."""
    with pytest.raises(Interrupted):
        tune(source, tmp_path / "run", Failing(8))
    return tmp_path / "run" / loop.JOURNAL


def test_half_a_line_is_dropped_and_its_episode_played_again(source, whole, journal):
    content = journal.read_bytes()
    for cut in (1, 50, len(content.splitlines()[-1])):
        journal.write_bytes(content[:-cut])
        assert len(entries(journal.parent)) == 7
    tune(source, journal.parent, Toy())
    assert journal.read_bytes() == (whole / loop.JOURNAL).read_bytes()


def test_a_journal_that_was_changed_is_refused(journal):
    lines = journal.read_bytes().splitlines(keepends=True)
    assert b'"discarded": false' in lines[2]
    changes = {
        "nonsense": [*lines[:2], b"nonsense\n", *lines[3:]],
        "changed": [*lines[:2], lines[2].replace(b'"discarded": false', b'"discarded": true'), *lines[3:]],
        "doubled": [*lines[:2], lines[1], *lines[2:]],
        "taken out": [*lines[:2], *lines[3:]],
        "exchanged": [*lines[:2], lines[3], lines[2], *lines[4:]],
        "the last one changed": [*lines[:-1], lines[-1].replace(b'"discarded": false', b'"discarded": true')],
    }
    for change, content in changes.items():
        journal.write_bytes(b"".join(content))
        with pytest.raises(RunError, match=f"line {len(lines) if 'last' in change else 3} was changed"):
            Journal(journal)


def test_a_journal_from_before_there_were_checksums_goes_on(source, whole, journal):
    old = re.sub(rb', "checksum": "[0-9a-f]+"', b"", journal.read_bytes())
    journal.write_bytes(old)
    tune(source, journal.parent, Toy())
    assert len(entries(journal.parent)) == len(entries(whole))
    journal.write_bytes(journal.read_bytes().replace(b'"discarded": false', b'"discarded": true', 1))
    with pytest.raises(RunError, match=f"line {len(old.splitlines()) + 1} was changed, or lines before it"):
        Journal(journal)


def test_another_fine_tuning_in_the_same_folder_is_refused(source, whole):
    with pytest.raises(RunError, match=r"settings\.sigma: the run has 0\.025, now 0\.05"):
        tune(source, whole, Toy(), sigma=0.05)
    with pytest.raises(RunError, match="updates = 1"):
        tune(source, whole, Toy(), updates=1)


def test_a_start_that_failed_does_not_stand_in_the_way_of_the_corrected_one(source, whole, tmp_path):
    class Absent(Toy):
        def play(self, *arguments) -> PlayedBall:
            raise RunError("no robot answers")

    with pytest.raises(RunError, match="no robot answers"):
        tune(source, tmp_path / "run", Absent(), sigma=0.05)
    tune(source, tmp_path / "run", Toy())
    np.testing.assert_array_equal(last_theta(tmp_path / "run"), last_theta(whole))
    assert yaml.safe_load((tmp_path / "run" / loop.SETTINGS).read_text())["settings"]["sigma"] == 0.025


def test_a_finished_run_goes_on_when_more_updates_are_asked_for(source, whole, tmp_path):
    tune(source, tmp_path / "run", Toy(), updates=2)
    report = tune(source, tmp_path / "run", Toy())
    assert report["updates"] == 3 and report["after"]["balls"] == 4 and report["difference"]["paired"]
    np.testing.assert_array_equal(last_theta(tmp_path / "run"), last_theta(whole))


# The operator


class Person(Operator):
    """Discards the balls of these numbers, some of them late, stops after so many balls, pauses for some looks once."""

    def __init__(self, discards=(), stop_after: int | None = None, looks: int = 0, late=()) -> None:
        self.asked, self._discards, self._stop_after, self.looks = 0, set(discards), stop_after, looks
        self._late = set(late)

    def retracts(self, seconds: float = 0.0) -> bool:
        wanted = self.asked - 1 in self._late
        self._late.discard(self.asked - 1)
        return wanted

    def discarded(self) -> bool:
        self.asked += 1
        return self.asked - 1 in self._discards

    def paused(self) -> bool:
        self.looks -= 1
        return self.looks >= 0

    def stopped(self) -> bool:
        return self.asked == self._stop_after


def test_discarded_balls_are_played_again_with_other_balls(source, tmp_path):
    person = Person(discards={1, 6, 7})
    report = tune(source, tmp_path / "run", Toy(), person)
    found = entries(tmp_path / "run")
    assert report["discarded"] == 3 and [entry.discarded for entry in found[:9]] == [i in (1, 6, 7) for i in range(9)]
    kept = [entry for entry in found if not entry.discarded]
    assert len(kept) == len({entry.slot for entry in kept}) == 3 * 12 + 2 * 4
    assert len({(entry.phase, entry.episode) for entry in found}) == len(found)
    assert not report["difference"]["paired"]  # other balls before than after
    rows = list(csv.DictReader(open(tmp_path / "run" / "human_balls.csv")))
    assert len({row["trajectory"] for row in rows}) == 3 * 12 + 4


def test_a_ball_that_is_discarded_late_is_played_again(source, tmp_path):
    """The one before the newest, the last of an evaluation (number 3), the last of an update (number 16)."""
    report = tune(source, tmp_path / "run", Toy(), Person(late={1, 4, 18}))
    found = entries(tmp_path / "run")
    kept = [entry for entry in found if not entry.discarded]
    assert report["discarded"] == 3 and [i for i, entry in enumerate(found) if entry.discarded] == [1, 4, 18]
    assert len(kept) == len({entry.slot for entry in kept}) == 3 * 12 + 2 * 4
    tune(source, tmp_path / "early", Toy(), Person(discards={1, 4, 18}))
    np.testing.assert_array_equal(last_theta(tmp_path / "run"), last_theta(tmp_path / "early"))


def test_what_the_bridge_discards_or_the_operators_stop_ends_does_not_count(source, tmp_path):
    class Stopped(Toy):
        def play(self, *arguments) -> PlayedBall:
            played = super().play(*arguments)
            human = {5: {"human_fault": "net"}, 6: {"human_fault": "long"}}  # replayed by themselves
            others = {7 + i: {"fault": cause} for i, cause in enumerate(others_faults)}  # tracker, network, operator
            own = {20: {"fault": "clearance"}, 21: {"fault": "arm_not_ready"}}
            bad = (human | others | own | {2: {"fault": "stopped"}, 3: {"discarded": True}}).get(len(self.played), {})
            return PlayedBall(replace(played.summary, **bad), played.trajectory)

    others_faults = ("stale_tracker", "clock", "stale_arm", "stale_axes", "estop", "operator", "timing", "stale_policy")
    report = tune(source, tmp_path / "run", Stopped())
    assert report["discarded"] == 4 + len(others_faults)
    assert report["before"]["balls"] == 4 and not report["before"]["faults"]
    kept = [entry for entry in entries(tmp_path / "run") if not entry.discarded]
    assert [entry.summary.fault for entry in kept if entry.summary.fault] == ["clearance", "arm_not_ready"]


def test_stop_and_continue_and_pause(source, whole, tmp_path):
    assert tune(source, tmp_path / "run", Toy(), Person(stop_after=11)) is None
    assert len(entries(tmp_path / "run")) == 11
    person = Person(looks=3)
    assert tune(source, tmp_path / "run", Toy(), person) is not None
    assert person.looks < 0
    np.testing.assert_array_equal(last_theta(tmp_path / "run"), last_theta(whole))
