"""A recording through camera processes and shared memory, out as datagrams on a socket."""

import socket
from dataclasses import replace

import numpy as np
import pytest

from experiments.vision import render
from experiments.vision.pipeline import SHIPPED
from robot_io.devices.ball_datagram import decode
from robot_io.vision import live, rig
from robot_io.vision.recording import FrameWriter
from robot_io.vision.sources import RecordedSource

RIG = rig.standard()
FRAMES = 40


def place(times: np.ndarray) -> np.ndarray:
    """A ball in free fall."""
    t = np.asarray(times)[:, None]
    return np.array([0.1, 0.9, 0.35]) + t * [0.3, -4.5, 1.5] - 4.905 * t**2 * [0, 0, 1]


@pytest.mark.slow
@pytest.mark.parametrize("bayer", ["RGGB", "GRBG"])
def test_a_recorded_ball_comes_out_as_datagrams(bayer, tmp_path):
    """A sensor whose first column is the other's second sees everything one pixel to the right."""
    column = ["RGGB", "GRBG"].index(bayer)
    right = column * np.outer([1.0, 0.0, 0.0], [0.0, 0.0, 1.0])  # of the matrix's principal point
    shifted = tuple(replace(camera, matrix=camera.matrix + right) for camera in RIG.cameras)
    its_rig = replace(RIG, bayer=bayer, cameras=shifted)
    path, rng = tmp_path / "flight.mcap", np.random.default_rng(3)
    scenes = [render.make_scene(camera, rng) for camera in RIG.cameras]
    with FrameWriter(path, {camera.name: camera.size for camera in RIG.cameras}, RIG.rate, bayer) as writer:
        for k in range(FRAMES):
            for camera, scene in zip(RIG.cameras, scenes, strict=True):
                scene.ball, scene.exposure = scenes[0].ball, RIG.exposure
                frame = render.render(scene, place, k / RIG.rate, rng).frame
                if not (camera.name == "right" and k == 5):  # lost on its way
                    writer.write(camera.name, k / RIG.rate, np.roll(frame, column, axis=1))
    said: list[str] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bridge:
        bridge.bind(("127.0.0.1", 0))
        bridge.settimeout(5.0)
        sources = [RecordedSource(str(path), camera.name) for camera in RIG.cameras]
        summary = live.run(its_rig, sources, SHIPPED, bridge.getsockname(), said.append, live=False)
        samples = [decode(bridge.recv(2048)) for _ in range(summary.frames)]
    assert summary.frames == FRAMES - 1 == len(samples)
    assert round(samples[5].captured * RIG.rate) == 6  # the frame without a partner is passed over
    seen = [sample for sample in samples if sample.position is not None]
    assert len(seen) == summary.balls > FRAMES / 2 and len({sample.ball for sample in seen}) == 1
    for sample in seen[3:]:
        truth = place(np.array([sample.captured]))[0]
        assert sample.position == pytest.approx(truth, abs=0.01)
        assert sample.velocity == pytest.approx([0.3, -4.5, 1.5 - 9.81 * sample.captured], abs=0.5)
