"""Trains the detector from nothing: flights, crops, network, hard negatives, network again, covariance, export.

Each stage leaves a file in the folder ``work``; a run that was interrupted goes on after the last one.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.progress import Stage
from experiments.vision import export, flights, network, training
from experiments.vision.crops import Crops, make_crops, mine_crops
from experiments.vision.evaluation import WITHIN, evaluate_rendered, use_one_core
from robot_io.vision import rig
from robot_io.vision.detector import Cells, Detector, read_cells

SHIPPED = Path(__file__).parents[1] / "shipped" / "vision"
MINING_THRESHOLD = 0.2
HARD_SHARE = 3  # times that each hard negative is in the data


@dataclass(frozen=True)
class Plan:
    """Sizes of the stages; the defaults made the shipped weights."""

    flights: int = 4000
    hall: int = 60_000  # crops as the paper's cameras give them
    film: int = 16_000  # crops as of ordinary video
    dressed: int = 14_000  # crops of people who wear photographs, half as hall and half as film
    held_out: int = 4000  # crops of flights and halls that training never sees
    first_steps: int = 2600
    places: int = 8_000  # crops for the search's classifier, a quarter as film
    hall_scenes: int = 400  # in which hard negatives are sought
    film_scenes: int = 150
    steps: int = 4000
    calibration_flights: int = 12  # by which the covariance is scaled
    seed: int = 0

    @classmethod
    def small(cls) -> Plan:
        """A try-out of a minute, whose detector is poor."""
        return cls(60, 900, 240, 120, 240, 60, 240, 4, 2, 60, 1)


def train_detector(out: Path, plan: Plan, stage: Stage, note: Callable[[str], object] = print) -> dict[str, float]:
    """Trains and writes the detector to ``out``; returns its figures on held-out crops.

    Raises ValueError where ``out`` holds the work of another plan.
    """
    work = out / "work"
    work.mkdir(parents=True, exist_ok=True)
    _claim(work / "plan.json", plan)
    use_one_core()

    def tell(step: int, cost: float) -> None:
        note(f"  step {step}: cost {cost:.3f}")

    tracks_file = work / "tracks.npy"
    if not tracks_file.exists():
        with stage(f"{plan.flights} flights"):
            np.save(tracks_file, flights.fly_balls(plan.flights, plan.seed + 1))
    tracks = np.load(tracks_file)
    flown = flights.split_flights(tracks, held_out=False)
    for number, (name, count) in enumerate((("hall", plan.hall), ("film", plan.film), ("held_out", plan.held_out))):
        if not (file := work / f"{name}.npz").exists():
            with stage(f"{count} crops: {name}"):
                chosen = flights.split_flights(tracks, name == "held_out")
                make_crops(count, chosen, np.random.default_rng(plan.seed + 11 + number), name == "film").save(file)
    crops = Crops.load(work / "hall.npz", work / "film.npz")
    held_out = Crops.load(work / "held_out.npz")

    first = work / "first.npz"
    if not first.exists():
        with stage(f"network, {plan.first_steps} steps"):
            training.save(first, training.train(crops, plan.first_steps, plan.seed, report=tell))
    dressed = work / "dressed.npz"
    if not dressed.exists():
        with stage(f"{plan.dressed} crops: dressed people"):
            rng = np.random.default_rng(plan.seed + 21)
            parts = [make_crops(plan.dressed // 2, flown, rng, video, dressed=True) for video in (False, True)]
            Crops.join(parts).save(dressed)
    seen = work / "places.npz"
    if not seen.exists():
        with stage(f"{plan.places} crops for the search"):
            features, balls = training.collect_places(plan.places, flown, np.random.default_rng(plan.seed + 41))
            np.savez(seen, features=features, balls=balls)
    order = training.train_search(**np.load(seen))
    hard = work / "hard.npz"
    if not hard.exists():
        with stage("hard negatives"):
            export.export(work / "first", training.load(first), order, held_out)
            detector = Detector(work / "first", threshold=MINING_THRESHOLD)
            mined = [
                mine_crops(detector, count, np.random.default_rng(plan.seed + 31 + video), video=bool(video))
                for video, count in enumerate((plan.hall_scenes, plan.film_scenes))
            ]
            Crops.join(mined).save(hard)
    crops = Crops.join([crops, Crops.load(dressed), *[Crops.load(hard)] * HARD_SHARE])
    second = work / "second.npz"
    if not second.exists():
        with stage(f"network again, {plan.steps} steps"):
            params = training.train(crops, plan.steps, plan.seed + 1, training.load(first), training.RATE * 0.7, tell)
            training.save(second, params)
    with stage("covariance, export"):
        params = training.load(second)
        export.export(out, params, order, held_out)
        some, rng = flown[: plan.calibration_flights], np.random.default_rng(plan.seed + 51)
        sights = evaluate_rendered(out, rig.standard().cameras, some, rng)
        params = calibrate(params, np.array(sights.squared))
        export.export(out, params, order, held_out)
    return judge(params, held_out)


def _claim(file: Path, plan: Plan) -> None:
    if file.exists() and json.loads(file.read_text("utf-8")) != asdict(plan):
        raise ValueError(f"{file.parent}: expected the work of this plan, got another's; choose another --out")
    file.write_text(json.dumps(asdict(plan), indent=1), "utf-8")


def calibrate(params: Any, squared: np.ndarray) -> Any:
    """Scales the covariance so that the squared errors over it (n,) get the mean of two degrees of freedom, 2.

    They come from whole frames: crops have more balls that are half hidden or at a window's edge. Without any, as in a
    try-out that finds no ball, the covariance stays.
    """
    if not len(squared):
        return params
    factor = np.sqrt(2.0 / squared.mean())
    kernel, bias = (np.array(params["out"][name]) for name in ("kernel", "bias"))
    for diagonal in (3, 5):
        bias[diagonal] += np.log(factor)
    kernel[..., 4], bias[4] = kernel[..., 4] * factor, bias[4] * factor
    return {**params, "out": {"kernel": kernel, "bias": bias}}


def judge(params: Any, crops: Crops) -> dict[str, float]:
    """Figures on crops: share found, false shares, errors [px], squared errors over the covariance."""
    parts = []
    for i in range(0, len(crops), 200):
        out = network.apply(params, crops.fine[i : i + 200], crops.coarse[i : i + 200])
        parts.append(read_cells(*(np.asarray(part).transpose(0, 3, 1, 2) for part in out)))
    said = Cells(*map(np.concatenate, zip(*parts, strict=True)))
    there, miss = crops.labels[:, 0] > 0, said.centre - crops.labels[:, 1:3]
    error = np.linalg.norm(miss, axis=1)
    found = there & (said.probability > 0.5) & (error < WITHIN)
    squared = np.einsum("ni,nij,nj->n", miss[found], np.linalg.inv(said.covariance[found]), miss[found])
    half, most = np.percentile(error[found], [50, 90]) if found.any() else (np.nan, np.nan)
    return {
        "found": float(found.sum()) / max(int(there.sum()), 1),
        "false": float((said.probability[~there] > 0.5).mean()),
        "error_50": float(half),
        "error_90": float(most),
        "squared": float(squared.mean()) if len(squared) else np.nan,
    }
