"""The built-in junction, made once per test process."""

from pathlib import Path

import numpy as np
import pytest

from protocol.messages import Setup
from sim_host.setup import build_setup


class FlatGround:
    """A ground without relief."""

    def body_poses(
        self,
        x: np.ndarray,
        y: np.ndarray,
        yaw: np.ndarray,
        level_m: np.ndarray,
    ) -> np.ndarray:
        zero = np.zeros_like(x)
        return np.stack([x, y, zero, zero, zero, yaw], axis=1)


@pytest.fixture(scope="session")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("run")


@pytest.fixture(scope="session")
def setup(run_dir: Path) -> Setup:
    return build_setup({"traffic": {"cav_rate": 0.3, "cv_rate": 0.3}}, run_dir)


@pytest.fixture(scope="session")
def flat() -> FlatGround:
    return FlatGround()
