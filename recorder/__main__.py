"""Runs the record role: `python -m recorder --id record …`."""

from protocol.process import run
from recorder.role import RecordRole

if __name__ == "__main__":
    run("record", RecordRole.build)
