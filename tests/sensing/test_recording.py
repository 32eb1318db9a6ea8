import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from protocol.errors import ConfigError
from protocol.messages import Equipment, Truth
from protocol.scans import RangeScan, ScanPattern
from sensing.config import LidarConfig
from sensing.recorded_scans import Recording, check_recording, write_recording

CONFIG = LidarConfig(channels=4, points_per_second=320)
SCAN = RangeScan(CONFIG.pattern, np.full((4, 8), 7, np.float32), np.zeros((4, 8), np.float32))
GOOD = {
    "agents": ["cav", "rsu-0"],
    "frame_period_s": 0.1,
    "pattern": {"channels": 4, "columns": 8, "upper_fov_deg": 2.0, "lower_fov_deg": -24.9},
}


def truth(frame: int, cav: str = "cav") -> Truth:
    return Truth(
        frame=frame,
        sim_time_ns=frame,
        ids=["car", cav],
        types=["car", "car"],
        lanes=["", ""],
        poses=np.zeros((2, 6)),
        speeds_mps=np.zeros(2, np.float32),
        lane_positions_m=np.zeros(2, np.float32),
        equipment=np.array([Equipment.NONE, Equipment.CAV], np.uint8),
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_recording(tmp_path, 0.1, [truth(0), truth(1)], {"cav": [SCAN] * 2, "rsu-0": [SCAN] * 2})
    return tmp_path


def about(folder: Path, **changes: object) -> None:
    (folder / "recording.json").write_text(json.dumps(GOOD | changes))


def test_what_was_written_is_read(folder):
    recording = Recording(folder)
    assert recording.agents == ["cav", "rsu-0"]
    assert recording.pattern == ScanPattern(4, 8, 2.0, -24.9)
    assert [recording.place(frame) for frame in range(4)] == [0, 1, 0, 1]
    assert np.allclose(recording.scan("cav", 1).range_m, SCAN.range_m)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"agents": {"cav": 1}}, "recording.json: agents: .*valid array"),
        ({"agents": "cav"}, "recording.json: agents: .*valid array"),
        ({"agents": ["cav", "cav"]}, "recording.json: agents: each may stand once"),
        ({"agents": []}, "recording.json: agents: .*at least 1 item"),
        ({"agents": ["car", "rsu-0"]}, "the CAV cav has no scans"),
        ({"frame_period_s": float("nan")}, "recording.json: frame_period_s: .*finite"),
        ({"frame_period_s": 0}, "recording.json: frame_period_s: .*greater than 0"),
        ({"frame_period_s": None}, "recording.json: frame_period_s: .*valid number"),
        ({"pattern": {"channels": 4}}, "recording.json: pattern: columns: .*required"),
        ({"pattern": GOOD["pattern"] | {"columns": 10**12}}, "pattern 4 x 1000000000000"),
        ({"pattern": GOOD["pattern"] | {"columns": 9}}, r"needs uint16 \(2, 2, 4, 9\)"),
    ],
)
def test_a_description_that_cannot_be_is_refused(folder, changes, message):
    about(folder, **changes)
    with pytest.raises(ConfigError, match=rf"recording {folder}: .*{message}|: {message}"):
        Recording(folder)


@pytest.mark.parametrize("text", ["", "[]", "[" * 100_000, '{"a":' * 100_000, "\xff"])
def test_a_description_that_is_no_json_is_refused(folder, text):
    (folder / "recording.json").write_text(text, "latin-1")
    with pytest.raises(ConfigError, match="recording.json"):
        Recording(folder)


@pytest.mark.parametrize("name", ["recording.json", "truth.bin", "ranges.npy"])
def test_a_file_that_is_missing_is_named(folder, name):
    (folder / name).unlink()
    with pytest.raises(ConfigError, match=name):
        Recording(folder)


@pytest.mark.parametrize("name", ["truth.bin", "ranges.npy"])
def test_an_empty_file_is_refused(folder, name):
    (folder / name).write_bytes(b"")
    with pytest.raises(ConfigError, match="recording"):
        Recording(folder)


def test_zipped_scans_are_refused(folder):
    np.savez(folder / "zipped.npz", np.load(folder / "ranges.npy"))
    (folder / "zipped.npz").rename(folder / "ranges.npy")
    with pytest.raises(ConfigError, match="magic string"):
        Recording(folder)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(st.sampled_from(["truth.bin", "ranges.npy"]), st.integers(0, 400), st.binary(max_size=9))
def test_damaged_bytes_are_played_or_refused(folder, name, at, junk):
    before = (folder / name).read_bytes()
    try:
        (folder / name).write_bytes(before[:at] + junk + before[at + len(junk) :])
        Recording(folder).scan("cav", 1)
    except ConfigError:
        pass
    finally:
        (folder / name).write_bytes(before)


def test_a_scenario_must_fit_its_recording(folder):
    lidar = CONFIG.model_dump()
    scenario = {
        "recording": str(folder),
        "lidar": {"vehicle": lidar, "roadside": LidarConfig().model_dump()},
        "roadside_mounts": [],
    }
    check_recording(scenario)
    with pytest.raises(ConfigError, match="the scenario's LiDARs of"):
        check_recording(scenario | {"roadside_mounts": [{"id": "rsu-0"}]})
    scenario["lidar"]["roadside"] = lidar
    check_recording(scenario | {"roadside_mounts": [{"id": "rsu-0"}]})
    with pytest.raises(ConfigError, match="roadside mount west; it has cav, rsu-0"):
        check_recording(scenario | {"roadside_mounts": [{"id": "west"}]})


def test_a_header_that_claims_gigabytes_is_not_read(folder):
    (folder / "ranges.npy").write_bytes(b"\x93NUMPY\x02\x00\xff\xff\xff\xff{'descr'")
    with pytest.raises(ConfigError, match=r"numpy's format 1\.0"):
        Recording(folder)
