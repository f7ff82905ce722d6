"""Faults of cameras, made on purpose, are named within a second, and nothing is named without one."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from experiments.vision import render
from robot_io.vision import rig
from robot_io.vision.health import Health
from robot_io.vision.triangulation import Detection

RIG = rig.standard()
PERIOD = 1.0 / RIG.rate
BEGIN, END = 1.0, 2.0  # [s] of the fault
COVER = np.random.default_rng(0).normal(4, 2, (1024, 1280)).clip(0, 255).astype(np.uint8)
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def pictures() -> dict[str, list[list[np.ndarray]]]:
    """Some frames of each camera: as they are, with the second turned by 0.05 degrees, and with a lamp less."""
    out: dict[str, list[list[np.ndarray]]] = {"well": [], "bumped": [], "dark": []}
    turn = Rotation.from_rotvec(np.radians(0.05) * np.array([0.6, 0.8, 0.0])).as_matrix()
    for number, camera in enumerate(RIG.cameras):
        for kind in out:
            stands = camera.moved(turn, np.zeros(3)) if kind == "bumped" and number == 1 else camera
            rng = np.random.default_rng(4)
            scene, person = render.make_scene(stands, rng), render.Actors(rng)
            if kind == "dark":
                scene = replace(scene, brightness=0.7 * scene.brightness)
            shapes = [person.person(0.05 * k, None) for k in range(4)]
            out[kind].append([render.render(scene, render.no_ball, 0.0, rng, s).frame for s in shapes])
    return out


def watch(pictures, fault: str = "") -> dict[str, float]:
    """Sentences of a second before and one with a fault, up to the colon, with when they came [s]."""
    health, rng, found = Health(RIG), np.random.default_rng(0), {}
    for k in range(round(END / PERIOD)):
        time = k * PERIOD
        on = time >= BEGIN
        kind = {"bump": "bumped", "lamp": "dark"}.get(fault, "well") if on else "well"
        for i in range(2):
            if fault == "drops" and on and i == 0 and k % 20 == 0:
                continue
            frame = pictures[kind][i][k % 4]
            if fault == "cover" and on and i == 0:
                frame = COVER
            health.frame(i, time, frame)
        flight = time % 0.6
        seen = []
        for i, camera in enumerate(RIG.cameras):
            t = flight + (0.001 if fault == "skew" and on and i == 1 else 0.0)
            place = np.array([0.3 * t, 1.3 - 4.5 * t, 0.2 + 2.0 * t - 4.9 * t * t])
            pixel = camera.project(place) + rng.normal(0, 0.3, 2)
            seen.append([Detection(pixel, 0.1 * np.eye(2), np.zeros(2), 1e3, 0.99)])
        health.pair((time, time), seen)
        for line in health.problems(time):
            found.setdefault(line.split(":")[0] + ":" + line.split(":")[1][:8], time)
    return found


def test_nothing_is_wrong_with_a_good_rig(pictures):
    assert watch(pictures) == {}


@pytest.mark.parametrize(
    "fault, name",
    [
        ("bump", "camera right: turned "),
        ("lamp", "light:"),
        ("cover", "camera left: its pic"),
        ("drops", "camera left: "),
        ("skew", "clocks:"),
    ],
)
def test_a_fault_is_named_within_a_second(pictures, fault, name):
    found = watch(pictures, fault)
    named = [when for line, when in found.items() if line.startswith(name)]
    assert named and BEGIN <= min(found.values()) <= min(named) < END
    others = [line for line in found if line.startswith("camera") and not line.startswith(name.split(":")[0])]
    assert fault == "lamp" or not others


def test_a_silent_camera_is_named(pictures):
    health = Health(RIG)
    health.frame(0, 0.0, pictures["well"][0][0])
    assert [line.split(";")[0] for line in health.problems(0.5)] == ["camera left: silent", "camera right: silent"]
