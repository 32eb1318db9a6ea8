"""Multi-object tracking: ids and speeds of vehicles, coasting while no sensor sees them.

- `tracker`: detections in, `tracks` out, frame by frame; `config`: its parameters
- `states`: the state of each track; `life_cycle`: birth and probability of existence
- `pairing`: which detection belongs to which track, by `association` and by `places`
- `motion`: the extended Kalman filter; `lane_following`: along lanes, behind others, before signals
- `lane_graph`: lanes as arrays; `sightlines`: ground that sensors have seen
"""
