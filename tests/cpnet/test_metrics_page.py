"""Metrics exported of a run, whatever its processes publish."""

import math
import socket
import threading
import urllib.request

import pytest
from hypothesis import given
from hypothesis import strategies as st
from prometheus_client import generate_latest
from prometheus_client.parser import text_string_to_metric_families

from cpnet.metrics_page import (
    BUCKETS_S,
    MAX_PROCESSES,
    MAX_REASONS,
    MAX_REGIONS,
    MAX_STAGES,
    OTHER,
    LabelSet,
    MetricsAddress,
    RunMetrics,
    serving,
)
from cpnet.processes import ProcessEntry, RoleEntry
from protocol import messages as m
from protocol.errors import ConfigError
from protocol.inbox import Envelope, Presence

MS = 1_000_000


def envelope(message: m.Message) -> Envelope:
    return Envelope("any", {}, message, 0, b"")


def metrics(process: str = "edge", **fields) -> Envelope:
    return envelope(m.Metrics(process=process, frame=1, sim_time_ns=0, **fields))


def progress(**fields) -> Envelope:
    plain = {"frame": 7, "sim_time_ns": 0, "real_time_factor": 1.0, "vehicles": 3, "cavs": 2}
    plain |= {"cvs": 0, "detections": 1, "mbps": {}, "end_to_end_ms": 40.0, "state": "Gr"}
    return envelope(m.Progress(**(plain | {"drops": 0} | fields)))


