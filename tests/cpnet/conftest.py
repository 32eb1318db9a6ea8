"""Real runs: `cpnet up` as a user starts it."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from filelock import FileLock

from tests.cpnet.commands import Shell

STARTING = {"shell", "first_run"}
"""Fixtures that start processes: tests here that use one are marked so."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    here = Path(__file__).parent
    for item in items:
        if here in item.path.parents and STARTING & {*getattr(item, "fixturenames", ())}:
            item.add_marker(pytest.mark.process)


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
