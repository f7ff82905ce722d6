"""Pictures and videos: real files, read back, with the things in them where the scene has them."""

from __future__ import annotations

import imageio.v2 as imageio
import mujoco
import numpy as np
import pytest
from PIL import Image

from mjx_tt.robot.mjcf import home_qpos, load_model
from mjx_tt.viz import opengl as back_end
from mjx_tt.viz import rendering
from mjx_tt.viz.caption import BACKGROUND, Caption
from mjx_tt.viz.rendering import BRIGHT, DARK, Moment

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


def luminance(rgb) -> np.ndarray:
    """Relative luminance of sRGB colours (..., 3) from 0 to 255, as WCAG 2 defines it."""
    c = np.asarray(rgb) / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4) @ np.array([0.2126, 0.7152, 0.0722])


def contrast(one, other) -> float:
    """Ratio of two luminances, from 1 to 21; WCAG 2 wants 3 of a part of a picture."""
    low, high = sorted((float(one), float(other)))
    return (high + 0.05) / (low + 0.05)


def near(image, colour, reach=60) -> np.ndarray:
    """True where a picture has a colour (3,) from 0 to 1."""
    return (np.abs(image - 255.0 * np.array(colour)) < reach).all(axis=-1)


@pytest.mark.parametrize("camera", rendering.camera_names())
def test_every_camera_shows_table_and_robot(home, camera):
    image = drawn(Moment(home), camera)
    assert image.shape == (SIZE[1], SIZE[0], 3)
    assert share(image, "blue") > 0.03
    assert share(image, "orange") > 0.002


def test_human_sees_the_red_face_and_the_robot_side_the_black(home):
    assert share(drawn(Moment(home), "human"), "red") > 0.0005
    assert share(drawn(Moment(home), "robot_back"), "red") == 0


def test_ball_appears_where_it_is(home):
    """In every view the ball is where the pinhole formula puts it, and nowhere without it."""
    for camera in rendering.camera_names():
        empty = drawn(Moment(home), camera)
        for ball in ((0.3, -1.0, 0.05), (-0.3, 0.4, 0.25)):
            changed = np.argwhere(near(drawn(Moment(home, np.array(ball)), camera), BRIGHT) & ~near(empty, BRIGHT))
            place, scale = pixel(ball, camera, SIZE)
            assert len(changed) > 0.5 * np.pi * (rendering.SHOWN_RADIUS * scale) ** 2
            np.testing.assert_allclose(changed.mean(axis=0) + 0.5, place, atol=1.0)


def in_front_of(face, home) -> np.ndarray:
    """Place of a ball that touches the blade's red face (+1) or black face (-1)."""
    model = load_model()
    data = mujoco.MjData(model)
    data.qpos[:] = home
    mujoco.mj_forward(model, data)
    site = model.site("paddle").id
    return data.site_xpos[site] + face * 0.026 * data.site_xmat[site].reshape(3, 3)[:, 2]


@pytest.mark.parametrize(
    ("background", "camera", "ball"),
    [
        ("red rubber", "human", +1),
        ("black rubber", "robot_back", -1),
        ("table", "human", (0.2, 0.3, 0.05)),
        ("white line", "human", (0.75, 0.5, 0.03)),
        ("net", "human", (0.2, 0.06, 0.09)),
        ("tape", "human", (0.2, 0.03, 0.145)),
        ("floor", "human", (1.2, -1.0, 0.3)),
        ("sky", "side", (0.0, -0.6, 1.3)),
        ("arm", "side", (0.4, -2.1, 0.12)),
    ],
)
def test_ball_and_trail_stand_out_from_every_background(home, background, camera, ball):
    """Bright within dark: one of the two has a contrast of 3 to whatever is around, and both are there to be seen."""
    size = (960, 540)
    ball = in_front_of(ball, home) if isinstance(ball, int) else np.array(ball)
    behind, shown = drawn(Moment(home), camera, size), drawn(Moment(home, ball), camera, size)
    centre, scale = pixel(ball, camera, size)
    distance = np.hypot(*(np.indices(shown.shape[:2]) + 0.5 - centre[:, None, None]))
    core = distance < 0.6 * rendering.SHOWN_RADIUS * scale
    ring = np.abs(distance / scale - 0.5 * (rendering.SHOWN_RADIUS + rendering.RING_RADIUS)) < 0.002
    around = (distance > rendering.RING_RADIUS * scale) & (distance < rendering.RING_RADIUS * scale + 6)
    assert near(shown[core], BRIGHT).mean() > 0.9
    assert near(shown[ring], DARK).mean() > 0.7
    core, ring = (np.median(luminance(shown[part])) for part in (core, ring))
    assert contrast(core, ring) > 7.0
    for shade in np.percentile(luminance(behind[around]), (10, 50, 90)):
        assert max(contrast(core, shade), contrast(ring, shade)) > 3.0
    trail = drawn(Moment(home, trail=ball + np.outer([-0.05, 0.05], [0.3, 0.2, 0.9])), camera, size)
    assert near(trail[distance < 0.02 * scale], BRIGHT).sum() > 5
    assert near(trail[distance < 0.03 * scale], DARK).sum() > 5


