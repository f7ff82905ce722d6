"""``mjx-tt run`` on the rig: real processes, real sockets, real time; and what is refused before anything moves."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.reader import make_reader
from rich.console import Console

from experiments.config import robot
from experiments.deploy import control_session as sessions
from experiments.deploy import play
from experiments.deploy.control_session import ControlSession
from experiments.deploy.rig import rig_for
from experiments.errors import explained
from experiments.options import RIG, RobotOptions
from robot_io import contract, log
from robot_io.control import process
from robot_io.control.config import RobotConfig
from robot_io.emulator.processes import Rig, free_ports
from robot_io.errors import JogFirstError, RefusedError
from robot_io.limits import LIMITS
from robot_io.policy import artefact, export
from robot_io.policy.policy import Policy
from robot_io.safety.owner_watch import LONGEST_SILENCE
from tests.support.paths import ROOT
from tests.support.simulated_control import Simulated


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """An artefact with small random weights: the robot moves, but hits nothing on purpose."""
    folder = tmp_path_factory.mktemp("policy") / "artefact"
    theta = 0.05 * np.random.default_rng(0).standard_normal(contract.n_parameters())
    mean, scale = np.zeros(contract.N_OBSERVATION), np.ones(contract.N_OBSERVATION)
    export.write(folder, Policy(theta, mean, scale), {"config": {"balls": "narrow"}})
    return folder


def run(policy, log_folder, balls=None) -> tuple[int, str]:
    """Exit status and everything printed, as the command line gives them."""
    console = Console(record=True, width=200)
    try:
        status = play.run(policy, RIG, log_folder, console, RobotOptions(backend="numpy"), balls)
    except Exception as error:
        if not explained(error):
            raise
        return 1, str(error)
    return status, console.export_text()


@pytest.mark.realtime
@pytest.mark.smoke
def test_plays_on_the_rig_and_leaves_a_log_and_a_summary(policy, tmp_path):
    status, text = run(policy, tmp_path, balls=2)
    assert status == 0, text
    (summary,) = (json.loads(path.read_text()) for path in tmp_path.glob("*.json"))
    assert summary["episodes"] == 2 and summary["robot"] == "rig"
    assert summary["egm"]["replies"] > 100 and summary["axes_cycles"] > 100
    (path,) = tmp_path.glob("*.mcap")
    with open(path, "rb") as stream:
        topics = {channel.topic for _, channel, _ in make_reader(stream).iter_messages()}
    assert {"/ball", "/joint_states", "/tick", "/event", "/observation", "/action"} <= topics
    session = log.read(path)
    assert session.metadata and len(session.episodes) == 2
    velocity = session.commands.sent
    assert np.abs(velocity).max() > 0 and (np.abs(velocity).max(axis=1) <= np.array(LIMITS.velocity)).all()


@pytest.mark.realtime
def test_a_virtual_player_rallies_in_real_time(policy, tmp_path):
    """The policy misses; the person serves again, and log and summary agree on the rallies."""
    console = Console(record=True, width=200)
    status = play.run(policy, RIG, tmp_path, console, RobotOptions(player="player3"), rallies=2)
    text = console.export_text()
    assert status == 0 and "policy comp" in text, text  # compiled by JAX, or on a busy machine computed by NumPy
    (summary,) = (json.loads(path.read_text()) for path in tmp_path.glob("*.json"))
    played = summary["rallies"]["list"]
    assert summary["rallies"]["count"] == 2 and len(played) >= 2 and summary["player"] == "player3"
    session = log.read(summary["log"])
    logged = [json.loads(event.text) for event in session.events if event.name == "rally"]
    keys = ("number", "length", "end", "filtered")
    assert [[r[k] for k in keys] for r in logged][: len(played)] == [[r[k] for k in keys] for r in played]
    strokes = sum(event.name == "stroke" for event in session.events)
    assert strokes >= len(played) and all(rally["length"] >= 1 for rally in played)
    assert [event.text for event in session.events if event.name == "policy"][0].startswith("policy comp")


def as_in_a_terminal():
    """Signals end a program there; nohup, or an &, under which tests may run, passes on that they are ignored."""
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT):
        signal.signal(number, signal.SIG_DFL)


def started(policy, folder, *more):
    """``mjx-tt run`` on the rig as a group of its own, after its first ball."""
    program = [sys.executable, "-m", "experiments.cli"]
    command = [*program, "run", str(policy), "--robot", "rig", "--log", str(folder), *more]
    pipe = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    running = subprocess.Popen(command, cwd=ROOT, start_new_session=True, preexec_fn=as_in_a_terminal, **pipe)
    for line in running.stdout:
        if line.startswith("ball 1:"):
            break
    return running


def children(pid):
    """Processes of a parent, by number."""
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def lives(pid):
    try:
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False


def states(session_log):
    """The bridge's states in a log, each with the reason why it was entered."""
    texts = [json.loads(event.text) for event in session_log.events if event.name == "state"]
    return [(text["to"], text["why"]) for text in texts]


