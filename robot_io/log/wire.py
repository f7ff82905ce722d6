"""Many protobuf messages of one type at once, field by field, as NumPy arrays.

A long session has tens of millions of messages; a library's object for each of them takes minutes and gigabytes.
https://protobuf.dev/programming-guides/encoding
"""

from __future__ import annotations

import numpy as np

MARGIN = 1 << 16  # zero bytes that the data must have at its end, more than a message's fields can run beyond it
_VARINT, _DOUBLE, _BLOCK = 0, 1, 2  # wire types


class WireError(ValueError):
    """``index`` of the first message that does not have the expected fields."""

    def __init__(self, index: int) -> None:
        super().__init__(f"message {index} does not have the expected fields")
        self.index = index


class Wire:
    """A place in each of n messages; every method reads the field that follows there and moves on.

    Fields stand in the order of their numbers, which every protobuf library keeps; one that is absent has its default.
    """

    def __init__(self, data: np.ndarray, start: np.ndarray, end: np.ndarray) -> None:
        """Messages data[start[i] : end[i]] of bytes that end with ``MARGIN`` more."""
        self._data, self._at, self._end = data, start.copy(), end
        self._sound = np.ones(start.size, bool)

    def skip_varint(self, number: int) -> None:
        self._skip_bytes_of_varint(self._skip_tag(number, _VARINT))

    def skip_block(self, number: int) -> None:
        """A message or text of fewer than 128 bytes."""
        there = self._skip_tag(number, _BLOCK)
        self._at += there * (1 + self._data[self._at].astype(np.int64))

    def enter(self, number: int) -> None:
        """The head of a message; its fields follow."""
        there = self._skip_tag(number, _BLOCK)
        self._sound &= there
        self._skip_bytes_of_varint(there)

    def expect_text(self, number: int, text: str) -> None:
        content = text.encode()
        self._expect(bytes([number << 3 | _BLOCK, len(content)]) + content)

    def double(self, number: int) -> np.ndarray:
        """Values (n,); 0 where the field is absent."""
        there = self._skip_tag(number, _DOUBLE)
        values = np.where(there, self._bytes(8).view("<f8")[:, 0], 0.0)
        self._at += 8 * there
        return values

    def doubles(self, number: int, count: int) -> np.ndarray:
        """Values (count, n) of a packed repeated field."""
        size, length = 8 * count, b""
        while size >= 0x80:
            length, size = length + bytes([size & 0x7F | 0x80]), size >> 7
        self._expect(bytes([number << 3 | _BLOCK]) + length + bytes([size]))
        values = self._bytes(8 * count).view("<f8").T
        self._at += 8 * count
        return values

    def finish(self) -> None:
        """Raises WireError unless every message ends here and was as expected."""
        sound = self._sound & (self._at == self._end)
        if not sound.all():
            raise WireError(int(np.argmin(sound)))

    def _skip_tag(self, number: int, kind: int) -> np.ndarray:
        there = (self._data[self._at] == (number << 3 | kind)) & (self._at < self._end)
        self._at += there
        return there

    def _skip_bytes_of_varint(self, there: np.ndarray) -> None:
        while there.any():
            following = there & (self._data[self._at] >= 0x80)
            self._at += there
            there = following

    def _expect(self, content: bytes) -> None:
        self._sound &= (self._bytes(len(content)) == np.frombuffer(content, np.uint8)).all(axis=1)
        self._at += len(content)

    def _bytes(self, count: int) -> np.ndarray:
        """The next ``count`` bytes of each message (n, count)."""
        return np.lib.stride_tricks.sliding_window_view(self._data, count)[self._at]
