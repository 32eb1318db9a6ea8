"""Prints AP40 by part of `realism`, detector and class: `accuracy_by_part.py STUDY.yaml SAMPLES`.

Each part is laid over the study's scenario, with its first seed. Samples are merged clouds inside
the geofence; boxes count from above, at IoU 0.5, vehicles with five points or more.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import yaml

from cpnet import scenario
from studies.accuracy import junction_of
from studies.evaluate import EVERYTHING, evaluate

OBJECTS = ("car", "truck", "vehicle")


def main() -> None:
    """Reads the study's parts, measures each with all detectors, and prints the rows."""
    study, samples = yaml.safe_load(Path(sys.argv[1]).read_text("utf-8")), int(sys.argv[2])
    detectors = tuple(study["axes"]["detector"])
    rows = []
    for part, settings in study["axes"]["part"].items():
        keys = study["set"] | settings | {"seed": study["seeds"][0]}
        world = scenario.load(study["scenario"], keys)
        site, listed = junction_of(world.model_dump(mode="json"), samples)
        found = evaluate(((site, one) for one in listed), detectors, geofences=(True,))
        rows += [
            {
                "part": part,
                "detector": row.detector,
                "objects": row.objects,
                "vehicles": row.vehicles,
                "ap40": row.ap40,
            }
            for row in found
            if (row.fusion, row.truth, row.view, row.iou) == ("early", "visible", "bev", 0.5)
            and row.part == EVERYTHING
            and row.objects in OBJECTS
        ]
    json.dump(rows, sys.stdout)


if __name__ == "__main__":
    main()
