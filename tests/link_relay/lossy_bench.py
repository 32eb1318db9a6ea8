"""Delays over a lossy path: kernel TCP, the relay, and the link in simulated time; needs root.

`python -m tests.link_relay.lossy_bench` prints a row for each path as JSON. The same packets are
lost in all three, by their numbers: a minute of messages for each seed, several at a time. Ratios
to the kernel's delays have intervals of a bootstrap over the seeds, the same ones in both.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import socket
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, astuple, dataclass, fields

import numpy as np
import numpy.typing as npt

from sensing.link_channel import Channel
from sensing.link_config import profile_named
from sensing.lossy_link import link_over
from tests.kernel_links import receive_whole
from tests.kernel_path import KernelPath, lossy_connection
from tests.link_relay.sink import Rig

_PACKETS = 60_000  # whose losses are given: more than a path sends
_RESAMPLES = 1000
_RESTRICTED_MS = 1000.0

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class LossyCase:
    """A path as a link's profile names it, and the messages that take it."""

    link: str
    size_bytes: int
    period_s: float
    messages: int
    seeds: int = 6  # a minute each; more where losses are so rare that a few decide the percentile


CASES = (
    LossyCase("6mbit,50ms,1%", 33_000, 0.2, 300),
    LossyCase("6mbit,50ms,0.3%", 33_000, 0.1, 600, seeds=48),
    LossyCase("10mbit,20ms,1%", 33_000, 0.1, 600, seeds=12),
    LossyCase("20mbit,50ms,0.5%x3", 33_000, 0.1, 600, seeds=48),
    LossyCase("5mbit,20ms,1%", 7_000, 0.1, 600),
    LossyCase("5mbit,20ms,2%x2", 7_000, 0.1, 600, seeds=48),
    LossyCase("3mbit,100ms,1%", 7_000, 0.2, 300),
    LossyCase("10mbit,20ms,1%", 100_000, 1.0, 60),
)


@dataclass(frozen=True, slots=True)
class Delays:
    """Mean, restricted mean (of delays that count as one second at most) and 95th percentile."""

    mean_ms: float
    restricted_ms: float
    p95_ms: float

    @classmethod
    def of(cls, delays_ns: list[int] | Ints) -> Delays:
        """Summarises single delays."""
        delays_ms = np.asarray(delays_ns) / 1e6
        restricted = float(np.minimum(delays_ms, _RESTRICTED_MS).mean())
        return cls(float(delays_ms.mean()), restricted, float(np.percentile(delays_ms, 95)))


def _channel(case: LossyCase, seed: int) -> Channel:
    profile = profile_named(case.link)
    assert profile is not None
    return Channel.draw(profile, seed, "vehicle 0")


def virtual_delays(case: LossyCase, seed: int) -> list[int]:
    """Returns the delays that are computed in simulated time, in ns."""
    link, period_ns = link_over(_channel(case, seed)), round(case.period_s * 1e9)
    return [link.send(n * period_ns, case.size_bytes).latency_ns for n in range(case.messages)]


def kernel_delays(case: LossyCase, seed: int) -> list[int]:
    """Returns the delays over the kernel's TCP (CUBIC), in ns."""
    channel = _channel(case, seed)
    assert channel.losses is not None
    lost = tuple(number for number in range(_PACKETS) if channel.losses[number])
    path = KernelPath(channel.rate_bps.at(0), channel.rtt_ns.at(0) / 1e6, lost)
    with lossy_connection(path) as (sender, receiver), ThreadPoolExecutor(1) as thread:
        receiving = thread.submit(_arrivals, receiver, case)
        sent_ns = _send(case, sender.sendall)
        arrived_ns = receiving.result()
    return [b - a for a, b in zip(sent_ns, arrived_ns, strict=True)]


