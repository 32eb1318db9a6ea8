"""What a figure of README and docs is: command, what code it measures, minutes, where shown."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from layouts.tables import Table

AGENTS = ("protocol", "sensing", "vehicle_agent", "infra_agent", "sim_host")
PERCEPTION = ("perception", "edge_server")
SYSTEM = (
    *AGENTS,
    *PERCEPTION,
    "signal_controller",
    "link_relay",
    "recording",
    "cpnet/supervisor.py",
)
STUDY = (*SYSTEM, "studies", "learning")
OTHER_COMMANDS = (
    *("studies/bench*.py", "studies/compare*.py", "studies/control*.py"),
    *("studies/run_pool.py", "studies/perceived_study.py"),
    *("studies/comparison.py", "studies/trajectories.py", "studies/trajectory_section.py"),
    *("protocol/observer.py", "recording/mcap/*.py"),
)
"""Of `cpnet bench`, `compare`, `study control`, `report`, `view`, `record`: no figure's but where
it names them, as one must that uses them."""
CONTROL = (
    *("sim_host", "protocol", "signal_controller"),
    *(f"studies/control_{one}.py" for one in ("baselines", "case", "file", "run", "study")),
)


@dataclass(frozen=True, slots=True)
class Part:
    """What a page shows of a figure; without a layout it was written by hand and is only kept."""

    name: str
    page: str
    layout: Callable[[Any], Table | str] | None = None


@dataclass(frozen=True, slots=True)
class Figure:
    """A command that prints JSON on stdout, or writes files: whole pages, pictures.

    The shell runs it in `runs/figures`, `$ROOT` is the repository. Without a command it cannot be
    made again by `scripts/figures`. One `of_rows` tells of what runs gave, and nothing of how fast;
    if `learned`, some of these of the detector `pointpillars`; if not `tracked`, all of these of
    detection alone; if `predictive`, some of these under predictive control. One `of_policies`
    tells of what signal policies gave on SUMO alone.
    """

    name: str
    command: str
    sources: tuple[str, ...]
    minutes: int
    parts: tuple[Part, ...]
    files: tuple[str, ...] = ()
    read: Callable[[str], Any] = field(default=json.loads)
    of_rows: bool = False
    of_policies: bool = False
    learned: bool = False
    tracked: bool = True
    predictive: bool = False

    def digests(self, root: Path) -> dict[str, str]:
        """Returns a hash of each of its files; of pages without the ages put in later."""
        found = {}
        for path in sorted(path for name in self.files for path in root.glob(name)):
            data = path.read_bytes()
            if path.suffix == ".md":
                data = re.sub(rb"\n<!-- figure: .*?<!-- /figure -->\n", b"", data, flags=re.DOTALL)
            found[str(path.relative_to(root))] = hashlib.sha256(data).hexdigest()[:16]
        return found


def rows_of(folder: str) -> str:
    """Returns the command that prints a study's table as JSON."""
    read = f'import json, pyarrow.parquet as p; t = p.read_table("{folder}/results.parquet")'
    return f"python -c '{read}; print(json.dumps(t.to_pylist()))'"


def needs_resco(*nets: str) -> str:
    """Returns a command that fails where RESCO's nets are not there."""
    return (
        f"for net in {' '.join(nets)}; do [ -e resco/$net ] || {{ echo "
        '"runs/figures/resco/$net is missing: a folder of RESCO\'s nets" >&2; exit 1; }; done; '
    )
