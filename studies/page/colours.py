"""Which colour a series has: the same name has the same colour all over a page."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count

from studies import palette
from studies.page.charts import Chart, MapChart, Timeline
from studies.page.model import Figure, Page

DASHES = ("solid", "dash", "dot", "dashdot")


@dataclass(frozen=True, slots=True)
class Colours:
    """Colours by name; after eight in one chart they repeat, and lines are dashed differently."""

    numbers: dict[str, int]

    @classmethod
    def of(cls, page: Page) -> Colours:
        """Gives each name, in reading order, the first colour that no neighbour has.

        Neighbours stand in a chart together. Who has a colour of its own takes part in nothing.
        """
        neighbours: dict[str, set[str]] = {}
        for figure in page.figures():
            names = _names(figure)
            for name in names:
                neighbours.setdefault(name, set()).update(names)
        numbers: dict[str, int] = {}
        for name, others in neighbours.items():
            taken = {numbers[other] for other in others if other in numbers}
            numbers[name] = next(number for number in count() if number not in taken)
        return cls(numbers)

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
