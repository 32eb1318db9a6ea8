"""`python -m signal_controller`: see `protocol.process`."""

from protocol.process import run
from signal_controller.role import SignalRole

run("signal", SignalRole.build)
