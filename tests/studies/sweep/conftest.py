"""A small study, and cells that need no world."""

from pathlib import Path

import pytest

from studies.sweep.cells import ResultStore


@pytest.fixture
def store(tmp_path: Path) -> ResultStore:
    return ResultStore.at(tmp_path / "out")
