"""Damaged EGM datagrams."""

from __future__ import annotations

import struct


def damage(rng, kind, valid, numbers, plain, wrong):
    """Kind 0: cut, 1: noise, 2: a number is ``wrong``, 4, 5: a flipped bit, 6: bytes exchanged, 7: a number's byte.

    numbers  offsets of the doubles that are read; plain: those of the bytes to flip bits in
    """
    data = bytearray(valid)
    if kind == 0:
        del data[rng.randrange(len(valid)) :]
    elif kind == 1:
        data = rng.randbytes(rng.randrange(200))
    elif kind == 2:
        at = rng.choice(numbers)
        data[at : at + 8] = struct.pack("<d", rng.choice(wrong))
    elif kind in (4, 5):
        data[rng.choice(plain)] ^= 1 << rng.randrange(8)
    elif kind == 6:
        at = rng.randrange(len(valid))
        data[at : at + rng.randrange(3)] = rng.randbytes(rng.randrange(3))
    elif kind == 7:
        data[rng.choice(numbers) + rng.randrange(8)] = rng.randrange(256)
    return bytes(data)
