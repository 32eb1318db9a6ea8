"""Figures 3, 5 and 7 of Chen et al. 2022, all of one sample."""

from __future__ import annotations

from perception.config import DetectorName
from studies.accuracy.maps import cloud_maps, fusion_maps, truth_map
from studies.accuracy.measure import Scenario, junction_of
from studies.accuracy.view import best_of, view_of
from studies.page.model import Section, SideBySide, Text

LOOKED_AT = 12  # samples, of which one is shown


def scenes_section(scenario: Scenario, detector: DetectorName, samples: int = LOOKED_AT) -> Section:
    """Returns clouds, detections and truth at the sample that shows most.

    Raises:
        ConfigError: the junction cannot be had, or the detector.
    """
    title = "Figures 3, 5 and 7: clouds, detections, truth"
    site, listed = junction_of(scenario, samples)
    sample = best_of(listed)
    if sample is None:
        return Section(title, (Text("No sample had a scan, so that there is nothing to show."),))
    view = view_of(site, sample, detector)
    return Section(
        title,
        (
            Text(
                f"One sample of {samples}, the one with the most scans, as the detector {detector} "
                f"sees it inside the geofence; all figures are of the part that is shown."
            ),
            Text("Figure 3: clouds before and after merging."),
            SideBySide(cloud_maps(view)),
            Text("Figure 5: detections before and after fusion."),
            SideBySide(fusion_maps(view)),
            Text("Figure 7: detected boxes over true boxes."),
            truth_map(view),
        ),
    )
