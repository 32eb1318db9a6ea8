"""Deployment files in deploy/ are valid: Dockerfile, compose file, systemd unit."""

from __future__ import annotations

import configparser
import re
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from cpnet.cli import command
from cpnet.doctor import SUMO_LIBRARIES
from cpnet.keys import add_keys
from cpnet.processes import ROLES, parse_only
from protocol.access import roles_of

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"
UNIT = DEPLOY / "systemd" / "cpnet@.service"
COMPOSE: dict[str, Any] = yaml.safe_load((DEPLOY / "compose.yaml").read_text("utf-8"))
SERVICES: dict[str, Any] = COMPOSE["services"]
METRICS_PORT = "9464"


def parsed(words: list[str]) -> dict[str, Any]:
    """Parses options of `cpnet up`; unknown ones are refused."""
    up = command().commands["up"]  # type: ignore[attr-defined]
    return up.make_context("up", list(words)).params


def test_the_compose_file_follows_the_specification() -> None:
    compose_spec = pytest.importorskip("compose_spec")
    plain = yaml.safe_dump(COMPOSE)  # merge keys are taken in: the checker knows none
    assert sorted(compose_spec.PyCompose.from_yaml(plain).service_names()) == sorted(SERVICES)


@pytest.mark.parametrize("name", SERVICES)
def test_a_service_has_the_keys_of_its_own_processes_alone(name, tmp_path) -> None:
    options = parsed(shlex.split(SERVICES[name]["command"])[1:])
    roles = {row.role for row in parse_only(options["only"]).roles}
    ids = list(roles_of(2, ["r0"]))
    own = [one for one in ids if one.partition("-")[0] in roles | {"watch"}]
    wanted = {"ca.pem", *(f"{one}.{end}" for one in own for end in ("pem", "key"))}
    wanted -= {name for name in wanted if name.startswith("mcap")}
    sources = [volume.split(":") for volume in SERVICES[name]["volumes"]]
    mounted = {Path(source).name: mode for source, target, *mode in sources if "/keys/" in target}
    assert set(mounted) == wanted
    assert all(mode == ["ro"] for mode in mounted.values())
    add_keys(tmp_path / "keys", ids, ["world", "edge"], 1)
    assert all((tmp_path / "keys" / file).is_file() for file in wanted)  # so they are called


def test_together_the_services_are_a_run_and_each_serves_metrics() -> None:
    roles: list[str] = []
    for service in SERVICES.values():
        options = parsed(shlex.split(service["command"])[1:])
        roles += [row.role for row in parse_only(options["only"]).roles]
        assert options["metrics"].endswith(f":{METRICS_PORT}")
        assert str(options["keys"]) == "/keys"
        assert service["stop_signal"] == "SIGINT"
        assert service["read_only"]
    assert sorted(roles) == sorted({row.role for row in ROLES} - {"mcap"})


def test_the_image_is_built_in_stages_and_runs_as_a_user() -> None:
    parse = pytest.importorskip("dockerfile_parse")
    made = parse.DockerfileParser(path=str(DEPLOY / "Dockerfile"), cache_content=True)
    steps = [(step["instruction"], step["value"]) for step in made.structure]
    names = [name for name, _ in steps]
    assert made.is_multistage
    last = steps[max(index for index, name in enumerate(names) if name == "FROM") :]
    of_last = dict(last)
    assert of_last["USER"] == "cpnet"
    assert METRICS_PORT in of_last["HEALTHCHECK"]
    assert METRICS_PORT in of_last["EXPOSE"].split()
    assert of_last["ENTRYPOINT"] == '["cpnet"]'
    users = [index for index, (name, _) in enumerate(last) if name == "USER"]
    assert all(name != "RUN" or "cpnet compile" in value for name, value in last[users[0] :])
    assert all(":" in value and "latest" not in value for name, value in steps if name == "FROM")
    assert not {"ADD", "MAINTAINER"} & set(names)


def test_the_image_has_the_libraries_that_sumo_needs() -> None:
    text = (DEPLOY / "Dockerfile").read_text("utf-8")
    assert [package for package in set(SUMO_LIBRARIES.values()) if f" {package} " not in text] == []
    assert "--no-install-recommends" in text
    assert "rm -rf /var/lib/apt/lists" in text


def unit() -> configparser.ConfigParser:
    found = configparser.ConfigParser(strict=False, interpolation=None)
    found.optionxform = str  # type: ignore[assignment, method-assign]
    found.read(UNIT)
    return found


