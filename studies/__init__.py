"""Analysis of recorded runs: figures of merit, reports, pictures, benchmarks, parameter studies.

Figures of one run
- `ecvpr`: matching of detections with vehicles, E-CVPR and its upper bounds
- `count_error`: lane counts against the truth; `frame_rows`: rows frame by frame, empty ones too
- `latency`, `uplink`: the latency breakdown; bytes and rates of agents
- `summary`: all figures of a run, as JSON and as tables on a terminal

Pages and pictures
- `page/`: content of a page, its charts by matplotlib, HTML and Markdown files
- `run_page`, `run_sections`, `over_time`: the page of a run (`cpnet report --html`)
- `study_page`, `paper_page`, `study_tables`, `study_networks`: the pages of studies
- `snapshot`, `frame_picture`: the picture of a frame (`cpnet draw`)
- `outlines`, `palette`: shapes and colours, also of the viewer

Many runs
- `in_process`: a lockstep run in one process; `simulated_frame` is a frame of it for programs
- `own_functions`: plain functions of a program as plug-ins
- `run_frames`: a recorded run as Polars frames (`cpnet.Run`); `comparison`: two runs side by side
- `sweep/`: `cpnet study`, its cells, workers and table
- `bench_*`, `evaluate`, `accuracy`: `cpnet bench`, `cpnet eval`, Table 1 of Chen et al. 2022
- `kitti_eval`: the same on files with labels in KITTI's format
- `box_files`: detected boxes of a run as KITTI's labels or Parquet
"""
