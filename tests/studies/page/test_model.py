"""What a page can be made of."""

import pytest

from studies import palette
from studies.page.model import Chart, Colours, Column, Page, Section, Series, Table


def page_of(*groups: tuple[str, ...]) -> Page:
    charts = tuple(
        Chart("", "", "", tuple(Series(name, (0,), (0,)) for name in names)) for names in groups
    )
    return Page("", "", (Section("", charts),))


def test_a_row_of_another_width_than_the_head_is_refused() -> None:
    with pytest.raises(ValueError, match="a row of 1 cells under 2 columns"):
        Table((Column("a"), Column("b")), (("x",),))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"x": (1, 2, 3, 4)}, "4 x for 2 y"),
        ({"low": (1, 2)}, "low and high come together"),
        ({"low": (1,), "high": (2,)}, "1 bounds for 2 y"),
    ],
)
def test_a_series_whose_lengths_do_not_fit_is_refused(changes, message) -> None:
    with pytest.raises(ValueError, match=message):
        Series(**({"name": "s", "x": (1, 2), "y": (1, 2)} | changes))


def test_a_name_has_one_colour_and_no_neighbour_has_it() -> None:
    colours = Colours.of(page_of(("a", "b"), ("c", "b"), ("c", "a")))
    assert len({colours["a"], colours["b"], colours["c"]}) == 3
    assert colours["a"] == palette.SERIES[0]


def test_more_series_than_colours_are_told_apart_by_their_dashes() -> None:
    names = tuple("abcdefghijkl")
    colours = Colours.of(page_of(names))
    assert len({(colours[name], colours.dash(name)) for name in names}) == len(names)
