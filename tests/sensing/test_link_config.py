from pathlib import Path

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.errors import ConfigError
from protocol.messages import Setup
from sensing.limits import MAX_PERIOD_US, MAX_RATE_BPS, MAX_RTT_US, MAX_STEPS
from sensing.link_channel import Channel as LinkPath
from sensing.link_config import LinkConfig, profile_named, read_trace
from sensing.link_profile import LinkProfile, TraceRate, VaryingRate

WIDE_CSV = f"time_s,rate_mbps\n0,1\n1,{'1' * 140_000}\n"
LONG_NAME = pytest.param("x" * 5000, id="long")
HUGE_RATE = pytest.param("9" * 999 + "mbit", id="huge")
LONG_CSV = "time_s,rate_mbps\n" + "".join(f"{n},1\n" for n in range(MAX_STEPS + 1))


def written(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text)
    return path


def rate_of(profile: LinkProfile | None) -> TraceRate:
    assert profile is not None
    assert isinstance(profile.rate, TraceRate)
    return profile.rate


def test_a_csv_trace_keeps_rate_and_round_trip(tmp_path):
    text = "lat, time_s, rate_mbps, rtt_ms\n1, 10.0, 2.5, 30\n1, 10.5, 0, 40\n1, 12, 4, 50\n"
    rate = rate_of(read_trace(written(tmp_path, "drive.csv", text)))
    assert rate.starts_us == [0, 500_000, 2_000_000]
    assert rate.rates_bps == [2_500_000, 0, 4_000_000]
    assert rate.rtt_us == [30_000, 40_000, 50_000]
    assert rate.period_us == 3_500_000


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1: the trace is empty"),
        ("time_s,speed\n0,1\n", "line 1: lacks the column rate_mbps.*has time_s, speed"),
        ("time_s,rate_mbps\n", "line 2: no step"),
        ("time_s,rate_mbps\n0,1\n1,fast\n", "line 3: rate_mbps is 'fast'"),
        ("time_s,rate_mbps\n0,1\n1\n", "line 3: rate_mbps is None"),
        ("time_s,rate_mbps\n0,1\n1,-2\n", "line 3: rate_mbps is '-2'"),
        ("time_s,rate_mbps\n0,1\n1,nan\n", "line 3: rate_mbps is 'nan'"),
        ("time_s,rate_mbps\n0,1\n0,2\n", "line 3: time_s must be 1 ms later"),
        ("time_s,rate_mbps\n0,0\n1,0\n", "the rate is 0 on every line"),
        ("time_s,rate_mbps\n0,1\n0.0009,2\n", "line 3: time_s must be 1 ms later"),
        ("time_s,rate_mbps\n0,1\n1,100001\n", "line 3: rate_mbps is '100001'.*to 100000"),
        ("time_s,rate_mbps,rtt_ms\n0,1,60001\n", "line 2: rtt_ms is '60001'.*to 60000"),
        ("time_s,rate_mbps\n0,1\n1e6,1\n", "repeats after 2e.06 s, limit 86400"),
        ("time_s,rate_mbps\n0,0.00001\n", "the mean rate is 10 bit/s, needs 1000"),
        pytest.param(WIDE_CSV, "line 3: field larger than field limit", id="wide"),
        pytest.param(LONG_CSV, "limit 200000", id="long"),
    ],
)
def test_a_csv_that_is_no_trace_is_refused_with_file_and_line(tmp_path, text, message):
    with pytest.raises(ConfigError, match=rf"drive\.csv: .*{message}|drive\.csv: {message}"):
        read_trace(written(tmp_path, "drive.csv", text))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("\n\n", "line 1: the trace is empty"),
        ("1\n2\nx\n", "line 3: 'x' is not a whole millisecond"),
        ("5\n4\n", "line 2: 4 ms comes after 5 ms"),
        ("0\n0\n", "line 2: the trace has no length"),
        ("1\n999999999999\n", "the trace repeats after 1e.09 s, limit 86400"),
        pytest.param("1\n" * 8400, "rates_bps are from 100800000000.*to 100000000000", id="fast"),
    ],
)
def test_a_mahimahi_file_that_is_none_is_refused_with_file_and_line(tmp_path, text, message):
    with pytest.raises(ConfigError, match=rf"city\.up: {message}"):
        read_trace(written(tmp_path, "city.up", text))


