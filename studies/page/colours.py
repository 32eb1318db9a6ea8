"""Which colour a series has: the same name has the same colour all over a page."""

from __future__ import annotations

from dataclasses import dataclass

from studies import palette
from studies.page.charts import Chart, MapChart, Timeline
from studies.page.model import Figure, Page

DASHES = ("solid", "dash", "dot", "dashdot")


@dataclass(frozen=True, slots=True)
class Colours:
    """Colours by name; after eight they repeat, and lines are dashed in another way."""

    numbers: dict[str, int]

    @classmethod
    def of(cls, page: Page) -> Colours:
        """Gives each name without a colour of its own the next one, in reading order."""
        names = [name for figure in page.figures() for name in _names(figure)]
        return cls({name: i for i, name in enumerate(dict.fromkeys(names))})

    def __getitem__(self, name: str) -> str:
        """Returns the colour as "#rrggbb"."""
        return palette.SERIES[self.numbers.get(name, 0) % len(palette.SERIES)]

    def dash(self, name: str) -> str:
        """Returns one of `DASHES`."""
        return DASHES[self.numbers.get(name, 0) // len(palette.SERIES) % len(DASHES)]


def _names(figure: Figure) -> list[str]:
    if isinstance(figure, Chart):
        return [one.name for one in figure.series if one.colour is None]
    if isinstance(figure, MapChart):
        found = [(one.name, one.colour) for one in figure.outlines]
        found += [(one.name, one.colour) for one in figure.points]
        return [name for name, colour in found if colour is None]
    if isinstance(figure, Timeline):
        known = dict(figure.colours)
        return [span.name for span in figure.spans if span.name not in known]
    return []
