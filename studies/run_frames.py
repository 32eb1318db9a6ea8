"""A recorded run for programs: its tables as Polars frames, its scans as arrays.

Columns are those of `recording.tables`; a column's unit is the end of its name. Frames of rows also
have `sim_time_s`, the time of the simulation with its warm-up.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

import numpy as np

from perception.arrays import Floats
from protocol.errors import ConfigError
from protocol.extras import to_install
from recording import run as recorded
from recording.tables import (
    TABLES,
    CloudRow,
    CountRow,
    DetectionRow,
    FrameRow,
    LatencyRow,
    PhaseRow,
    TripRow,
    TruthRow,
    UploadRow,
)
from studies.simulated_frame import UploadedScan, cloud_of

if TYPE_CHECKING:
    import polars as pl


class Run(recorded.Run):
    """A run folder, read-only. It may be used as a context manager."""

    def __init__(self, run_dir: Path | str) -> None:
        """Opens the run.

        Raises:
            ConfigError: there is no run, it was written by another version, or Polars is missing.
        """
        try:
            import polars  # noqa: F401
        except ModuleNotFoundError:
            raise ConfigError(
                f"tables of runs need polars (extra `study`): {to_install('study')}"
            ) from None
        super().__init__(Path(run_dir))

    def __repr__(self) -> str:
        return f"Run({str(self.dir)!r})"

    def table(self, row: type[Any]) -> pl.DataFrame:
        """Returns a whole table of `recording.tables` by its row type, sorted by its keys.

        Raises:
            ConfigError: it is no such type.
        """
        import polars as pl

        if not isinstance(row, type) or row not in TABLES:
            names = ", ".join(sorted(one.__name__ for one in TABLES))
            raise ConfigError(
                f"table({row!r:.60}): must be a class of recording.tables, one of {names}"
            )

        hints = get_type_hints(row)
        schema = {name: _polars_type(hints[name]) for name in TABLES[row].columns}
        found = pl.DataFrame(list(self.rows(row)), schema=schema, orient="row")
        if "frame" not in schema or "sim_time_s" in schema:
            return found
        return found.join(self._times, on="frame", how="left", maintain_order="left")

    @cached_property
    def _times(self) -> pl.DataFrame:
        import polars as pl

        rows = self.query("SELECT frame, sim_time_ns / 1e9 FROM frames")
        schema = {"frame": pl.Int64, "sim_time_s": pl.Float64}
        return pl.DataFrame(rows, schema=schema, orient="row")

    @cached_property
    def frames(self) -> pl.DataFrame:
        """A row for each frame: vehicles, agents, points, detections, end-to-end latency."""
        return self.table(FrameRow)

    @cached_property
    def uploads(self) -> pl.DataFrame:
        """A row for each chunk that an agent sent: points, bytes, and its times."""
        return self.table(UploadRow)

    @cached_property
    def detections(self) -> pl.DataFrame:
        """A row for each vehicle that an edge knew of in a frame, in the map frame."""
        return self.table(DetectionRow)

    @cached_property
    def tracks(self) -> pl.DataFrame:
        """The detections that belong to a track, sorted by `track` and `frame`."""
        import polars as pl

        return self.detections.filter(pl.col("track") != 0).sort("track", "frame", "region")

    @cached_property
    def counts(self) -> pl.DataFrame:
        """A row for each frame, signal, lane and side of the stop bar: vehicles, queued ones."""
        return self.table(CountRow)

    @cached_property
    def signals(self) -> pl.DataFrame:
        """A row for each frame and signal: its state."""
        return self.table(PhaseRow)

    @cached_property
    def latency(self) -> pl.DataFrame:
        """A row for each frame, region and agent: latency by stage."""
        return self.table(LatencyRow)

    @cached_property
    def truth(self) -> pl.DataFrame:
        """A row for each frame and body: ground truth, which no part of the system receives."""
        return self.table(TruthRow)

    @cached_property
    def trips(self) -> pl.DataFrame:
        """A row for each vehicle: departure, arrival and time lost, in s."""
        return self.table(TripRow)

    @cached_property
    def figures(self) -> dict[str, Any]:
        """The run's measures, as studies have them: `e_cvpr`, `delay_s`, `uplink_mbps` and more."""
        from studies.sweep.worker import measure

        return measure(self.dir).row

    @cached_property
    def scan_frames(self) -> list[int]:
        """The frames of which scans were kept; see the scenario key `record.snapshot_period_s`."""
        return [
            frame for (frame,) in self.query("SELECT DISTINCT frame FROM clouds ORDER BY frame")
        ]

    def scans(self, frame: int) -> list[UploadedScan]:
        """Returns the uploads of a frame, by region, agent and chunk.

        Raises:
            ConfigError: none were kept of this frame.
        """
        if frame not in self.scan_frames:
            raise ConfigError(
                f"{self.dir} has no scans of frame {frame}; scan_frames lists those that it has"
            )
        rows = sorted(self.of_frame(CloudRow, frame), key=lambda r: (r.region, r.agent, r.chunk))
        return [UploadedScan(r.agent, r.region, r.chunk, _pose(r), r.payload) for r in rows]

    def cloud(self, frame: int) -> Floats:
        """Returns the points (N, 3) of all uploads of a frame, map frame, in m.

        Raises:
            ConfigError: none were kept of this frame.
        """
        return cloud_of(self.scans(frame))


def _pose(row: CloudRow) -> Floats:
    first = CloudRow._fields.index("sensor_x_m")
    return np.array(row[first : first + 6], np.float64)


def _polars_type(hint: object) -> Any:  # noqa: ANN401 - Polars' are untyped here
    import polars as pl

    kind = next(k for k in get_args(hint) or (hint,) if k is not type(None))
    return {int: pl.Int64, float: pl.Float64, str: pl.String, bytes: pl.Binary}[kind]
