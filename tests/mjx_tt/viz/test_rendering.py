"""Pictures and videos: real files, read back, with the things in them where the scene has them."""

import mujoco
import numpy as np
import pytest

from mjx_tt.robot.mjcf import home_qpos, load_model
from mjx_tt.viz import rendering
from mjx_tt.viz.rendering import BRIGHT, Moment

SIZE = (320, 180)


@pytest.fixture(scope="module", autouse=True)
def opengl():
    """Rendering needs an OpenGL library on the machine; without one its absence is reported, not hidden."""
    try:
        list(rendering.render_frames([Moment(np.zeros(8))], size=(16, 16)))
    except RuntimeError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def home():
    return home_qpos(load_model())


def share(image, colour) -> float:
    """Share of the pixels whose hue is the named one: its channels lead the others by a clear margin."""
    r, g, b = np.moveaxis(image, -1, 0)
    return {
        "blue": (b > r + 40) & (b > g + 30),
        "orange": (r > g + 40) & (g > b + 20),
        "red": (r > 60) & (r > 3 * g) & (r > 3 * b),
    }[colour].mean()


def drawn(moment, camera, size=SIZE) -> np.ndarray:
    (frame,) = rendering.render_frames([moment], camera, size)
    return frame.astype(int)


def pixel(place, camera, size) -> tuple[np.ndarray, float]:
    """Row and column (2,) of a place (3,) [m] by the pinhole formula, and pixels per metre there."""
    model = load_model()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    k = model.camera(camera).id
    x, y, z = data.cam_xmat[k].reshape(3, 3).T @ (np.asarray(place) - data.cam_xpos[k])
    scale = size[1] / (2.0 * np.tan(np.radians(model.cam_fovy[k]) / 2.0)) / -z
    return np.array([size[1] / 2 - scale * y, size[0] / 2 + scale * x]), scale


def near(image, colour, reach=60) -> np.ndarray:
    """True where a picture has a colour (3,) from 0 to 1."""
    return (np.abs(image - 255.0 * np.array(colour)) < reach).all(axis=-1)


@pytest.mark.parametrize("camera", rendering.camera_names())
def test_every_camera_shows_table_and_robot(home, camera):
    image = drawn(Moment(home), camera)
    assert image.shape == (SIZE[1], SIZE[0], 3)
    assert share(image, "blue") > 0.03
    assert share(image, "orange") > 0.002


def test_ball_appears_where_it_is(home):
    """In every view the ball is where the pinhole formula puts it, and nowhere without it."""
    for camera in rendering.camera_names():
        empty = drawn(Moment(home), camera)
        for ball in ((0.3, -1.0, 0.05), (-0.3, 0.4, 0.25)):
            changed = np.argwhere(near(drawn(Moment(home, np.array(ball)), camera), BRIGHT) & ~near(empty, BRIGHT))
            place, scale = pixel(ball, camera, SIZE)
            assert len(changed) > 0.5 * np.pi * (rendering.SHOWN_RADIUS * scale) ** 2
            np.testing.assert_allclose(changed.mean(axis=0) + 0.5, place, atol=1.0)
