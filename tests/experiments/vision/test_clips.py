"""Labels of several programs, and frames of video files and recordings."""

import av
import numpy as np
import pytest

from experiments.vision import clips

FORMS = {
    "own.csv": "frame,x,y\n0,10.5,20\n2,,\n3,7,8\n",
    "blur.csv": "Frame,Visibility,X,Y,L,Theta\n0,1,10.5,20,3,0.1\n2,0,0,0,0,0\n3,1,7,8,2,90\n",
    "ttnet.json": '{"0": {"x": 10.5, "y": 20}, "2": {"x": -1, "y": -1}, "3": {"x": 7, "y": 8}}',
}


@pytest.mark.parametrize("name", FORMS)
def test_labels_are_read(tmp_path, name):
    (tmp_path / name).write_text(FORMS[name])
    labels = clips.read_labels(tmp_path / name)
    assert sorted(labels) == [0, 2, 3] and labels[2] is None
    assert [tuple(labels[k]) for k in (0, 3)] == [(10.5, 20.0), (7.0, 8.0)]
    clips.write_labels(tmp_path / "again.csv", labels)
    assert clips.read_labels(tmp_path / "again.csv").keys() == labels.keys()


def test_a_video_gives_bayer_frames(tmp_path):
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as file:
        stream = file.add_stream("mpeg4", rate=50)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = 70, 50, "yuv420p", 4_000_000
        for _ in range(4):
            picture = np.full((50, 70, 3), (200, 100, 30), np.uint8)
            file.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        file.mux(stream.encode())
    clip = clips.open_clip(path)
    frames = list(clip.frames())
    assert clip.rate == 50 and len(frames) == 4 and frames[0].shape == (50, 70)
    levels = [frames[1][row::2, column::2].mean() for row, column in ((0, 0), (0, 1), (1, 0), (1, 1))]
    np.testing.assert_allclose(levels, (200, 100, 100, 30), atol=6)