@pytest.mark.parametrize("role", [row.role for row in ROLES if row.role != "mcap"])
def test_there_are_options_of_each_role_that_its_unit_can_be_started_with(role) -> None:
    line = unit()["Service"]["ExecStart"].replace("%i", role)
    text = (DEPLOY / "systemd" / f"{role}.env").read_text("utf-8")
    (options,) = re.findall(r'^CPNET_OPTIONS="(.*)"$', text, re.MULTILINE)
    words = shlex.split(line.replace("$CPNET_OPTIONS", options))
    assert words[1] == "up"
    found = parsed(words[2:])
    assert found["only"] == role
    assert found["restart"]
    assert found["metrics"] in (None, METRICS_PORT)


def test_the_unit_counts_an_end_by_a_signal_as_success() -> None:
    service = unit()["Service"]
    assert service["SuccessExitStatus"] == "130"
    assert service["KillSignal"] == "SIGINT"
    assert service["User"] != "root"
    assert service["ExecStartPre"].startswith("-/opt/cpnet/bin/cpnet prune runs ")
    assert "cpnet/%i/runs" in service["StateDirectory"].split()  # there at the first start too


def test_the_unit_takes_from_a_role_what_it_does_not_need() -> None:
    service = unit()["Service"]
    assert service["CapabilityBoundingSet"] == ""
    families = service["RestrictAddressFamilies"].split()
    assert families == ["AF_INET", "AF_INET6", "AF_UNIX", "AF_NETLINK"]  # Zenoh lists interfaces
    assert service["UMask"] == "0077"
    assert "MemoryDenyWriteExecute" not in service  # numba compiles
    protected = ("KernelTunables", "KernelModules", "KernelLogs", "ControlGroups", "Home")
    for name in ("PrivateDevices", "NoNewPrivileges", *(f"Protect{what}" for what in protected)):
        assert service.getboolean(name), name


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd")
def test_systemd_finds_no_fault_in_the_unit(tmp_path) -> None:
    text = UNIT.read_text("utf-8").replace("/opt/cpnet/bin/cpnet", "/bin/true")
    (tmp_path / UNIT.name).write_text(text)
    done = subprocess.run(
        ["systemd-analyze", "verify", str(tmp_path / "cpnet@edge.service")],
        capture_output=True,
        text=True,
        check=False,
    )
    own = [line for line in done.stderr.splitlines() if "cpnet" in line]
    assert own == []


def test_no_other_port_is_named_for_metrics() -> None:
    docs = DEPLOY.parent / "docs"
    files = [*docs.glob("*.md"), *DEPLOY.rglob("*.env"), DEPLOY / "compose.yaml"]
    ports = re.compile(r"--metrics[ =](?:[\d.]+:)?(\d{4,})")
    found = {port for file in files for port in ports.findall(file.read_text("utf-8"))}
    assert found <= {METRICS_PORT}


SECRET = ["keys/ca.key", "deploy/keys/ca.key", "deploy/keys-b/sim.key", "deploy/other/ca.key"]
RUNS = ["runs/a/run.sqlite", "deploy/runs/world/runs/a/run.sqlite"]


def is_sent_to_docker(path: str) -> bool:
    """Whether a file of the build context is sent, by the rules of .dockerignore."""
    text = (ROOT / ".dockerignore").read_text("utf-8")
    is_sent = True
    for line in text.splitlines():
        pattern = line.strip().removeprefix("!")
        if pattern and not pattern.startswith("#"):
            inner = re.escape(pattern).replace(r"\*\*/", "(.*/)?").replace(r"\*", "[^/]*")
            if re.fullmatch(rf"{inner}(/.*)?", path):
                is_sent = line.startswith("!")
    return is_sent


def git(*arguments: str) -> list[str]:
    done = subprocess.run(
        ["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=False
    )
    if done.returncode not in (0, 1):
        pytest.skip("no checkout")
    return done.stdout.splitlines()


@pytest.mark.parametrize("path", SECRET + RUNS)
def test_keys_and_runs_get_neither_into_an_image_nor_into_the_repository(path) -> None:
    assert not is_sent_to_docker(path)
    assert git("check-ignore", "--no-index", path) == [path]


def test_no_source_file_is_kept_from_an_image_or_from_the_repository() -> None:
    packages = [path.parent.name for path in ROOT.glob("*/__init__.py")]
    assert "cpnet" in packages
    tracked = git("ls-files", *packages, "requirements", "pyproject.toml")
    assert [path for path in tracked if not is_sent_to_docker(path)] == []
    assert git("ls-files", "--cached", "--ignored", "--exclude-standard") == []