def apart(pid):
    """The control process of a running play: it is not of its owner's group."""
    (found,) = (child for child in children(pid) if os.getpgid(child) != os.getpgid(pid))
    return found


def summary_of(folder):
    (summary,) = (json.loads(path.read_text()) for path in folder.glob("*.json"))
    assert summary["episodes"] >= 1 and summary["egm"]["replies"] > 100
    return summary


@pytest.mark.realtime
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_signal_ends_with_the_summary(policy, tmp_path, number):
    """Ctrl-C, a terminal that closes; SIGTERM stands in one list with them."""
    with started(policy, tmp_path) as running:
        os.killpg(running.pid, number)  # the whole group, as a terminal does
        text = running.stdout.read()
    assert running.returncode == 130, text
    assert "return rate" in text and "linear axes" in text and "stopped by Ctrl-C" in text
    assert len(log.read(summary_of(tmp_path)["log"]).episodes) >= 1


@pytest.mark.realtime
def test_a_play_whose_control_process_dies_keeps_its_summary(policy, tmp_path):
    with started(policy, tmp_path) as running:
        os.kill(apart(running.pid), signal.SIGKILL)
        text = running.stdout.read()
    assert running.returncode == 1 and "the control process has ended" in text, text
    assert summary_of(tmp_path)["episodes"] >= 1


@pytest.mark.realtime
def test_an_owner_that_dies_ends_the_play_in_order(policy, tmp_path, number=signal.SIGQUIT):
    """The control process is not of its group, brakes and ends its log."""
    before = set(Path("/dev/shm").glob("psm_*"))
    with started(policy, tmp_path) as running:
        family, control = children(running.pid), apart(running.pid)
        try:
            assert os.getsid(control) == control
        finally:
            os.killpg(running.pid, number)
    assert running.returncode == -number
    end = time.monotonic() + 20.0
    while any(lives(child) for child in family):
        assert time.monotonic() < end, "processes are left behind"
        time.sleep(0.05)
    assert set(Path("/dev/shm").glob("psm_*")) <= before, "shared memory is left behind"
    (path,) = tmp_path.glob("*.mcap")
    session_log = log.read(path)
    # The rig ends with its owner, so the loss of its devices may be noticed first: a fault, which brakes as well.
    assert states(session_log)[-1][0] in ("stopping", "disarmed")
    assert np.abs(session_log.commands.sent).max() > 0 and not session_log.commands.sent[:, -1].any()


@pytest.mark.realtime
def test_play_goes_on_after_an_owner_that_stood_still(policy, tmp_path):
    """As Ctrl-Z, a stalled SSH or Ctrl-S do to it: the robot is stopped meanwhile, and on the rig armed again."""
    with started(policy, tmp_path, "--balls", "3") as running:
        os.kill(running.pid, signal.SIGSTOP)
        time.sleep(LONGEST_SILENCE + 1.5)
        os.kill(running.pid, signal.SIGCONT)
        text = running.stdout.read()
    assert running.returncode == 0, text
    assert "stopped: the operator's program was not heard for 2 s" in " ".join(text.split())
    (path,) = tmp_path.glob("*.mcap")
    found = states(log.read(path))
    silent = next(i for i, (_, why) in enumerate(found) if "was not heard" in why)
    assert [state for state, _ in found[silent : silent + 3]] == ["stopping", "disarmed", "ready"], found


