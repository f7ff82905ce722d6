"""A UDP socket on one of this computer's addresses that never waits."""

from __future__ import annotations

import socket
from collections.abc import Iterator

from robot_io.errors import DeviceError

MAX_DRAIN = 1000  # datagrams per call: a flood must not keep the caller from its control tick
MAX_DATAGRAM = 2048  # bytes; whatever comes here is shorter, and what is longer is cut and refused by its reader


class UdpSocket:
    """Datagrams of one device; use as a context manager, or close it.

    host, port      address of this computer that it listens on; port 0 takes a free one
    key             of robot.yaml where that address is given, for the error
    network_errors  datagrams that the network refused

    Raises DeviceError where it cannot listen there.
    """

    def __init__(self, host: str, port: int, key: str) -> None:
        self.network_errors = 0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind((host, port))
        except (OSError, OverflowError) as error:
            self._socket.close()
            raise DeviceError(
                f"{key}: cannot listen on UDP {host}:{port} ({getattr(error, 'strerror', None) or error}); end the "
                f"program that uses the port (ss -ulpn lists it), or give another of this computer's addresses (ip "
                f"address) or ports as {key}.host and {key}.port"
            ) from None

    @property
    def address(self) -> tuple[str, int]:
        """(address, port) that it listens on."""
        return self._socket.getsockname()

    def fileno(self) -> int:
        return self._socket.fileno()

    def drain(self) -> Iterator[tuple[bytes, tuple[str, int]]]:
        """The datagrams that wait, with address and port of their senders."""
        for _ in range(MAX_DRAIN):
            try:
                yield self._socket.recvfrom(MAX_DATAGRAM)
            except BlockingIOError:
                return
            except OSError:  # a reply met a closed port, the interface is down; what is queued behind is still good
                self.network_errors += 1

    def send(self, datagram: bytes, endpoint: tuple[str, int]) -> bool:
        """Sends to an address and port; False where the network refuses it."""
        try:
            return self._socket.sendto(datagram, endpoint) == len(datagram)
        except OSError:
            self.network_errors += 1
            return False

    def close(self) -> None:
        self._socket.close()

    def __enter__(self) -> UdpSocket:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()
