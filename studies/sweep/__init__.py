"""Parameter studies of many runs: a study file, its cells, Dask workers, the table of results.

- `study_file`: the file, its grids and axes
- `cells`: a scenario with a seed each, and their results on disk
- `worker`: runs and measures one cell
- `cluster`, `engine`: Dask workers, the distribution of cells to them, progress
- `results`: the table, and its overview over seeds
"""
