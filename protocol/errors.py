"""The one exception tree of cpnet.

CpnetError
├── ConfigError         the user asked for something impossible; names what is allowed
├── ProtocolError       bytes received from a bus are not a valid message
│   ├── VersionError    another protocol version; names both
│   ├── MessageError    malformed, truncated, oversized or non-finite
│   └── CodecError      a scan payload that does not decode
└── BusError            the transport cannot be opened or was lost
"""

import difflib
from collections.abc import Collection


class CpnetError(Exception):
    """Root of every error that cpnet raises on purpose."""


class ConfigError(CpnetError):
    """A user's mistake: the text names the file or key, the value and what is allowed."""


class ProtocolError(CpnetError):
    """Bad bytes from a bus: counted and dropped by the receiver, never fatal."""


class VersionError(ProtocolError):
    """The sender speaks another protocol version."""


class MessageError(ProtocolError):
    """A message that is truncated, oversized, of the wrong kind or invalid."""


class CodecError(ProtocolError):
    """A scan that cannot be encoded within its bound or a payload that does not decode."""


class BusError(CpnetError):
    """A bus that cannot be opened or that lost its router."""


_NEAR, _MAX_NEAR = 0.4, 3


def did_you_mean(name: str, known: Collection[str]) -> str:
    """Returns "; did you mean A or B?" with the known names that are like this one, else ""."""
    near = difflib.get_close_matches(name, known, n=_MAX_NEAR, cutoff=_NEAR)
    return f"; did you mean {' or '.join(near)}?" if near else ""
