"""Whether a run works, judged by the messages on its buses alone."""

from __future__ import annotations

import time
from collections.abc import Callable

from protocol import observer as protocol_observer
from protocol.bus import Endpoint
from protocol.inbox import Envelope, Presence
from protocol.messages import Equipment, LaneCounts, SignalRequest, SignalState, Tick
from protocol.topics import BusName

STEADY_FRAMES = 3
SETTLED_FRAMES = 10
"""A CAV that has just come may still be connecting; after so many frames it must publish."""
KEPT_FRAMES = 100
FALLBACK = "plan"


class Health:
    """A frame is right if it has all agents, a request follows, and every process is there.

    All agents are the posts and the CAVs that a live process plays. Meanwhile the signal must not
    show its plan. All is right again with the first of `STEADY_FRAMES` right frames in a row.
    """

    def __init__(self, processes: set[str], posts: set[str]) -> None:
        self._needed = {(bus, process) for bus in BusName for process in processes}
        self._posts = posts
        self._here: set[tuple[BusName, str]] = set()
        self._first_seen: dict[str, int] = {}
        self._awaited: dict[int, set[str]] = {}
        self._counted: dict[int, int] = {}
        self._streak: list[int] = []
        self.source = FALLBACK
        self.wrong: str = "nothing was heard"
        self.frame = -1

    @property
    def right_since_ns(self) -> int | None:
        """When the first of enough right frames had its counts; None while it is not right."""
        return self._streak[0] if len(self._streak) >= STEADY_FRAMES else None

    def reset(self) -> None:
        """Forgets how it was: something is about to happen."""
        self._streak.clear()
        self._counted.clear()

    def take(self, item: Envelope | Presence, now_ns: int) -> None:
        """Takes a message or presence of a bus, received at `now_ns` (monotonic)."""
        if isinstance(item, Presence):
            self._note_presence(item)
            return
        match item.message:
            case Tick() as tick:
                self._note_tick(tick)
            case SignalState() as state:
                self.source = state.source
            case LaneCounts() as counts:
                self._judge(counts, now_ns)
            case SignalRequest() as request if request.frame in self._counted:
                self._streak.append(self._counted.pop(request.frame))

    def present(self) -> set[str]:
        """Returns the processes that show themselves on both buses."""
        first, second = ({p for bus, p in self._here if bus is one} for one in BusName)
        return first & second

    def absent(self) -> list[str]:
        """Returns the processes that are missing on a bus."""
        return sorted({process for _, process in self._needed - self._here})

    def _note_presence(self, presence: Presence) -> None:
        known = (presence.bus, presence.id)
        (self._here.add if presence.alive else self._here.discard)(known)
        if not presence.alive and known in self._needed:
            self.reset()

    def _note_tick(self, tick: Tick) -> None:
        self.frame = tick.frame
        hosted = {
            name
            for name, kind, host in zip(tick.agents, tick.equipment, tick.hosts, strict=True)
            if kind == Equipment.CAV and host >= 0
        }
        first = self._first_seen
        self._first_seen = {name: first.get(name, tick.frame) for name in hosted}
        settled = {
            n for n, since in self._first_seen.items() if tick.frame - since >= SETTLED_FRAMES
        }
        self._awaited[tick.frame] = self._posts | settled
        for kept in (self._awaited, self._counted):
            for frame in [n for n in kept if n < tick.frame - KEPT_FRAMES]:
                del kept[frame]

    def _judge(self, counts: LaneCounts, now_ns: int) -> None:
        missing = self._awaited.get(counts.frame, set()) - set(counts.agents)
        absent = self.absent()
        wrong = ""
        if not counts.complete or missing:
            wrong = f"frame {counts.frame} lacks {', '.join(sorted(missing)) or 'a part'}"
        elif absent:
            wrong = f"{', '.join(absent)} not there"
        elif self.source == FALLBACK:
            wrong = "the signal shows its plan"
        self.wrong = wrong
        if wrong:
            self.reset()
        else:
            self._counted[counts.frame] = now_ns


TOPICS = ("tick", "lanes", "state", "request")


class Observer:
    """Keeps a `Health` up to date; a context manager. `asked` are the frames with a request."""

    def __init__(self, v2x: Endpoint, world: Endpoint, health: Health) -> None:
        """Connects.

        Raises:
            BusError: the buses are not there.
        """
        self.health = health
        self.asked: set[int] = set()
        self._observer = protocol_observer.Observer(v2x, world, TOPICS)

    def __enter__(self) -> Observer:
        return self

    def __exit__(self, *details: object) -> None:
        self._observer.__exit__(*details)

    def listen(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Takes what comes for so long, or until that holds; returns whether it held."""
        for item in self._observer.listen(seconds):
            if isinstance(item, Envelope) and isinstance(item.message, SignalRequest):
                self.asked.add(item.message.frame)
            self.health.take(item, time.monotonic_ns())
            if until():
                return True
        return until()

    def is_right(self) -> bool:
        """Whether all is right now."""
        return self.health.right_since_ns is not None
