"""`python -m sim_host.trial`: simulates a step of the smallest net, tells SUMO's version."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from protocol.errors import ConfigError
from sim_host.sumo import load_libsumo, netconvert

_NODES = '<nodes><node id="a" x="0" y="0"/><node id="b" x="50" y="0"/></nodes>'
_EDGES = '<edges><edge id="ab" from="a" to="b"/></edges>'


def main() -> None:
    """Exits with status 1 and one line if SUMO does not run here."""
    try:
        with tempfile.TemporaryDirectory() as folder:
            sys.stdout.write(f"{simulate_a_step(Path(folder))}\n")
    except ConfigError as error:
        sys.exit(str(error))


def simulate_a_step(folder: Path) -> str:
    """Returns SUMO's name and version.

    Raises:
        ConfigError: a program or library of it is missing or fails.
    """
    nodes, edges, net = (folder / f"{name}.xml" for name in ("nodes", "edges", "net"))
    nodes.write_text(_NODES)
    edges.write_text(_EDGES)
    netconvert(["-n", str(nodes), "-e", str(edges), "-o", str(net)])
    sumo = load_libsumo()
    try:
        quiet = ["--no-step-log", "true", "--xml-validation", "never"]
        sumo.start(["sumo", "--net-file", str(net), *quiet])
        sumo.simulationStep()
        version = str(sumo.getVersion()[1])
        sumo.close()
    except (sumo.TraCIException, sumo.FatalTraCIError) as error:
        raise ConfigError(f"SUMO does not simulate: {error}") from None
    return version


if __name__ == "__main__":
    main()
