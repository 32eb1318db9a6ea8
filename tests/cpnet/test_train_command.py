"""`cpnet dataset` and `cpnet train`, as they are typed."""

from __future__ import annotations

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
