"""The link section of a scenario: profiles by name, by rate, or from a trace file.

CSV: a first line that names the columns, then one line a step. `time_s` ascends from any start;
`rate_mbps` is the uplink's rate from then on, 0 for no connection; `rtt_ms` is optional. Other
columns are ignored. The last step lasts as long as the one before it (one alone never ends); then
the trace repeats.

Mahimahi: a line is the millisecond at which one packet of 1500 bytes can leave; a millisecond may
stand on several lines. The trace repeats after its last millisecond.

A trace has at most 200 000 steps of 1 ms or more, lasts at most a day, passes 1 kbit/s or more in
the mean and never more than 100 Gbit/s; round trips are at most 60 s.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import Field, ValidationError, field_validator

from protocol.config import Section, is_file
from protocol.errors import ConfigError
from sensing.limits import (
    MAX_BURST,
    MAX_LOST_SHARE,
    MAX_RATE_BPS,
    MAX_RTT_US,
    MAX_STEPS,
    MAX_TRACE_FILE_BYTES,
    MIN_STEP_US,
)
from sensing.link_profile import BUILTIN, LinkProfile, PacketLoss, RoundTrip, TraceRate, VaryingRate

_PACKET_BITS = 1500 * 8
_COLUMNS = ("time_s", "rate_mbps")


def read_trace(path: Path, rtt_ms: float = 0.0) -> LinkProfile:
    """Reads a trace: `.csv` by its columns, anything else as Mahimahi's.

    Args:
        path: the file.
        rtt_ms: round trip where the file gives none.

    Raises:
        ConfigError: the file cannot be read, or a line of it; names file and line.
    """
    read = _read_csv if path.suffix.lower() == ".csv" else _read_mahimahi
    rate = read(path, _lines(path))
    return LinkProfile(
        name=path.name[:80], source=f"file {path}", rate=rate, rtt=RoundTrip.steady(rtt_ms)
    )


def _lines(path: Path) -> list[str]:
    try:
        size_bytes = path.stat().st_size
        if size_bytes > MAX_TRACE_FILE_BYTES:
            raise ConfigError(
                f"{path}: has {size_bytes} bytes, limit {MAX_TRACE_FILE_BYTES}: cut the trace"
            )
        lines = path.read_text("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    if not any(line.strip() for line in lines):
        raise ConfigError(f"{path}: line 1: the trace is empty")
    return lines


def _read_csv(path: Path, lines: list[str]) -> TraceRate:
    reader = csv.DictReader(lines, skipinitialspace=True)
    try:
        return _read_rows(path, reader)
    except csv.Error as error:  # it has not counted the line that it failed on
        raise ConfigError(f"{path}: line {reader.line_num + 1}: {error}") from None


def _read_rows(path: Path, reader: csv.DictReader[str]) -> TraceRate:
    names = [name.strip() for name in reader.fieldnames or []]
    missing = [name for name in _COLUMNS if name not in names]
    if missing:
        raise ConfigError(
            f"{path}: line 1: lacks the column {missing[0]}; needs time_s, rate_mbps and, if you "
            f"like, rtt_ms; has {', '.join(names)}"
        )
    reader.fieldnames = names
    times_us, rates_bps, rtts_us = [], [], []
    for row in reader:
        where = f"{path}: line {reader.line_num}"
        times_us.append(round(_number(where, "time_s", row["time_s"], least=-1e9) * 1e6))
        mbps = _number(where, "rate_mbps", row["rate_mbps"], most=MAX_RATE_BPS / 1e6)
        rates_bps.append(round(mbps * 1e6))
        if "rtt_ms" in names:
            rtt_ms = _number(where, "rtt_ms", row["rtt_ms"], most=MAX_RTT_US / 1e3)
            rtts_us.append(round(rtt_ms * 1e3))
        if len(times_us) > 1 and times_us[-1] - times_us[-2] < MIN_STEP_US:
            raise ConfigError(
                f"{where}: time_s must be 1 ms later than on the line before, or more"
            )
        _check_steps(path, len(times_us))
    if not times_us:
        raise ConfigError(f"{path}: line 2: no step follows the column names")
    starts_us = [time_us - times_us[0] for time_us in times_us]
    last_us = starts_us[-1] - starts_us[-2] if len(starts_us) > 1 else 1_000_000
    return _trace(path, starts_us, rates_bps, rtts_us, starts_us[-1] + last_us)


def _read_mahimahi(path: Path, lines: list[str]) -> TraceRate:
    packets: Counter[int] = Counter()
    last_ms = 0
    for number, line in enumerate(lines, 1):
        text = line.strip()
        if not text:
            continue
        if not text.isascii() or not text.isdigit() or len(text) > 12:
            raise ConfigError(
                f"{path}: line {number}: {text[:40]!r} is not a whole "
                "millisecond, as a Mahimahi trace has it; the name of a table must end in .csv"
            )
        time_ms = int(text)
        if time_ms < last_ms:
            raise ConfigError(
                f"{path}: line {number}: {time_ms} ms comes after {last_ms} ms; must not descend"
            )
        last_ms = time_ms
        packets[max(time_ms - 1, 0)] += 1  # what can leave at t ms gathered in the ms before it
    if last_ms == 0:
        raise ConfigError(f"{path}: line {len(lines)}: the trace has no length, it ends at 0 ms")
    starts_us, rates_bps = _runs(packets)
    return _trace(path, starts_us, rates_bps, [], last_ms * 1000)


def _runs(packets: Counter[int]) -> tuple[list[int], list[int]]:
    """Returns steps in which the number of packets per millisecond does not change."""
    starts_us, rates_bps = [0], [0]
    ends_ms = 0
    for time_ms in sorted(packets):
        rate_bps = packets[time_ms] * _PACKET_BITS * 1000
        if time_ms > ends_ms and rates_bps[-1] != 0:
            starts_us.append(ends_ms * 1000)
            rates_bps.append(0)
        if rate_bps != rates_bps[-1]:
            starts_us.append(time_ms * 1000)
            rates_bps.append(rate_bps)
        ends_ms = time_ms + 1
    if len(starts_us) > 1 and starts_us[1] == 0:
        del starts_us[0], rates_bps[0]
    return starts_us, rates_bps


def _trace(
    path: Path, starts_us: list[int], rates_bps: list[int], rtts_us: list[int], period_us: int
) -> TraceRate:
    if not any(rates_bps):
        raise ConfigError(f"{path}: the rate is 0 on every line: nothing would ever pass")
    _check_steps(path, len(starts_us))
    try:
        return TraceRate(
            starts_us=starts_us, rates_bps=rates_bps, rtt_us=rtts_us, period_us=period_us
        )
    except ValidationError as error:
        message = error.errors()[0]["msg"].removeprefix("Value error, ")
        raise ConfigError(f"{path}: {message}") from None


def _check_steps(path: Path, steps: int) -> None:
    if steps > MAX_STEPS:
        raise ConfigError(f"{path}: has {steps} steps or more, limit {MAX_STEPS}: cut the trace")


def _number(
    where: str, name: str, text: str | None, least: float = 0.0, most: float = 1e9
) -> float:
    try:
        value = float(text or "")
    except ValueError:
        raise ConfigError(f"{where}: {name} is {text!r:.80}, needs a number") from None
    if not least <= value <= most:  # NaN is not either
        raise ConfigError(
            f"{where}: {name} is {text!r:.80}, needs a number from {least:g} to {most:g}"
        )
    return value


NONE = "none"
_FIXED = re.compile(
    r"(?P<rate>[0-9]+(?:\.[0-9]+)?)(?P<unit>k|m|g)bit(?:/s)?(?:,(?P<rtt>[0-9]+(?:\.[0-9]+)?)ms)?"
    r"(?:,(?P<loss>[0-9]+(?:\.[0-9]+)?)%(?:x(?P<burst>[0-9]+(?:\.[0-9]+)?))?)?",
    re.IGNORECASE,
)
_MBPS = {"k": 1e-3, "m": 1.0, "g": 1e3}


def profile_named(text: str) -> LinkProfile | None:
    """Reads `none`, a built-in name, a trace file, or `5mbit`, `5mbit,20ms`, `5mbit,20ms,1%x3`.

    That is rate, round trip, and share of packets lost, here in bursts of 3 on average.

    Raises:
        ConfigError: it is none of these, or the file cannot be read.
    """
    if text == NONE:
        return None
    if text in BUILTIN:
        return BUILTIN[text]
    if match := _FIXED.fullmatch(text):
        return _fixed(text, match)
    if not is_file(text):
        raise ConfigError(
            f"link {text!r:.80}: neither a file, nor a rate such as 5mbit or 5mbit,20ms,1% (rate, "
            "round trip, packets lost; 1%x3: in bursts of 3), nor one of "
            f"{', '.join([NONE, *BUILTIN])}"
        )
    return read_trace(Path(text))


def _fixed(text: str, match: re.Match[str]) -> LinkProfile:
    mbps, rtt_ms = float(match["rate"]) * _MBPS[match["unit"].lower()], float(match["rtt"] or 0)
    if not (0.001 <= mbps <= 100_000 and rtt_ms <= 60_000):
        raise ConfigError(
            f"link {text!r:.80}: the rate must be 1kbit to 100gbit, the round trip at most 60000ms"
        )
    return LinkProfile(
        name=text[:80],
        source="given by the user",
        rate=VaryingRate(mean_mbps=mbps),
        rtt=RoundTrip.steady(rtt_ms),
        loss=_loss(text, match),
    )


def _loss(text: str, match: re.Match[str]) -> PacketLoss:
    share, burst = float(match["loss"] or 0) / 100, float(match["burst"] or 0)
    if not (share <= MAX_LOST_SHARE and (burst == 0 or 1 <= burst <= MAX_BURST)):
        raise ConfigError(
            f"link {text!r:.80}: the loss must be at most {MAX_LOST_SHARE:.0%} of all packets, "
            f"bursts 1 to {MAX_BURST} packets on average"
        )
    return PacketLoss.in_bursts(share, burst) if burst else PacketLoss.independent(share)


class LinkConfig(Section):
    """The network between agents and edge. Without profiles it is as fast as the machine.

    A profile is written as `none`, a built-in name, `5mbit,20ms,1%`, a trace file, or in full; the
    scenario keeps it in full, so that other machines need no file.
    """

    profile: LinkProfile | None = Field(None, description="of every vehicle with a radio")
    roadside_profile: LinkProfile | None = Field(
        None, description="of every roadside LiDAR; null: it is wired and has no limits"
    )
    apply: Literal["auto", "virtual", "emulated", "none"] = Field(
        "auto",
        description="virtual: arrival in simulated time, for lockstep; emulated: a shaping relay, "
        "for realtime; auto: virtual or emulated, whichever fits the mode; none: profiles are not "
        "applied",
    )
    agent_compute_ms: float = Field(
        0.0, ge=0, le=10_000, description="virtual: from the frame's time until an agent sends"
    )
    edge_compute_ms: float = Field(
        0.0, ge=0, le=10_000, description="virtual: from the last arrival until the request is out"
    )

    @classmethod
    def of(cls, scenario: dict[str, Any]) -> Self:
        """Reads the section of a scenario's data."""
        return cls.model_validate(scenario.get("link", {}))

    @field_validator("profile", "roadside_profile", mode="before")
    @classmethod
    def _by_name(cls, value: object) -> object:
        return profile_named(value) if isinstance(value, str) else value

    def channel(self, mode: str) -> Literal["virtual", "emulated", "none"]:
        """Returns how links are emulated in a mode: in simulated time, by relays, or not at all."""
        if self.apply == "none" or (self.profile is None and self.roadside_profile is None):
            return "none"
        return "virtual" if mode == "lockstep" else "emulated"
