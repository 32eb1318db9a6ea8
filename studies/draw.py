"""A picture of a recorded frame."""

from __future__ import annotations

from pathlib import Path

from protocol.errors import ConfigError
from recorder.run import Run
from studies.snapshot import load_snapshot


def draw_frame(run_dir: Path, frame: int | None, png_path: Path) -> None:
    """Draws the merged cloud of a frame by agent, with boxes, truth, lanes and counts.

    Args:
        run_dir: the run's folder.
        frame: a frame whose uploads were kept; None for the last of them.
        png_path: the picture to write.

    Raises:
        ConfigError: no such run or frame, matplotlib is missing, or the file cannot be written.
    """
    try:
        from studies.figure import save_picture
    except ModuleNotFoundError as error:
        raise ConfigError(f"drawing needs {error.name}: pip install 'cpnet-edge[plot]'") from None
    with Run(run_dir) as run:
        snapshot = load_snapshot(run, frame)
    try:
        save_picture(snapshot, png_path)
    except OSError as error:
        raise ConfigError(f"{png_path} cannot be written: {error}") from None
