"""Runs the record role: `python -m recording --id record …`."""

from protocol.process import run
from recording.role import RecordRole

if __name__ == "__main__":
    run("record", RecordRole.build)
