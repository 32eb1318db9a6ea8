import json

import pytest

from cpnet.exit_report import describe_status, log_tail, readable_line


@pytest.mark.parametrize("line", ["", "plain", "{", "[1]", "7", '{"level": "INFO"}', "[" * 9999])
def test_a_line_that_is_no_record_stays_as_it_is(line):
    assert readable_line(line) == line


def test_a_record_reads_like_a_line_of_text():
    record = {"time": "2026-01-01T00:00:00+00:00", "process": "edge", "level": "INFO"}
    line = json.dumps(record | {"logger": "edge_server.role", "message": "it is here"})
    assert readable_line(line) == "2026-01-01T00:00:00+00:00 edge INFO edge_server.role: it is here"


@pytest.mark.parametrize(
    ("status", "text"),
    [(3, "ended with status 3"), (-9, "was killed by SIGKILL"), (-35, "was killed by signal 35")],
)
def test_every_end_can_be_told(status, text):
    assert describe_status(status) == text


def test_the_tail_of_a_log_ends_with_the_error(tmp_path):
    trace = "\n".join([*(f"  line {n}" for n in range(40)), "ValueError: no"])
    record = {"process": "edge", "level": "ERROR", "message": "it broke", "exception": trace}
    (tmp_path / "log").write_text(f"{json.dumps(record)}\nand a plain line\n")
    lines = log_tail(tmp_path / "log", 3).splitlines()
    assert lines == ["  line 39", "ValueError: no", "and a plain line"]


def test_who_has_no_log_is_told_of_by_the_fork_server(tmp_path):
    assert log_tail(tmp_path / "router.log").startswith("(no log: ")
    (tmp_path / "fork-server.log").write_text("ModuleNotFoundError: no\n")
    first, last = log_tail(tmp_path / "router.log").splitlines()
    assert str(tmp_path / "fork-server.log") in first
    assert last == "ModuleNotFoundError: no"
