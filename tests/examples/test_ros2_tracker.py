"""The example's node: messages of ROS 2's own definition, as bytes on its wire, over a socket to the receiving side."""

from __future__ import annotations

import math
import socket
from contextlib import closing

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from examples.tracker.ros2_tracker import Frames
from examples.tracker.tracker_client import datagram
from robot_io.devices.tracker import Tracker, TrackerConfig
from robot_io.devices.udp import UdpSocket

STORE = get_typestore(Stores.ROS2_HUMBLE)
KIND = "geometry_msgs/msg/PointStamped"
OFFSET = -1_700_000_000_000_000_000  # [ns]


def sent(nanoseconds, point, frame="table"):
    """A message as a subscriber gets it: serialised and read again."""
    time, header = STORE.types["builtin_interfaces/msg/Time"], STORE.types["std_msgs/msg/Header"]
    stamp = time(sec=1_700_000_000 + nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    message = STORE.types[KIND](
        header=header(stamp=stamp, frame_id=frame), point=STORE.types["geometry_msgs/msg/Point"](*map(float, point))
    )
    return STORE.deserialize_cdr(STORE.serialize_cdr(message, KIND), KIND)


def test_the_bridge_receives_what_the_topic_carries():
    """Two balls: seen, out of sight for a moment, back at the human's end; and after a second of an empty table."""
    frames, nowhere = Frames(OFFSET), (math.nan,) * 3
    flight = [(0.1, 1.2 - 0.04 * i, 0.3) for i in range(30)]
    points = [*flight, *[nowhere] * 5, *flight, *[nowhere] * 125, flight[0]]
    found, tracker = [], Tracker(TrackerConfig())
    with (
        closing(UdpSocket("127.0.0.1", 0, "tracker")) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        with socket.fromfd(receiver.fileno(), socket.AF_INET, socket.SOCK_DGRAM) as bound:
            to = bound.getsockname()
        for i, point in enumerate(points):
            sender.sendto(datagram(frames.frame(sent(8_000_000 * i, point))), to)
            for got, (source, port) in receiver.drain():
                found.append(tracker.receive(got, source, 0.008 * i + 0.01, port))
    assert len(found) == len(points) and all(found)
    assert [sample.ball for sample in found] == [1] * 35 + [2] * 155 + [3]
    np.testing.assert_allclose([sample.captured for sample in found], 0.008 * np.arange(len(points)), atol=1e-9)
    for sample, point in zip(found, points, strict=True):
        assert (sample.position is None) == math.isnan(point[0])
        assert sample.position is None or (sample.position == point).all()


def test_a_point_in_another_frame_is_refused():
    with pytest.raises(ValueError, match="frame_id is 'camera', expected 'table'"):
        Frames(0).frame(sent(0, (0, 0, 0), "camera"))
