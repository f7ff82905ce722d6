"""Cameras against OpenCV, and their YAML."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robot_io.vision import rig
from robot_io.vision.camera import Camera, look_at

DISTORTION = np.array([-0.11, 0.04, 0.0012, -0.0008, -0.006])


@pytest.fixture
def bent() -> Camera:
    """A camera whose lens has all five coefficients, and which is not upright."""
    base = look_at("bent", (-2.3, -0.9, 1.8))
    matrix = np.array([[1042.0, 0.0, 637.0], [0.0, 1051.0, 514.0], [0.0, 0.0, 1.0]])
    turned = Rotation.from_rotvec([0.02, -0.03, 0.2]).as_matrix()
    return Camera("bent", base.size, matrix, DISTORTION, base.rotation, base.translation).moved(turned, np.zeros(3))


@pytest.fixture
def points() -> np.ndarray:
    return np.random.default_rng(0).uniform([-0.8, -1.4, 0.0], [0.8, 1.4, 0.6], (200, 3))


def test_projection_is_opencv_s(bent, points):
    cv2 = pytest.importorskip("cv2")
    pixels, slopes = cv2.projectPoints(
        points, cv2.Rodrigues(bent.rotation)[0], bent.translation, bent.matrix, bent.distortion
    )
    assert bent.project(points) == pytest.approx(pixels[:, 0], abs=1e-6)
    by_shift = slopes[:, 3:6].reshape(-1, 2, 3) @ bent.rotation  # of the translation, in the camera's frame
    assert np.stack([bent.jacobian(p) for p in points]) == pytest.approx(by_shift, abs=1e-5)


def test_rays_meet_the_points(bent, points):
    seen = points[bent.sees(points)]
    rays = bent.rays(bent.project(seen))
    truth = (seen - bent.centre) / np.linalg.norm(seen - bent.centre, axis=1, keepdims=True)
    assert len(seen) > 100 and rays == pytest.approx(truth, abs=1e-7)


def test_nothing_is_seen_behind(bent):
    behind = 2.0 * bent.centre
    assert bent.depth(behind) < 0.0
    assert np.isnan(bent.project(behind)).all() and not bent.sees(behind)


def test_yaml_gives_back_what_was_written(tmp_path, bent, points):
    path = tmp_path / "rig.yaml"
    rig.write(path, rig.CameraRig((look_at("first", (2.0, 0.0, 2.0)), bent), (0.0, 0.0015), (0.2, 0.3), 150.0, 0.001))
    found = rig.read(path)
    assert found.delays == (0.0, 0.0015) and (found.rate, found.exposure) == (150.0, 0.001)
    assert found.cameras[1].project(points) == pytest.approx(bent.project(points), abs=1e-3)


def test_mistakes_are_named(tmp_path):
    path = tmp_path / "rig.yaml"
    path.write_text(rig.STANDARD.read_text().replace("size: [1280, 1024]", "size: [1280, 1023]", 1))
    with pytest.raises(ValueError, match=r"cameras\.left\.size\[1\]: expected .*, got 1023"):
        rig.read(path)


def test_the_standard_rig_sees_the_whole_table():
    x, y = np.meshgrid([-0.7625, 0.7625], [-1.37, 1.37])
    corners = np.stack([x.ravel(), y.ravel(), np.zeros(4)], -1)
    for camera in rig.standard().cameras:
        assert camera.sees(corners, margin=10).all() and camera.sees(corners + [0, 0, 0.3]).all()
