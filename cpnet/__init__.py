"""The command line `cpnet`: starts the processes of a run, follows it, and prints its results.

- Commands: `cli` (report, draw, scenario), `cli_run` (up, replay), `cli_setup` (doctor, keys),
  `cli_learn`, `cli_study`, `cli_bench`, `cli_options` (what they share) and those of observers.
- A run: `scenario` (all keys, defaults, renamed keys), `processes` (the process table),
  `preparation` and `run_folder` (before the first frame), `up`, `supervisor`, `fork_server`,
  `exit_report`, `run_monitor` (progress, stalls, failures, exit status), `watch` (the world bus).
- Other machines: `endpoints` (where buses are), `discovery` (RUN/buses.json, joining a run),
  `security` (TLS or loopback), `keys` (certificates), `doctor` (checks), `metrics_page`.
- Recordings: `replay`; `reproduce` (the command that repeats a run).
- `limits`: bounds on what others may send.
"""
