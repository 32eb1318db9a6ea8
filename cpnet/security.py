"""Security of a run's buses: TLS with `--keys`, or loopback only."""

from __future__ import annotations

import ipaddress
import ssl
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from cpnet.endpoints import Endpoints, address_of, resolve
from cpnet.processes import AGENTS, ProcessEntry, RoleSelection
from protocol.access import Keys
from protocol.bus import Endpoint
from protocol.config import is_file, is_folder
from protocol.errors import ConfigError
from protocol.instances import REGION_ROLES
from protocol.topics import BusName


def check_key(folder: Path, process_id: str, *, hosts: bool = False) -> datetime:
    """Checks a process's certificate and key; returns its expiry.

    A bus's host needs a certificate for servers.

    Raises:
        ConfigError: a file is missing or is not what its name says, or the certificate has
            expired, is another's or another authority's.
    """
    if not is_folder(folder):
        raise ConfigError(f"--keys {folder}: there is no such folder; `cpnet keys` makes one")
    keys = Keys.of(folder, process_id)
    for path in (keys.authority, keys.certificate, keys.private_key):
        _check_readable(path, process_id)
    client, server = (
        _context(keys, ssl.PROTOCOL_TLS_CLIENT),
        _context(keys, ssl.PROTOCOL_TLS_SERVER),
    )
    server.verify_mode = ssl.CERT_REQUIRED
    client.check_hostname = False
    client.verify_mode = ssl.CERT_REQUIRED if hosts else ssl.CERT_NONE
    try:
        certificate = _shake_hands(client, server).getpeercert() or {}
    except ssl.SSLCertVerificationError as error:
        raise ConfigError(f"{keys.certificate}: {_why(error, keys)}") from None
    except ssl.SSLError as error:
        raise ConfigError(f"{keys.certificate}: cannot be used: {error.reason}") from None
    if (name := _common_name(certificate)) != process_id:
        raise ConfigError(f"{keys.certificate}: is the certificate of {name!r}, not {process_id!r}")
    return datetime.fromtimestamp(ssl.cert_time_to_seconds(str(certificate["notAfter"])), UTC)


def _check_readable(path: Path, process_id: str) -> None:
    if not is_file(path):
        raise ConfigError(
            f"{path}: there is no such file, and {process_id} runs here; copy it from where "
            "`cpnet keys` was run"
        )
    try:
        path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None


def _context(keys: Keys, protocol: int) -> ssl.SSLContext:
    context = ssl.SSLContext(protocol)
    try:
        context.load_verify_locations(keys.authority)
    except ssl.SSLError:
        raise ConfigError(f"{keys.authority}: holds no certificate") from None
    try:
        # Without the answer to a password, the terminal would be asked for one.
        context.load_cert_chain(keys.certificate, keys.private_key, password="")
    except ssl.SSLError as error:
        if error.reason == "KEY_VALUES_MISMATCH":
            reason = f"its key is not {keys.private_key}"
        else:
            reason = f"it or {keys.private_key} is no PEM file of a certificate and its plain key"
        raise ConfigError(f"{keys.certificate}: {reason}") from None
    return context


def _shake_hands(client: ssl.SSLContext, server: ssl.SSLContext) -> ssl.SSLObject:
    """Returns the server's side of a handshake in memory."""
    there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
    asking = client.wrap_bio(back, there)
    answering = server.wrap_bio(there, back, server_side=True)
    while True:
        pending = [_step(side) for side in (asking, answering)]
        if not any(pending):
            return answering


def _step(side: ssl.SSLObject) -> bool:
    """Continues a handshake; returns whether it waits for the other side."""
    try:
        side.do_handshake()
    except ssl.SSLWantReadError:
        return True
    return False


def _common_name(certificate: Mapping[str, Any]) -> str:
    # One pair, or several, in each part of the name; types say less than that.
    subject = certificate.get("subject", ())
    return str(dict(pair for part in subject for pair in part).get("commonName", ""))


def _why(error: ssl.SSLCertVerificationError, keys: Keys) -> str:
    text = error.verify_message
    if "issuer" in text or "signature" in text or "self-signed" in text:
        return f"is not by the authority of {keys.authority}"
    return f"{text}; `cpnet keys` makes another"


WATCH = "watch"
"""The id of the supervisor of each machine."""
VIEW = "view"
"""The id of observers, which may subscribe to everything."""


def secured_endpoints(
    listen: list[str], connect: list[str], hosted: set[BusName], keys: Path | None, insecure: bool
) -> Endpoints:
    """Returns how this machine reaches each bus, with the supervisor's own keys if there are any.

    Raises:
        ConfigError: as `resolve`; the keys cannot be used; or without keys, a bus would leave this
            machine.
    """
    if keys is None:
        places = resolve(listen, connect, hosted)
        for endpoint in places.values():
            if not (insecure or _is_on_loopback(endpoint)):
                raise ConfigError(_refusal(endpoint))
        return places
    if insecure:
        raise ConfigError("--insecure: has no meaning with --keys; give one of them")
    check_key(keys, WATCH)
    own = Keys.of(keys, WATCH)
    places = resolve(listen, connect, hosted, "tls")
    return {bus: replace(endpoint, keys=own) for bus, endpoint in places.items()}


def check_keys(keys: Path | None, entries: list[ProcessEntry]) -> None:
    """Checks the certificates of the processes that are to start here.

    Raises:
        ConfigError: one is missing or cannot be used.
    """
    if keys is None:
        return
    for entry in entries:
        check_key(keys, entry.id, hosts=entry.role.hosts is not None)


def check_keys_of_roles(keys: Path | None, choice: RoleSelection) -> None:
    """Checks all certificates of a folder for roles whose processes the scenario decides.

    So invalid keys are reported before the command waits for the scenario's machine.

    Raises:
        ConfigError: a role has none, or a certificate or its key cannot be used.
    """
    if keys is None:
        return
    for row in choice.roles:
        if row.role not in {*REGION_ROLES, *AGENTS} or choice.chosen(row, []):
            continue
        found = {path.stem for end in ("pem", "key") for path in keys.glob(f"{row.role}-*.{end}")}
        if not found:
            raise ConfigError(
                f"{keys}: has no certificate of the role {row.role}, which runs here; copy its "
                "files from where `cpnet keys` was run"
            )
        for name in sorted(found):
            check_key(keys, name)


def _is_on_loopback(endpoint: Endpoint) -> bool:
    host, _ = address_of(endpoint.locator)
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _refusal(endpoint: Endpoint) -> str:
    option = "--listen" if endpoint.listen else "--connect"
    return (
        f"{option} {endpoint.locator}: without keys anybody on that network could read and forge "
        "all messages; give --keys DIR (`cpnet keys DIR` makes them), or --insecure to do without"
    )
