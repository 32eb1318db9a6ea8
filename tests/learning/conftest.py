"""A small dataset, made once per test process."""

from pathlib import Path

import pytest

from learning.dataset import Dataset
from learning.generate import generate
from tests.learning.small_dataset import SPEC


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("dataset") / "small"
    generate(path, SPEC, jobs=2)
    return path


@pytest.fixture
def dataset(folder: Path) -> Dataset:
    return Dataset(folder)
