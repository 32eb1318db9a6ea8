"""The player role on in-process buses: the recorded messages, on this run's link."""

import pytest
from frame_messages import Rig, of, pose, roster, scan, state

from protocol import messages as m

pytest.importorskip("mcap", reason="needs the extra `mcap`")


def frames(count: int, *, chunks: int = 1, size: int = 9):
    return [
        published
        for n in range(count)
        for published in (
            state(n),
            roster(n, ["a", "b"]),
            pose(n, "a"),
            *(scan(n, "a", k, chunks, size=size) for k in range(chunks)),
            pose(n, "b", cav=False),
        )
    ]


def test_all_is_said_again_under_the_same_names_with_the_same_bytes():
    recording = frames(3, chunks=2)
    rig = Rig(recording)
    for frame in range(3):
        published = rig.play(frame)
        assert [(r.agents, r.scanning) for r in of(m.Roster, published)] == [(["a", "b"], ["a"])]
        assert [p.agent for p in of(m.AgentPose, published)] == ["a", "b"]
        recorded = [s for s in of(m.Scan, recording) if s.frame == frame]
        played = of(m.Scan, published)
        assert [s.payload.tobytes() for s in played] == [s.payload.tobytes() for s in recorded]
        kept = ("frame", "sim_time_ns", "agent", "chunk", "chunks", "points", "plan_frame")
        for one, other in zip(played, recorded, strict=True):
            assert [getattr(one, k) for k in kept] == [getattr(other, k) for k in kept]
            assert one.sensor_pose.tolist() == other.sensor_pose.tolist()
            assert one.arrival_sim_ns is None
        assert {one.parts["process"] for one in published if one.topic == "scan"} == {"vehicle-0"}
    rig.role.close()


def test_what_the_agents_work_took_stays_and_its_end_is_now():
    rig = Rig(frames(1, chunks=2))
    published = rig.play(0)
    (metrics,) = of(m.Metrics, published)
    first, second = metrics.uploads
    assert first.sense_end_ns - first.sense_start_ns == 2_000_000
    assert first.encode_end_ns - first.sense_end_ns == 3_000_000
    assert second.encode_end_ns - second.sense_end_ns == 4_000_000
    assert 0 <= first.sent_ns - first.encode_end_ns < 1_000_000_000
    spans = {(s.stage, s.end_ns - s.start_ns) for s in metrics.spans if s.stage != "send"}
    assert spans == {("sense", 2_000_000), ("encode", 3_000_000), ("encode", 1_000_000)}
    rig.role.close()


def test_a_frame_that_the_recording_lacks_is_one_without_agents():
    rig = Rig([one for one in frames(5) if one.topic == "state" or one.message.frame != 2])
    published = [of(m.Roster, rig.play(frame))[0].agents for frame in range(5)]
    assert published == [["a", "b"], ["a", "b"], [], ["a", "b"], ["a", "b"]]
    rig.role.close()


def test_on_a_slow_virtual_link_frames_are_left_out_and_arrivals_are_computed_anew():
    rig = Rig(frames(6, size=20_000), **{"link.profile": "500kbit,20ms"})
    played = {frame: of(m.Scan, rig.play(frame)) for frame in range(6)}
    sent = [frame for frame, scans in played.items() if scans]
    assert sent
    assert len(sent) < 6
    assert all(scan.arrival_sim_ns > scan.sim_time_ns for f in sent for scan in played[f])
    rig.role.close()


def test_a_post_speaks_for_itself_alone():
    published = [state(0), roster(0, ["rsu-0"], "infra-r0"), scan(0, "rsu-0", process="infra-r0")]
    rig = Rig([*published, *frames(1)], "infra-r0")
    published = rig.play(0)
    assert of(m.Roster, published)[0].agents == ["rsu-0"]
    assert of(m.AgentPose, published) == []
    assert [scan.agent for scan in of(m.Scan, published)] == ["rsu-0"]
    rig.role.close()


def test_in_realtime_scans_go_out_as_long_after_the_tick_as_they_did():
    rig = Rig(frames(1), mode="realtime")
    rig.play(0)
    published = []
    from tests.waiting import wait_until

    def scans():
        published.extend(rig.turn())
        return of(m.Scan, published)

    (scan,) = wait_until(scans)
    assert scan.encode_end_ns - scan.sense_start_ns == 5_000_000
    rig.role.close()
