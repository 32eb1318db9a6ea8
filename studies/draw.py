"""A picture of a recorded frame."""

from __future__ import annotations

import sys
from pathlib import Path

from protocol.errors import ConfigError
from recorder.run import Run
from studies.snapshot import load_snapshot


def draw_frame(run_dir: Path, frame: int | None, png_path: Path | None) -> Path:
    """Draws the merged cloud of a frame by agent, with boxes, truth, lanes and counts.

    Returns the path of the picture.

    Args:
        run_dir: the run's folder.
        frame: a frame whose uploads were kept; None for the last of them.
        png_path: the picture to write; None for `frame-N.png` in the run's folder.

    Raises:
        ConfigError: no such run or frame, matplotlib is missing, or the file cannot be written.
    """
    if png_path is not None and png_path.suffix.lower() != ".png":
        raise ConfigError(f"--png {png_path}: needs a name that ends in .png")
    try:
        from studies.figure import save_picture
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"drawing needs {error.name} (extra `plot`): {sys.executable} -m pip install matplotlib"
        ) from None
    with Run(run_dir) as run:
        snapshot = load_snapshot(run, frame)
    path = png_path or run_dir / f"frame-{snapshot.row.frame}.png"
    try:
        save_picture(snapshot, path)
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error}") from None
    return path
