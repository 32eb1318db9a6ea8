"""The edge server: scans and poses in, vehicles and counts per lane out. It uses the V2X bus only.

- `role`: I/O: subscribes, publishes detections, counts, plans and metrics
- `scenario`, `config`: what it reads from a scenario; `owners`: processes of agents
- `decoding`: threads that decode and place chunks as they arrive
- `assembler`: frame assembly; `completion`: when a frame is complete, or late
- `frame`: chunks, frames, the state of a frame, and what a stage is
- `pipeline`: the list of stages; the stages merge, detect, fuse and count; `tracking`: track
- `placing`: the stages decode and place; `misbehaviour` (with `motion`, `map_consistency`): check
- `fusion`: duplicates and agents' poses; `lanes`: positions and counts; `coverage`: what is seen
- `planner`, `power_diagram`: which agent uploads which part of the scene
"""
