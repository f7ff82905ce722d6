"""``mjx-tt robot check`` against sockets that count what they get: nothing."""

from __future__ import annotations

import csv
import re
import socket
import threading
import time
from collections import deque
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from experiments.config import robot as robots
from experiments.deploy import commissioning
from experiments.deploy.commissioning import Commissioning, Jogger
from mjx_tt.robot import robots as simulated
from robot_io import log
from robot_io.calibrated import Calibration
from robot_io.contract import JOINT_NAMES, PAPER
from robot_io.control import messages
from robot_io.control.commissioning.mark import Stay
from robot_io.control.config import ArmConfig, AxisConfig, RobotConfig
from robot_io.control.messages import Marked
from robot_io.devices.ball_datagram import BallSample, encode
from robot_io.devices.egm.messages import encode_robot
from robot_io.devices.tracker import TrackerConfig
from robot_io.emulator.processes import HOST, free_ports
from robot_io.history import History
from robot_io.safety.clearance import BLADE
from tests.support.simulated_control import Simulated

ARM_HEARD = np.array([-1.4, 0.1, -0.5, 0.05, 0.9, 0.2, 0.3])


class Keys:
    """Keys that an operator presses, each so many seconds after the first look at them."""

    def __init__(self, *keys):
        self._keys, self._began = deque(keys), None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def pressed(self):
        self._began = self._began or time.monotonic()
        due = self._keys and time.monotonic() - self._began >= self._keys[0][0]
        return self._keys.popleft()[1] if due else None


