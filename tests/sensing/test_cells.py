"""Every place of the scene has an owner, and at the plain borders exactly one."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sensing.upload_selection import BEYOND, NOT_SENT, PLAIN, TIGHT, WIDE, cut

Floats = npt.NDArray[np.float64]
Bytes = npt.NDArray[np.uint8]

steps = st.integers(-4, 4).map(float)
metres = st.one_of(steps, st.floats(-300, 300))


@st.composite
def plans(draw: st.DrawFn) -> tuple[Floats, Floats]:
    """Returns sites and weights, often at one place, in one line or with equal weights."""
    agents = draw(st.integers(1, 6))
    sites = draw(hnp.arrays(np.float64, (agents, 2), elements=metres))
    plain = draw(hnp.arrays(np.float64, agents, elements=st.one_of(steps, st.floats(-900, 900))))
    margins = hnp.arrays(np.float64, agents, elements=st.one_of(st.just(0.0), st.floats(0, 300)))
    return sites, np.stack([plain - draw(margins), plain, plain + draw(margins)], axis=1)


def borders_of_all(xy: npt.NDArray[np.float32], sites: Floats, weights_m2: Floats) -> Bytes:
    """Returns the border of each agent that each place lies within, (agents, places)."""
    result = np.zeros((len(sites), len(xy)), np.uint8)
    for own in range(len(sites)):
        cut(xy, result[own], sites, weights_m2, own)
    return result


somewhere = hnp.arrays(
    np.float32, (40, 2), elements=st.one_of(steps, st.floats(-400, 400, width=32))
)


@given(somewhere, plans())
def test_a_place_is_within_the_plain_border_of_exactly_one_agent(
    xy: npt.NDArray[np.float32], plan: tuple[Floats, Floats]
) -> None:
    assert ((borders_of_all(xy, *plan) <= PLAIN).sum(axis=0) == 1).all()


@given(somewhere, plans())
def test_the_widest_borders_leave_no_hole_and_overlap_between_tight_and_wide_only(
    xy: npt.NDArray[np.float32], plan: tuple[Floats, Floats]
) -> None:
    borders = borders_of_all(xy, *plan)
    owners = (borders <= WIDE).sum(axis=0)
    assert (owners >= 1).all()
    several = borders[:, owners > 1]
    assert not (several == TIGHT).any()
    assert ((borders == TIGHT).sum(axis=0) <= 1).all()


@given(somewhere, plans())
def test_what_one_of_two_agents_keeps_from_its_tight_border_the_other_has_in_its_wide_one(
    xy: npt.NDArray[np.float32], plan: tuple[Floats, Floats]
) -> None:
    sites, weights_m2 = plan[0][:2], plan[1][:2]
    if len(sites) == 2:
        first, second = borders_of_all(xy, sites, weights_m2)
        np.testing.assert_array_equal(first == TIGHT, second == BEYOND)


def test_what_is_not_to_be_sent_stays_so() -> None:
    chunk = np.array([0, NOT_SENT], np.uint8)
    cut(np.zeros((2, 2), np.float32), chunk, np.zeros((1, 2)), np.zeros((1, 3)), 0)
    assert chunk.tolist() == [TIGHT, NOT_SENT]
