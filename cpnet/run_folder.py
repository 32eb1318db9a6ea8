"""The folder of a run, which a start that fails or is broken off does not leave behind."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from protocol.errors import ConfigError


@dataclass(frozen=True, slots=True)
class RunFolder:
    """A folder that is to hold a run; `was_there` if it was the user's, and empty."""

    path: Path
    was_there: bool

    @classmethod
    def at(cls, out: Path | None, name: str) -> RunFolder:
        """Looks at the place, `runs/NAME-TIME` if none is named.

        Raises:
            ConfigError: there can be no such folder, or it holds something.
        """
        if out is None:
            stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S-%f")[:-3]
            out = Path("runs") / f"{name}-{stamp}"
        if "," in str(out.absolute()):
            raise ConfigError(f"--out {out}: SUMO takes no path with a comma in it")
        try:
            found = out.exists()
            if found and (not out.is_dir() or any(out.iterdir())):
                raise ConfigError(f"--out {out}: it exists and is not an empty folder")
            return cls(out.absolute(), found)
        except (OSError, ValueError) as error:
            raise ConfigError(f"--out {out}: {error}") from None

    def make(self) -> Path:
        """Makes it, unless it is there; returns its place.

        Raises:
            ConfigError: it cannot be made.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            return self.path.resolve()
        except (OSError, ValueError) as error:
            raise ConfigError(f"--out {self.path}: {error}") from None

    def take_back(self) -> None:
        """Removes what was made, so that the same command can be repeated."""
        if not self.was_there:
            shutil.rmtree(self.path, ignore_errors=True)
            return
        for entry in self.path.iterdir():
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry, ignore_errors=True)
            else:
                entry.unlink(missing_ok=True)


@contextmanager
def written(run_dir: Path) -> Iterator[None]:
    """Guards what writes there.

    Raises:
        ConfigError: the disk is full, or may not be written.
    """
    try:
        yield
    except OSError as error:
        raise ConfigError(f"run folder {run_dir} cannot be written: {error}") from None
