"""Queue filter for partly observed lanes: histogram filter, point queue, Poisson arrivals.

For each lane before a stop bar it holds the joint probability of the arrival rate and of the number
of vehicles that queue: those that have stood and have not passed the stop bar. Unseen vehicles
arrive as a Poisson process and leave one by one while the lane is green. Observations correct it,
after Comert and Cetin (2009): a vehicle that stops joins the end of the queue, so that its distance
shows how many stand ahead; one that passes the stop bar has none of them ahead any more; one that
still drives is behind the last one. So a few vehicles that report themselves are evidence of all
others.

Which share of all vehicles reports itself is unknown, too, and the same on all lanes: there is such
a filter for each of some shares, weighted by how well it predicted the observations (a bank of
filters, Magill 1965). Few reports could be of few vehicles or of many: their number and where they
stopped decide together, and on lanes that are seen, the share that reports itself.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numba import njit

from signal_controller.observation import LaneVehicles
from signal_controller.predictive_model import Bools, Floats, Ints, JunctionModel
from signal_controller.queue_estimator import MIN_COVERAGE, SPACING_M
from signal_controller.tracked_vehicle import STOPPED_MPS

_FREE_MPS = 5.0  # a vehicle that drives so fast does not stand in the queue
_RATE_FACTORS = np.array([0.1, 0.25, 0.5, 0.75, 1.0, 1.5, 2.2, 3.0])  # of the expected inflow
_LEAST_INFLOW_VPH = 1.0  # with none expected it could not learn
_RATE_MEMORY_S = 300.0  # after which a rate may have become that of another lane
_ANY_RATE = 0.05  # probability that it has become any
_RATE_SPREAD = 0.7  # of the logarithm of a rate of which nothing is known but what is expected
_MOST_QUEUED = 60
_LOST_S = 2.0  # from the begin of green to the first vehicle that leaves
_YIELDING = 0.4  # of the saturation flow, of turns that yield
_REPORTING = np.geomspace(0.02, 1.0, 12)  # shares of all vehicles
_REPORTING_PRIOR = _REPORTING**-0.5 / (_REPORTING**-0.5).sum()  # a mean of 0.14
_REPORTING_MEMORY_S = 7200.0  # after which the share may have become another
_PLACE_M, _PLACE_SHARE = 3.0, 0.08  # how far off its place in the queue one stands, by distance
_MISTAKE = 1e-3  # likelihood of what cannot be: places are not exact, lanes are changed
_LOST_AFTER_S = 2.0
_HEAD_M = 10.0  # a vehicle that vanishes so near the stop bar has passed it
_WHOLE = 0.9  # of a lane: what is seen of it is all
_HIDDEN_M = 20.0  # before the end of what is seen, vehicles are often hidden by those before them
_INSIDE = 0.9  # of the probability, in the interval


@dataclass(frozen=True, slots=True)
class LaneQueue:
    """Vehicles that queue on a lane: expectation, median, and the interval that holds 90 %.

    No other number is less far off on average than the median.
    """

    mean: float
    median: int
    low: float
    high: float


@dataclass(slots=True)
class _Seen:
    """A vehicle before a stop bar, as last seen.

    Attributes:
        due_s: of one that has stood, when it would have been at the stop bar if nothing held it.
        reports: it has reported itself.
        is_counted: its arrival has updated the rate.
        ends_m: it drives, so that no queue reaches back to this distance.
    """

    lane: int
    distance_m: float
    time_s: float
    due_s: float = math.nan
    reports: bool = False
    is_counted: bool = False
    ends_m: float = math.inf

    @property
    def queues(self) -> bool:
        """Whether it has stood."""
        return not math.isnan(self.due_s)


class QueueFilter:
    """Follows the queues of a signal's lanes from frame to frame.

    Attributes:
        coverage: (L,) part of each lane, from the stop bar on, that sensors see without a gap.
    """

    def __init__(self, model: JunctionModel, inflow_vph: float, saturation_vph: float) -> None:
        self._model = model
        lanes = len(model.lanes)
        inflow_vph = max(inflow_vph, _LEAST_INFLOW_VPH)
        self._rates_per_s = inflow_vph / 3600 * _RATE_FACTORS
        self._saturation_per_s = saturation_vph / 3600
        self._reach_m = np.maximum(SPACING_M, model.reach_m)
        self._most = np.minimum(_MOST_QUEUED, np.ceil(self._reach_m / SPACING_M)).astype(int)
        self._numbers = np.arange(self._most.max(initial=1) + 1)
        self._joint = np.zeros((len(_REPORTING), lanes, len(_RATE_FACTORS), len(self._numbers)))
        self._joint[:, :, :, 0] = _rate_weights(self._rates_per_s, inflow_vph / 3600)
        self._reporting_weights = _REPORTING_PRIOR.copy()
        self._seen: dict[str, _Seen] = {}
        self._green_s = np.zeros(lanes)
        self._time_s: float | None = None
        self.coverage = np.ones(lanes)
        self._unseen_s = 0.0

    @property
    def reporting(self) -> float:
        """Expected share of all vehicles that report themselves."""
        return float(self._reporting_weights @ _REPORTING)

    @property
    def arrivals_per_s(self) -> Floats:
        """Expected rate of arrival (L,), of lanes that are not seen."""
        return np.asarray(self._reporting_weights @ self._rates)

    @property
    def unreported_per_s(self) -> Floats:
        """The same of those (L,) that do not report themselves."""
        return np.asarray((self._reporting_weights * (1 - _REPORTING)) @ self._rates)

    @property
    def _rates(self) -> Floats:
        """Expected rate of arrival for each share that reports itself (S, L)."""
        return np.asarray(self._joint.sum(axis=3) @ self._rates_per_s)

    @property
    def is_seen(self) -> Bools:
        """Whether a lane (L,) is seen at least before the stop bar."""
        return self.coverage >= MIN_COVERAGE

    @property
    def blind_s(self) -> float:
        """For how long no lane has been seen and no vehicle has reported itself."""
        return self._unseen_s

    def queued(self) -> Floats:
        """Returns the vehicles (L,) of those given that queue."""
        found = np.zeros(len(self.coverage))
        for one in self._seen.values():
            found[one.lane] += one.queues
        return found

    def queue(self, lane: int) -> LaneQueue:
        """Returns the estimate of a lane's queue."""
        numbers = self._reporting_weights @ self._joint[:, lane].sum(axis=1)
        median = int(np.searchsorted(np.cumsum(numbers), 0.5))
        return LaneQueue(float(numbers @ self._numbers), median, *shortest_interval(numbers))

    def expected(self) -> Floats:
        """Returns the expected queues (L,)."""
        return np.asarray(self._reporting_weights @ (self._joint.sum(axis=2) @ self._numbers))

    def take(
        self,
        time_s: float,
        vehicles: LaneVehicles,
        open_shares: Floats,
        coverage: Mapping[str, float],
        parked: Collection[str] = (),
    ) -> None:
        """Updates by a frame.

        Args:
            time_s: of the frame.
            vehicles: all that are known, with ids.
            open_shares: (L, 2) of a lane's vehicles that may go, with right of way and yielding.
            coverage: share by lane that sensors cover from the stop bar on; without any, vehicles
                report themselves.
            parked: ids of those that stand beside a lane, in no queue.
        """
        passed_s = 0.0 if self._time_s is None else max(0.0, min(10.0, time_s - self._time_s))
        self._time_s = time_s
        self.coverage = np.array(
            [coverage.get(lane, 1.0) if coverage else 0.0 for lane in self._model.lanes]
        )
        is_blind = not self.is_seen.any() and not len(vehicles.ids)
        self._unseen_s = self._unseen_s + passed_s if is_blind else 0.0
        for part_s in _parts(passed_s):
            self._predict(part_s, open_shares)
        in_lane = [n for n, name in enumerate(vehicles.ids) if name not in parked]
        driving = vehicles.take(np.array(in_lane, np.int64))
        goes_on = 0.0 < passed_s <= _LOST_AFTER_S
        self._follow(time_s, driving, open_shares.sum(axis=1) <= 0, goes_on=goes_on)
        self._note_seen()

    def _predict(self, passed_s: float, open_shares: Floats) -> None:
        """Lets unseen vehicles arrive and leave for a part of a second."""
        flow = open_shares @ np.array([1.0, _YIELDING])
        self._green_s = np.where(flow > 0, self._green_s + passed_s, 0.0)
        leave = np.where(self._green_s > _LOST_S, flow * self._saturation_per_s * passed_s, 0.0)
        leave = np.minimum(1.0, leave)
        # No vehicle arrived that would be known, else it is counted in `_follow`.
        known = np.where(self.is_seen, 1.0, _REPORTING[:, None])
        totals = _advance(
            self._joint, self._rates_per_s, _REPORTING, known, leave, self._most, passed_s
        )
        self._weigh_reporting(np.where(self.is_seen, 1.0, totals).prod(axis=1))
        self._change_rates(passed_s / _RATE_MEMORY_S)
        self._reporting_weights += (
            passed_s / _REPORTING_MEMORY_S * (_REPORTING_PRIOR - self._reporting_weights)
        )

    def _change_rates(self, probability: float) -> None:
        """Lets rates change over time: to those of the signal's other lanes, or to any.

        So lanes of which little is known are assumed to be like the others.
        """
        of_lanes = self._joint.sum(axis=3).mean(axis=1)
        pooled = (1 - _ANY_RATE) * of_lanes + _ANY_RATE / len(_RATE_FACTORS)
        changed = pooled[:, None, :, None] * self._joint.sum(axis=2)[:, :, None, :]
        self._joint += probability * (changed - self._joint)

    def _follow(
        self, time_s: float, vehicles: LaneVehicles, is_red: Bools, *, goes_on: bool
    ) -> None:
        """Follows each vehicle from where it is first known until it passes the stop bar.

        The nearest come first: one that stops behind them stops later. Unless the frame `goes_on`
        from the one before, vehicles that are there have come some time ago.
        """
        upstream, index_of = self._model.approaches.upstream, self._model.lane_index
        gone = []
        for row in np.argsort(vehicles.distances_m, kind="stable").tolist():
            name, lane_name = vehicles.ids[row], vehicles.lanes[row]
            distance_m, speed_mps = vehicles.distances_m.item(row), vehicles.speeds_mps.item(row)
            side = upstream.get(lane_name)
            if side is None or distance_m > self._reach_m[index_of[side.counts_for]]:
                gone.append(name)
                continue
            lane = index_of[side.counts_for]
            is_old = not goes_on and not self.is_seen[lane]
            one = self._seen.setdefault(name, _Seen(lane, distance_m, time_s, is_counted=is_old))
            one.lane, one.distance_m, one.time_s = lane, distance_m, time_s
            one.reports |= vehicles.agents is None or vehicles.agents[row] != ""
            if one.reports and not one.is_counted and not self.is_seen[lane]:
                self._count(one, _REPORTING)
            if not one.queues and speed_mps < STOPPED_MPS:
                one.due_s = time_s + self._model.free_flow_s(lane_name, distance_m)
                self._join(one)
            elif not one.queues and speed_mps > _FREE_MPS and is_red[lane]:
                self._not_behind(one)
        gone += [n for n, one in self._seen.items() if time_s - one.time_s > _LOST_AFTER_S]
        for one in [self._seen.pop(name) for name in gone if name in self._seen]:
            if one.distance_m < _HEAD_M:
                self._leave(one, time_s, tells=vehicles.agents is not None)

    def _leave(self, one: _Seen, time_s: float, *, tells: bool) -> None:
        """Updates for a vehicle that passed the stop bar; `tells`: its reporting is known."""
        if not self.is_seen[one.lane]:
            self._pass(one, time_s)
        elif not one.is_counted:
            reporting = _REPORTING if one.reports else 1 - _REPORTING
            self._count(one, reporting if tells else np.ones(len(_REPORTING)))

    def _count(self, one: _Seen, likelihood: Floats) -> None:
        """Updates for an arrival, with its likelihood by the share (S,) that reports itself."""
        one.is_counted = True
        self._weigh(one.lane, self._rates_per_s[:, None])
        self._weigh_reporting(likelihood)

    def _not_behind(self, one: _Seen) -> None:
        """Updates for a vehicle that still drives: the queue ends before it."""
        if self.is_seen[one.lane] or one.distance_m > one.ends_m - SPACING_M:
            return
        tails_m = self._numbers * SPACING_M - _PLACE_M
        is_behind = (tails_m > one.distance_m) & (tails_m <= one.ends_m)
        one.ends_m = one.distance_m
        self._weigh(one.lane, np.where(is_behind, _MISTAKE, 1.0))

    def _join(self, one: _Seen) -> None:
        """Updates for a vehicle that stopped: as many stand before it as fit up to the stop bar."""
        lane = one.lane
        if self.is_seen[lane]:
            return
        away_m = self._numbers * SPACING_M - one.distance_m
        deviation_m = _PLACE_M + _PLACE_SHARE * one.distance_m
        self._weigh(lane, np.exp(-0.5 * (away_m / deviation_m) ** 2) + _MISTAKE)
        joint = self._joint[:, lane]
        longest = joint[..., -1].copy()
        joint[..., 1:] = joint[..., :-1].copy()
        joint[..., 0] = 0.0
        joint[..., -1] += longest

    def _weigh(self, lane: int, likelihood: Floats) -> None:
        """Corrects a lane by a likelihood, which is at least `_MISTAKE` somewhere."""
        joint = self._joint[:, lane] * likelihood
        totals = joint.sum(axis=(1, 2))
        self._joint[:, lane] = joint / totals[:, None, None]
        if not self.is_seen[lane]:
            self._weigh_reporting(totals)

    def _weigh_reporting(self, likelihood: Floats) -> None:
        """Corrects the probabilities of the shares that report themselves."""
        self._reporting_weights = self._reporting_weights * likelihood
        self._reporting_weights /= self._reporting_weights.sum()

    def _pass(self, one: _Seen, time_s: float) -> None:
        """Updates for a vehicle that passed the stop bar: only later arrivals can still queue."""
        lane = one.lane
        weights = self._joint[:, lane].sum(axis=2)
        behind = sum(other.lane == lane and other.queues for other in self._seen.values())
        since_s = max(1.0, time_s - one.due_s) if one.queues else 1.0
        expected = (1 - _REPORTING)[:, None] * self._rates_per_s * since_s
        numbers = np.maximum(0, self._numbers - behind)
        log = numbers * np.log(expected[..., None] + 1e-9) - expected[..., None]
        log -= np.array([math.lgamma(n + 1) for n in numbers])
        chance = np.exp(log) * (self._numbers >= behind) * (self._numbers <= self._most[lane])
        chance += 1e-12
        self._joint[:, lane] = weights[..., None] * chance / chance.sum(axis=2, keepdims=True)

    def _note_seen(self) -> None:
        """Updates by the observed queues; one that fills the covered part may be longer."""
        if not self.is_seen.any():
            return
        queued = self.queued()
        tails_m = np.zeros(len(self.coverage))
        for one in self._seen.values():
            if one.queues:
                tails_m[one.lane] = max(tails_m[one.lane], one.distance_m)
        for lane in np.flatnonzero(self.is_seen):
            covered = self.coverage[lane]
            number = min(int(queued[lane]), len(self._numbers) - 1)
            seen_m = covered * self._reach_m[lane]
            is_whole = covered > _WHOLE or tails_m[lane] < seen_m - _HIDDEN_M
            allowed = self._numbers == number if is_whole else self._numbers >= number
            weights = self._joint[:, lane].sum(axis=2, keepdims=True)
            joint = self._joint[:, lane] * allowed
            total = joint.sum(axis=2, keepdims=True)
            exact = weights * (self._numbers == number)
            self._joint[:, lane] = np.where(
                total > 1e-9, joint * weights / np.maximum(total, 1e-12), exact
            )


