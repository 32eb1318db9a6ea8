"""`cpnet dataset` and `cpnet train`, as they are typed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `learn`")

from perception.pillars.weights import load
from tests.cpnet.commands import Shell


def test_a_data_set_that_keeps_nothing_for_validation_is_trained_on(shell: Shell) -> None:
    status, output = shell.run("dataset", "data", "--networks=1", "--samples=1", "--furniture=10")
    assert status == 0, output
    one_step = ["--steps=1", "--windows=1", "--cells=64"]
    status, output = shell.run("train", "data", "--out=out", *one_step)
    assert (status, "keeps no networks for validation" in output) == (0, True), output
    about = load(shell.folder / "out" / "pointpillars.safetensors")[1]
    assert about["dataset"]["furniture_per_100m"] == 10
    _goes_on_with_real_scans(shell, one_step)


def _goes_on_with_real_scans(shell: Shell, one_step: list[str]) -> None:
    write_frame(shell.folder / "real")
    begun = "out/pointpillars.safetensors"
    for out, more in (("plain", []), ("between", ["--mean"])):
        options = [f"--out={out}", f"--start={begun}", "--real=real", "--real-share=0.5", *more]
        status, output = shell.run("train", "data", *options, *one_step)
        assert status == 0, output
    first, plain, between = (
        load(shell.folder / out / "pointpillars.safetensors") for out in ("out", "plain", "between")
    )
    assert between[1]["real"] == {"frames": ["one"], "range_m": 50.0, "share": 0.5}
    assert (between[1]["mean"], "mean" in plain[1]) == (True, False)
    for name, value in between[0].state_dict().items():
        if value.is_floating_point():
            ends = [one[0].state_dict()[name] for one in (first, plain)]
            np.testing.assert_allclose(value, sum(ends) / 2, rtol=2e-3, atol=1e-4)
    status, output = shell.run("train", "data", "--out=no", "--mean", *one_step)
    assert (status, "--mean: needs --start" in output) == (2, True), output


def write_frame(folder: Path) -> None:
    """Writes level ground and a labelled block on it, in KITTI's layout."""
    rng = np.random.default_rng(1)
    ground = np.column_stack([rng.uniform(-20, 20, (5000, 2)), np.full(5000, -1.8)])
    block = np.array([8.0, 3.0, -1.0]) + rng.uniform(-0.7, 0.7, (100, 3))
    for part in ("velodyne", "label_2"):
        (folder / part).mkdir(parents=True)
    np.save(folder / "velodyne" / "one.npy", np.concatenate([ground, block]).astype(np.float32))
    label = "Car -1 0 -10 -1 -1 -1 -1 1.6 1.8 4.4 -3 1.8 8 -1.57\n"
    (folder / "label_2" / "one.txt").write_text(label)
