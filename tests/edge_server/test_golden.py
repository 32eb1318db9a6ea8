"""Golden replay: recorded scans through the pipeline give the expected vehicles."""

import json

import numpy as np

from tests.edge_server.golden_scans import EXPECTED, replay


def test_recorded_scans_give_the_vehicles_that_they_gave_before():
    expected = json.loads(EXPECTED.read_text())
    for now, before in zip(replay(), expected, strict=True):
        assert now["lanes"] == before["lanes"]
        assert (now["upstream"], now["downstream"]) == (before["upstream"], before["downstream"])
        np.testing.assert_allclose(now["boxes"], before["boxes"], atol=0.05)
