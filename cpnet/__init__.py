"""The command line `cpnet`, and its Python API: `cpnet.run`, `simulate`, `study`, `Run`.

- For programs: `python_api` (runs, frames, studies), `environments` (Gymnasium, PettingZoo).
- Studies: `study_cells` (what the command and programs share).
- Commands: `cli` (report, draw, scenario), `cli_run` (up, replay), `cli_setup` (doctor, keys),
  `cli_learn`, `cli_study`, `cli_bench`, `cli_options` (what they share) and those of observers.
- A run: `scenario` (all keys, defaults, renamed keys), `processes` (the process table),
  `needs`, `preparation` and `run_folder` (before the first frame), `up`, `supervisor`,
  `fork_server`, `exit_report`, `run_monitor` (progress, stalls, failures, exit status), `watch`
  (the world bus).
- Installed: `compiling` (Numba's functions, once), `main_module` (a user's script), `shadowing`
  (a user's `protocol.py`).
- Other machines: `endpoints` (where buses are), `discovery` (RUN/buses.json, joining a run),
  `security` (TLS or loopback), `keys` (certificates), `doctor` (checks), `metrics_page`.
- Recordings: `replay`; `reproduce` (the command that repeats a run).
- `limits`: bounds on received data.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cpnet.python_api import run as run
    from cpnet.python_api import simulate as simulate
    from cpnet.python_api import study as study
    from studies.run_frames import Run as Run

__all__ = ["Run", "run", "simulate", "study"]


def __getattr__(name: str) -> Any:  # noqa: ANN401 - the API loads all roles: when it is asked for
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from cpnet.shadowing import check_packages

    check_packages()
    from cpnet.compiling import compile_ahead

    compile_ahead()
    from cpnet import python_api

    return getattr(python_api, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
