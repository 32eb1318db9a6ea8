"""What a process's log holds, in a process of its own: logging is one for all of a process."""

import json
import subprocess
import sys
from datetime import datetime, timedelta

import pytest

CODE = """
import logging, threading, warnings
from protocol.logs import LogStyle, configure
configure("edge-%d", LogStyle("{style}"))
log = logging.getLogger("some.role")
log.info("two\\nlines of %s", "ü")
try:
    1 / 0
except ZeroDivisionError:
    log.exception("divided")
warnings.warn("beware")
thread = threading.Thread(target=lambda: [][1], name="worker")
thread.start()
thread.join()
raise SystemError("the end")
"""


def log_of(style: str) -> str:
    code = CODE.format(style=style)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    return done.stderr


def test_as_json_every_line_is_a_record_whatever_happens():
    records = [json.loads(line) for line in log_of("json").splitlines()]
    levels = [record["level"] for record in records]
    assert levels == ["INFO", "ERROR", "WARNING", "CRITICAL", "CRITICAL"]
    assert {record["process"] for record in records} == {"edge-%d"}
    assert records[0]["message"] == "two\nlines of ü"
    assert records[0]["logger"] == "some.role"
    assert "exception" not in records[0]
    assert records[1]["exception"].endswith("ZeroDivisionError: division by zero")
    assert "beware" in records[2]["message"]
    assert records[3]["message"] == "the thread worker ended by an error"
    assert records[3]["exception"].endswith("IndexError: list index out of range")
    assert records[4]["exception"].endswith("SystemError: the end")
    for record in records:
        assert datetime.fromisoformat(record["time"]).utcoffset() == timedelta(0)


@pytest.mark.parametrize("text", ["edge-%d INFO some.role: two\n", "SystemError: the end\n"])
def test_as_text_a_log_is_what_people_read(text):
    assert text in log_of("text")
