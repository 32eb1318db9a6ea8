"""A run as its operators see it: metrics while it goes on, logs for programs, the doctor."""

import json
import os
import signal
import urllib.request
from contextlib import suppress

from prometheus_client.parser import text_string_to_metric_families

from tests.cpnet.commands import Command, Shell, children_of, free_port, free_ports

Samples = dict[tuple[str, ...], float]


def scrape(port: str) -> Samples:
    """Returns all samples by name and values in order of labels, none without an answer."""
    text = ""
    with suppress(OSError):
        page = urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=5)
        with page:
            text = page.read().decode()
    return {
        (sample.name, *dict(sorted(sample.labels.items())).values()): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def scrape_until(command: Command, port: str, *wanted: tuple[str, ...]) -> Samples:
    """Scrapes until these samples are there and not 0."""

    def look() -> Samples | None:
        samples = scrape(port)
        return samples if all(samples.get(key) for key in wanted) else None

    return command.wait_until(look, what=f"no {wanted} was ever exported")


def test_a_run_is_scraped_while_it_goes_on_and_its_logs_are_json(shell: Shell):
    port = free_port()
    options = ("--duration=600", "--out=run", "--metrics", port, "--log=json")
    command = shell.up(*options, "--mode=realtime", "--restart")
    command.read_until("vehicles")
    agents = ("vehicle-0", "vehicle-1", "infra-r0")
    uploads = [("cpnet_uploaded_bytes_total", agent, "r0") for agent in agents]
    spans = [
        ("cpnet_stage_seconds_count", region, stage)
        for region, stages in {
            "": ("sense", "encode", "actuate", "world"),
            "r0": ("decode", "merge", "detect", "decide"),
        }.items()
        for stage in stages
    ]
    named = (("edge-r0", "edge"), ("sim", "sim"), ("record", "record"), ("signal-r0", "signal"))
    roles = [("cpnet_process_up", *one) for one in named]
    counted = ("cpnet_frames_total",)
    sent = ("cpnet_sent_bytes_total", "infra-r0")
    latency = ("cpnet_end_to_end_seconds",)
    samples = scrape_until(command, port, counted, sent, latency, *uploads, *spans, *roles)
    assert samples[("cpnet_vehicles",)] > samples[("cpnet_cavs",)] > 0
    assert samples[latency] < 10
    assert all(samples[role] == 1 for role in roles)
    later = command.wait_until(
        lambda: (
            (now := scrape(port))[("cpnet_frames_total",)] > samples[("cpnet_frames_total",)]
            and now
        )
    )
    assert all(later[key] >= n for key, n in samples.items() if key[0].endswith("_total"))
    assert later[("cpnet_process_restarts_total", "vehicle-0")] == 0
    os.kill(children_of(shell.folder / "run")["vehicle-0"], signal.SIGKILL)
    restarted = scrape_until(command, port, ("cpnet_process_restarts_total", "vehicle-0"))
    uploaded = ("cpnet_uploaded_bytes_total", "vehicle-0", "r0")
    command.wait_until(lambda: scrape(port)[uploaded] > restarted[uploaded])
    os.kill(children_of(shell.folder / "run")["sim"], signal.SIGKILL)
    status, output = command.finish()
    assert status == 1
    assert "sim was killed by SIGKILL" in output
    assert '"level"' not in output
    assert "sim INFO sim_host" in output
    lines = [
        json.loads(line)
        for log in (shell.folder / "run" / "logs").iterdir()
        for line in log.read_text().splitlines()
    ]
    assert {"sim"} <= {line["process"] for line in lines}
    assert all(line.keys() >= {"time", "level", "logger", "message"} for line in lines)


def test_a_machine_of_some_roles_exports_the_run_and_the_doctor_sees_the_other(shell: Shell):
    port, metrics = free_ports(), free_port()
    place = f"127.0.0.1:{port}"
    roles = "--only=router,sim,record,edge,signal"
    without_end = ("--mode=realtime", "--duration=600")
    here = shell.up(*without_end, "--out=here", roles, f"--listen={place}")
    there = shell.start(
        "up", "--only=vehicle,infra", f"--connect={place}", "--out=there", f"--metrics={metrics}"
    )
    there.read_until("vehicles")
    samples = scrape_until(there, metrics, ("cpnet_frame",), ("cpnet_frames_total",))
    assert samples[("cpnet_process_up", "edge-r0", "edge")] == 1
    assert samples[("cpnet_process_up", "vehicle-0", "vehicle")] == 1
    _, output = shell.run("doctor", "--json", "--connect", place)
    found = {finding["check"]: finding for finding in json.loads(output)["findings"]}
    for bus in ("v2x", "world"):
        assert found[f"{bus}_reached"]["ok"]
        names = found[f"{bus}_processes"]["measured"]["processes"]
        assert {"edge-r0", "router", "sim", "vehicle-0", "infra-r0"} <= set(names)
    assert found["world_clock"]["measured"]["error_ms"] == 0
    assert found["world_version"]["ok"]
    assert found["world_version"]["measured"]["scenario"] == "t_junction"
    for command in (there, here):
        command.process.send_signal(signal.SIGTERM)
        command.finish()
