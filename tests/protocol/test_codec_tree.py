"""The octree of clouds: lattice, order, contexts, and what a damaged one may do."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from protocol.codec import decode, encode_cloud
from protocol.codec.lattice import fill_nodes, lattice_edge_m, sort_keys
from protocol.codec.octree import pack_tree, unpack_tree
from protocol.codec.payload import Form, Head, read_payload
from protocol.codec.symbols import read_tables
from protocol.codec.tree_contexts import CONTEXTS, STRIDE
from protocol.errors import CodecError
from protocol.limits import MAX_TABLES
from protocol.scans import PointCloud


def street(seed: int = 0, points: int = 4000) -> np.ndarray:
    """Points (N, 3) on a street and two walls, denser near the middle."""
    rng = np.random.default_rng(seed)
    x, y = rng.normal(0, 12, points), rng.uniform(-8, 8, points)
    z = np.where(rng.random(points) < 0.6, 0.0, rng.uniform(0, 5, points))
    y = np.where(z > 0, 8 * np.sign(y), y)
    return (np.stack([x, y, z - 2], -1) + rng.normal(0, 0.01, (points, 3))).astype(np.float32)


def bare(points: np.ndarray) -> PointCloud:
    return PointCloud(points, np.zeros(len(points), np.float32))


def there_and_back(points: np.ndarray, bound_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the decoded points and the sent ones in their order."""
    edge_m = lattice_edge_m(bound_m)
    sections, order = pack_tree(points.astype(np.float64), edge_m)
    _, reader = read_payload(Head(Form.TREE, len(points), edge_m).seal(*sections))
    assert sorted(order) == list(range(len(points)))
    return unpack_tree(reader, len(points), edge_m), points[order]


@settings(deadline=None)  # the machine may be busy
@given(
    hnp.arrays(np.float64, (500, 3), elements=st.floats(-3, 3)), st.sampled_from([0.01, 0.1, 2.0])
)
def test_every_place_is_within_the_bound_of_its_node(points, bound_m):
    edge_m, cells = lattice_edge_m(bound_m), np.empty((500, 3), np.int64)
    keys, low = np.empty(500, np.uint64), points.min(axis=0)
    assert fill_nodes(points, low, edge_m, cells, keys) == cells.max()
    middle = (keys & np.uint64(1)).astype(float)[:, None]
    nodes = low + (cells + 0.5 * middle) * edge_m
    assert np.linalg.norm(nodes - points, axis=1).max() <= bound_m * (1 + 1e-9)


@pytest.mark.parametrize("bound_m", [0.01, 0.05, 0.5])
def test_cells_are_no_finer_than_the_bound_asks_for(bound_m):
    found, sent = there_and_back(street(), bound_m)
    error_m = np.linalg.norm(found - sent.astype(float), axis=1).max()
    assert 0.9 * bound_m < error_m <= bound_m * 1.001


@settings(deadline=None)
@given(
    st.integers(0, 5),
    st.integers(1, 60),
    st.integers(1, 300),
    st.sampled_from([0.003, 0.05, 1.0, 20.0]),
)
def test_points_that_crowd_in_cells_all_come_back(seed, places, copies, bound_m):
    rng = np.random.default_rng(seed)
    centres = rng.normal(0, 30, (places, 3))
    points = centres[rng.integers(0, places, copies)] + rng.normal(0, 0.02, (copies, 3))
    found, sent = there_and_back(points.astype(np.float32), bound_m)
    assert np.linalg.norm(found - sent.astype(float), axis=1).max() <= bound_m * 1.001 + 1e-5


@settings(deadline=None)
@given(hnp.arrays(np.uint64, st.integers(0, 200), elements=st.integers(0, 2**61 - 1)))
def test_keys_are_sorted_and_equal_ones_keep_their_order(keys):
    order, given_keys = np.empty(len(keys), np.int64), keys.copy()
    sort_keys(keys, 61, order)
    assert order.tolist() == np.argsort(given_keys, kind="stable").tolist()
    assert np.array_equal(keys, given_keys[order])


def test_intensities_change_nothing_of_the_geometry():
    points, rng = street(1), np.random.default_rng(0)
    shaded = PointCloud(points, rng.random(len(points)).astype(np.float32))
    plain = decode(encode_cloud(bare(points), 0.05)).points
    assert np.array_equal(decode(encode_cloud(shaded, 0.05, intensity=True)).points, plain)


def test_a_payload_that_claims_more_or_fewer_points_than_its_tree_is_refused():
    payload = encode_cloud(bare(street()), 0.05)
    head, reader = read_payload(payload)
    assert head.form == Form.TREE
    sections = [reader.section() for _ in range(4)]
    for points in (head.points - 1, head.points + 1):
        with pytest.raises(CodecError, match="damaged, or holds other"):
            decode(replace(head, points=points).seal(*sections))


def test_as_many_tables_as_contexts_are_refused_where_a_byte_cannot_number_them():
    assert CONTEXTS > MAX_TABLES
    written = np.full(1 << 14, 255, np.uint8)  # each context a table of its own
    table_of, levels = np.zeros(CONTEXTS, np.uint8), np.zeros((CONTEXTS, STRIDE), np.uint8)
    assert read_tables(written, table_of, levels) == -1


def test_forms_of_older_versions_are_refused():
    payload = bytearray(encode_cloud(bare(street()), 0.05))
    for form in (4, 5):
        payload[4] = form
        with pytest.raises(CodecError, match=f"form {form}"):
            decode(bytes(payload))
