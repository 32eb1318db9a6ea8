"""What `cpnet up --netns` does before a run and after it; in between the relays do the work."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console

from cpnet.processes import ProcessEntry
from cpnet.scenario import Scenario
from link_relay.netns import probe
from link_relay.netns.leftovers import remove_leftovers
from sensing.link.profile import LinkProfile, TraceRate


def prepare(scenario: Scenario, relays: list[ProcessEntry], console: Console) -> None:
    """Tries whether this machine can do it, removes what killed runs left, says what is left out.

    Raises:
        ConfigError: namespaces are not possible here.
    """
    if not _wanted(scenario, relays):
        return
    delays = probe.require()
    if left := remove_leftovers():
        console.print(f"links: {len(left)} namespaces of runs that were killed are removed")
    link = scenario.link
    late = [p.name for p in (link.profile, link.roadside_profile) if p is not None and _delays(p)]
    if late and not delays:
        console.print(
            f"links: this kernel has no netem (sch_netem): the round trip of {', '.join(late)} is "
            "not applied, its rate and outages are",
            markup=False,
            soft_wrap=True,
        )


@contextmanager
def cleaned_up(scenario: Scenario, relays: list[ProcessEntry]) -> Iterator[None]:
    """Removes at the end what relays did not; they have ended by then."""
    try:
        yield
    finally:
        if _wanted(scenario, relays):
            remove_leftovers()


def _wanted(scenario: Scenario, relays: list[ProcessEntry]) -> bool:
    return scenario.link.apply == "netns" and bool(relays)


def _delays(profile: LinkProfile) -> bool:
    own = profile.rate.rtt_us if isinstance(profile.rate, TraceRate) else []
    return profile.rtt.p99_ms > 0 or any(own)
