"""The baseline without an edge sees what the agents' scans show."""

from studies.bench import WARM_UP_FRAMES
from studies.bench_sharing import measure_sharing
from studies.bench_traffic import record_traffic


def test_every_vehicle_detects_what_all_agents_together_see(tmp_path) -> None:
    frames = WARM_UP_FRAMES + 4
    record_traffic(tmp_path, agents=3, frames=frames)
    row = measure_sharing(tmp_path, "none", frames)
    assert row.recall_visible is not None
    assert row.count_error is not None
    assert row.recall_visible > 0.95
    assert row.count_error < 0.6
    assert 20_000 < row.bytes_per_frame < 50_000
    assert row.fps == row.whole_fps == 10
