"""Whether this machine can shape links with namespaces, found out by making one."""

from __future__ import annotations

import os
import shutil
import socket
from dataclasses import dataclass

from link_relay.netns.enter import socket_in
from link_relay.netns.iproute import NetnsError, call
from link_relay.netns.leftovers import remove
from link_relay.netns.place import UPLINK, Place
from link_relay.netns.qdisc import delay_of_agent, tbf
from protocol.errors import ConfigError

_RIGHTS = "it needs root (CAP_SYS_ADMIN and CAP_NET_ADMIN)"


@dataclass(frozen=True, slots=True)
class Ability:
    """What is missing for namespaces, empty if nothing is; and whether netem can delay."""

    missing: str
    delays: bool


def examine() -> Ability:
    """Makes a namespace with a shaped link and removes it."""
    absent = [program for program in ("ip", "tc") if shutil.which(program) is None]
    if absent:
        return Ability(f"the program {absent[0]} (Debian package iproute2)", delays=False)
    place = Place(os.getpid(), 0)
    try:
        return _try_out(place)
    finally:
        remove(place)


def require() -> bool:
    """Returns whether netem can delay.

    Raises:
        ConfigError: namespaces are not possible here; says what is missing.
    """
    ability = examine()
    if ability.missing:
        raise ConfigError(
            f"--netns is not possible here, what is missing is {ability.missing}. Leave --netns "
            "out: then a relay shapes the links, which needs no root"
        )
    return ability.delays


def _try_out(place: Place) -> Ability:
    inside = ("-netns", place.namespace)
    pair = f"{place.device} type veth peer name {UPLINK} netns {place.namespace}"
    queue, delay = tbf("add", 1_000_000, 10**9).split(), delay_of_agent("add", 1).split()
    steps = (
        ("network namespaces", "ip", ("netns", "add", place.namespace)),
        ("pairs of virtual devices (veth)", "ip", ("link", "add", *pair.split())),
        ("the queue tbf (sch_tbf)", "tc", (*inside, *queue)),
    )
    for what, program, words in steps:
        try:
            call(program, *words)
        except NetnsError as error:
            return Ability(f"{what}; {_RIGHTS}: {error}", delays=False)
    try:
        socket_in(place.namespace, socket.SOCK_DGRAM).close()
    except NetnsError as error:
        return Ability(f"entering a namespace; {_RIGHTS}: {error}", delays=False)
    try:
        call("tc", *inside, *delay)
    except NetnsError:
        return Ability("", delays=False)
    return Ability("", delays=True)
