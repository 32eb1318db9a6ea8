"""The run at a glance: what the recorder tells whoever watches, about once a second."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from protocol.messages import Equipment, Metrics, Progress, Tick

MAX_AGENTS = 1024


@dataclass(slots=True)
class Glance:
    """Gathers between two reports; rates are per simulated second, as the agents would see them."""

    frame_period_ns: int
    frame: int = 0
    sim_time_ns: int = 0
    vehicles: int = 0
    cavs: int = 0
    cvs: int = 0
    detections: int = 0
    state: str = ""
    end_to_end_ns: int = 0
    payload_bytes: Counter[str] = field(default_factory=Counter)
    _since: tuple[int, int] | None = None

    def ticked(self, tick: Tick, now_ns: int) -> None:
        """Notes where the world is."""
        equipment = tick.equipment.tolist()
        self.frame, self.sim_time_ns = tick.frame, tick.sim_time_ns
        self.vehicles = len(tick.ids)
        self.cavs = equipment.count(Equipment.CAV)
        self.cvs = equipment.count(Equipment.CV)
        if self._since is None:
            self._since = (tick.sim_time_ns - self.frame_period_ns, now_ns)

    def measured(self, metrics: Metrics) -> None:
        """Notes what was sent; of too many agents no more are told of."""
        for upload in metrics.uploads:
            if upload.agent in self.payload_bytes or len(self.payload_bytes) < MAX_AGENTS:
                self.payload_bytes[upload.agent] += upload.payload_bytes

    def report(self, now_ns: int, drops: int) -> Progress:
        """Returns what happened since the last report and begins anew."""
        sim_ns, wall_ns = self._since or (self.sim_time_ns, now_ns)
        sim_passed_ns, wall_passed_ns = self.sim_time_ns - sim_ns, now_ns - wall_ns
        self._since = (self.sim_time_ns, now_ns)
        # Mbit/s = 8e-6 Mbit per byte over 1e-9 s per ns
        mbps = {
            agent: count * 8e3 / sim_passed_ns if sim_passed_ns > 0 else 0.0
            for agent, count in sorted(self.payload_bytes.items())
        }
        self.payload_bytes.clear()
        return Progress(
            frame=self.frame,
            sim_time_ns=self.sim_time_ns,
            real_time_factor=sim_passed_ns / wall_passed_ns if wall_passed_ns > 0 else 0.0,
            vehicles=self.vehicles,
            cavs=self.cavs,
            cvs=self.cvs,
            detections=self.detections,
            mbps=mbps,
            end_to_end_ms=self.end_to_end_ns / 1e6,
            state=self.state,
            drops=drops,
        )
