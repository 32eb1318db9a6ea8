"""The figures of Chen et al. 2022, from CARLA's Town04 with SUMO."""

from __future__ import annotations

E_CVPR_MEAN: dict[str, dict[float, float]] = {
    "DBSCAN": {0: 29.9, 0.01: 35.4, 0.02: 38.3},
    "PointPillars": {0: 31.4, 0.01: 35.7, 0.02: 37.4, 0.05: 46.6},
}
"""Table 2, per cent by share of CAVs; standard deviations are 10 to 15."""

DELAY_S = (10.6, 11.0)
"""Table 3: the mean delays of all cells lie between these."""

TWIN = {"fast": "DBSCAN", "reference": "DBSCAN", "pointpillars": "PointPillars"}
"""Their detector for ours."""
