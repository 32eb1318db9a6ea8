"""What the small dataset of these tests holds."""

from learning.generate import DatasetSpec

SPEC = DatasetSpec(networks=3, samples=2, seed=7)
