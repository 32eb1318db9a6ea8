"""Tracking: vehicles keep their id, get a speed, and stay known while nobody sees them.

- `tracker`: detections in, `tracks` out, frame by frame; `config`: what it goes by
- `association`: which detection is whose; `motion`: where a track goes in the open and on lanes
- `lane_graph`: lanes as arrays; `sightlines`: what sensors have seen through
"""
