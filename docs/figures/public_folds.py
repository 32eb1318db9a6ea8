"""Prints what PointPillars finds in public scans whose halves it was trained on in turn.

`public_folds.py OUSTER_SDK WEIGHTS FOLDER`: from WEIGHTS, which saw no real scan, it goes on by
the recipe of the shipped ones with one half of the scans of `public_scans`, and is tried on the
other half. Both scans of a place are in one half. FOLDER gets datasets, weights and clouds.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from public_scans import RECORDINGS, rows_of, write_frames

from edge_server.config import EdgeConfig

HALVES = (
    ("street-1", "street-3", "street-4", "street-5"),
    ("street-2", "street-6", "car-park-1", "car-park-2"),
)
DATASET = "--networks 200 --samples 5 --seed 10 --realism hard --furniture 24 --split train"
RECIPE = "--steps 2000 --rate 1.5e-3 --real-share 0.3 --mean"


def main() -> None:
    """Prints JSON: a row for each scene and score."""
    start, folder = Path(sys.argv[2]).resolve(), Path(sys.argv[3]).resolve()
    write_frames(Path(sys.argv[1]) / RECORDINGS, folder / "all")
    _run("dataset", folder / "generated", DATASET)
    rows = []
    for number, (trained, tried) in enumerate((HALVES, HALVES[::-1])):
        seen, out = _half(folder, trained), folder / f"weights-{number}"
        _run("train", folder / "generated", f"--out {out} --start {start} --real {seen} {RECIPE}")
        config = EdgeConfig()
        weights = str(out / "pointpillars.safetensors")
        pillars = config.pillars.model_copy(update={"weights": weights})
        config = config.model_copy(update={"pillars": pillars})
        rows += rows_of(_half(folder, tried), ["pointpillars"], config)
    json.dump(rows, sys.stdout)


def _run(command: str, folder: Path, options: str) -> None:
    cpnet = Path(sys.executable).with_name("cpnet")
    subprocess.run([cpnet, command, folder, *options.split()], check=True, stdout=sys.stderr)


def _half(folder: Path, names: tuple[str, ...]) -> Path:
    """Returns a folder with links to these frames."""
    half = folder / "-".join(names)
    for part, suffix in (("velodyne", "npy"), ("label_2", "txt")):
        (half / part).mkdir(parents=True, exist_ok=True)
        for name in names:
            link = half / part / f"{name}.{suffix}"
            link.unlink(missing_ok=True)
            link.symlink_to(folder / "all" / part / f"{name}.{suffix}")
    return half


if __name__ == "__main__":
    main()