@njit(
    "float64[:,::1](float64[:,:,:,::1], float64[::1], float64[::1], float64[:,::1], float64[::1], "
    "int64[::1], float64)",
    cache=True,
)
def _advance(
    joint: Floats,
    rates_per_s: Floats,
    reporting: Floats,
    known: Floats,
    leave: Floats,
    most: Ints,
    passed_s: float,
) -> Floats:
    """Lets unseen vehicles leave (L,) and arrive, and no vehicle arrive that would be known.

    Returns the probability (S, L) of the latter; joint (S, L, R, N) is changed in place, and its
    sum over R and N is 1 again.
    """
    totals = np.zeros(known.shape)
    last = joint.shape[3] - 1
    for share in range(joint.shape[0]):
        for lane in range(joint.shape[1]):
            goes = leave[lane]
            for rate in range(joint.shape[2]):
                own, per_s = joint[share, lane, rate], rates_per_s[rate]
                stays = np.exp(-known[share, lane] * per_s * passed_s)
                come = min(1.0, per_s * (1 - reporting[share]) * passed_s)
                own[0] += goes * own[1]
                for number in range(1, last):
                    own[number] += goes * (own[number + 1] - own[number])
                own[last] -= goes * own[last]
                for number in range(most[lane] - 1, -1, -1):
                    if number > 0 or goes == 0.0:  # else they pass without having to stop
                        own[number + 1] += come * own[number]
                        own[number] -= come * own[number]
                own *= stays
                totals[share, lane] += own.sum()
            joint[share, lane] /= totals[share, lane]
    return totals


