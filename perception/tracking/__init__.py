"""Tracking: vehicles keep their id, get a speed, and stay known while nobody sees them.

- `tracker`: detections in, `tracks` out, frame by frame; `config`: what it goes by
- `states`: what is known of each track; `birth`: of a new one; `existence`: is it still there?
- `pairing`: which detection is whose, by `association` and by `places` that are one
- `motion`: the filter, in the open; `lane_following`: along lanes, behind others, before lights
- `lane_graph`: lanes as arrays; `sightlines`: what sensors have seen through
"""
