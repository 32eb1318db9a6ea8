"""`cpnet keys`: a test CA, certificates for processes, settings of a Zenoh router."""

from __future__ import annotations

import ipaddress
import json
import os
import re
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from protocol.access import AUTHORITY, Keys, Members, access_control
from protocol.bus import drop_for_observers, settings_of
from protocol.errors import ConfigError
from protocol.instances import ROUTER, WORLD_HOST, role_of
from protocol.topics import ROLES, BusName

HOSTS = (ROUTER, WORLD_HOST)
"""Processes that others connect to. Only their certificates are valid for a bus's host."""

LOOPBACK = ("localhost", "127.0.0.1", "::1")
AUTHORITY_KEY = "ca.key"
AUTHORITY_DAYS = 3650
_LABEL = "[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?"
_HOST = re.compile(rf"{_LABEL}(\.{_LABEL})*")
_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL
BACK = timedelta(hours=1)  # machines' clocks differ


class Authority:
    """A certificate authority (CA); its own key never leaves the folder it was made in."""

    def __init__(self, certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> None:
        self._certificate = certificate
        self._key = key

    @classmethod
    def make(cls, folder: Path, now: datetime) -> Authority:
        """Makes a new authority and writes it into an empty folder.

        Raises:
            ConfigError: the folder holds something, or cannot be written.
        """
        key = ec.generate_private_key(ec.SECP256R1())
        name = _name("cpnet test authority")
        until = now + timedelta(days=AUTHORITY_DAYS)
        usage = x509.KeyUsage(
            digital_signature=False,
            content_commitment=False,
            key_encipherment=False,
            data_encipherment=False,
            key_agreement=False,
            key_cert_sign=True,
            crl_sign=True,
            encipher_only=False,
            decipher_only=False,
        )
        certificate = (
            _builder(name, name, key.public_key(), now - BACK, until)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(usage, critical=True)
            .sign(key, hashes.SHA256())
        )
        _write(folder / AUTHORITY_KEY, _packed(key), secret=True)
        _write(folder / AUTHORITY, certificate.public_bytes(serialization.Encoding.PEM))
        return cls(certificate, key)

    @classmethod
    def read(cls, folder: Path) -> Authority:
        """Reads the authority that was made in this folder.

        Raises:
            ConfigError: its files cannot be read, or its key has been taken away.
        """
        try:
            certificate = x509.load_pem_x509_certificate((folder / AUTHORITY).read_bytes())
            packed = (folder / AUTHORITY_KEY).read_bytes()
            key = serialization.load_pem_private_key(packed, password=None)
        except FileNotFoundError as error:
            raise ConfigError(
                f"{error.filename}: there is no such file; more keys can be made only where the "
                "authority was made"
            ) from None
        except (OSError, ValueError, TypeError) as error:
            raise ConfigError(f"the authority in {folder} cannot be read: {error}") from None
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise ConfigError(f"{folder / AUTHORITY_KEY}: is not a key that `cpnet keys` made")
        if key.public_key() != certificate.public_key():
            raise ConfigError(f"{folder / AUTHORITY_KEY}: is not the key of {folder / AUTHORITY}")
        return cls(certificate, key)

    def issue(
        self, folder: Path, process_id: str, names: Sequence[str], now: datetime, days: int
    ) -> None:
        """Writes certificate and key of a process; `names` are host names and addresses.

        Raises:
            ConfigError: the folder cannot be written, or the authority's own time is over.
        """
        until = min(now + timedelta(days=days), self._certificate.not_valid_after_utc)
        if until <= now:
            raise ConfigError(f"{folder / AUTHORITY}: expired on {until:%Y-%m-%d}; make another")
        key = ec.generate_private_key(ec.SECP256R1())
        usages = [ExtendedKeyUsageOID.CLIENT_AUTH]
        builder = _builder(
            _name(process_id), self._certificate.subject, key.public_key(), now - BACK, until
        ).add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        if process_id in HOSTS:
            usages.append(ExtendedKeyUsageOID.SERVER_AUTH)
            alternatives = x509.SubjectAlternativeName([_alternative(name) for name in names])
            builder = builder.add_extension(alternatives, critical=False)
        builder = builder.add_extension(x509.ExtendedKeyUsage(usages), critical=False)
        certificate = builder.sign(self._key, hashes.SHA256())
        files = Keys.of(folder, process_id)
        _write(files.private_key, _packed(key), secret=True)
        _write(files.certificate, certificate.public_bytes(serialization.Encoding.PEM))


def add_keys(
    folder: Path, ids: Sequence[str], hosts: Sequence[str], days: int, now: datetime | None = None
) -> list[str]:
    """Makes missing certificates, the CA included; returns the ids that are new.

    Raises:
        ConfigError: the folder holds something else, or an older certificate that does not name
            one of the hosts; or a file cannot be read or written.
    """
    now = now or datetime.now(UTC)
    names = list(dict.fromkeys([*LOOPBACK, *hosts]))
    authority = _authority(folder, now)
    missing = [name for name in ids if not Keys.of(folder, name).certificate.exists()]
    for name in ids:
        if name in HOSTS and name not in missing:
            _check_names(Keys.of(folder, name).certificate, hosts)
    for name in missing:
        authority.issue(folder, name, names, now, days)
    return missing


def _authority(folder: Path, now: datetime) -> Authority:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        entries = {entry.name for entry in folder.iterdir()}
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(f"{folder}: must be a folder that can be made ({reason})") from None
    if entries & {AUTHORITY, AUTHORITY_KEY}:
        return Authority.read(folder)
    if entries:
        raise ConfigError(f"{folder}: it holds something, but no authority; give a new folder")
    return Authority.make(folder, now)


def _check_names(path: Path, hosts: Sequence[str]) -> None:
    try:
        certificate = x509.load_pem_x509_certificate(path.read_bytes())
        kind = x509.SubjectAlternativeName
        known = set(certificate.extensions.get_extension_for_class(kind).value)
    except (OSError, ValueError, x509.ExtensionNotFound) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    for host in hosts:
        if _alternative(host) not in known:
            raise ConfigError(
                f"{path}: is there already and does not name {host}; remove it, and it is made "
                "anew for the hosts that you give"
            )


def _alternative(name: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        pass
    if not _HOST.fullmatch(name):
        raise ConfigError(f"--host {name!r}: needs a name such as edge.city.net, or an address")
    return x509.DNSName(name)


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePublicKey,
    since: datetime,
    until: datetime,
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(since)
        .not_valid_after(until)
    )


def _packed(key: ec.EllipticCurvePrivateKey) -> bytes:
    packed: bytes = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    return packed


def _write(path: Path, data: bytes, *, secret: bool = False) -> None:
    try:
        path.unlink(missing_ok=True)  # one without its certificate, perhaps of another mode
        with os.fdopen(os.open(path, _NEW, 0o600 if secret else 0o644), "wb") as file:
            file.write(data)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from None


"""The id of that router's certificate."""

ROUTER_LISTEN = "tls/[::]:7447"
_ROUTER_HEAD = """\
// For zenohd as host of the V2X bus, with the rules of cpnet for the certificates in
// {folder}.
// Paths are those of the machine where `cpnet keys` was run.
"""


def members_in(folder: Path) -> Members:
    """Returns the role of each process that has a certificate in a folder, by its id."""
    names = [path.stem for path in sorted(folder.glob("*.pem")) if path.name != AUTHORITY]
    return Members({name: role for name in names if (role := role_of(name)) in ROLES})


def router_config(folder: Path) -> dict[str, Any]:
    """Returns the router's settings: its address, which may be changed, and the access rules."""
    config: dict[str, Any] = {"mode": "router", "listen": {"endpoints": [ROUTER_LISTEN]}}
    for path, value in settings_of(Keys.of(folder, ROUTER)).items():
        *parents, last = path.split("/")
        inner = config
        for name in parents:
            inner = inner.setdefault(name, {})
        inner[last] = value
    config["qos"] = {"network": drop_for_observers()}
    config["access_control"] = access_control(BusName.V2X, members_in(folder))
    return config


def write_router_config(path: Path, folder: Path) -> None:
    """Writes the file that `zenohd --config` takes.

    Raises:
        ConfigError: it cannot be written.
    """
    folder = folder.resolve()
    text = _ROUTER_HEAD.format(folder=folder) + json.dumps(router_config(folder), indent=2) + "\n"
    try:
        path.write_text(text, "utf-8")
    except (OSError, ValueError) as error:
        raise ConfigError(f"--router-config {path}: {error}") from None
