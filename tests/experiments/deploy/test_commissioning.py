"""``mjx-tt robot check`` against sockets that count what they get: nothing."""

from __future__ import annotations

import csv
import socket
import threading
import time

import numpy as np
import pytest
from rich.console import Console

from experiments.config import robot as robots
from experiments.deploy import commissioning
from experiments.deploy.commissioning import Jogger, Marks
from robot_io import log
from robot_io.control import messages
from robot_io.control.config import ArmConfig, AxisConfig, RobotConfig
from robot_io.devices.egm.messages import encode_robot
from robot_io.devices.tracker import BallSample, TrackerConfig, encode
from robot_io.emulator.processes import HOST, free_ports

ARM = np.array([-1.4, 0.1, -0.5, 0.05, 0.9, 0.2])


@pytest.mark.realtime
def test_a_dry_run_hears_everything_and_sends_nothing(tmp_path):
    ports, got, finish = free_ports(), [], threading.Event()
    listeners = [socket.create_server((HOST, port)) for port in ports.axes]
    controller, tracker = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    for wire in (*listeners, controller):
        wire.setblocking(False)

    def devices():
        count = 0
        while not finish.wait(0.004):
            count, now = count + 1, time.monotonic()
            controller.sendto(encode_robot(count, 4 * count, ARM, ARM, True, True, True), (HOST, ports.arm))
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
    axes = AxisConfig(HOST, ports.axes[0]), AxisConfig(HOST, ports.axes[1])
    config = RobotConfig(arm=ArmConfig(HOST, ports.arm), axes=axes, tracker=TrackerConfig(HOST, ports.tracker))
    path.write_text(robots.to_yaml(config))
    console = Console(record=True, width=300)
    try:
        assert commissioning.check(path, None, tmp_path, tmp_path / "points.csv", 2.0, console) == 0
    finally:
        finish.set()
        thread.join()
        for wire in (*listeners, controller, tracker):
            wire.close()
    text = console.export_text()
    assert not got and "ball at +0.100 +0.200 +0.300 m in the table frame" in text and " 0 answered" in text
    session = log.read(next(tmp_path.glob("*-check.mcap")))
    np.testing.assert_allclose(session.joints.position[2:, -1], ARM, atol=1e-6)
    assert session.ball.id.size > 100 and session.ticks.tick.size > 50


def status(ball, joints):
    names = [(str(i), float(q), 0.0) for i, q in enumerate(joints)]
    return messages.Status(1.0, "ready", False, True, (), {}, None, None, None, names, ball)


def test_points_are_noted_as_they_were_before_any_calibration(tmp_path, monkeypatch):
    found = robots.fill(
        RobotConfig,
        {
            "calibration": {
                "tracker": {"position": [0.01, 0.0, 0.0], "date": "2026-11-22"},
                "robot": {"joint_zeros": [0.01] * 6, "date": "2026-11-22"},
            }
        },
        "robot.yaml",
    )
    now = [0.0]
    monkeypatch.setattr(commissioning.time, "monotonic", lambda: now[0])
    marks = Marks(tmp_path / "points.csv", found, with_joints=True)
    for spread in (0.0, 0.05):  # the second time ball and arm move
        marks.begin()
        told = None
        for i in range(12):
            now[0] += 0.1
            told = told or marks.take(status((0.5 + spread * i, 0.2, 0.02), np.arange(8) * 0.1 + spread * i))
    assert "nothing stands still" in told
    (line,) = csv.DictReader(open(tmp_path / "points.csv", encoding="utf-8"))
    assert line["table_x"] == "" and float(line["ball_x"]) == pytest.approx(0.49)
    assert float(line["gantry_y"]) == pytest.approx(0.1) and float(line["joint_1"]) == pytest.approx(0.19)


def test_keys_choose_and_move():
    jogger = Jogger()
    assert jogger.pressed("4") is None and jogger.pressed("-") == messages.Jog((0, 0, 0, -0.002, 0, 0, 0, 0))
    assert jogger.pressed("z") is None and jogger.pressed("s") is None
    assert jogger.pressed("+") == messages.JogBlade((0, 0, 0.005)) and str(jogger) == "blade along z, 5 mm a step"
