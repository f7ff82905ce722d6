"""A recorded EGM session of a real controller, played to the emulated one: how they differ is evidence.

The record is a capture of tcpdump or Wireshark (pcap or pcapng) from the computer that answered the controller. It is
read by dpkt, an optional extra.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robot_io.devices.egm.messages import ArmFeedback, EgmError, decode_robot, decode_sensor
from robot_io.emulator.arm import ArmController, ArmParams, ArmStateError

ANSWERER = ("0.0.0.0", 0)  # stands for the computer that answered, wherever it was


@dataclass(frozen=True)
class Capture:
    """The EGM datagrams of a capture, each kind by rising time [s].

    feedback  (time, message) of the controller
    replies   (time, datagram) of the computer
    skipped   packets that are no EGM of either kind
    """

    feedback: list[tuple[float, ArmFeedback]]
    replies: list[tuple[float, bytes]]
    skipped: int

    @property
    def times(self) -> np.ndarray:
        """Times (n,) [s] of the feedback."""
        return np.array([time for time, _ in self.feedback])

    @property
    def positions(self) -> np.ndarray:
        """Measured joint positions (n, 6) [rad] of the feedback."""
        return np.array([message.position for _, message in self.feedback])

    @property
    def lost(self) -> int:
        """Packets of the controller that the capture lacks."""
        numbers = np.diff([message.sequence for _, message in self.feedback])
        return int((numbers[numbers > 0] - 1).sum())


def read(path: Path) -> Capture:
    """The EGM datagrams in a capture. Raises ValueError where it is none, or holds no feedback of a controller."""
    import dpkt

    layers = {
        dpkt.pcap.DLT_EN10MB: dpkt.ethernet.Ethernet,
        dpkt.pcap.DLT_LINUX_SLL: dpkt.sll.SLL,
        dpkt.pcap.DLT_LINUX_SLL2: dpkt.sll2.SLL2,
        dpkt.pcap.DLT_RAW: dpkt.ip.IP,
        dpkt.pcap.DLT_NULL: dpkt.loopback.Loopback,
    }
    feedback, replies, skipped = [], [], 0
    with path.open("rb") as file:
        try:
            reader = dpkt.pcap.UniversalReader(file)
        except (ValueError, dpkt.UnpackError) as error:
            raise ValueError(f"{path}: expected a capture of tcpdump or Wireshark, got {error}; save one") from None
        if reader.datalink() not in layers:
            raise ValueError(
                f"{path}: expected a capture of Ethernet, got link type {reader.datalink()}; capture there"
            )
        for time, frame in reader:
            try:
                packet = layers[reader.datalink()](frame)
            except dpkt.UnpackError:
                skipped += 1
                continue
            while isinstance(packet, dpkt.Packet) and not isinstance(packet, dpkt.udp.UDP):
                packet = packet.data
            datagram = bytes(packet.data) if isinstance(packet, dpkt.udp.UDP) else b""
            try:
                feedback.append((float(time), decode_robot(datagram)))
            except EgmError:
                try:
                    decode_sensor(datagram)
                    replies.append((float(time), datagram))
                except EgmError:
                    skipped += 1
    if not feedback:
        raise ValueError(f"{path}: expected an arm's EGM feedback, got {skipped} other packets; capture UDP port 6510")
    return Capture(sorted(feedback, key=lambda row: row[0]), sorted(replies, key=lambda row: row[0]), skipped)


def replay(capture: Capture, params: ArmParams) -> np.ndarray:
    """Positions (n, 6) [rad] that the emulated controller reports at the capture's times, given the same replies.

    Its drives follow at once. Where a session of the controller begins, the arm stands where it was captured.
    """
    arm, replies, found = ArmController(ANSWERER, params), iter(capture.replies), []
    q = capture.positions[0]
    velocity, last, due = np.zeros_like(q), -np.inf, next(replies, None)
    for time, message in capture.feedback:
        while due is not None and due[0] < time:
            arm.receive(due[1], ANSWERER, due[0])
            due = next(replies, None)
        if np.isfinite(last):
            q = q + velocity * (time - last)
        if message.egm_running and not arm.egm_is_running:
            with suppress(ArmStateError):  # it still brakes
                arm.switch_on()
                q = message.position
        elif arm.egm_is_running and not message.egm_running:
            arm.stop_egm()
        if time > last:
            velocity, datagram = arm.step(time, q, velocity)
            last = time
        found.append(q if datagram is None else decode_robot(datagram).position)
    return np.array(found)
