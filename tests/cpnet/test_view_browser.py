"""The live view in a real browser: drawn objects are recognised by their unique colours."""

import io
import re
import shutil
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import pytest

from studies import palette
from tests.cpnet.commands import UNHURRIED, Shell, free_port
from viewer.layers import Rgb, rgb

pytest.importorskip("rerun", reason="the extra `view` is not installed")
playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
images = pytest.importorskip("PIL.Image", reason="pillow is not installed")

CHROMIUM = shutil.which("chromium")
FLAGS = [
    "--headless=new", "--no-sandbox", "--no-first-run", "--disable-quic", "--disable-sync",
    "--disable-background-networking", "--disable-component-update",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
]  # fmt: skip
WIDTH, HEIGHT = 1600, 900
SCENE = np.s_[65:870, :1140]
UPLINK, LATENCY, SCORE = np.s_[60:240, 1400:], np.s_[280:500, 1300:], np.s_[715:860, 1150:]
SHOT_MS = 120_000
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed"),
]


@pytest.fixture
def page() -> Iterator[Any]:
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, headless=True, args=FLAGS)
        yield browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, color_scheme="dark")
        browser.close()


def pixels(picture: np.ndarray, colours: Iterable[Rgb]) -> int:
    """Counts the pixels that have one of the colours."""
    apart = [np.abs(picture - np.array(colour)).max(axis=-1) for colour in colours]
    return int((np.min(apart, axis=0) < 12).sum())


def drawn(shot: bytes) -> dict[str, int]:
    """Returns of what is to be seen how many pixels are there."""
    picture = np.asarray(images.open(io.BytesIO(shot)).convert("RGB"), np.int64)
    agents = [rgb(text) for text in palette.AGENTS]
    return {
        "cloud": pixels(picture[SCENE], agents),
        "boxes": pixels(picture[SCENE], [rgb(palette.BOX)]),
        "uplink": pixels(picture[UPLINK], agents),
        "latency": pixels(picture[LATENCY], [rgb(palette.TEXT)]),
        "score": pixels(picture[SCORE], [rgb(palette.AGENTS[2])]),
    }


ENOUGH = {"cloud": 2000, "boxes": 700, "uplink": 60, "latency": 200, "score": 60}


def test_a_browser_draws_cloud_boxes_and_plots_of_a_live_run(
    shell: Shell, page: Any, request: pytest.FixtureRequest
) -> None:
    run = shell.up("--duration=600", "--out=run", "--mode=realtime", "--restart", *UNHURRIED)
    run.read_until("vehicles")
    view = shell.start("view", "run", "--web", "--port", free_port(), "--fps=1")
    found = re.search(r"http://\S+", view.read_until("http://"))
    assert found is not None
    page.goto(found[0])
    kept = request.config.cache.mkdir("view") / "view.png"
    seen: dict[str, int] = {}

    def all_is_drawn() -> bool:
        shot = page.screenshot(timeout=SHOT_MS)
        kept.write_bytes(shot)
        seen.update(drawn(shot))
        return all(seen[what] >= least for what, least in ENOUGH.items())

    run.wait_until(all_is_drawn, what=lambda: f"of {ENOUGH} there is {seen}, see {kept}")
