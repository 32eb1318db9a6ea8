"""Recorded traffic in the place of SUMO: it heeds no signal."""

from __future__ import annotations

from protocol.messages import Trip
from sensing.recorded_scans import Recording
from sim_host.world import Bodies, Counts


class RecordedWorld:
    """Plays a frame of the recording a step; `sim_host.traffic.Traffic` says what of a world."""

    def __init__(self, recording: Recording, step_ns: int) -> None:
        self._recording = recording
        self._step_ns = step_ns
        self._frame = 0
        self.time_ns = 0
        self.counts = Counts(inserted=len(recording.truths[0].ids))

    def step(self) -> None:
        """Goes on to the next frame."""
        self._frame += 1
        self.time_ns += self._step_ns

    def bodies(self) -> Bodies:
        """Returns where every vehicle was."""
        truth = self._recording.truths[self._recording.place(self._frame)]
        return Bodies(
            ids=truth.ids,
            types=truth.types,
            lanes=truth.lanes,
            poses=truth.poses,
            speeds_mps=truth.speeds_mps,
            lane_positions_m=truth.lane_positions_m,
            equipment=truth.equipment,
        )

    def set_signal(self, state: str) -> None:
        """Does nothing: what is recorded goes its way."""

    def take_trips(self) -> list[Trip]:
        """Returns nothing: nobody arrives."""
        return []

    def unfinished_trips(self) -> list[Trip]:
        """Returns nothing: journeys were not recorded."""
        return []

    def waiting(self) -> int:
        """Returns 0: nobody wants to enter."""
        return 0

    def close(self) -> None:
        """Holds nothing of its own."""