def relayed_delays(case: LossyCase, seed: int) -> list[int]:
    """Returns the delays over the relay, in ns."""
    rig = Rig(case.link, seed)
    try:
        sent_ns = _send(case, rig.agent.sendall)
        ends = [(n + 1) * case.size_bytes for n in range(case.messages)]
        rig.sink.arrival_ns(ends[-1])
        marks = np.array(rig.sink.marks)
        arrived_ns = marks[np.searchsorted(marks[:, 1], ends), 0].tolist()
    finally:
        rig.close()
    return [b - a for a, b in zip(sent_ns, arrived_ns, strict=True)]


def _send(case: LossyCase, send: Callable[[bytes], object]) -> list[int]:
    sent_ns, begin_ns = [], time.monotonic_ns()
    for number in range(case.messages):
        due_ns = begin_ns + round(number * case.period_s * 1e9)
        time.sleep(max(0, due_ns - time.monotonic_ns()) / 1e9)
        sent_ns.append(time.monotonic_ns())
        send(bytes(case.size_bytes))
    return sent_ns


def _arrivals(receiver: socket.socket, case: LossyCase) -> list[int]:
    arrived_ns = []
    for _ in range(case.messages):
        receive_whole(receiver, case.size_bytes)
        arrived_ns.append(time.monotonic_ns())
    return arrived_ns


MEASURED = {"kernel": kernel_delays, "emulated": relayed_delays}
FORMS = (*MEASURED, "virtual")


def measured_delays(case: LossyCase, seed: int) -> dict[str, list[int]]:
    """Returns the delays of a seed by form, measured at one time, in ns."""
    with ThreadPoolExecutor(len(MEASURED)) as threads:
        running = {name: threads.submit(form, case, seed) for name, form in MEASURED.items()}
    return {name: one.result() for name, one in running.items()}


def row(case: LossyCase, of_seeds: list[dict[str, list[int]]]) -> dict[str, object]:
    """Returns the case beside the delays of its seeds together, by form, and ratios to kernel's."""
    every = {name: np.array([one[name] for one in of_seeds]) for name in FORMS}
    of_kernel = {name: ratios(every[name], every["kernel"]) for name in FORMS if name != "kernel"}
    return {
        **asdict(case),
        **{name: asdict(Delays.of(one)) for name, one in every.items()},
        "of_kernel": of_kernel,
    }


def ratios(delays_ns: Ints, kernel_ns: Ints) -> dict[str, list[float]]:
    """Compares delays (seeds, messages) with the kernel's of the same seeds.

    Returns:
        For each of `Delays` its ratio to the kernel's, and the ends of the 95 % interval.
    """
    seeds, rng = len(delays_ns), np.random.default_rng(1)
    drawn = [np.arange(seeds), *rng.integers(seeds, size=(_RESAMPLES, seeds))]
    found = [
        np.divide(*(astuple(Delays.of(one[some])) for one in (delays_ns, kernel_ns)))
        for some in drawn
    ]
    ends = np.percentile(found[1:], [2.5, 97.5], axis=0)
    names = [field.name for field in fields(Delays)]
    return dict(zip(names, np.vstack([found[0], ends]).T.tolist(), strict=True))


def _in_realtime() -> None:
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))


def main() -> None:
    """Runs all cases, some seeds at a time, and prints a row for each case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", type=int, default=8, help="seeds at a time")
    given = parser.parse_args()
    runs = [(case, seed) for case in CASES for seed in range(1, case.seeds + 1)]
    spawning = multiprocessing.get_context("spawn")
    with spawning.Pool(given.jobs, _in_realtime, maxtasksperchild=1) as pool:
        measured = pool.starmap(measured_delays, runs, chunksize=1)
    # Computed when nothing is measured any more: it would keep a core from those in real time.
    found = [
        one | {"virtual": virtual_delays(*run)} for run, one in zip(runs, measured, strict=True)
    ]
    by_case = {
        case: [one for (its, _), one in zip(runs, found, strict=True) if its == case]
        for case in CASES
    }
    json.dump([row(case, of_seeds) for case, of_seeds in by_case.items()], sys.stdout, indent=1)


if __name__ == "__main__":
    main()
