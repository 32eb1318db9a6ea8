"""PointPillars (Lang et al. 2019): a learned detector, on the CPU or on a GPU.

- `config`: of networks and anchors; `network`: layers, terms of boxes; `weights`: their files
- `windows`: of a cloud, and the pillars in them; `detector`: from a cloud to vehicles
- `seen_side`: boxes go behind their points; `hidden_ground`: vehicles on lower ground
"""
