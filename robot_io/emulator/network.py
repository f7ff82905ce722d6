"""A bad network between two ends: loss, delay and jitter (hence reordering), duplication, flipped bits."""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ballmodel.io.ranges import Within, check_fields


@dataclass(frozen=True)
class NetworkFaults:
    """Probabilities per datagram, times in seconds. Raises ValueError for what is no probability or time."""

    loss: Annotated[float, Within(0.0, 1.0)] = 0.0
    duplication: Annotated[float, Within(0.0, 1.0)] = 0.0
    bit_flip: Annotated[float, Within(0.0, 1.0)] = 0.0
    reordering: Annotated[float, Within(0.0, 1.0)] = 0.0  # probability of being held back by ``hold``
    hold: Annotated[float, Within(0.0, 10.0, "s")] = 0.006
    delay: Annotated[float, Within(0.0, 10.0, "s")] = 0.0
    jitter: Annotated[float, Within(0.0, 10.0, "s")] = 0.0  # standard deviation of an additional half-normal delay

    def __post_init__(self) -> None:
        check_fields(self)


class Network:
    """Carries datagrams one way. Deterministic for a seed."""

    def __init__(self, faults: NetworkFaults, seed: int) -> None:
        self._faults, self._random = faults, np.random.default_rng(seed)
        self._heap: list[tuple[float, int, bytes]] = []
        self._count = 0
        self._perfect = faults == NetworkFaults()

    def send(self, datagram: bytes, now: float) -> None:
        f, random = self._faults, self._random
        if self._perfect:
            return self._put(now, datagram)
        if random.random() < f.loss:
            return
        for _ in range(2 if random.random() < f.duplication else 1):
            content = bytearray(datagram)
            if datagram and random.random() < f.bit_flip:
                place = int(random.integers(8 * len(datagram)))
                content[place // 8] ^= 1 << place % 8
            late = f.delay + abs(random.normal()) * f.jitter + (f.hold if random.random() < f.reordering else 0.0)
            self._put(now + late, bytes(content))

    def _put(self, when: float, datagram: bytes) -> None:
        heapq.heappush(self._heap, (when, self._count, datagram))
        self._count += 1

    def due(self, now: float) -> list[bytes]:
        """The datagrams that have arrived by ``now``, in order of arrival."""
        arrived = []
        while self._heap and self._heap[0][0] <= now:
            arrived.append(heapq.heappop(self._heap)[2])
        return arrived
