"""The short form of a campaign: all seeds and some changes to them, in every reader."""

from __future__ import annotations

import warnings
from random import Random

import pytest
from fuzz_targets import TARGETS, Target

INPUTS = 120

targets = pytest.mark.parametrize("target", TARGETS.values(), ids=TARGETS.keys())


@targets
def test_what_is_kept_is_read_or_refused(target: Target):
    seeds = target.seeds()
    assert seeds
    assert any(target.takes(data) for data in seeds)


@targets
def test_what_is_changed_is_read_or_refused(target: Target):
    rng, seeds = Random(1), target.seeds()
    light = [data for data in seeds if len(data) < 10_000]
    good = 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # numpy on headers of Python 2
        for _ in range(INPUTS):
            good += target.takes(target.mutate(rng, rng.choice(light), light))
    assert 0 < good <= INPUTS
    assert good < INPUTS or not target.allowed
