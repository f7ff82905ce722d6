"""The robot plays by what cameras see of its world."""

import numpy as np
import pytest

from experiments.vision.pipeline import SHIPPED
from experiments.vision.rendered_rig import RenderedCameras
from robot_io.emulator.config import RigParams
from robot_io.emulator.tracker import TrackerEmulator, TrackerParams
from robot_io.vision import rig
from tests.support.lockstep_play import throws
from tests.support.lockstep_play import world as shared_world


def test_rendered_cameras_are_for_lock_step():
    with pytest.raises(ValueError, match="'rendered'; it is for lock-step"):
        TrackerEmulator(TrackerParams(cameras="rendered"), 0)


@pytest.mark.slow
def test_a_thrown_ball_is_tracked_in_its_pictures():
    params = RigParams(tracker=TrackerParams(cameras="rendered"))
    world = shared_world()
    world.reset()
    tracker = RenderedCameras(rig.standard(), SHIPPED).open(params.tracker, world, 1)
    balls, errors = throws(), []
    world.throw(balls.position[:, 0], balls.velocity[:, 0], balls.spin[:, 0])
    for _ in range(40):
        world.advance(np.zeros(8), 0.008)
        if not world.in_play:
            break
        tracker.step(world.time, 1, world.ball)
        ball = tracker.tracker.reported
        errors.append(np.inf if ball is None else float(np.linalg.norm(ball.ball.mean[:3] - world.ball)))
    assert np.median(errors) < 0.005
    assert len(tracker.due(world.time + 1.0)) == len(errors)
