"""Random junctions are roads that traffic can use."""

import numpy as np
import pytest

from protocol.messages import Setup
from sensing.noise import stream
from sim_host.junctions import Junction, draw_junction, write_junction
from sim_host.netfile import read_net
from sim_host.road_map import road_map
from sim_host.setup import build_setup
from sim_host.world import sample_traffic

SEEDS = range(40)


def drawn(seed: int) -> Junction:
    return draw_junction(stream(seed, "junction"))


@pytest.mark.parametrize("seed", SEEDS)
def test_any_seed_gives_a_net_on_which_every_approach_leads_on(tmp_path, seed):
    junction = drawn(seed)
    roads = road_map(read_net(write_junction(tmp_path, "net", junction)), None)
    assert len(roads.intersections[0].outline) >= 3
    assert roads.intersections[0].signal.greens
    approaches = {roads.by_id[lane].edge for lane in roads.incoming}
    assert approaches == {f"{arm.name}_in" for arm in junction.arms if arm.lanes_in}
    lanes = {lane.id for lane in roads.lanes if lane.edge.endswith("_in")}
    assert set(roads.incoming) == lanes
    for link in roads.intersections[0].signal.links:
        assert any(state[link.index] in "Gg" for state in roads.intersections[0].signal.greens)


def test_the_same_seed_gives_the_same_bytes(tmp_path):
    texts = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        texts.append(write_junction(tmp_path / name, "net", drawn(5)).read_text())
    assert texts[0] == texts[1]
    assert "generated on" not in texts[0]


def test_junctions_differ_in_kind_lanes_bends_and_slopes():
    junctions = [drawn(seed) for seed in range(100)]
    arms = [arm for junction in junctions for arm in junction.arms]
    assert len({junction.kind for junction in junctions}) == 5
    assert {arm.lanes_in for arm in arms} == {arm.lanes_out for arm in arms} == {0, 1, 2, 3, 4}
    assert 0.2 < np.mean([arm.turn_deg != 0 for arm in arms]) < 0.6
    assert 0.15 < np.mean([arm.grade != 0 for arm in arms]) < 0.6
    assert len({arm.speed_mps for arm in arms}) == 4


def test_arms_keep_apart_beyond_the_junction():
    assert all(drawn(seed).parts for seed in range(100))


def test_a_slope_is_in_the_net(tmp_path):
    seed = next(n for n in range(99) if any(arm.grade > 0.03 for arm in drawn(n).arms))
    arm = next(arm for arm in drawn(seed).arms if arm.grade > 0.03)
    net = read_net(write_junction(tmp_path, "net", drawn(seed)))
    way = "in" if arm.lanes_in else "out"
    heights = [z for _, _, z in net.lanes[f"{arm.name}_{way}_0"].shape]
    assert max(heights) == pytest.approx(arm.line[-1, 2], abs=0.05)
    assert min(heights) == pytest.approx(0, abs=0.05)


def test_traffic_is_filmed_at_the_steps_asked_for(tmp_path, flat):
    net = write_junction(tmp_path, "net", drawn(3))
    setup: Setup = build_setup({"traffic": {"net": str(net), "step_s": 0.5}}, tmp_path)
    first, second = sample_traffic(setup, tmp_path, flat, 1, [80, 84])
    (again,) = sample_traffic(setup, tmp_path, flat, 1, [84])
    assert first.ids
    assert second.ids == again.ids
    np.testing.assert_array_equal(second.poses, again.poses)
    both = [name for name in first.ids if name in second.ids]
    moved = [
        np.hypot(*(second.poses[second.ids.index(n)] - first.poses[first.ids.index(n)])[:2])
        for n in both
    ]
    assert 1 < max(moved) < 2.0 * 1.3 * 16.67