def robot_at(ports) -> RobotConfig:
    axes = [{"port": port} for port in ports.axes]
    return robot.fill(
        RobotConfig, {"arm": {"port": ports.arm}, "tracker": {"port": ports.tracker}, "axes": axes}, "test"
    )


def test_port_in_use_is_refused(policy):
    ports = free_ports()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", ports.tracker))
        with pytest.raises(RefusedError, match=f"127.0.0.1:{ports.tracker}.*end the program"):
            ControlSession(robot_at(ports), process.ControlOptions(str(policy)), Console())


@pytest.mark.realtime
def test_missing_devices_are_named_and_arming_is_refused(policy, monkeypatch):
    monkeypatch.setattr(sessions, "PREPARE_TIME", 1.0)
    with ControlSession(robot_at(free_ports()), process.ControlOptions(str(policy)), Console()) as session:
        with pytest.raises(RefusedError, match="arm: No EGM packet.*axes: gantry_x is lost.*tracker: silent"):
            session.prepare(None)
        with pytest.raises(RefusedError, match="not armed: arm: No EGM packet"):
            session.arm()


def until(session, condition):
    """Take messages until a status fulfils the condition; 10 s at most."""
    end = time.monotonic() + 10.0
    while not (session.status and condition(session.status)):
        assert time.monotonic() < end
        list(session.messages(0.02))


@pytest.fixture
def on_the_simulated_clock(policy, monkeypatch):
    """A simulated control process, and its session."""
    simulated = Simulated(policy, monkeypatch)
    thread = simulated.thread(monkeypatch)
    monkeypatch.setattr(sessions, "SETTLE", 0.0)
    thread.start()
    with ControlSession(RobotConfig(), process.ControlOptions(str(policy)), Console()) as session:
        until(session, lambda status: not status.missing and not status.present)
        yield simulated, session
    assert not thread.is_alive()


def test_arming_that_is_refused_after_a_reset_can_be_tried_again(on_the_simulated_clock, monkeypatch):
    """Again and again: the emergency stop, a reset that works, axes that do not get ready at once."""
    simulated, session = on_the_simulated_clock
    bridge, simulation = simulated.control.bridge, simulated.simulation

    def press(pressed):
        simulated.script.append((0.0, lambda: bridge.gate.estop(pressed, simulation.now)))

    session.arm()
    for _ in range(3):
        press(True)
        until(session, lambda status: status.state == "fault")
        with pytest.raises(RefusedError, match="cannot reset while a cause is present: ESTOP"):
            session.reset()
        press(False)
        until(session, lambda status: not status.present)
        session.reset()
        assert session.status.state == "disarmed"
        monkeypatch.setattr(simulation.axes, "problem", lambda _: "gantry_x is switched off")
        for _ in range(2):
            with pytest.raises(RefusedError, match="not armed: axes: gantry_x is switched off"):
                session.arm()
            session.reset()  # no fault is left: nothing to do, and no refusal
        monkeypatch.setattr(simulation.axes, "problem", lambda _: None)
        session.recover(SimpleNamespace(switch_on=lambda: None))
        assert session.status.state == "ready" and session.status.at_home and not session.status.faults


def test_a_robot_that_was_left_where_it_cannot_be_armed_is_jogged(on_the_simulated_clock, monkeypatch):
    simulated, session = on_the_simulated_clock
    arm, jogged = simulated.control.bridge.arm, []

    def arm_there(now):
        if not jogged:
            raise JogFirstError("not armed: not from here")
        arm(now)

    monkeypatch.setattr(simulated.control.bridge, "arm", arm_there)
    session.recover(SimpleNamespace(switch_on=lambda: None, jog=lambda: jogged.append(True)))
    assert len(jogged) == 1 and session.status.state == "ready"