def page(run_metrics: RunMetrics) -> dict[tuple[str, ...], float]:
    """Returns all samples, as Prometheus reads them, by name and values in order of labels."""
    text = generate_latest(run_metrics.registry).decode()
    return {
        (sample.name, *dict(sorted(sample.labels.items())).values()): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_before_anything_was_heard_the_page_can_be_read():
    samples = page(RunMetrics())
    assert samples[("cpnet_frames_total",)] == 0
    assert ("cpnet_frame",) not in samples


def test_stages_are_counted_by_bucket_in_seconds():
    run_metrics = RunMetrics()
    for took_ns in (MS // 10, 3 * MS, 5000 * MS):
        run_metrics.take(metrics(spans=[m.Span(stage="merge", start_ns=10, end_ns=10 + took_ns)]))
    samples = page(run_metrics)
    reached = {"0.0001": 1, "0.0025": 1, "0.005": 2, "1.0": 2, "+Inf": 3}
    for bound, count in reached.items():
        assert samples[("cpnet_stage_seconds_bucket", bound, "", "merge")] == count
    assert samples[("cpnet_stage_seconds_sum", "", "merge")] == pytest.approx(5.0031)
    assert list(BUCKETS_S) == sorted(BUCKETS_S)


@pytest.mark.parametrize("end_ns", [-1, (1 << 62) - 1])
def test_a_stage_that_ends_before_it_began_or_never_is_left_out(end_ns):
    run_metrics = RunMetrics()
    run_metrics.take(metrics(spans=[m.Span(stage="merge", start_ns=0, end_ns=end_ns)]))
    samples = page(run_metrics)
    assert samples[("cpnet_odd_spans_total",)] == 1
    assert ("cpnet_stage_seconds_count", "", "merge") not in samples


def test_frames_are_those_that_the_world_has_finished():
    run_metrics = RunMetrics()
    for stage in ("actuate", "world", "actuate", "world"):
        span = m.Span(stage=stage, agent="J" if stage == "actuate" else "", start_ns=0, end_ns=MS)
        run_metrics.take(metrics("sim", spans=[span]))
    samples = page(run_metrics)
    assert samples[("cpnet_frames_total",)] == 2
    assert 0 <= samples[("cpnet_signal_request_age_seconds", "J")] < 60


def test_what_is_about_one_region_or_signal_says_which():
    times = dict.fromkeys(("sense_start_ns", "sense_end_ns", "encode_end_ns", "sent_ns"), 0)
    run_metrics = RunMetrics()
    for region, size in (("r0", 100), ("r1", 40)):
        upload = m.Upload(agent="a", region=region, chunk=0, points=1, payload_bytes=size, **times)
        run_metrics.take(metrics("vehicle-0", uploads=[upload]))
        detect = m.Span(stage="detect", start_ns=0, end_ns=MS)
        run_metrics.take(metrics(f"edge-{region}", spans=[detect], border_bytes=size))
    for tls in ("A0", "cluster_1_2 #x/y"):  # ids of nets are not ours to choose
        acted = m.Span(stage="actuate", agent=tls, start_ns=0, end_ns=MS)
        run_metrics.take(metrics("sim", spans=[acted]))
    samples = page(run_metrics)
    for region, size in (("r0", 100), ("r1", 40)):
        assert samples[("cpnet_uploaded_bytes_total", "vehicle-0", region)] == size
        assert samples[("cpnet_border_bytes_total", region)] == size
        assert samples[("cpnet_stage_seconds_count", region, "detect")] == 1
    ages = {key[1] for key in samples if key[0] == "cpnet_signal_request_age_seconds"}
    assert ages == {"A0", "cluster_1_2 #x/y"}


def test_ghosts_take_no_label_of_the_regions_that_are_expected():
    run_metrics = RunMetrics()
    run_metrics.expect([], [("edge", "edge-south")])
    for n in range(2 * MAX_REGIONS):
        run_metrics.take(metrics(f"edge-ghost{n}", border_bytes=1))
    run_metrics.take(metrics("edge-south", border_bytes=7))
    samples = page(run_metrics)
    assert samples[("cpnet_border_bytes_total", "south")] == 7
    assert sum(key[0] == "cpnet_border_bytes_total" for key in samples) == MAX_REGIONS + 1


def test_bytes_are_counted_by_process_and_never_by_agent():
    times = dict.fromkeys(("sense_start_ns", "sense_end_ns", "encode_end_ns", "sent_ns"), 0)
    run_metrics = RunMetrics()
    for agent in ("a", "b"):
        upload = m.Upload(agent=agent, region="r0", chunk=0, points=1, payload_bytes=100, **times)
        wire = m.WireCount(agent=agent, frame=0, sent_bytes=130)
        run_metrics.take(metrics("vehicle-0", uploads=[upload], wire=[wire]))
    samples = page(run_metrics)
    assert samples[("cpnet_uploaded_bytes_total", "vehicle-0", "r0")] == 200
    assert samples[("cpnet_sent_bytes_total", "vehicle-0")] == 260


def test_drops_go_on_rising_when_a_process_starts_anew():
    run_metrics = RunMetrics()
    for drops in ({"late": 3}, {"late": 5, "odd": 1}, {"late": 2}, {"late": 2, "odd": 4}):
        run_metrics.take(metrics(drops=drops))
    samples = page(run_metrics)
    assert samples[("cpnet_drops_total", "edge", "late")] == 7
    assert samples[("cpnet_drops_total", "edge", "odd")] == 5


def test_a_process_is_down_until_it_shows_itself_and_when_it_leaves():
    run_metrics = RunMetrics()
    run_metrics.expect([ProcessEntry("edge", RoleEntry("edge", "edge_server"))])
    seen = [page(run_metrics)]
    for alive in (True, False):
        run_metrics.take(Presence("edge", "edge", alive))
        seen.append(page(run_metrics))
    assert [samples[("cpnet_process_up", "edge", "edge")] for samples in seen] == [0, 1, 0]


def test_ghosts_that_come_and_go_leave_no_series_and_a_newcomer_has_its_own():
    run_metrics = RunMetrics()
    edge = ProcessEntry("edge", RoleEntry("edge", "edge_server"))
    run_metrics.expect([edge], [("vehicle", "vehicle-0")])
    for n in range(4000):
        run_metrics.take(Presence(f"role{n}", f"ghost{n}", alive=True))
        run_metrics.take(metrics(f"ghost{n}", drops={"late": 1}))
        run_metrics.take(Presence(f"role{n}", f"ghost{n}", alive=False))
    for process in ("vehicle-0", "vehicle-9"):
        run_metrics.take(Presence("vehicle", process, alive=True))
        run_metrics.take(metrics(process, drops={"late": 2}))
    run_metrics.take(Presence("vehicle", "vehicle-0", alive=False))
    samples = page(run_metrics)
    up = {key[1:]: value for key, value in samples.items() if key[0] == "cpnet_process_up"}
    assert up == {("edge", "edge"): 0, ("vehicle-0", "vehicle"): 0, ("vehicle-9", "vehicle"): 1}
    drops = {key[1:]: value for key, value in samples.items() if key[0] == "cpnet_drops_total"}
    assert drops == {("vehicle-0", "late"): 2, ("vehicle-9", "late"): 2}


def test_ghosts_that_stay_take_no_label_of_those_who_are_expected():
    run_metrics = RunMetrics()
    run_metrics.expect([], [("vehicle", "vehicle-0")])
    for n in range(4000):
        run_metrics.take(Presence("vehicle", f"ghost{n}", alive=True))
    run_metrics.take(Presence("vehicle", "vehicle-0", alive=True))
    assert page(run_metrics)[("cpnet_process_up", "vehicle-0", "vehicle")] == 1


def test_restarts_are_counted_and_begin_with_0():
    run_metrics = RunMetrics()
    run_metrics.expect([ProcessEntry("edge", RoleEntry("edge", "edge_server"))])
    assert page(run_metrics)[("cpnet_process_restarts_total", "edge")] == 0
    run_metrics.restarted("edge")
    assert page(run_metrics)[("cpnet_process_restarts_total", "edge")] == 1


def junction(**fields) -> m.JunctionProgress:
    plain = {"region": "r0", "phase": 0, "unchanged_s": 1.5, "vehicles": 4, "queued": 3}
    return m.JunctionProgress(**(plain | fields))


def test_the_progress_of_each_region_and_junction_has_a_series_of_its_own():
    region = {"agents": 2, "detections": 5, "frames": 8, "incomplete": 1, "mbps": 1.5}
    regions = {n: m.RegionProgress(**region, end_to_end_ms=40 + i) for i, n in enumerate("ab")}
    junctions = {"J": junction(coverage=0.25), "K": junction(region="b", phase=-1, queued=0)}
    run_metrics = RunMetrics()
    run_metrics.take(progress(regions=regions, junctions=junctions))
    run_metrics.take(progress(regions=regions, junctions=junctions | {"J": junction(vehicles=6)}))
    samples = page(run_metrics)
    assert samples[("cpnet_region_agents", "a")] == 2
    assert samples[("cpnet_region_detections", "a")] == 5
    assert samples[("cpnet_region_frames", "a")] == 8
    assert samples[("cpnet_region_frames_incomplete", "a")] == 1
    assert samples[("cpnet_region_uplink_mbps", "b")] == 1.5
    assert samples[("cpnet_region_end_to_end_seconds", "b")] == pytest.approx(0.041)
    assert samples[("cpnet_junction_vehicles", "r0", "J")] == 6
    assert samples[("cpnet_junction_queued", "b", "K")] == 0
    assert samples[("cpnet_junction_phase", "b", "K")] == -1
    assert samples[("cpnet_signal_state_age_seconds", "r0", "J")] == 1.5
    assert math.isnan(samples[("cpnet_junction_coverage_ratio", "r0", "J")])


def test_absurd_figures_leave_a_page_that_can_be_read():
    run_metrics = RunMetrics()
    huge = {"real_time_factor": -1e308, "end_to_end_ms": 1.7e308, "vehicles": (1 << 40) - 1}
    absurd = {"J": junction(unchanged_s=1e308)}
    run_metrics.take(progress(sim_time_ns=(1 << 62) - 1, state="u" * 512, junctions=absurd, **huge))
    run_metrics.take(progress(sim_time_ns=1 - (1 << 62), state="u" * 512, **huge))
    for count in ((1 << 53) - 1, 0) * 50:
        run_metrics.take(metrics(drops={"late": count}))
    samples = page(run_metrics)
    assert samples[("cpnet_end_to_end_seconds",)] == pytest.approx(1.7e305)
    assert samples[("cpnet_signal_state_age_seconds", "r0", "J")] == 1e308
    assert samples[("cpnet_drops_total", "edge", "late")] == pytest.approx(50 * 2**53)


def test_names_without_end_leave_a_page_with_one():
    run_metrics = RunMetrics()
    for n in range(400):
        spans = [m.Span(stage=f"s{n}", start_ns=0, end_ns=1)]
        run_metrics.take(metrics(f"p{n}", spans=spans, drops={f"r{n}-{k}": 1 for k in range(40)}))
        run_metrics.take(Presence(f"role{n}", f"p{n}", alive=True))
    samples = page(run_metrics)
    stages = [key for key in samples if key[0] == "cpnet_stage_seconds_count"]
    assert len(stages) == MAX_STAGES + 1
    assert samples[("cpnet_stage_seconds_count", "", OTHER)] == 400 - MAX_STAGES
    dropping = {key[1:] for key in samples if key[0] == "cpnet_drops_total"}
    assert len({reason for _, reason in dropping}) == MAX_REASONS + 1
    assert len({process for process, _ in dropping}) == MAX_PROCESSES + 1
    assert sum(key[0] == "cpnet_process_up" for key in samples) <= MAX_PROCESSES + 1


def test_processes_beyond_the_last_place_do_not_make_a_counter_run():
    run_metrics = RunMetrics()
    for n in range(MAX_PROCESSES):
        run_metrics.take(Presence("x", f"p{n}", alive=True))
    for n in range(100):
        run_metrics.take(metrics(f"late{n % 2}", drops={"odd": 5 + n % 2}))
    assert page(run_metrics)[("cpnet_drops_total", OTHER, "odd")] == 6


@given(st.text(max_size=80))
def test_a_label_is_a_plain_word(name):
    label = LabelSet(9).label(name)
    assert label in (name, OTHER)
    assert label.isascii()
    assert label.isprintable()
    assert len(label) <= 64


def test_a_page_may_be_asked_for_while_the_tally_grows():
    run_metrics, stop = RunMetrics(), threading.Event()

    def grow() -> None:
        n = 0
        while not stop.is_set():
            n += 1
            run_metrics.take(metrics(f"p{n % 300}", drops={f"r{n % 7}": n}))

    growing = threading.Thread(target=grow)
    growing.start()
    try:
        for _ in range(10):
            page(run_metrics)
    finally:
        stop.set()
        growing.join()


def test_the_page_is_served_on_the_address_that_was_asked_for():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    address = MetricsAddress.parse(str(port))
    with serving(address) as run_metrics:
        run_metrics.take(metrics("sim", spans=[m.Span(stage="world", start_ns=0, end_ns=MS)]))
        with urllib.request.urlopen(f"http://{address}/metrics", timeout=30) as answer:
            assert "cpnet_frames_total 1.0" in answer.read().decode()
        with pytest.raises(ConfigError, match="cannot listen at 127"):
            MetricsAddress.parse(f"127.0.0.1:{port}")
        with pytest.raises(ConfigError, match="cannot listen"), serving(address):
            pass
