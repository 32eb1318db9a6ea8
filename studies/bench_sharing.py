"""Sharing without an edge, the baseline of EMP: every agent broadcasts, every vehicle detects.

Each agent sends its whole scan once, over its own uplink, to all; a vehicle receives scan after
scan over its own downlink, which is as fast. An agent skips a frame while the queue on its link
takes longer than a frame lasts. Vehicles merge and detect by themselves. Computing is measured
here, one vehicle after the other, as if each had a computer of its own; links are virtual.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np

from edge_server.config import EdgeConfig
from edge_server.frame import Frame
from edge_server.pipeline import Pipeline
from protocol.messages import NEVER_NS, Scan, Setup, Truth
from protocol.regions import RegionMap
from recording.rows import count_rows, detection_rows, truth_rows
from sensing.config import SceneConfig
from sensing.link_channel import Channel as LinkPath
from sensing.link_channel import VirtualLink
from sensing.link_config import profile_named
from sensing.radio import ENVELOPE_BYTES
from sensing.recorded_scans import Recording
from sensing.terrain import Terrain
from sim_host.setup import build_setup
from studies.bench import SHARING, WARM_UP_FRAMES
from studies.bench_traffic import (
    RSU,
    SEED,
    agent_poses,
    rsu_pose,
    uploaded_scan,
    visible_vehicles,
)
from studies.bench_uplink import UplinkRow
from studies.count_error import PerceptionTally
from studies.latency import distribution_ms


def measure_sharing(traffic: Path, link: str, frames: int) -> UplinkRow:
    """Plays a recording as `sharing` on a link.

    Raises:
        ConfigError: there is no such link.
    """
    with tempfile.TemporaryDirectory() as scratch:
        setup = build_setup({}, Path(scratch))
    return _Sharing(setup, traffic, link).play(frames)


class _Sharing:
    def __init__(self, setup: Setup, traffic: Path, link: str) -> None:
        self._recording = Recording(traffic)
        self._visible = visible_vehicles(traffic)
        self._post = rsu_pose(setup.road_map, Terrain(setup.road_map, SceneConfig(), SEED))
        self._setup = setup
        self._pipelines = {  # each vehicle's own: it keeps misbehaviour scores
            agent: Pipeline.of(RegionMap.whole(setup.road_map), EdgeConfig(), seed=SEED)
            for agent in self._recording.agents
            if agent != RSU
        }
        self._tally = PerceptionTally(setup)
        self._link = link
        self._period_ns = round(self._recording.frame_period_s * 1e9)
        self._up, self._down = (self._links(way) for way in ("up", "down"))
        self._bytes: list[int] = []
        self._latencies_ns: list[int] = []

    def play(self, frames: int) -> UplinkRow:
        for frame in range(frames):
            self._play(frame)
        period_s = self._recording.frame_period_s
        mean_bytes = float(np.mean(self._bytes))
        receivers = len(self._recording.agents) - 1
        fps = len(self._latencies_ns) / receivers / (frames - WARM_UP_FRAMES) / period_s
        return UplinkRow(
            policy=SHARING,
            link=self._link,
            agents=len(self._recording.agents),
            bytes_per_frame=mean_bytes,
            mbps_per_agent=mean_bytes * 8e-6 / period_s,
            latency_ms=distribution_ms(self._latencies_ns),
            fps=fps,
            whole_fps=fps,
            recall_visible=self._tally.recall_visible,
            count_error=self._tally.count_error,
            false_per_frame=self._tally.false_per_frame,
        )

    def _links(self, way: str) -> dict[str, VirtualLink | None]:
        profile, agents = profile_named(self._link), self._recording.agents
        if profile is None:
            return dict.fromkeys(agents)
        return {a: VirtualLink(LinkPath.draw(profile, SEED, f"{a} {way}")) for a in agents}

    def _play(self, frame: int) -> None:
        place = self._recording.place(frame)
        now_ns = frame * self._period_ns
        now = {"frame": frame, "sim_time_ns": now_ns}
        truth = self._recording.truths[place].model_copy(update=now)
        sent: dict[str, tuple[Scan, int]] = {}
        for agent in self._recording.agents:
            begin_ns = time.perf_counter_ns()
            scan = uploaded_scan(self._recording, agent, truth, self._post)
            ready_ns = now_ns + time.perf_counter_ns() - begin_ns
            at_ns = NEVER_NS
            if not self._is_clogged(self._up[agent], now_ns):
                at_ns = _carry(self._up[agent], ready_ns, scan.payload.size)
            sent[agent] = (scan, at_ns)
            self._bytes.append(scan.payload.size if at_ns < NEVER_NS else 0)
        for agent in self._recording.agents:
            if agent != RSU and not self._is_clogged(self._down[agent], now_ns):
                heard = {a: s for a, s in sent.items() if a == agent or s[1] < NEVER_NS}
                self._receive(agent, truth, now_ns, heard)

    def _is_clogged(self, link: VirtualLink | None, now_ns: int) -> bool:
        return link is not None and link.backlog_ns(now_ns) >= self._period_ns

    def _receive(
        self, agent: str, truth: Truth, now_ns: int, sent: dict[str, tuple[Scan, int]]
    ) -> None:
        others = sorted((at_ns, name) for name, (_, at_ns) in sent.items() if name != agent)
        last_ns = now_ns
        for at_ns, name in others:
            last_ns = _carry(self._down[agent], at_ns, sent[name][0].payload.size)
        begin_ns = time.perf_counter_ns()
        pipeline = self._pipelines[agent]
        chunks = [pipeline.open(sent[name][0], 0) for name in sorted(sent)]
        poses = agent_poses(sent, truth, self._setup)
        whole = Frame(
            truth.frame, now_ns, sorted(sent), poses, chunks, complete=True, first_ns=0, ready_ns=0
        )
        result = pipeline.run(whole)
        if truth.frame >= WARM_UP_FRAMES:
            took_ns = time.perf_counter_ns() - begin_ns
            self._latencies_ns.append(last_ns - now_ns + took_ns)
            self._tally.add(
                self._visible[self._recording.place(truth.frame)],
                list(detection_rows(result.detections, agent)),  # a vehicle is its own edge
                [row for counts in result.counts.values() for row in count_rows(counts)],
                list(truth_rows(truth)),
            )


def _carry(link: VirtualLink | None, now_ns: int, payload_bytes: int) -> int:
    return now_ns if link is None else link.send(now_ns, payload_bytes + ENVELOPE_BYTES).arrival_ns
