"""What evaluation counts, on clips of drawn discs; labels, videos; commands from recording to figures; training."""

from __future__ import annotations

import json
from contextlib import nullcontext

import av
import jax
import numpy as np
import pytest

from experiments import cli
from experiments.vision import clips, evaluation, export, network, pipeline
from experiments.vision.pipeline import SHIPPED
from robot_io.vision import rig
from robot_io.vision.detector import Detector, read_cells
from robot_io.vision.recording import FrameWriter
from tests.support.discs import draw_discs

START, SPEED = np.array([300.0, 400.0]), np.array([14.0, -6.0])


def test_a_clip_s_balls_misses_and_false_sights_are_counted(tmp_path):
    middles = [START + k * SPEED for k in range(10)]
    path = tmp_path / "a.mcap"
    with FrameWriter(path, {"a": (640, 512)}, 125.0) as writer:
        for k, frame in enumerate(draw_discs(middles)):
            writer.write("a", k / 125, frame)
    labels = dict(enumerate(middles))
    labels[5] = middles[5] + 50.0  # a wrong label: neither found nor right
    labels[6] = None  # as if there were none
    del labels[8]
    clip = clips.open_clip(path)
    for guided in (False, True):
        sights = evaluation.evaluate_clip(SHIPPED, clip, labels, guided)
        assert (sights.frames, sights.balls, sights.found) == (7, 6, 5)  # from the third frame on, without one
        assert sights.false >= 2 and max(sights.error) < 1.0
        assert any(line == "found 0.8333" for line in sights.lines())


def test_calibration_scales_every_covariance_alike():
    params = jax.tree.map(np.asarray, network.start(jax.random.key(0)))
    crops = np.random.default_rng(0).integers(0, 255, (2, 4, 64, 64, 3), np.uint8)
    scaled = pipeline.calibrate(params, np.full(10, 6.0))
    before, after = (
        read_cells(*(np.asarray(said).transpose(0, 3, 1, 2) for said in network.apply(p, *crops)))
        for p in (params, scaled)
    )
    # Errors three times too large for the covariance: it grows threefold.
    np.testing.assert_allclose(after.covariance, 3 * before.covariance, rtol=1e-3)
    np.testing.assert_allclose(after.centre, before.centre, atol=1e-4)
    assert after.probability == pytest.approx(before.probability, abs=1e-5)


@pytest.mark.slow
def test_from_a_recording_to_its_figures(tmp_path, capsys):
    recording, draft = tmp_path / "rally.mcap", tmp_path / "draft.csv"
    assert cli.main(["vision", "record", "--flights", "1", "--seed", "5", "--out", str(recording)]) == 0
    name = rig.standard().cameras[0].name
    truth = clips.read_labels(recording.with_suffix(f".{name}.csv"))
    assert cli.main(["vision", "label", str(recording), "--camera", name, "--out", str(draft)]) == 0
    drawn = clips.read_labels(draft)
    both = [k for k in truth if truth[k] is not None and drawn[k] is not None]
    assert np.median([np.linalg.norm(truth[k] - drawn[k]) for k in both]) < 1.0
    arguments = ["--labels", str(recording.with_suffix(f".{name}.csv")), "--camera", name]
    capsys.readouterr()
    assert cli.main(["vision", "evaluate", str(recording), *arguments]) == 0
    said = capsys.readouterr().out
    assert float(said.split("found ")[1].split()[0]) > 0.8 and "guided" in said
    assert cli.main(["vision", "render", "--count", "1", "--out", str(tmp_path / "pictures")]) == 0
    assert len(list((tmp_path / "pictures").rglob("*.png"))) == 2


@pytest.mark.slow
def test_training_from_nothing_gives_a_detector_and_resumes(tmp_path):
    plan = pipeline.Plan(20, 300, 120, 80, 120, 20, 120, 2, 1, 20, 1)
    figures = pipeline.train_detector(tmp_path, plan, lambda text: nullcontext())
    assert set(figures) == {"found", "false", "error_50", "error_90", "squared"}
    assert export.check_golden(tmp_path) < export.AGREEMENT
    assert Detector(tmp_path).detect(np.zeros((128, 128), np.uint8)) == []
    before = (tmp_path / "work" / "second.npz").stat().st_mtime_ns
    assert pipeline.train_detector(tmp_path, plan, lambda text: nullcontext()) == pytest.approx(figures, nan_ok=True)
    assert (tmp_path / "work" / "second.npz").stat().st_mtime_ns == before
    assert json.loads((tmp_path / "work" / "plan.json").read_text())["steps"] == 20
    with pytest.raises(ValueError, match="another --out"):
        pipeline.train_detector(tmp_path, pipeline.Plan.small(), lambda text: nullcontext())


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
