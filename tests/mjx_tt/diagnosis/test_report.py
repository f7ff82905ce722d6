"""The report and the JSON of a diagnosis: of balls flown by other code in a side wind, and of joints."""

from __future__ import annotations

import base64
import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from mjx_tt import diagnosis as gap
from mjx_tt.diagnosis.ball import effects as catalogue
from mjx_tt.diagnosis.ball.spins import Spins
from mjx_tt.diagnosis.hits.diagnose import HitCause, HitFindings
from mjx_tt.diagnosis.joint import effects as joint_effects
from mjx_tt.diagnosis.joint.effects import NAMES
from mjx_tt.diagnosis.logs import Logs
from mjx_tt.diagnosis.report import figures, residuals
from mjx_tt.diagnosis.report import page as report
from mjx_tt.diagnosis.report import text as words
from mjx_tt.diagnosis.verdict import Unexplained
from mjx_tt.sim import model
from tests.exam.generator import robot
from tests.exam.generator.world import World
from tests.mjx_tt.diagnosis.test_tracks import flights
from tests.mjx_tt.diagnosis.together.test_joints import logged
from tests.support.paths import ROOT

pytestmark = pytest.mark.optimised

PLAY = {
    "nominal": {"rate": 0.93, "low": 0.91, "high": 0.95},
    "extended": {"rate": 0.71, "low": 0.68, "high": 0.74},
    "retrained": {"rate": 0.9, "low": 0.88, "high": 0.92},
    "balls": 1000,
}
SCHEMA = json.loads((ROOT / "docs" / "reference" / "verdict.schema.json").read_text(encoding="utf-8"))
WIND = 0.35  # [m/s] towards -x
VOID = {"meta", "link", "br", "img", "hr", "wbr", "input"}


@pytest.fixture(scope="module")
def windy() -> gap.Diagnosis:
    return gap.diagnose(Logs(flights(60, 1, world=World(wind_x=-WIND)), (), {"windy.csv": "ab" * 32}))


@pytest.fixture(scope="module")
def joints() -> gap.Diagnosis:
    """Joints of which one answers 60 ms late on top of what is known."""
    true = {name: robot.nominal(name) for name in robot.JOINTS}
    true["joint_2"] = replace(true["joint_2"], action_delay=0.131)
    records = logged(true, np.random.default_rng(4), 20.0)
    return gap.diagnose(Logs((), tuple(records), {"command.csv": "12" * 32, "state.csv": "34" * 32}))


class Page(HTMLParser):
    """Tags with their attributes, text, and whether every tag is closed in its turn."""

    def __init__(self, text: str):
        super().__init__()
        self.tags, self.text, self.open, self.section, self.sections = [], "", [], "", {}
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open and self.open.pop() == tag, f"</{tag}> at {self.getpos()}"

    def handle_data(self, data):
        if self.open and self.open[-1] == "h2":
            self.section = data
        if "style" not in self.open:
            self.text += data
            self.sections[self.section] = self.sections.get(self.section, "") + data


@pytest.fixture(scope="module")
def windy_page(windy, tmp_path_factory) -> tuple[Page, list[Path]]:
    return written(tmp_path_factory.mktemp("report"), windy, play=PLAY)


def written(folder: Path, diagnosis: gap.Diagnosis, **more) -> tuple[Page, list[Path]]:
    files = report.write_report(folder, diagnosis, "one <log> & another.csv", **more)
    page = Page(files[0].read_text(encoding="utf-8"))
    assert not page.open
    return page, files


def test_page_is_whole_and_needs_nothing_else(windy_page):
    page, files = windy_page
    assert files[0].name == "report.html"
    assert sorted(p for p in files[0].parent.rglob("*") if p.is_file()) == sorted(files)
    assert not {"script", "link", "iframe", "object", "base"} & {tag for tag, _ in page.tags}
    assert "one <log> & another.csv" in page.text, "the title is text, not markup"
    for _, attributes in page.tags:
        for name in set(attributes) & {"src", "href", "srcset"}:
            assert attributes[name].startswith(("data:image/png;base64,", "#"))
    anchors = {a.get("id") for _, a in page.tags}
    assert {a["href"].removeprefix("#") for tag, a in page.tags if tag == "a"} <= anchors
    pictures = {f.read_bytes() for f in files[1:]}
    sources = [a["src"] for tag, a in page.tags if tag == "img"]
    shown = {base64.b64decode(s.removeprefix("data:image/png;base64,"), validate=True) for s in sources}
    assert shown == pictures, "the page and plots/ show the same pictures"
    assert "ab" * 32 in page.sections["Data and noise"] and "60 flights" in page.sections["Data and noise"]


