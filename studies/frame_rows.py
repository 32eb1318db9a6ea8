"""Rows of a run, frame by frame; a frame in which nobody is there has no row of the truth."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from operator import attrgetter
from typing import Any, Generic, TypeVar

from recording.run import Run
from recording.tables import DetectionRow, TruthRow

R = TypeVar("R", bound=tuple[Any, ...])


def by_frame(rows: Iterator[R]) -> Iterator[tuple[int, list[R]]]:
    """Groups rows that are in the order of frames."""
    for frame, group in groupby(rows, key=attrgetter("frame")):
        yield frame, list(group)


class FrameRows(Generic[R]):
    """Rows that are in the order of frames, to be asked for in that order.

    Attributes:
        any: whether there are any.
    """

    def __init__(self, rows: Iterator[R]) -> None:
        self._groups = by_frame(rows)
        self._next = next(self._groups, None)
        self.any = self._next is not None

    def of(self, frame: int) -> list[R]:
        """Returns the rows of a frame, which must not be before the last one."""
        while self._next is not None and self._next[0] < frame:
            self._next = next(self._groups, None)
        return self._next[1] if self._next is not None and self._next[0] == frame else []


def truth_by_frame(run: Run) -> Iterator[tuple[int, list[TruthRow]]]:
    """Yields each frame that was simulated, with its vehicles and pedestrians.

    Nothing where no truth was recorded. A frame whose truth was lost looks like an empty one.
    """
    truth = FrameRows(run.rows(TruthRow))
    if truth.any:
        sql = "SELECT frame FROM frames WHERE tick_ns IS NOT NULL ORDER BY frame"
        for (frame,) in run.query(sql):
            yield frame, truth.of(frame)


def perceived_by_frame(run: Run) -> Iterator[tuple[int, list[DetectionRow], list[TruthRow]]]:
    """Yields the detections and the truth of each frame that was perceived and has truth."""
    perceived = {n for (n,) in run.query("SELECT frame FROM frames WHERE detections IS NOT NULL")}
    detections = FrameRows(run.rows(DetectionRow))
    for frame, bodies in truth_by_frame(run):
        if frame in perceived:
            yield frame, detections.of(frame), bodies
