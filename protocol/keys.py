"""Where a process finds its certificate, for buses over TLS."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

AUTHORITY = "ca.pem"
"""The certificate by which every process knows the others."""


@dataclass(frozen=True, slots=True)
class Keys:
    """A process's certificate and private key, and the authority that all certificates are from.

    The common name of a certificate is the process's id.
    """

    authority: Path
    certificate: Path
    private_key: Path

    @classmethod
    def of(cls, folder: Path, process_id: str) -> Keys:
        """Returns what `cpnet keys` calls the files of this process."""
        key = folder / f"{process_id}.key"
        return cls(folder / AUTHORITY, folder / f"{process_id}.pem", key)

    def settings(self) -> dict[str, object]:
        """Returns Zenoh's settings of links over TLS: both sides show a certificate."""
        return {
            "root_ca_certificate": str(self.authority),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "listen_certificate": str(self.certificate),
            "listen_private_key": str(self.private_key),
            "connect_certificate": str(self.certificate),
            "connect_private_key": str(self.private_key),
        }
