"""When a frame needs no more chunks: the space between any two neighbours is covered.

An agent whose first chunk came covers its part up to the tight borders, with the second up to the
plain and with the third up to the wide ones; the fourth is all the rest that it sees. What one
agent leaves within its tight border, the other covers within its wide one: so two neighbours cover
the space between them once they have sent four chunks together. Neighbours are agents whose widest
cells meet. Then every place lies within the borders of an agent: its owner's, or, if the owner sent
its tight part only and the place lies beyond, those of the one that comes nearest to owning it,
which is a neighbour of the owner and has sent up to its wide border.

Unlike in EMP, every owner's first chunk is needed besides: within its tight border nobody else sees
as well, and a post on a wire, which sends all at once, would make the others' scans useless.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

TOGETHER = 4  # chunks of two neighbours that cover the space between them


@dataclass(frozen=True, slots=True)
class Uploaded:
    """How far an agent's scan came: chunks without a gap from the first on, of how many.

    `chunks` is 0 while none came; `plan_frame` is then -1.
    """

    came: int
    chunks: int
    plan_frame: int

    @property
    def is_whole(self) -> bool:
        """Whether all chunks came."""
        return 0 < self.chunks == self.came

    def came_by(self, plan_frame: int) -> int:
        """Returns how many chunks of a plan came; a whole scan is as good as all of any plan."""
        if self.is_whole:
            return TOGETHER
        return self.came if self.plan_frame == plan_frame else 0


@dataclass(frozen=True, slots=True)
class Borders:
    """The agents of a plan, those of them whose cell is not empty, and who are neighbours."""

    agents: tuple[str, ...]
    owners: tuple[str, ...]
    pairs: tuple[tuple[str, str], ...]

    def covered(self, came: Mapping[str, int]) -> bool:
        """Whether these numbers of chunks cover the scene.

        An agent that is not among them has left, or its link is full; its part is covered when the
        next plan comes.
        """
        here = [(a, b) for a, b in self.pairs if a in came and b in came]
        own = [came[agent] for agent in self.owners if agent in came]
        return all(own) and all(came[a] + came[b] >= TOGETHER for a, b in here)