@pytest.mark.parametrize(("name", "fps", "seconds"), [("a.mp4", 30, 0.3), ("a.gif", 25, 0.36), ("b.gif", 30, 0.3)])
def test_video_has_its_frames_and_duration(tmp_path, home, name, fps, seconds):
    moments = []
    for k, y in enumerate(np.linspace(1.0, -1.0, 9)):
        qpos = home.copy()
        qpos[0] += k / 16
        moments.append(Moment(qpos, np.array([0.3, y, 0.3 if k < 8 else np.nan])))
    rendering.render_video(tmp_path / name, moments, fps, size=SIZE)
    assert [p.name for p in tmp_path.iterdir()] == [name]
    read_back = imageio.mimread(tmp_path / name)
    assert len(read_back) == 9
    assert np.abs(read_back[0].astype(int) - read_back[-1].astype(int)).max() > 50  # the robot moved
    found = [bool(near(frame[..., :3].astype(int), BRIGHT).sum() > 3) for frame in read_back]
    assert found == [True] * 8 + [False]
    with Image.open(tmp_path / name) if name.endswith("gif") else imageio.get_reader(tmp_path / name) as video:
        if name.endswith("gif"):
            durations = []
            for i in range(video.n_frames):
                video.seek(i)
                durations.append(video.info["duration"] / 1000)
            assert sum(durations) == pytest.approx(seconds, abs=0.011)
            assert min(durations) >= 0.02
        else:
            assert video.get_meta_data()["duration"] == pytest.approx(seconds, abs=0.01)
            assert video.get_meta_data()["size"] == SIZE


def test_trail_and_dots_mark_the_way_of_the_ball(home):
    """From the top: one line along the table as long as the path, and as many dots as there are places."""
    path = np.linspace([0.3, 1.2, 0.3], [0.3, 0.2, 0.3], 10)
    ahead = np.array([[0.3, y, 0.3] for y in (0.0, -0.3, -0.6)])
    image = drawn(Moment(home, trail=path, dots=ahead), "top", (640, 360))
    where = np.argwhere(near(image, BRIGHT, 90))
    (_, first), scale = pixel(path[0], "top", (640, 360))
    (_, last), _ = pixel(path[-1], "top", (640, 360))
    line = where[where[:, 1] > last - 0.02 * scale]
    assert np.ptp(line[:, 0]) <= 2 * rendering.TRAIL_RADIUS * scale
    assert line[:, 1].max() == pytest.approx(first, abs=2.5)
    for dot in ahead:
        place, scale = pixel(dot, "top", (640, 360))
        assert (np.hypot(*(where + 0.5 - place).T) < 0.012 * scale + 1).sum() >= 2


def test_caption_lies_in_the_picture_and_leaves_the_scene(home):
    plain = drawn(Moment(home), "human", (640, 360))
    for text in ("returned, 5.5 m/s in, 6.1 m/s out", "long " * 40):
        image = drawn(Moment(home, caption=Caption("Ball 1", text, "1/8 speed")), "human", (640, 360))
        bar = (np.abs(image - np.array(BACKGROUND)) < 12).all(axis=-1)
        top = int(np.argmax(bar[:, 0]))
        assert (image[:top] == plain[:top]).all()
        assert 0.9 < top / 360 < 0.94
        assert bar[top:, :6].all()
        assert bar[top:, -6:].all()  # the text ends before the edge
        assert (~bar[top:]).mean() > 0.02  # it is there


def test_mistakes_are_named(tmp_path, home):
    moment = Moment(home)
    for call, message in (
        (lambda: rendering.render_png(tmp_path / "a.jpg", moment), r"a\.jpg: suffix '\.jpg'; allowed: \.png"),
        (lambda: rendering.render_png(tmp_path / "none" / "a.png", moment), "folder .* does not exist"),
        (lambda: rendering.render_png(tmp_path / "a.png", Moment(home[:7])), "qpos needs 8 joint positions, got 7"),
        (
            lambda: rendering.render_png(tmp_path / "a.png", Moment(home, np.zeros(2))),
            r"ball needs the shape \(3\), got \(2,\)",
        ),
        (lambda: rendering.render_png(tmp_path / "a.png", moment, "front"), "no camera 'front'; it has .*'side'"),
        (
            lambda: rendering.render_video(tmp_path / "a.mp4", [Moment(home, trail=np.zeros((3, 8)))], 30),
            r"trail needs the shape \(any, 3\), got \(3, 8\)",
        ),
        (lambda: rendering.render_video(tmp_path / "a.mp4", [], 30), "at least one frame"),
        (lambda: rendering.render_video(tmp_path / "a.gif", [moment], 75), "50 frames per second at most, got fps 75"),
        (lambda: rendering.render_video(tmp_path / "a.mp4", [moment], 30, size=(321, 180)), "even width and height"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
    assert not list(tmp_path.iterdir())


def test_unknown_back_end_is_named(monkeypatch, tmp_path, home):
    back_end.backend.cache_clear()
    monkeypatch.setenv("MUJOCO_GL", "glx")
    try:
        with pytest.raises(RuntimeError, match="MUJOCO_GL='glx'.*egl.*osmesa"):
            rendering.render_png(tmp_path / "a.png", Moment(home))
    finally:
        back_end.backend.cache_clear()
