"""Pages as HTML: alone in the world, safe, the same each time, and drawn by a browser."""

import shutil
import subprocess
import xml.etree.ElementTree as ElementTree
from base64 import b64decode
from html.parser import HTMLParser
from pathlib import Path

import pytest

from tests.studies.page.pages import HOSTILE, whole_page

pytest.importorskip("jinja2", reason="extra study")
pytest.importorskip("matplotlib", reason="extra study")

from matplotlib.figure import Figure

from studies.page.model import Chart, Colours, Page, Section, Series, Text
from studies.page.plotting import draw_chart
from studies.page.write import to_html
from tests.waiting import TIMEOUT_S

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
DRAWN = 8


class Elements(HTMLParser):
    """The elements of a page with their attributes, and the text outside of scripts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        if self.found and self.found[-1][0] not in ("script", "style"):
            self.text += data


def charts(text: str) -> list[bytes]:
    sources = [a.get("src") or "" for tag, a in Elements(text).found if tag == "img"]
    start = "data:image/svg+xml;base64,"
    return [b64decode(one.removeprefix(start)) for one in sources if one.startswith(start)]


@pytest.fixture(scope="module")
def html() -> str:
    return to_html(whole_page())


def test_a_page_needs_no_network(html: str) -> None:
    links = [a.get(k) for _, a in Elements(html).found for k in ("src", "href") if a.get(k)]
    assert links
    assert all(link.startswith(("#", "data:image/")) for link in links)
    assert "default-src 'none'" in html  # and the browser holds it to that


def test_the_same_page_gives_the_same_text(html: str) -> None:
    assert to_html(whole_page()) == html


def test_a_page_without_charts_is_small() -> None:
    assert len(to_html(Page("t", "", (Section("s", (Text("x"),)),)))) < 10_000


def test_names_cannot_become_markup(html: str) -> None:
    elements = Elements(html)
    assert not [tag for tag, _ in elements.found if tag == "script"]
    assert HOSTILE not in html
    assert elements.text.count(HOSTILE) >= 8


def test_every_chart_is_a_picture_without_scripts_and_links(html: str) -> None:
    drawn = charts(html)
    assert len(drawn) == DRAWN
    for picture in drawn:
        parts = list(ElementTree.fromstring(picture).iter())
        assert not [part for part in parts if part.tag.endswith("script")]
        links = [v for part in parts for k, v in part.attrib.items() if k.endswith("href")]
        assert all(link.startswith(("#", "data:image/png;base64,")) for link in links)


def test_a_missing_cell_is_a_dash(html: str) -> None:
    assert '<td>–</td><td class="n">–</td><td class="n">–</td>' in html
    assert '<td class="n">1.23</td><td class="n">1,000</td>' in html


def test_contents_are_listed_from_four_sections_on(html: str) -> None:
    assert '<a href="#s4">Places</a>' in html
    assert "<nav" not in to_html(Page("t", "", (Section("s", ()),) * 3))


@pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium")
def test_a_browser_draws_every_chart(html: str, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    counted = (
        '<script>document.title = "drawn " + '
        '[...document.querySelectorAll(".chart img")].filter((one) => one.naturalWidth).length'
        "</script>"
    )
    allowed = html.replace("style-src", "script-src 'unsafe-inline'; style-src")
    page.write_text(allowed.replace("</body>", f"{counted}</body>"))
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'own'}"]
    done = subprocess.run(
        [str(CHROMIUM), *options, "--virtual-time-budget=5000", "--dump-dom", page.as_uri()],
        capture_output=True, text=True, timeout=TIMEOUT_S, check=True,
    )  # fmt: skip
    assert f"<title>drawn {DRAWN}</title>" in done.stdout


def test_axes_begin_at_zero_where_a_chart_says_so_and_empty_series_are_left_out() -> None:
    series = Series("known", (10, 20), (15.0, 20.0)), Series("empty", (10, 20), (None, None))
    chart = Chart("A chart", "time, s", "delay, s", series, from_zero=True)
    axes = Figure().add_subplot()
    colours = Colours.of(Page("A page", "", (Section("A section", (chart,)),)))
    assert draw_chart(chart, axes, colours) == ["known"]
    assert (axes.get_xlim()[0], axes.get_ylim()[0]) == (0, 0)
