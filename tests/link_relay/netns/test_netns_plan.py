"""What is told to `ip` and `tc`, and what things are called; nothing is made."""

import os
import re
import stat
from pathlib import Path as File

import pytest

from link_relay.netns import leftovers, probe
from link_relay.netns.place import Pair, Place
from link_relay.netns.qdisc import delay_of_agent, delay_of_host, tbf
from link_relay.netns.schedule import STEP_NS, delay_us, held_ns, rate_bps
from protocol.errors import ConfigError
from sensing.link.named import profile_named
from sensing.link.path import Path

TRACE = "time_s,rate_mbps,rtt_ms\n0,5,20\n0.25,0,40\n0.4,1,40\n0.8,1,40\n"


def test_names_carry_the_process_and_fit_the_kernel():
    place = Place(4_194_304, 99_999)
    assert place.namespace == "cpnet-4194304-99999"
    assert len(place.device) <= 15
    assert Place.of(place.namespace) == Place.of(place.device) == place


@pytest.mark.parametrize("name", ["eth0", "cpnet-1", "cpnet-1-2x", "xcp1-2", "cp-1-2", "cp1-2@if3"])
def test_names_of_others_are_nobodys(name):
    assert Place.of(name) is None


def test_every_device_has_a_pair_of_addresses_of_its_own():
    pairs = [Pair.of(index) for index in range(1, 1 << 15)]
    assert pairs[0] == Pair("198.19.0.2", "198.19.0.3")
    assert len({address for pair in pairs for address in (pair.host, pair.agent)}) == 2 * len(pairs)
    assert pairs[-1].agent == "198.19.255.255"


def words(line: str) -> dict[str, int]:
    found = re.findall(r"(rate|burst) (\d+)", line)
    return {name: int(number) for name, number in found}


@pytest.mark.parametrize("bps", [800_000, 5_000_000, 50_000_000, 1_000_000_000])
def test_tbf_lets_the_rate_pass_with_the_headers_of_ethernet(bps):
    told = words(tbf("add", bps, 10**12))
    assert told["rate"] == pytest.approx(bps * 1514 / 1500, rel=1e-3)
    assert told["burst"] == pytest.approx(1514 + bps / 8000, rel=0.02)


def test_what_a_change_gives_at_once_comes_off_the_rate():
    told = words(tbf("change", 5_000_000, STEP_NS))
    passed_bits = told["rate"] * 0.1 + 8 * (told["burst"] - 757)
    assert passed_bits == pytest.approx(500_000 * 1514 / 1500, rel=1e-3)


def test_no_connection_is_a_rate_at_which_nothing_moves():
    assert words(tbf("change", 0, STEP_NS)) == {"rate": 1000, "burst": 1514}


def test_netem_delays_one_way_each():
    assert "dev uplink parent 1:1 handle 10: netem delay 8000us" in delay_of_agent("add", 8000)
    assert delay_of_host("change", "cp1-1", 8000).startswith(
        "qdisc change dev cp1-1 root netem delay 8000us"
    )


def test_a_path_becomes_steps_of_its_mean(tmp_path):
    (tmp_path / "a.csv").write_text(TRACE)
    path = Path.draw(profile_named(str(tmp_path / "a.csv")), 1, "vehicle 0")
    rates = [rate_bps(path, step) for step in range(12)]
    assert rates == [5e6, 5e6, 2.5e6, 0, *[1e6] * 8]
    assert [delay_us(path, step) for step in range(4)] == [10_000, 10_000, 15_000, 20_000]
    assert [held_ns(path, step) // STEP_NS for step in (0, 2, 3, 4)] == [2, 1, 1, 8]


def test_a_drawn_path_keeps_its_own_rates():
    path = Path.draw(profile_named("lte"), 3, "vehicle 1")
    assert [rate_bps(path, step) for step in range(50)] == path.rate_bps.values[:50]


def test_without_ip_the_missing_package_is_named(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ConfigError, match=r"ip \(Debian package iproute2\).*needs no root"):
        probe.require()


@pytest.mark.parametrize(
    ("refused", "missing"), [("netns add", "network namespaces"), ("veth", "veth"), ("tbf", "tbf")]
)
def test_what_the_kernel_refuses_is_named(monkeypatch, tmp_path, refused, missing):
    for program in ("ip", "tc"):
        script = tmp_path / program
        script.write_text(
            f'#!/bin/sh\ncase "$*" in *"{refused}"*) echo Not so >&2; exit 1;; esac\n'
        )
        script.chmod(script.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", str(tmp_path))
    found = probe.examine().missing
    assert missing in found
    assert "root" in found
    assert "Not so" in found


def test_leftovers_are_those_of_processes_that_are_no_more(monkeypatch, tmp_path):
    gone, mine = Place(2**22 + 1, 7), Place(os.getpid(), 7)
    for name in (gone.namespace, mine.namespace, "another"):
        (tmp_path / name).touch()
    removed: list[Place] = []
    monkeypatch.setattr(leftovers, "NAMESPACES", tmp_path)
    monkeypatch.setattr(leftovers, "_DEVICES", File(tmp_path / "nothing"))
    monkeypatch.setattr(leftovers, "remove", removed.append)
    assert leftovers.remove_leftovers() == removed == [gone]
