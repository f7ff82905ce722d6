"""A ROS 2 node that passes a tracker's topic on to the bridge: a geometry_msgs/PointStamped for each camera frame.

    python3 examples/tracker/ros2_tracker.py 127.0.0.1 6520 --ros-args -r ball:=/my_tracker/ball

Run it with ROS 2's own Python, on the computer of the bridge. The point is the ball's centre in the table frame, NaN
while no ball is seen; the stamp is when the cameras exposed the frame. A message carries no ball's number: a ball that
was out of sight for half a second, or is suddenly a metre nearer to the human, is a new one.

Tested against the message definition of ROS 2 Humble, not in a running ROS 2.
"""

from __future__ import annotations

import math
import socket
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
from tracker_client import Frame, datagram  # noqa: E402, beside this file

FRAME = "table"  # header.frame_id
FORGOTTEN = 500_000_000  # [ns] out of sight after which a ball is a new one
BACK = 1.0  # [m] along y that no ball flies between two frames


class Frames:
    """Turns messages into frames. offset_ns: added to a stamp, so that it is of a clock that never jumps."""

    def __init__(self, offset_ns: int) -> None:
        self._offset_ns = offset_ns
        self._sequence = -1
        self._ball = 0
        self._seen_ns: int | None = None
        self._y = 0.0

    def frame(self, message: Any) -> Frame:
        """The frame of a geometry_msgs/PointStamped. Raises ValueError for a point in another frame."""
        if message.header.frame_id != FRAME:
            raise ValueError(f"frame_id is {message.header.frame_id!r}, expected {FRAME!r}: transform the point first")
        stamp, point = message.header.stamp, message.point
        captured = stamp.sec * 1_000_000_000 + stamp.nanosec + self._offset_ns
        self._sequence += 1
        if not all(math.isfinite(x) for x in (point.x, point.y, point.z)):
            return Frame(self._sequence, self._ball, captured, None)
        if self._seen_ns is None or captured - self._seen_ns > FORGOTTEN or point.y - self._y > BACK:
            self._ball += 1
        self._seen_ns, self._y = captured, point.y
        return Frame(self._sequence, self._ball, captured, (point.x, point.y, point.z))


def main() -> None:
    """Sends every message of the topic ``ball`` until the node is stopped."""
    import rclpy
    from geometry_msgs.msg import PointStamped
    from rclpy.qos import qos_profile_sensor_data

    host, port = sys.argv[1], int(sys.argv[2])
    rclpy.init()
    node = rclpy.create_node("table_tennis_tracker")
    frames = Frames(time.monotonic_ns() - time.time_ns())  # once: the stamps' clock may be set later, ours must not
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        node.create_subscription(
            PointStamped,
            "ball",
            lambda message: sender.sendto(datagram(frames.frame(message)), (host, port)),
            qos_profile_sensor_data,
        )
        rclpy.spin(node)


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit("usage: ros2_tracker.py HOST PORT [--ros-args ...]")
    main()
