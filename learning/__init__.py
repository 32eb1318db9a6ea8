"""Labelled scans of generated junctions, and the training of PointPillars on them.

- `sites`: random draws of a junction with its traffic, scene and sensors
- `scanner`: simulates them, or a user's net or scenario, and yields labelled scans
- `kitti`: a scan's labels in KITTI's format
- `kitti_object`: reader of clouds and labels in the layout of KITTI's object benchmark
- `dataset`: the files of a dataset, and its reader
- `generate`: writes a dataset (`cpnet dataset`)
- `examples`: draws training windows from samples, with the targets of their anchors
- `training`: loss, optimiser and the loop (`cpnet train`)
"""