def test_a_folder_and_bytes_are_refused(tmp_path):
    (tmp_path / "bytes.up").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="cannot be read"):
        read_trace(tmp_path / "bytes.up")
    with pytest.raises(ConfigError, match="neither a file"):
        profile_named(str(tmp_path))


@settings(deadline=None)
@given(st.lists(st.integers(0, 40), min_size=1, max_size=80).map(sorted))
def test_a_mahimahi_trace_lets_pass_what_its_lines_say(tmp_path_factory, stamps):
    if stamps[-1] == 0:
        stamps.append(3)
    text = "".join(f"{ms}\n" for ms in stamps)
    path = written(tmp_path_factory.mktemp("trace"), "city.up", text)
    link = LinkPath.draw(read_trace(path), 1, "a")
    assert link.rate_bps.period_ns == stamps[-1] * 1_000_000
    for turn in (0, 2):
        for ms in range(1, stamps[-1] + 1):
            start = turn * link.rate_bps.period_ns
            bits = link.rate_bps.integral(start, start + ms * 1_000_000) // 10**9
            assert bits == 12_000 * sum(stamp <= ms for stamp in stamps)


def test_a_packet_every_millisecond_is_12_mbit(tmp_path):
    rate = rate_of(profile_named(str(written(tmp_path, "steady", "1\n"))))
    assert (rate.starts_us, rate.rates_bps, rate.period_us) == ([0], [12_000_000], 1000)


@pytest.mark.parametrize(
    ("text", "mbps", "rtt_ms"),
    [("5mbit", 5, 0), ("300kbit,80ms", 0.3, 80), ("1.5Gbit/s,0.5ms", 1500, 0.5)],
)
def test_a_rate_is_a_profile(text, mbps, rtt_ms):
    profile = profile_named(text)
    assert profile is not None
    assert profile.rate.mean_mbps == pytest.approx(mbps)
    assert profile.rtt.p99_ms == rtt_ms


@pytest.mark.parametrize(
    "text",
    ["6g", "5mbps", "0mbit", "nowhere.csv", "", "a\0b", "5mbit,60001ms", LONG_NAME, HUGE_RATE],
)
def test_what_is_no_profile_is_refused_with_what_is_allowed(text):
    with pytest.raises(ConfigError, match=r"^.{,120}(neither a file.*5g-urban|1kbit to 100gbit)"):
        profile_named(text)


def test_a_scenario_keeps_the_whole_profile():
    config = LinkConfig.model_validate({"profile": "lte", "roadside_profile": "none"})
    again = LinkConfig.model_validate(config.model_dump(mode="json"))
    assert again == config
    assert config.profile is not None
    assert config.profile.name == "lte"
    assert config.roadside_profile is None


@pytest.mark.parametrize(
    ("data", "mode", "channel"),
    [
        ({}, "lockstep", "none"),
        ({"profile": "lte"}, "lockstep", "virtual"),
        ({"profile": "lte"}, "realtime", "emulated"),
        ({"roadside_profile": "lte"}, "realtime", "emulated"),
        ({"profile": "lte", "apply": "none"}, "realtime", "none"),
    ],
)
def test_the_mode_decides_how_a_link_is_applied(data, mode, channel):
    assert LinkConfig.model_validate(data).channel(mode) == channel


def test_a_rate_needs_no_kind_to_be_a_varying_one():
    profile = LinkProfile.model_validate({"rate": {"mean_mbps": 5}})
    assert profile.rate == VaryingRate(mean_mbps=5)


def test_the_longest_traces_fit_into_a_setup():
    count, day = MAX_STEPS, MAX_PERIOD_US
    starts = [0, *range(day - count * 1000, day - 1000, 1000)]
    rates = [MAX_RATE_BPS] * len(starts)
    rtts = [MAX_RTT_US] * len(starts)
    rate = TraceRate(starts_us=starts, rates_bps=rates, rtt_us=rtts, period_us=day)
    profile = LinkProfile(rate=rate).model_dump(mode="json")
    packed = msgpack.packb({"profile": profile, "roadside_profile": profile})
    assert len(starts) == MAX_STEPS
    assert len(packed) < Setup.max_header_bytes * 0.6
