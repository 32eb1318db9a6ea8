"""Which colour is whose."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping

from studies import palette

Rgb = tuple[int, int, int]
MAX_REMEMBERED = 256


def rgb(text: str) -> Rgb:
    """Reads `#rrggbb`."""
    number = int(text[1:], 16)
    return number >> 16, number >> 8 & 255, number & 255


class Colours:
    """Gives each agent a colour, which it still has when it comes again."""

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}

    def of(self, agents: Iterable[str]) -> Mapping[str, Rgb]:
        """Returns the colours of the agents that are there now; a newcomer gets a rare one."""
        present = list(dict.fromkeys(agents))
        for agent in present:
            if agent in self._numbers:
                self._numbers[agent] = self._numbers.pop(agent)  # the newest stand last
        for agent in present:
            if agent not in self._numbers:
                taken = Counter(self._numbers[other] for other in present if other in self._numbers)
                self._numbers[agent] = min(range(len(palette.AGENTS)), key=lambda n: (taken[n], n))
        while len(self._numbers) > max(MAX_REMEMBERED, len(present)):
            del self._numbers[next(iter(self._numbers))]
        return {agent: rgb(palette.AGENTS[self._numbers[agent]]) for agent in present}
