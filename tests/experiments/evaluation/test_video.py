"""Pictures of a policy at play: time, caption and trail of a video; the ball at the paddle in the picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from experiments.evaluation import video
from experiments.view.replay import RATE, Replay
from mjx_tt.robot.mjcf import home_qpos, load_model
from mjx_tt.viz.rendering import BRIGHT

CONTACT, SECONDS, SPEED = 0.5, 1.0, 5.0


@pytest.fixture
def replay():
    """A ball that flies at 5 m/s towards the robot for half a second, and back."""
    time = np.arange(round(SECONDS * RATE) + 1) / RATE
    y = -1.3 + SPEED * np.abs(time - CONTACT)
    ball = np.stack([np.full_like(y, 0.3), y, np.full_like(y, 0.3)], axis=1)
    qpos = np.tile(home_qpos(load_model()), (len(time), 1))
    outcome = "returned, 5.0 m/s in, 5.0 m/s out"
    return Replay(time, qpos, {"ball": ball}, "", outcome, decided=CONTACT, contact=CONTACT)


def test_video_is_in_real_time_but_for_the_contact(replay):
    rate = 30.0
    moments = list(video.video_moments(replay, 3, rate))
    slow = [m for m in moments if m.caption.note]
    away = [abs(m.ball[1] + 1.3) / SPEED for m in moments]
    assert all(bool(m.caption.note) == (t < video.NEAR_CONTACT) for m, t in zip(moments, away, strict=True))
    assert {m.caption.note for m in slow} == {"1/8 speed"}
    # The time around the contact at an eighth of the speed; the rest as it is, and the last frame's rest.
    assert len(slow) == pytest.approx(2 * video.NEAR_CONTACT * 8 * rate, abs=2)
    normal = SECONDS - 2 * video.NEAR_CONTACT + video.REST
    assert len(moments) - len(slow) == pytest.approx(normal * rate, abs=3)
    steps = np.abs(np.diff([m.ball[1] for m in slow]))
    assert np.median(steps) == pytest.approx(
        SPEED / 8 / rate, rel=0.01
    )  # smooth, though replays have 300 frames a second


def test_trail_is_the_balls_last_third_of_a_second_and_ends_at_it(replay):
    moment = next(m for m in video.video_moments(replay, 1, 25.0) if m.caption.note)
    flown = np.linalg.norm(np.diff(moment.trail, axis=0), axis=1).sum()
    assert flown == pytest.approx(video.TRAIL * SPEED, abs=0.05)
    np.testing.assert_array_equal(moment.trail[-1], moment.ball)


def test_picture_is_of_the_contact_with_the_whole_way(replay, tmp_path):
    moment = video.at_contact(replay)
    assert moment.ball[1] == pytest.approx(-1.3)
    assert np.ptp(moment.trail[:, 1]) == pytest.approx(CONTACT * SPEED)
    apart = np.linalg.norm(np.diff(moment.dots, axis=0), axis=1)
    np.testing.assert_allclose(apart, SPEED * video.DOTS_APART)
    assert moment.dots[-1, 1] == pytest.approx(1.2, abs=0.2)
    falling = replay.balls["ball"] - np.outer(replay.time > 0.8, [0.0, 0.0, 1.0])
    assert video.at_contact(replace(replay, balls={"ball": falling})).dots[:, 2].min() > 0.0
    try:
        video.draw(tmp_path / "a.png", [replay])
    except RuntimeError as error:
        pytest.skip(str(error))
    image = np.asarray(Image.open(tmp_path / "a.png").convert("RGB")).astype(int)
    assert image.shape == (*video.PICTURE_SIZE[::-1], 3)
    assert (np.abs(image - 255 * np.array(BRIGHT)) < 60).all(axis=-1).sum() > 1000
