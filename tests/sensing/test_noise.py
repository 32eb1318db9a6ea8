"""Random streams: the same for the same keys, different for others."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sensing.noise import stream

GOLDEN = 277267666203991605
KEYS = st.lists(st.text(max_size=8) | st.integers(0, 2**40), max_size=3)


def first(seed: int, *keys: str | int) -> int:
    return int(stream(seed, *keys).integers(2**63))


def test_streams_are_the_same_in_every_process() -> None:
    assert first(1, "scan", "rsu-0", 17) == GOLDEN


@given(KEYS, KEYS)
def test_other_keys_give_other_numbers(one: list[str | int], other: list[str | int]) -> None:
    assert (first(1, *one) == first(1, *other)) == (one == other)


@pytest.mark.parametrize("other", [(2, "a", 1), (1, "b", 1), (1, "a", 2), (1, "a1"), (1, "a", "1")])
def test_seed_name_and_frame_all_count(other: tuple[int, str | int]) -> None:
    assert first(*other) != first(1, "a", 1)
