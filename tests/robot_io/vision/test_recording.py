"""Raw frames come back bit by bit, with their stamps; what is no recording is refused."""

import numpy as np
import pytest
import zstandard
from mcap.writer import Writer

from robot_io.vision.recording import FrameReader, FrameWriter, compress_frame, decompress_frame

SIZES = {"left": (64, 48), "right": (32, 32)}


def draw(rng, size):
    return rng.integers(0, 256, size[::-1], np.uint8)


def test_frames_and_stamps_come_back(tmp_path):
    rng, path = np.random.default_rng(0), tmp_path / "a.mcap"
    written = [(name, k / 125 + 0.001, draw(rng, size)) for k in range(5) for name, size in SIZES.items()]
    with FrameWriter(path, SIZES, 125.0) as writer:
        for entry in written:
            writer.write(*entry)
    reader = FrameReader(path)
    assert (reader.cameras, reader.rate, reader.bayer) == (SIZES, 125.0, "RGGB")
    for given, got in zip(written, reader.frames(), strict=True):
        assert got.camera == given[0] and abs(got.stamp - given[1]) < 1e-9
        np.testing.assert_array_equal(got.frame, given[2])
    assert [r.camera for r in reader.frames("right")] == ["right"] * 5


def test_the_encoding_is_the_documented_one():
    frame = draw(np.random.default_rng(1), (8, 6))
    raw = np.frombuffer(zstandard.ZstdDecompressor().decompress(compress_frame(frame)), np.uint8)
    red = raw[:12].reshape(3, 4)  # quarter picture of the rows and columns 0, 2, 4
    assert [int(sum(map(int, row[: k + 1]))) % 256 for row in red for k in range(4)] == frame[::2, ::2].ravel().tolist()


def test_a_colour_that_hardly_changes_takes_little_room():
    frame = np.empty((256, 256), np.uint8)
    frame[::2], frame[1::2] = np.arange(256) % 7 // 3 + 100, 30
    assert len(compress_frame(frame)) < frame.size / 20


def test_other_frames_and_bytes_are_refused():
    for wrong in (np.zeros((4, 4)), np.zeros((4, 4, 3), np.uint8), np.zeros((5, 4), np.uint8)):
        with pytest.raises(ValueError, match="expected a frame"):
            compress_frame(wrong)
    for data, size in ((b"no", (4, 4)), (compress_frame(np.zeros((4, 4), np.uint8)), (8, 8))):
        with pytest.raises(ValueError, match="record it again"):
            decompress_frame(data, *size)


def test_other_files_and_cameras_are_refused(tmp_path):
    empty = tmp_path / "empty.mcap"
    writer = Writer(str(empty))
    writer.start()
    writer.finish()
    with pytest.raises(ValueError, match="found none"):
        FrameReader(empty)
    path = tmp_path / "a.mcap"
    with FrameWriter(path, SIZES, 125.0) as frames:
        with pytest.raises(ValueError, match="camera left"):
            frames.write("left", 0.0, np.zeros((32, 32), np.uint8))
    with pytest.raises(ValueError, match="left, right"):
        list(FrameReader(path).frames("middle"))
