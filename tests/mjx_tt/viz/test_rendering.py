"""Pictures and videos: real files, read back, with the things in them where the scene has them."""

from __future__ import annotations

import imageio.v2 as imageio
import numpy as np
import pytest
from PIL import Image

from mjx_tt.robot.model import home_qpos, load_model
from mjx_tt.viz import rendering

SIZE = (320, 180)


@pytest.fixture(scope="module", autouse=True)
def opengl(tmp_path_factory):
    """Rendering needs an OpenGL library on the machine; without one its absence is reported, not hidden."""
    try:
        rendering.render_png(tmp_path_factory.mktemp("probe") / "probe.png", np.zeros(8), size=(16, 16))
    except RuntimeError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def home():
    return home_qpos(load_model())


def read(path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def share(image, colour) -> float:
    """Share of the pixels whose hue is the named one: its channels lead the others by a clear margin."""
    r, g, b = np.moveaxis(image, -1, 0)
    return {
        "blue": (b > r + 40) & (b > g + 30),
        "orange": (r > g + 40) & (g > b + 20),
        "red": (r > 60) & (r > 3 * g) & (r > 3 * b),
    }[colour].mean()


@pytest.mark.parametrize("camera", rendering.camera_names())
def test_every_camera_shows_table_and_robot(tmp_path, home, camera):
    rendering.render_png(tmp_path / "a.png", home, camera=camera, size=SIZE)
    image = read(tmp_path / "a.png")
    assert image.shape == (SIZE[1], SIZE[0], 3)
    assert share(image, "blue") > 0.03
    assert share(image, "orange") > 0.002


def test_human_sees_the_red_face_and_the_robot_side_the_black(tmp_path, home):
    rendering.render_png(tmp_path / "human.png", home, camera="human", size=SIZE)
    rendering.render_png(tmp_path / "back.png", home, camera="robot_back", size=SIZE)
    assert share(read(tmp_path / "human.png"), "red") > 0.0005
    assert share(read(tmp_path / "back.png"), "red") == 0


def test_ball_appears_where_it_is(tmp_path, home):
    """In the top view right is +y and down is +x: the ball's pixels move with it, and it is left out on request."""
    centres = []
    for name, ball in (("none", None), ("near", (0.3, -1.0, 0.05)), ("far", (-0.3, 0.9, 0.05))):
        rendering.render_png(tmp_path / f"{name}.png", home, ball, camera="top", size=SIZE)
    empty = read(tmp_path / "none.png")
    for name in ("near", "far"):
        changed = np.abs(read(tmp_path / f"{name}.png") - empty).sum(axis=-1) > 60
        assert 0 < changed.sum() < 60
        centres.append(np.argwhere(changed).mean(axis=0))
    rows, columns = np.subtract(*centres)
    assert rows > 0 and columns < 0
    assert abs(columns / rows) == pytest.approx(1.9 / 0.6, rel=0.25)


@pytest.mark.parametrize(
    ("name", "fps", "frames", "seconds"), [("a.mp4", 30, 9, 0.3), ("a.gif", 25, 9, 0.36), ("b.gif", 75, 5, 0.12)]
)
def test_video_has_its_frames_and_duration(tmp_path, home, name, fps, frames, seconds):
    qpos = np.tile(home, (9, 1))
    qpos[:, 0] += np.linspace(0, 0.5, 9)
    ball = np.linspace([0.3, 1.0, 0.3], [0.3, -1.0, 0.3], 9)
    ball[-1] = np.nan
    assert rendering.render_video(tmp_path / name, qpos, ball, fps=fps, size=SIZE) == frames
    assert [p.name for p in tmp_path.iterdir()] == [name]
    read_back = imageio.mimread(tmp_path / name)
    assert len(read_back) == frames
    assert np.abs(read_back[0].astype(int) - read_back[-1].astype(int)).max() > 50  # the robot moved
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


def test_trail_marks_the_path_of_the_ball(home):
    qpos, ball = np.tile(home, (10, 1)), np.linspace([0.3, 1.2, 0.3], [0.3, -1.2, 0.3], 10)
    marked, plain = (
        list(rendering.render_frames(qpos, ball, "top", SIZE, trail_frames=n))[-1].astype(int) for n in (100, 0)
    )
    path = np.argwhere(np.abs(marked - plain).sum(axis=-1) > 10)
    pixels_per_metre = SIZE[1] / (2 * np.tan(np.radians(20)) * (4.4 - 0.3))  # of the top camera at the ball's height
    assert np.ptp(path[:, 0]) <= 2  # one line along the table, from the first to the last but one position
    assert np.ptp(path[:, 1]) == pytest.approx(8 / 9 * 2.4 * pixels_per_metre, abs=2.5)


def test_mistakes_are_named(tmp_path, home):
    many = np.tile(home, (3, 1))
    for call, message in (
        (lambda: rendering.render_png(tmp_path / "a.jpg", home), r"a\.jpg: suffix '\.jpg'; allowed: \.png"),
        (lambda: rendering.render_png(tmp_path / "none" / "a.png", home), "folder .* does not exist"),
        (lambda: rendering.render_png(tmp_path / "a.png", home[:7]), "qpos needs 8 joint positions, got 7"),
        (lambda: rendering.render_png(tmp_path / "a.png", home, [0, 0]), r"ball_position needs .* \(3\), got \(2,\)"),
        (lambda: rendering.render_png(tmp_path / "a.png", home, camera="front"), "no camera 'front'; it has .*'side'"),
        (
            lambda: rendering.render_video(tmp_path / "a.mp4", many, many),
            r"ball needs the shape \(3, 3\), got \(3, 8\)",
        ),
        (lambda: rendering.render_video(tmp_path / "a.mp4", many[:0]), "at least one frame"),
        (lambda: rendering.render_video(tmp_path / "a.mp4", many, size=(321, 180)), "even width and height"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
    assert not list(tmp_path.iterdir())


def test_unknown_back_end_is_named(monkeypatch, tmp_path, home):
    rendering._backend.cache_clear()
    monkeypatch.setenv("MUJOCO_GL", "glx")
    try:
        with pytest.raises(RuntimeError, match="MUJOCO_GL='glx'.*egl.*osmesa"):
            rendering.render_png(tmp_path / "a.png", home)
    finally:
        rendering._backend.cache_clear()
