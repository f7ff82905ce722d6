"""The page in a real browser: pictures that move, hands at the page that change the simulation, and the other sources.

Drawn by a processor where there is no graphics card, a frame takes a while: everything is waited for.
"""

import io
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest
from PIL import Image

from ballmodel import registry
from experiments import cli
from experiments.runs import load_policy
from experiments.view import viewer as viewers
from experiments.view.auth import Server
from experiments.view.playlist import PolicyPlaylist
from tests.support.paths import ROOT
from tests.support.tiny_experiment import write_tiny

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = (
    "--no-sandbox --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader --disable-quic --no-first-run "
    "--disable-background-networking --disable-component-update --disable-sync"
).split()
PATIENCE = 60.0  # [s]
WIDE, NARROW = (900, 560), (430, 760)
RESTITUTION = "ball.table.restitution"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium"),
]


def until(condition: Callable[[], object], what: str):
    """Waits for a condition and returns what it gave."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        if found := condition():
            return found
        time.sleep(0.1)
    pytest.fail(f"after {PATIENCE:.0f} s: not yet {what}")


@pytest.fixture(scope="module")
def browser():
    from playwright.sync_api import sync_playwright  # not where the module is skipped

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield chromium
        chromium.close()


@pytest.fixture
def open_page(browser):
    """Opens an address in a fresh profile; closed after the test."""
    contexts = []

    def opened(address: str, size: tuple[int, int] = WIDE):
        context = browser.new_context(viewport={"width": size[0], "height": size[1]})
        contexts.append(context)
        page = context.new_page()
        page.goto(address)
        page.wait_for_selector("canvas", timeout=1000 * PATIENCE)
        return page

    yield opened
    for context in contexts:
        context.close()


@pytest.fixture
def shown():
    """Serves a playlist and returns its viewer and address; stopped after the test."""
    running = []

    def serve(playlist):
        server = Server("127.0.0.1", 0)
        viewer = viewers.Viewer(server, playlist)
        running.append((server, viewer, threading.Thread(target=viewer.run, daemon=True)))
        running[-1][2].start()
        return viewer, f"http://127.0.0.1:{server.get_port()}/"

    yield serve
    for server, viewer, thread in running:
        viewer.stop()
        thread.join()
        server.stop()


def picture(page) -> np.ndarray:
    """Screenshot of the page, (height, width, 3)."""
    return np.asarray(Image.open(io.BytesIO(page.screenshot(timeout=1000 * PATIENCE))).convert("RGB"), float)


def table_is_seen(image: np.ndarray) -> bool:
    """True where a good part of the picture is as blue as the table's top."""
    red, green, blue = np.moveaxis(image, -1, 0)
    return float(((blue > red + 60) & (blue > green + 20) & (red < 130)).mean()) > 0.008


def moving(page) -> None:
    """Waits until the table is drawn, and something moves in the left part, where no panel is."""
    until(lambda: table_is_seen(picture(page)), "the table drawn")
    first = picture(page)
    width = int(0.5 * first.shape[1])
    until(lambda: (np.abs(picture(page) - first)[:, :width].max(axis=2) > 60).sum() > 40, "anything that moves")


@pytest.mark.parametrize("size", [WIDE, NARROW], ids=["wide", "narrow"])
def test_the_table_is_drawn_and_the_play_moves(shown, open_page, play, size):
    viewer, address = shown(play)
    page = open_page(address, size)
    moving(page)
    assert page.get_by_text("Ball 1 of player3/M0").or_(page.get_by_text("of player3/M0")).count() >= 1
    until(lambda: viewer.number >= 1, "the second ball")


def number(page, label: str):
    """The number beside a slider."""
    return page.get_by_text(label, exact=True).first.locator("xpath=following::input[not(@type='hidden')][1]")


def thumb(page, label: str):
    """The part of a slider that is moved."""
    return page.get_by_text(label, exact=True).first.locator("xpath=following::*[@role='slider'][1]")


def test_a_slider_moved_in_the_page_changes_what_the_simulation_does(shown, open_page, play):
    viewer, address = shown(play)
    page = open_page(address)
    page.get_by_role("button", name="Pause").click()
    until(lambda: not viewer.playing, "paused")
    before = viewer.shown[0].balls["ball"]
    page.get_by_role("tab", name="Physics").click()
    box = number(page, "table's restitution")
    assert float(box.input_value()) == pytest.approx(play.values[RESTITUTION], abs=0.01)
    thumb(page, "table's restitution").press("Home")
    until(lambda: play.values[RESTITUTION] == pytest.approx(0.5), "the slider's low end in the simulation")
    assert float(box.input_value()) == pytest.approx(0.5)
    until(lambda: viewer.shown[0].balls["ball"] is not before, "a new replay")
    after = viewer.shown[0].balls["ball"]
    bounce = int(np.argmin(before[: len(before) // 2, 2]))
    np.testing.assert_allclose(after[: bounce - 8], before[: bounce - 8], atol=1e-5)  # the same flight until then
    rise = [np.diff(path[:, 2])[bounce + 5 : bounce + 20].mean() for path in (before, after)]
    assert rise[1] < 0.75 * rise[0]
    page.get_by_role("button", name="As the model has it").click()
    until(lambda: play.values == play.recorder.nominal(), "all values as before")
    until(lambda: np.array_equal(viewer.shown[0].balls["ball"], before), "the replay as before")


def test_a_training_is_followed_while_it_goes_on(shown, open_page, tmp_path, recorder):
    yaml = write_tiny(tmp_path, updates=100_000, evaluate_every=100_000, checkpoint_seconds=1)
    command = [sys.executable, "-m", "experiments.cli", "train", str(yaml), "--out", str(tmp_path)]
    training = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        folder = tmp_path / "tiny"
        until(lambda: any((folder / "checkpoints").glob("*.npz")), "a checkpoint")
        trained = load_policy.load(folder)
        play = PolicyPlaylist(recorder, [viewers.title_of(trained)], [trained.policy], registry.load("player5/M0"))
        viewer, address = shown(play)
        viewers.follow_training(folder, viewer)
        page = open_page(address)
        moving(page)
        first = viewer.shown[0]
        until(lambda: viewer.shown[0].title != first.title, "a newer checkpoint")
        assert viewer.shown[0].title.startswith("tiny, update ")
        assert not np.array_equal(play.policies[0].theta, trained.policy.theta)
    finally:
        training.terminate()
        training.wait()


def test_an_exported_page_plays_without_a_server(open_page, browser, tmp_path, play, capsys):
    path = tmp_path / "page.html"
    assert cli.main(["view", "--export", str(path), "--entries", "1"]) == 0
    assert path.stat().st_size < 2_000_000
    context = browser.new_context(viewport={"width": 700, "height": 500}, offline=True)
    page, asked = context.new_page(), []
    page.on("request", lambda request: asked.append(request.url))
    page.goto(path.as_uri())
    page.wait_for_selector("canvas", timeout=1000 * PATIENCE)
    moving(page)
    assert not [url for url in asked if not url.startswith(("file:", "blob:", "data:"))]
    context.close()