@pytest.fixture
def playing(policy, tmp_path):
    """A rig whose robot is armed, and its session."""
    artefact_ = artefact.load(policy)
    with rig_for(artefact_, RobotOptions()) as rig:
        options = process.ControlOptions(str(policy), log_folder=str(tmp_path), log_name="session")
        with ControlSession(rig.robot, options, Console()) as session:
            session.prepare(rig)
            try:
                session.arm()
            except RefusedError:  # a busy machine may be late for the axes: a fault, from which an operator recovers
                session.recover(rig)
            yield rig, session, tmp_path


@pytest.mark.realtime
def test_killed_bridge_leaves_a_readable_log_and_the_arm_stops(playing):
    rig, session, folder = playing
    rig.throw(True)
    end = time.monotonic() + 20
    moving = False
    while not moving and time.monotonic() < end:
        list(session.messages(0.0))
        if session.status and session.status.faults:  # a busy machine may lose an axis for a moment: as above
            session.recover(rig)
        moving = np.abs(rig.state()[1]).max() > 0.3
    assert moving
    killed = time.monotonic()
    os.kill(session.process.pid, signal.SIGKILL)
    session.process.join()
    time.sleep(0.5)
    assert np.abs(rig.state()[1]).max() < 0.02  # comm time-out and node guard have stopped it
    path = folder / "session.mcap"
    while not path.exists() and time.monotonic() < killed + 10:
        time.sleep(0.05)
    session_log = log.read(path)
    assert session_log.ticks.time[-1] > killed - 0.5


@pytest.mark.realtime
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGQUIT])
def test_signals_never_leave_the_robot_moving(playing, number):
    """Those of a terminal's stop do nothing, the others end the process once the robot stands."""
    _, session, folder = playing
    for ignored in (signal.SIGINT, signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU):
        os.kill(session.process.pid, ignored)
    before = session.status.time
    until(session, lambda status: status.time > before + 0.5)
    os.kill(session.process.pid, number)
    session.process.join(10.0)
    assert session.process.exitcode == 0
    session_log = log.read(folder / "session.mcap")
    assert states(session_log)[-1][0] in ("stopping", "disarmed") and not session_log.commands.sent[:, -1].any()


@pytest.mark.realtime
def test_a_session_that_nobody_listens_to_is_stopped(playing):
    rig, session, _ = playing
    end = time.monotonic() + LONGEST_SILENCE + 1.0
    while time.monotonic() < end:
        list(session.messages(0.3))
    if session.status.faults:  # a busy machine, as above
        session.recover(rig)
    assert session.status.state in ("ready", "active") and not session.status.stopped
    time.sleep(LONGEST_SILENCE + 1.0)
    list(session.messages(0.5))
    assert session.status.state in ("disarmed", "fault") and "was not heard" in session.status.stopped
    session.recover(rig)
    assert session.status.state in ("ready", "active") and not session.status.halt


@pytest.mark.realtime
@pytest.mark.parametrize(
    "breaks, causes",
    [
        (Rig.motors_off, ["arm_not_ready"]),
        (lambda rig: rig.connect_arm(False), ["stale_arm"]),
        (lambda rig: rig.connect_axis(0, False), ["axis_lost", "stale_axes"]),  # whichever is noticed first
    ],
    ids=["emergency stop", "the arm's cable", "an axis's cable"],
)
def test_what_stops_the_robot_is_a_latched_fault_and_can_be_mended(playing, breaks, causes):
    rig, session, _ = playing
    breaks(rig)
    until(session, lambda status: any(fault.cause in causes for fault in status.faults))
    assert session.status.state == "fault"
    with pytest.raises(RefusedError, match="cannot reset"):
        session.reset()
    rig.connect_arm(True)
    rig.connect_axis(0, True)
    session.recover(rig)
    assert session.status.state in ("ready", "active") and not session.status.faults
