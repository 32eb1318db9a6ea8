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
def test_the_kernels_tcp_is_no_faster_and_on_a_busy_machine_not_much_slower():
    """How near both are on a quiet machine, `tests.link_relay.lossy_bench` measures."""
    with ThreadPoolExecutor(4) as threads:
        seeds = range(1, 5)
        kernel = [d for one in threads.map(lambda s: kernel_delays(CASE, s), seeds) for d in one]
    virtual = [delay for seed in seeds for delay in virtual_delays(CASE, seed)]
    measured, computed = Delays.of(kernel), Delays.of(virtual)
    assert 0.9 < measured.mean_ms / computed.mean_ms < 2
    assert 0.9 < measured.p95_ms / computed.p95_ms < 3