def test_sentence_names_the_cause_with_its_direction_and_size(windy, windy_page):
    text = words.headline(windy)
    assert windy.verdict.verdict == "named" and [c.name for c in windy.verdict.causes] == ["wind_x"]
    assert text.startswith("The air moves sideways, towards -x, at 0.3")
    low, high = (float(x) for x in text.split("(")[1].split(")")[0].split(" to "))
    assert low <= WIND <= high  # to two digits
    assert "gravity_tilt_x" in windy.verdict.causes[0].group
    page, _ = windy_page
    assert page.sections["Verdict"].split("Verdict", 1)[1].strip().startswith(words.headline(windy))
    assert "gravity_tilt_x" in page.sections["What these logs cannot tell"]
    assert "ball.flight.wind_x" in page.sections["Parameters"]


def test_curve_is_the_plain_quantile_of_each_bin():
    rng = np.random.default_rng(0)
    quantity, residual = rng.uniform(0.0, 1.0, 4000), rng.normal(size=4000)
    c = residuals.curve(quantity, residual + 10.0 * quantity, np.ones(4000, bool), 5)
    low, high = np.percentile(quantity, (1, 99))
    inside = (quantity >= low) & (quantity < low + (high - low) / 5)
    expected = np.percentile((residual + 10.0 * quantity)[inside], (5, 25, 50, 75, 95))
    np.testing.assert_allclose(c.quantiles[:, 0], expected, rtol=1e-12)
    np.testing.assert_allclose(c.place[0], low + 0.1 * (high - low), rtol=1e-12)
    assert residuals.curve(quantity[:10], residual[:10], np.ones(10, bool)).place.size == 0
    assert residuals.curve(np.ones(100), residual[:100], np.ones(100, bool)).place.size == 0


def test_smallest_visible_effect_falls_with_more_balls(windy):
    """Half the balls hold half the information: what shows grows by the square root of two, up to its own scatter."""
    all_of_them = words.detectable(windy.balls)
    assert set(all_of_them) >= {"table_friction", "wind_y", "camera_scale"} and "wind_x" not in all_of_them
    search = windy.balls.search
    half = replace(search, model=search.model.of_pieces(np.arange(0, windy.balls.problem.grid.n, 2)))
    fewer = words.detectable(replace(windy.balls, search=half))
    ratio = [fewer[n] / all_of_them[n] for n in all_of_them if math.isfinite(all_of_them[n] + fewer[n])]
    assert 1.2 < np.median(ratio) < 1.7


def test_verdicts_validate_against_the_schema(windy, joints, tmp_path):
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    check = jsonschema.Draft202012Validator(SCHEMA)
    for diagnosis in (windy, joints):
        diagnosis.verdict.save(tmp_path / "verdict.json")
        check.validate(json.loads((tmp_path / "verdict.json").read_text(encoding="utf-8")))
    wrong = windy.verdict.to_dict() | {"verdict": "sure"}
    assert [e.path[0] for e in check.iter_errors(json.loads(json.dumps(wrong)))] == ["verdict"]


def test_joints_are_named_and_drawn(joints, tmp_path):
    assert "joint_2 acts later on a command than the model says, delay 131" in words.headline(joints)
    page, files = written(tmp_path, joints)
    assert [f.stem for f in files[1:]] == ["verdict", "residuals_joints", "parameters", "held_out_joints"]
    assert "joint_2.action_delay" in page.sections["Parameters"] and "ball" not in page.sections["Data and noise"]


def test_nothing_wrong_says_what_would_have_been_seen(tmp_path):
    """The windy balls against a model that knows the wind: nothing is left to name."""
    path = "ball.flight.wind_x"
    balls = flights(60, 1, world=World(wind_x=-WIND))
    right = gap.diagnose(Logs(balls, (), {}), model.with_values(model.SimModel(), {path: -WIND}))
    assert right.verdict.verdict == "none" and "agrees with 60 balls" in words.nothing(right)
    page, _ = written(tmp_path, right)
    assert "table_restitution" in page.sections["Verdict"]


