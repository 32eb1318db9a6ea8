"""The viewer process of `cpnet up --view`: it starts and ends with the run."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from enum import Enum
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console

from cpnet.exit_report import describe_status, log_tail
from cpnet.shadowing import same_path
from protocol.errors import ConfigError
from protocol.extras import to_install

_GRACE_S = 8.0


class Viewing(Enum):
    """Output of the viewer process."""

    NATIVE = "native"
    WEB = "web"


def check_viewing(how: Viewing | None) -> None:
    """Raises ConfigError if the viewer is wanted and its extra is missing."""
    if how is not None and find_spec("rerun") is None:
        raise ConfigError(f"--view needs rerun (extra `view`): {to_install('view')}")


@contextmanager
def viewed(run_dir: Path, how: Viewing | None, console: Console) -> Iterator[None]:
    """Context manager: shows the run; the viewer's output is printed."""
    if how is None:
        yield
        return
    command = [sys.executable, "-m", "cpnet", "view", str(run_dir)]
    command += ["--web"] if how is Viewing.WEB else []
    path = run_dir / "logs" / "view.log"
    pipe, environment = subprocess.PIPE, os.environ | same_path()
    with (
        path.open("ab") as log,
        subprocess.Popen(command, stdout=pipe, stderr=log, text=True, env=environment) as viewer,
    ):
        telling = threading.Thread(target=_tell, args=(viewer, path, console), daemon=True)
        telling.start()
        try:
            yield
        finally:
            viewer.terminate()
            try:
                viewer.wait(_GRACE_S)
            except subprocess.TimeoutExpired:
                viewer.kill()
            telling.join(_GRACE_S)


def _tell(viewer: subprocess.Popen[str], log: Path, console: Console) -> None:
    for line in viewer.stdout or ():
        console.print(line.rstrip(), highlight=False, markup=False, soft_wrap=True)
    if viewer.wait() > 0:  # it failed, not by a signal
        how = describe_status(viewer.returncode)
        said = f"the viewer {how}; the run goes on without it:\n{log_tail(log)}"
        console.print(said, highlight=False, markup=False, soft_wrap=True)