@pytest.mark.realtime
@pytest.mark.parametrize("own", [None, "fr3_pedestal"])
def test_a_dry_run_hears_everything_notes_the_ball_and_sends_nothing(tmp_path, monkeypatch, own):
    contract = PAPER if own is None else simulated.load_shipped(own).contract
    ports, got, finish = free_ports(len(contract.carrying)), [], threading.Event()
    heard = ARM_HEARD[: len(contract.arm)]
    listeners = [socket.create_server((HOST, port)) for port in ports.axes]
    controller, tracker = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    for wire in (*listeners, controller):
        wire.setblocking(False)

    def devices():
        count = 0
        while not finish.wait(0.004):
            count, now = count + 1, time.monotonic()
            controller.sendto(encode_robot(count, 4 * count, heard, heard, True, True, True), (HOST, ports.arm))
            if count % 2:
                frame = encode(BallSample(count // 2, 1, now - 0.015, np.array([0.1, 0.2, 0.3])))
                tracker.sendto(frame, (HOST, ports.tracker))
            for wire in (*listeners, controller):
                try:
                    got.append(wire.accept() if wire is not controller else wire.recv(2048))
                except OSError:
                    pass

    thread = threading.Thread(target=devices)
    thread.start()
    path = tmp_path / "robot.yaml"
    axes = tuple(AxisConfig(HOST, port) for port in ports.axes)
    devices_of = {"arm": ArmConfig(HOST, ports.arm), "axes": axes, "tracker": TrackerConfig(HOST, ports.tracker)}
    config = replace(RobotConfig.of(contract), **devices_of)
    path.write_text(robots.to_yaml(config))
    console = Console(record=True, width=300)
    monkeypatch.setattr(commissioning, "Keyboard", lambda: Keys((1.5, "m"), (2.0, "q")))
    try:
        assert Commissioning(path, tmp_path, tmp_path / "points.csv", 20.0, own).check(console) == 0
    finally:
        finish.set()
        thread.join()
        for wire in (*listeners, controller, tracker):
            wire.close()
    text = console.export_text()
    assert not got and "ball at +0.100 +0.200 +0.300 m in the table frame" in text and " 0 answered" in text
    session = log.read(next(tmp_path.glob("*-check.mcap")))
    assert session.robot == contract
    np.testing.assert_allclose(session.joints.position[list(contract.arm), -1], heard, atol=1e-6)
    assert session.ball.id.size > 100 and session.ticks.tick.size > 50
    (line,) = csv.DictReader(open(tmp_path / "points.csv", encoding="utf-8"))
    assert [float(line[f"ball_{axis}"]) for axis in "xyz"] == [0.1, 0.2, 0.3] and line[contract.joints[-1]] == ""


def test_keys_move_the_blade_only_once_armed_and_note_where_it_is(tmp_path, monkeypatch):
    """On the simulated clock, which has all seconds it needs."""
    simulated, console = Simulated(None, monkeypatch, jog=True), Console(record=True, width=300)
    bridge, simulation, said = simulated.control.bridge, simulated.simulation, []

    class View(commissioning.View):
        def say(self, text):
            said.append(text)

    class Pressed(Keys):
        def pressed(self):
            """The next key as soon as what the one before asked for has been done."""
            if not self._keys or not self._keys[0][0]():
                return None
            return self._keys.popleft()[1]

    def raised():
        moved = bridge.gate.geometry.middle(BLADE, bridge.measured) - before
        return np.abs(moved - [0.0, 0.0, 0.005]).max() < 1e-3 and simulation.now > start + 20.0

    thread = simulated.thread(monkeypatch)
    (tmp_path / "robot.yaml").write_text("{}")
    before = bridge.gate.geometry.middle(BLADE, bridge.gate.geometry.home)
    start = simulation.now
    keys = Pressed(
        (lambda: simulation.now > start + 1.0, "z"),
        (lambda: True, "+"),  # before it is armed
        (lambda: any("arm it first" in text for text in said), "a"),
        (lambda: bridge.state.value == "ready", "s"),
        (lambda: True, "+"),
        (raised, "m"),
        (lambda: any("noted" in text for text in said), "q"),
    )
    monkeypatch.setattr(commissioning, "Keyboard", lambda: keys)
    monkeypatch.setattr(commissioning, "View", View)
    thread.start()
    assert Commissioning(tmp_path / "robot.yaml", tmp_path, tmp_path / "points.csv", 60.0).jog(console) == 0
    thread.join(10.0)
    assert not thread.is_alive() and not any("nan" in text for text in said)
    (line,) = csv.DictReader(open(tmp_path / "points.csv", encoding="utf-8"))
    place = bridge.gate.geometry.middle(BLADE, np.array([float(line[name]) for name in JOINT_NAMES]))
    np.testing.assert_allclose(place - before, [0.0, 0.0, 0.005], atol=1e-3)
    assert line["ball_x"] == "" and "no ball" in said[-1]


FOUND = robots.fill(
    Calibration,
    {
        "tracker": {"position": [0.01, 0.0, 0.0], "date": "2026-11-22"},
        "robot": {"joint_zeros": [0.01] * 6, "date": "2026-11-22"},
    },
    "calibration.yaml",
)


def stay(place, noise=0.0, speed=0.0, seconds=1.2, rate=125.0, seed=0):
    """Of something that was at ``place`` in the middle of the last second."""
    history, random = History(256), np.random.default_rng(seed)
    for i in range(round(seconds * rate)):
        t = -seconds + (i + 1) / rate
        history.add(t, np.asarray(place) + speed * (t + 0.5) + noise * random.normal(size=len(place)))
    return Stay.of(history, 0.0)


AXES, ARM = np.array([0.2, -0.3]), np.arange(6) * 0.1


@pytest.mark.parametrize("seed", range(3))
def test_a_resting_ball_is_noted_in_spite_of_the_trackers_noise(tmp_path, seed):
    """As it was before any calibration; the mean of 125 frames at 3 mm is known to 0.3 mm."""
    path, ball = tmp_path / "points.csv", stay((0.5, 0.2, 0.02), noise=0.003, seed=seed)
    told = commissioning.note(path, FOUND, Marked(ball, stay(AXES), stay(ARM)), with_joints=True)
    assert ball.count == 125 and told == f"noted in {path}; fill in table_x, table_y, table_z of its last line"
    (line,) = csv.DictReader(open(path, encoding="utf-8"))
    assert line["table_x"] == "" and float(line["ball_x"]) == pytest.approx(0.49, abs=0.0012)
    assert float(line["gantry_y"]) == pytest.approx(-0.3) and float(line["joint_2"]) == pytest.approx(0.09)


@pytest.mark.parametrize(
    "ball, why",
    [
        (stay((0.5, 0.2, 0.02), noise=0.003, speed=0.02), "no ball: moves by"),
        (stay((0.5, 0.2, 0.02), noise=0.03), "no ball: (scatters|moves) by"),
        (stay((0.5, 0.2, 0.02), seconds=0.1), "no ball: 12 samples in the last second, at least 30"),
        (stay((0.5, 0.2, 0.02), seconds=0.0), "no ball: 0 samples"),
    ],
)
def test_what_is_left_out_is_said(tmp_path, ball, why):
    path = tmp_path / "points.csv"
    told = commissioning.note(path, FOUND, Marked(ball, stay(AXES), stay(ARM)), with_joints=True)
    assert re.search(rf"noted in .* [(]{why}", told)
    (line,) = csv.DictReader(open(path, encoding="utf-8"))
    assert line["ball_x"] == "" and line["joint_1"] != ""
    for moving, with_joints in ((stay(ARM, speed=0.01), True), (stay(ARM), False)):
        assert commissioning.note(path, FOUND, Marked(ball, stay(AXES), moving), with_joints).startswith(
            "not noted: no"
        )
    assert len(path.read_text().splitlines()) == 2


def test_keys_choose_and_move():
    jogger = Jogger()
    assert jogger.pressed("4") is None and jogger.pressed("-") == messages.Jog((0, 0, 0, -0.002, 0, 0, 0, 0))
    assert jogger.pressed("z") is None and jogger.pressed("s") is None
    assert jogger.pressed("+") == messages.Jog((0, 0, 0.005)) and str(jogger) == "blade along z, 5 mm a step"
