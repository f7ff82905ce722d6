"""Frames from pylon's own camera emulation."""

from itertools import islice

import numpy as np
import pytest

from robot_io.errors import DeviceError
from robot_io.vision.sources import PylonSource


@pytest.mark.slow
def test_emulated_pylon_cameras_give_frames_at_their_rate(monkeypatch):
    monkeypatch.setenv("PYLON_CAMEMU", "1")
    pytest.importorskip("pypylon")
    shots = list(islice(PylonSource("0815-0000", 50.0, 0.002, (640, 512)).frames(), 25))
    assert {(frame.shape, frame.dtype.name) for _, frame in shots} == {((512, 640), "uint8")}
    steps = np.diff([stamp for stamp, _ in shots])
    assert (steps > 0.0).all()
    with pytest.raises(DeviceError, match="expected camera 17, found 0815-0000"):
        next(PylonSource("17", 50.0, 0.002, (640, 512)).frames())