def shortest_interval(probabilities: Floats) -> tuple[int, int]:
    """Returns the first and the last of the fewest numbers that hold 90 % of probabilities (N,).

    Hardly any numbers hold just that: half of what the less likely end holds may be missing, so
    that on average it is 90 % and not more (mid-P, Lancaster 1961).
    """
    below = np.append(0.0, np.cumsum(probabilities))
    ends = np.minimum(np.searchsorted(below, below[:-1] + _INSIDE - 1e-9), len(probabilities))
    holds = below[ends] - below[:-1] >= _INSIDE - 1e-6
    low = int(np.argmin(np.where(holds, ends - np.arange(len(probabilities)), np.inf)))
    high = int(ends[low]) - 1
    least = min(probabilities[low], probabilities[high])
    if high == low or below[high + 1] - below[low] - least / 2 <= _INSIDE:
        return low, high
    return (low + 1, high) if probabilities[low] < probabilities[high] else (low, high - 1)


def _rate_weights(rates_per_s: Floats, rate_per_s: float) -> Floats:
    """Returns the probabilities (R,) of rates of which this one is expected."""
    median_per_s = rate_per_s * math.exp(-(_RATE_SPREAD**2) / 2)
    away = np.log(rates_per_s / median_per_s) / _RATE_SPREAD
    weights = np.exp(-0.5 * away**2) + 0.02
    return np.asarray(weights / weights.sum())


def _parts(passed_s: float) -> list[float]:
    """Splits time into parts of a second at most."""
    number = math.ceil(passed_s)
    return [passed_s / number] * number if number else []
