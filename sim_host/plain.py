"""SUMO's plain XML, from which netconvert makes nets."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

from sim_host.sumo import netconvert

Row = dict[str, str | int | float]

_SUFFIXES = {"node": "nod", "edge": "edg", "connection": "con"}
_HEADER = re.compile(r"<!-- generated on .*?-->\s*", re.DOTALL)


def write_plain_net(
    folder: Path, name: str, parts: Mapping[str, Sequence[Row]], signal: str | None = None
) -> Path:
    """Writes `NAME.net.xml` into the folder, by way of netconvert.

    The same parts give the same bytes: netconvert's header, which tells the hour, is cut off.

    Args:
        folder: holds the plain files as well.
        name: of the net.
        parts: rows by their tag: node, edge, connection. Without connections netconvert guesses.
        signal: the text of a file of signal plans; without one, netconvert makes a plan.

    Raises:
        ConfigError: netconvert is missing or fails.
    """
    arguments = []
    for tag, rows in parts.items():
        path = folder / f"{name}.{_SUFFIXES[tag]}.xml"
        path.write_text(xml(f"{tag}s", [(tag, row) for row in rows]), encoding="utf-8")
        arguments += [f"--{tag}-files", str(path)]
    if signal is not None:
        path = folder / f"{name}.tll.xml"
        path.write_text(signal, encoding="utf-8")
        arguments += ["--tllogic-files", str(path)]
    net = folder / f"{name}.net.xml"
    netconvert([*arguments, "--output-file", str(net)])
    net.write_text(_HEADER.sub("", net.read_text("utf-8"), count=1), encoding="utf-8")
    return net


def xml(root: str, rows: Sequence[tuple[str, Row]], before: str = "") -> str:
    """Returns rows of (tag, attributes) under a root; `before` stands first."""
    lines = [
        f"  <{tag} " + " ".join(f"{k}={quoteattr(str(v))}" for k, v in row.items()) + "/>"
        for tag, row in rows
    ]
    return "\n".join([f"<{root}>", before, *lines, f"</{root}>", ""])
