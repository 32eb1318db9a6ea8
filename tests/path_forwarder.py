"""The process between two TUN devices of `tests.kernel_path`: rate, delay and loss of packets."""

import os
import select
import sys
import time
from collections import deque
from contextlib import suppress
from json import loads
from typing import Any

_LEAST_DATA_BYTES = 100  # a packet without payload is smaller


def _forward(host: int, agent: int, path: dict[str, Any]) -> None:
    """Passes packets on until it is killed: from the agent shaped, to the agent delayed."""
    delay_ns, lost = round(path["rtt_ms"] * 5e5), frozenset(path["lost"])
    free_ns = data_packets = 0
    lines: dict[int, deque[tuple[int, bytes]]] = {host: deque(), agent: deque()}
    while True:
        due = [line[0][0] for line in lines.values() if line]
        wait_s = max(0, min(due) - time.monotonic_ns()) / 1e9 if due else None
        ready, _, _ = select.select([host, agent], [], [], wait_s)
        for file in ready:
            with suppress(BlockingIOError):
                while True:
                    packet = os.read(file, 1 << 16)
                    now_ns = time.monotonic_ns()
                    if file == host:
                        lines[agent].append((now_ns + delay_ns, packet))
                        continue
                    free_ns = max(free_ns, now_ns) + len(packet) * 8_000_000_000 // path["rate_bps"]
                    has_data = len(packet) >= _LEAST_DATA_BYTES
                    if not (has_data and data_packets in lost):
                        lines[host].append((free_ns + delay_ns, packet))
                    data_packets += has_data
        for file, line in lines.items():
            while line and line[0][0] <= time.monotonic_ns():
                with suppress(OSError):
                    os.write(file, line.popleft()[1])


if __name__ == "__main__":
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    _forward(int(sys.argv[1]), int(sys.argv[2]), loads(sys.argv[3]))
