"""Tracks in the forms that people's files have, each read as the same balls.

The balls are SciPy-free parabolas with one bounce; the forms are written by hand here.
"""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

from ballmodel.io import TrackOptions, read

RATE = 120.0


def flights() -> dict[str, np.ndarray]:
    """Rows (n, 4) of t, x, y, z by name: six balls in vacuum, one bounce of restitution 0.9 each, 3 s apart."""
    found = {}
    for i in range(6):
        t = np.arange(84) / RATE
        fall = (1.0 + np.sqrt(1.0 + 2 * 9.81 * 0.3)) / 9.81
        late = np.maximum(t - fall, 0.0)
        z = np.where(late > 0, 0.02 + 0.9 * (9.81 * fall - 1.0) * late - 4.905 * late**2, 0.32 + t - 4.905 * t**2)
        found[f"{i:03d}"] = np.stack([t + 3.0 * i, 0.11 * i - 0.3 + 0.2 * t, 1.3 - 4.5 * t, z], axis=1)
    return found


ROWS = [(name, *row) for name, table in flights().items() for row in table]


def text(rows, head="trajectory,t,x,y,z"):
    lines = [",".join(c if isinstance(c, str) else f"{c:.9f}" for c in row) for row in rows]
    return "\n".join(([head] if head else []) + lines) + "\n"


def frame_numbers(rows):
    return [(name, f"{round(RATE * t)}", x, y, z) for name, t, x, y, z in rows]


EXACT = {
    "other names": text(ROWS, "Ball ID,Timestamp,Pos X,Pos Y,Pos Z"),
    "no header": text(ROWS, ""),
    "comments before it": "# exported\n" + text(ROWS),
    "semicolons and decimal commas": text(ROWS).replace(",", ";").replace(".", ","),
    "blanks": text(ROWS).replace(",", "  "),
    "tabs": text(ROWS).replace(",", "\t"),
    "milliseconds": text([(n, 1e3 * t, *p) for n, t, *p in ROWS]),
    "nanoseconds since 1970": text([(n, str(1_700_000_000_000_000_000 + round(1e9 * t)), *p) for n, t, *p in ROWS]),
    "millimetres": text([(n, t, *(1e3 * c for c in p)) for n, t, *p in ROWS]),
    "centimetres in the names": text([(n, t, *(1e2 * c for c in p)) for n, t, *p in ROWS], "id,time,x_cm,y_cm,z_cm"),
    "frames": text(frame_numbers(ROWS), "id,frame,x,y,z"),
    "frames called t": text(frame_numbers(ROWS)),
    "stamps twice": text([row for row in ROWS for _ in range(2)]),
    "backwards": text(ROWS[::-1]),
    "one id": text([("match", *row[1:]) for row in ROWS]),
    "no id": text([row[1:] for row in ROWS], "t,x,y,z"),
    "a column more": text([(*row, "0.97", "left") for row in ROWS], "trajectory,t,x,y,z,confidence,camera"),
}


def assert_same(found, wanted=None, atol=2e-6):
    wanted = list(flights().values()) if wanted is None else wanted
    assert len(found) == len(wanted)
    start = found.trajectories[0].time[0] - wanted[0][0, 0]
    for trajectory, rows in zip(found, wanted, strict=True):
        np.testing.assert_allclose(trajectory.time - start, rows[:, 0], atol=atol)
        np.testing.assert_allclose(trajectory.position.T, rows[:, 1:], atol=atol)


@pytest.mark.parametrize("form", EXACT, ids=str)
def test_a_form_of_text_is_read_as_the_same_balls(form, tmp_path):
    path = tmp_path / "balls.txt"
    path.write_text(EXACT[form], encoding="utf-8-sig")
    found = read(path)
    if form == "backwards":
        assert [t.name for t in found] == [f"{i:03d}" for i in reversed(range(6))]
        found = type(found)(found.trajectories[::-1], found.source)
    assert_same(found)


def test_arrays_and_objects(tmp_path):
    table = pd.DataFrame(ROWS, columns=["trajectory", "t", "x", "y", "z"])
    records = table.to_dict("records")
    (tmp_path / "list.json").write_text(json.dumps(records))
    (tmp_path / "lines.jsonl").write_text("\n".join(map(json.dumps, records)))
    (tmp_path / "nested.json").write_text(
        json.dumps([{"id": r["trajectory"], "time": r["t"], "position": {a: r[a] for a in "xyz"}} for r in records])
    )
    table.to_parquet(tmp_path / "table.parquet")
    np.save(tmp_path / "array.npy", table[["t", "x", "y", "z"]].to_numpy())
    np.savez(tmp_path / "arrays.npz", t=table["t"], xyz=table[["x", "y", "z"]].to_numpy(), ball=table.index // 84)
    for path in tmp_path.iterdir():
        assert_same(read(path))


def test_lost_samples_are_left_out_and_counted(tmp_path):
    path, lost = (
        tmp_path / "lost.csv",
        {5: ("nan",) * 3, 50: ("",) * 3, 90: ("0",) * 3, 200: ("-1",) * 3, 300: ("-",) * 3},
    )
    path.write_text(text([(*row[:2], *lost.get(i, row[2:])) for i, row in enumerate(ROWS)]))
    found = read(path)
    kept = np.array([i for i in range(len(ROWS)) if i not in lost])
    wanted = np.array([row[1:] for row in ROWS])[kept]
    assert_same(found, [wanted[kept // 84 == k] for k in range(6)])
    assert found.notes == (
        "3 of 504 rows without all their numbers were left out",
        "2 of 504 rows with three equal coordinates, which mark no ball were left out",
    )


def test_two_balls_under_one_id_are_parted(tmp_path):
    tables = list(flights().values())
    other = tables[1] * [1, -1, -1, 1] - [3.0, 0, 0, 0]
    rows = [row for pair in zip(tables[0], other, strict=True) for row in pair]
    path = tmp_path / "pair.csv"
    path.write_text(text(map(tuple, rows), "t,x,y,z"))
    assert_same(read(path), [tables[0], other])


def test_what_a_person_says_counts(tmp_path):
    path = tmp_path / "odd.csv"
    path.write_text(text([(t, a, b, c, "9") for _, t, a, b, c in ROWS], "when,east,north,up,x"))
    names = {"t": "when", "x": "east", "y": "north", "z": "up"}
    assert_same(read(path, options=TrackOptions(columns=names)))
    with pytest.raises(ValueError, match="--columns x=west: expected one of when, east"):
        read(path, options=TrackOptions(columns=names | {"x": "west"}))
    path.write_text(text(frame_numbers(ROWS)))
    slow = read(path, options=TrackOptions(time="frames", rate=60.0))
    assert slow.trajectories[0].time[-1] == pytest.approx(83 / 60)
    path.write_text(text([(n, f, x, y, -z) for n, f, x, y, z in frame_numbers(ROWS)]))
    with pytest.raises(ValueError, match="numbers of frames; say how many a second there are"):
        read(path)
    path.write_text(text(ROWS, "id,time,x_mm,y_mm,z_mm"))
    assert_same(read(path, options=TrackOptions(length="m")))
    with pytest.raises(ValueError, match="unit of length: expected one of m, cm, mm, got 'inch'"):
        TrackOptions(length="inch")
