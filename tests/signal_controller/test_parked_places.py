"""Places of parked cars: remembered whoever stands there, given up once they prove to be none."""

from __future__ import annotations

from signal_controller.parked_places import ParkedPlaces


def test_who_stands_where_something_was_parked_is_parked_whatever_its_id() -> None:
    places = ParkedPlaces()
    places.note_sign("a", 30.0, 0.0)
    assert places.note_standing("a", 31.0, 10.0)
    assert not places.note_standing("a", 34.0, 10.0)
    assert not places.note_standing("b", 30.0, 10.0)


def test_a_place_is_given_up_once_as_many_drove_off_as_spoke_for_it() -> None:
    places = ParkedPlaces()
    places.note_sign("a", 30.0, 0.0)
    places.note_sign("a", 30.5, 1.0)
    places.disprove("a", 30.0)
    assert places.note_standing("a", 30.0, 2.0)
    places.disprove("a", 30.0)
    assert not places.note_standing("a", 30.0, 3.0)
    places.disprove("a", 30.0)


def test_a_place_is_forgotten_once_nobody_stands_there() -> None:
    places = ParkedPlaces()
    places.note_sign("a", 30.0, 0.0)
    places.forget(250.0)
    assert places.note_standing("a", 30.0, 250.0)
    places.forget(500.0)
    assert places.note_standing("a", 30.0, 500.0)
    places.forget(900.0)
    assert not places.note_standing("a", 30.0, 900.0)
