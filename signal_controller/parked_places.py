"""Places of parked cars and ghosts: stationary objects on a lane that no green discharges.

A parked car that is partly in the lane loses its track whenever another vehicle passes, and gets a
new one. Therefore the place is kept, not the track.
"""

from __future__ import annotations

from dataclasses import dataclass, field

_NEAR_M = 1.5  # what stands so near a place stands in it
_MOST_SIGNS = 5  # further ones make a place no surer
_FORGOTTEN_S = 300.0  # after which a place in which nobody stands is one no more


@dataclass(slots=True)
class _Place:
    """Position on a lane, when a vehicle last stood there, and the number of signs for parking."""

    distance_m: float
    seen_s: float
    signs: int = 1


@dataclass(slots=True)
class ParkedPlaces:
    """The places of a signal's lanes, by lane; distances are to the stop bar."""

    _places: dict[str, list[_Place]] = field(default_factory=dict)

    def note_sign(self, lane: str, distance_m: float, time_s: float) -> None:
        """Adds a sign that a vehicle there is parked: others passed, or it did not go."""
        place = self._at(lane, distance_m)
        if place is None:
            self._places.setdefault(lane, []).append(_Place(distance_m, time_s))
        else:
            place.signs, place.seen_s = min(place.signs + 1, _MOST_SIGNS), time_s

    def note_standing(self, lane: str, distance_m: float, time_s: float) -> bool:
        """Registers a stationary vehicle; returns whether it is in a parked place."""
        place = self._at(lane, distance_m)
        if place is None:
            return False
        place.seen_s = time_s
        return True

    def disprove(self, lane: str, distance_m: float) -> None:
        """Removes a place whose vehicle has driven off."""
        place = self._at(lane, distance_m)
        if place is not None:
            place.signs -= 1
            if place.signs == 0:
                self._places[lane].remove(place)

    def forget(self, time_s: float) -> None:
        """Drops the places in which no vehicle has stood for long."""
        for lane, places in self._places.items():
            kept = [place for place in places if time_s - place.seen_s < _FORGOTTEN_S]
            self._places[lane] = kept

    def _at(self, lane: str, distance_m: float) -> _Place | None:
        places = self._places.get(lane, ())
        near = [place for place in places if abs(place.distance_m - distance_m) <= _NEAR_M]
        return min(near, key=lambda place: abs(place.distance_m - distance_m), default=None)