def test_unexplained_says_where_and_how_much(windy, tmp_path):
    odd = Unexplained("bounce over x", "x near -0.18 m", "z", "12.8 mm")
    unexplained = replace(windy, verdict=replace(windy.verdict, verdict="unexplained", unexplained=odd))
    text = words.headline(unexplained)
    assert all(part in text for part in ("no entry of the catalogue explains", "x near -0.18 m", "12.8 mm"))
    page, _ = written(tmp_path, unexplained)
    assert ("span", {"class": "badge unexplained"}) in page.tags


def test_spins_are_drawn(windy, tmp_path):
    mean = np.random.default_rng(0).normal([[60.0], [0.0], [5.0]], 30.0, (3, 40))
    spins = Spins(("day",) * 40, tuple(map(str, range(40))), np.zeros(40), mean, np.full((3, 40), 4.0))
    page, files = written(tmp_path, replace(windy, balls=replace(windy.balls, spins=spins)))
    assert f"median {np.median(np.linalg.norm(mean, axis=0)):.0f} rad/s" in page.sections["Spin of the balls"]
    assert "spins.png" in [f.name for f in files]


def test_hits_show_where_the_returns_lie_off(windy, tmp_path):
    """Forty hits whose returns are 20 mm ahead along the table and 0.3 m/s too slow upwards, and right afterwards."""
    scatter = np.random.default_rng(2).normal(size=(6, 40)) * np.array([[2e-3] * 3 + [0.04] * 3]).T
    scatter -= np.median(scatter, axis=1, keepdims=True)
    off = np.array([0.0, 0.020, 0.0, 0.0, 0.0, -0.3])[:, None]
    causes = (HitCause(catalogue.BY_NAME["paddle_offset"], (), 0.012, 0.001, 0.04),)
    hits = HitFindings(causes, 40, ("paddle_friction", "paddle_offset"), scatter + off, scatter)
    page, files = written(tmp_path, replace(windy, hits=hits))
    assert "hits.png" in [f.name for f in files]
    text = page.sections["The robot's hits"]
    assert "40 hits were judged: they name paddle_offset" in text and "velocity z [m/s]-0.30 (" in text
    number = r"([+-][0-9.]+)"
    cells = (
        rf"<td>place y \[mm\]</td>\s*<td class=n[^>]*><b>{number}</b> \({number} to {number}\)</td>.*?<b>{number}</b>"
    )
    middle, low, high, after = map(float, re.search(cells, files[0].read_text(encoding="utf-8")).groups())
    assert (middle, after) == (20.0, 0.0) and 18.5 < low < 20.0 < high < 21.5


def test_interval_of_a_median_covers_it():
    """By the binomial law: of twelve numbers the third to the tenth, of twenty the sixth to the fifteenth."""
    assert figures.median_interval(np.arange(12.0, 0.0, -1.0)) == (6.5, 3.0, 10.0)
    assert figures.median_interval(np.arange(1.0, 21.0)) == (10.5, 6.0, 15.0)
    draws = np.random.default_rng(5).exponential(size=(2000, 31))
    inside = [low <= math.log(2.0) <= high for _, low, high in map(figures.median_interval, draws)]
    assert 0.90 <= np.mean(inside) < 0.96


def test_cost_in_play(windy_page, joints, tmp_path):
    page, files = windy_page
    text = page.sections["What it costs in play"]
    assert "costs 22.0 percentage points" in text and "brings 19.0 back" in text
    assert "play.png" in [f.name for f in files]
    page, _ = written(tmp_path, joints, play=PLAY | {"retrained": None})
    assert "costs 22.0" in page.text and "brings" not in page.sections["What it costs in play"]


def test_every_name_of_the_catalogue_has_words():
    effects = {e.name for e in catalogue.EFFECTS}
    names = effects | {t.name for e in catalogue.EFFECTS for t in e.twins}
    assert names == set(catalogue.DESCRIPTIONS) and set(NAMES) == set(joint_effects.DESCRIPTIONS)
    everything = [*catalogue.DESCRIPTIONS.values(), *joint_effects.DESCRIPTIONS.values()]
    assert all(e.meaning and e.reading and e.unit for e in everything)


def test_a_failed_write_leaves_the_old_report(joints, tmp_path, monkeypatch):
    (tmp_path / "report.html").write_text("old")

    def broken(figure):
        raise RuntimeError("no picture")

    monkeypatch.setattr("mjx_tt.viz.html.png", broken)
    with pytest.raises(RuntimeError, match="no picture"):
        report.write_report(tmp_path, joints, "title")
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"] and (tmp_path / "report.html").read_text() == "old"
