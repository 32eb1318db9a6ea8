"""Runs the mcap role: `python -m recording.mcap --id mcap …`."""

from protocol.process import run
from recording.mcap.recorder import build

if __name__ == "__main__":
    run("mcap", build)
