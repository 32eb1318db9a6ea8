"""Runs the router role: `python -m v2x_router --id router --v2x listen:tcp/… …`."""

from protocol.process import run
from v2x_router.role import RouterRole

if __name__ == "__main__":
    run("v2x_router", RouterRole.build)
