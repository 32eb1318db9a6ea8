"""Of several junctions the live view shows all, or one as if it were alone."""

import numpy as np
import pytest

from protocol import messages as m
from protocol.errors import ConfigError
from protocol.inbox import Envelope
from protocol.observer import BufferedFrame
from studies import palette
from tests.messages import SCAN
from tests.viewer.city import CITY_SETUP
from tests.viewer.shown import MS, PERIOD_NS, SETUP, detections
from viewer import layers
from viewer.layers import rgb
from viewer.road import camera
from viewer.scene import Moment, Scene
from viewer.stages import LAG_FRAMES

GREEN, YELLOW, RED = (rgb(palette.SIGNAL[letter]) for letter in "Gyr")


def state(tls: str, shown: str) -> m.SignalState:
    return m.SignalState(
        frame=1, sim_time_ns=PERIOD_NS, tls=tls, state=shown, stage="green", green="Gr",
        source="plan", earliest_change_ns=0,
    )  # fmt: skip


def counts(tls: str, queued: int, number: int = 1) -> m.LaneCounts:
    lane = f"{tls}south_0"
    return m.LaneCounts(
        frame=number, sim_time_ns=number * PERIOD_NS, tls=tls, agents=["a"], complete=True,
        upstream={lane: 2 * queued}, downstream={}, stationary_upstream={lane: queued},
        coverage_upstream={lane: 0.25},
    )  # fmt: skip


def plan(agent: str, x_m: float) -> m.Plan:
    return m.Plan(
        frame=1, agent=agent, mbps=0, enough=-1, agents=["a", "b"],
        sites=np.array([[x_m - 10, 0], [x_m + 10, 0]]), weights_m2=np.zeros((2, 3)),
    )  # fmt: skip


def item(topic: str, message: m.Message, **parts: str) -> Envelope:
    return Envelope(topic, parts, message, 0, b"")


def frame() -> BufferedFrame:
    scan = SCAN.model_copy(update={"frame": 1})
    received = [
        *(item("state", state(*one)) for one in (("J", "Gr"), ("K", "yr"), ("L", "rG"))),
        *(item("lanes", counts(tls, n), region="r") for n, tls in enumerate("JKL")),
        *(item("scan", scan, region=region) for region in ("r0", "r1")),
        *(item("plan", plan("a", x_m), region=r) for r, x_m in (("r0", 0), ("r1", 400))),
        *(item("detections", detections(), region=region) for region in ("r0", "r1")),
    ]
    return BufferedFrame(1, received)


def test_the_overview_has_lamps_counts_and_parts_of_all_junctions() -> None:
    scene = Scene(CITY_SETUP)
    picture = scene.picture(Moment.of(frame(), scene.regions))
    assert picture is not None
    assert picture.lamps == [GREEN, RED, YELLOW, RED, RED, GREEN]
    assert picture.counts is not None
    assert picture.counts.texts == ["0", "2", "4"]
    assert picture.totals is not None
    assert picture.totals.texts == [
        "J: 0\n0 queued\n25% covered",
        "K: 2\n1 queued\n25% covered",
        "L: 4\n2 queued\n25% covered",
    ]
    assert picture.totals.places[:, 0].tolist() == [0, 200, 400]
    assert picture.queues == {"J": 0, "K": 1, "L": 2}
    assert picture.pressures == {}
    assert picture.boxes is not None
    assert len(picture.boxes.values) == 2 * len(detections().boxes)
    assert len(picture.cells.lines) == 2  # those of a, in either region; b has not been seen


def test_one_junction_is_shown_with_what_its_region_receives() -> None:
    scene = Scene(CITY_SETUP, "L")
    moment = Moment.of(frame(), scene.regions)
    assert [len(moment.scans), [*moment.plans], [*moment.states]] == [1, ["r1"], ["L"]]
    picture = scene.picture(moment)
    assert picture is not None
    assert not scene.is_overview
    assert scene.phases == ["Lsouth", "Lwest"]
    assert picture.lamps == [RED, GREEN]
    assert picture.counts is not None
    assert picture.counts.texts == ["4"]
    assert camera(scene.road_map).target[0] == pytest.approx(400, abs=3)


def test_a_runs_only_junction_is_shown_alike_with_and_without_its_name() -> None:
    scenes = Scene(SETUP), Scene(SETUP, "J")
    assert len({camera(scene.road_map) for scene in scenes}) == 1
    assert [scene.is_overview for scene in scenes] == [False, False]


def test_an_unknown_signal_is_refused() -> None:
    with pytest.raises(ConfigError, match="--tls M: none .* 3 signals; they are: J, K, L"):
        Scene(CITY_SETUP, "M")


def test_the_camera_sees_all_junctions_from_above() -> None:
    look = camera(CITY_SETUP.road_map)
    assert look.position[2] > 200
    assert look.position[1] < look.target[1]  # north is ahead
    assert look.target[0] == pytest.approx(200)


def test_a_regions_parts_are_drawn_around_all_its_junctions() -> None:
    area = layers.CellArea.around(CITY_SETUP.road_map.intersections[:2])
    reach_m = layers.CELLS_REACH_M
    assert area.box.tolist() == [-reach_m, -reach_m, 200 + reach_m, reach_m]


def test_of_a_signal_without_a_state_the_lamps_are_dark() -> None:
    scene = Scene(CITY_SETUP)
    found = layers.lamps({"K": state("K", "Gr")}, scene.road_map, scene.heads.lanes)
    dark = rgb(palette.FAINT)
    assert found == [dark, dark, GREEN, RED, dark, dark]


def test_rates_are_those_of_uploads_to_the_shown_region() -> None:
    scene = Scene(CITY_SETUP, "L")
    for region, size in (("r0", 100), ("r1", 12_500)):
        upload = m.Upload(
            agent="a", region=region, chunk=0, points=1, payload_bytes=size, sense_start_ns=0,
            sense_end_ns=MS, encode_end_ns=MS, sent_ns=MS,
        )  # fmt: skip
        scene.measured(
            m.Metrics(process="vehicle-0", frame=1, sim_time_ns=PERIOD_NS, uploads=[upload])
        )
    number = 1 + LAG_FRAMES
    later = BufferedFrame(number, [item("lanes", counts("L", 0, number), region="r1")])
    picture = scene.picture(Moment.of(later, scene.regions))
    assert picture is not None
    assert picture.mbps == {"a": pytest.approx(1.0)}
