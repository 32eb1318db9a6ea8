"""Runs the relay role: `python -m link_relay --id relay-vehicle --uplink listen:tcp/… …`."""

from link_relay.role import RelayRole
from protocol.process import run

if __name__ == "__main__":
    run("link_relay", RelayRole.build)
