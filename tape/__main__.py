"""Runs the tape role: `python -m tape --id tape …`."""

from protocol.process import run
from tape.role import build

if __name__ == "__main__":
    run("tape", build)
