"""Runs the record role: `python -m recording --id record …`."""

from protocol.process import run
from recording.role import RecordRole, collect_seldom

if __name__ == "__main__":
    collect_seldom()
    run("record", RecordRole.build)
