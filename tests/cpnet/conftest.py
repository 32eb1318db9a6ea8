"""Real runs: `cpnet up` as a user starts it."""

from collections.abc import Callable, Iterator
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


Make = Callable[[Path], None]
Shared = Callable[[str, Make], Path]


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Shared:
    """Returns a folder by name, which its first user fills for the tests of all workers."""
    base = tmp_path_factory.getbasetemp()
    place = base if worker_id == "master" else base.parent

    def folder(name: str, make: Make) -> Path:
        made = place / name
        with FileLock(f"{made}.lock"):
            if not (place / f"{name}.done").exists():
                made.mkdir()
                make(made)
                (place / f"{name}.done").touch()
        return made

    return folder


@pytest.fixture(scope="session")
def first_run(shared: Shared) -> Path:
    """Returns a finished run, which tests only read."""

    def make(folder: Path) -> None:
        status, output = Shell(folder).up("--duration", "8", "--out", "first").finish()
        assert status == 0, output

    return shared("first", make) / "first"
