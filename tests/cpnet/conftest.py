"""Real runs: `cpnet up` as a user starts it."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from filelock import FileLock

from tests.cpnet.commands import Shell


@pytest.fixture
def shell(tmp_path: Path) -> Iterator[Shell]:
    made = Shell(tmp_path)
    yield made
    made.stop_all()


@pytest.fixture(scope="session")
def first_run(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Path:
    """Returns a finished run, which tests only read; all workers share it."""
    base = tmp_path_factory.getbasetemp()
    folder = (base if worker_id == "master" else base.parent) / "first"
    with FileLock(f"{folder}.lock"):
        if not (folder / "done").exists():
            folder.mkdir()
            status, output = Shell(folder).up("--duration", "8", "--out", "first").finish()
            assert status == 0, output
            (folder / "done").touch()
    return folder / "first"
