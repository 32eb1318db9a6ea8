"""Detection of vehicles in point clouds: pure functions that know no network, for edge and agents.

- `config`: parameters of every stage; `registry` builds the detector that they name
- `detector`: interface: `Cloud` in, `Vehicles` out; plug-ins are held to it
- `fast`: the default detector, by clustering: `ground` (RANSAC per tile), `cluster` (DBSCAN on the
  grid of `cells`), `boxes` (fit, size filter, overlap), `completion` (what of a vehicle is unseen)
- `reference`: the paper's detector by Open3D; `pillars/`: PointPillars
- `roadway`: raster of the road, points placed on it, lowest point of each square metre
- `thin`: thinning of near beams before upload
- `tracking/`: vehicles followed from frame to frame
- `arrays`: array types; `parallel`: threads for the chunks of a cloud
"""
