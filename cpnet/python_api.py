"""cpnet for Python programs: runs, studies, and a loop over frames; results as Polars frames.

    import cpnet

    run = cpnet.run("t_junction", duration_s=30, traffic={"cav_rate": 0.1})
    print(run.figures["delay_s"], run.detections)

    for frame in cpnet.simulate("t_junction", duration_s=10, detector=my_detector):
        print(frame.sim_time_s, len(frame.boxes), frame.upload_bytes)

For the keys of a scenario see the reference; a section may be given as a dictionary.
"""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cpnet import scenario as scenarios
from cpnet.main_module import check_not_again
from cpnet.needs import check_detector, check_simulator
from cpnet.run_folder import RunFolder
from protocol.errors import BusError, ConfigError
from protocol.messages import Setup
from protocol.plugins import provided
from sim_host.setup import build_setup
from studies.in_process import perceived_frames, run_setup_in_process
from studies.own_functions import OwnController, OwnDetector, OwnFusion, OwnParts, OwnUpload
from studies.run_frames import Run
from studies.simulated_frame import SimulatedFrame

Scenario = str | Path | Mapping[str, Any]
_ARGUMENTS = {
    "edge.detector": "detector",
    "upload.policy": "upload_policy",
    "edge.fusion.rule": "fusion",
    "signal.policy": "controller",
}
"""The arguments that take functions, by the scenario keys that take names."""


def run(
    scenario: Scenario = "t_junction",
    *,
    detector: OwnDetector | None = None,
    upload_policy: OwnUpload | None = None,
    fusion: OwnFusion | None = None,
    controller: OwnController | None = None,
    processes: bool = False,
    out: Path | str | None = None,
    **overrides: Any,  # noqa: ANN401 - values of scenario keys
) -> Run:
    """Runs a scenario to its end and returns the recorded run.

    Args:
        scenario: a built-in name, a YAML file, or keys and values over `t_junction`.
        detector: a function that replaces the edge's, see `studies.own_functions`.
        upload_policy: the same for the agents' upload policy.
        fusion: the same for fusion.
        controller: the same for the signal policy.
        processes: a process for each role, over Zenoh on loopback, as `cpnet up`; else all in this
            process, in lockstep. Functions need this process.
        out: the run folder, new or empty; None: a temporary one, removed with the run's object.
        **overrides: scenario keys, such as `duration_s=30`, `traffic={"cav_rate": 0.1}` or
            `**{"edge.detector": "fast"}`.

    Raises:
        ConfigError: the scenario cannot be run.
        BusError: the roles wait for each other.
    """
    check_not_again()
    own = OwnParts(detector, upload_policy, fusion, controller)
    if processes:
        return _run_processes(scenario, own, out, overrides)
    with provided(own.plugins()):
        resolved = resolve(scenario, _with_own(overrides, own))
        run_dir = _folder(out, resolved.name)
        with _removed_if(out is None, run_dir, after_error_only=True):
            run_setup_in_process(_setup(resolved, run_dir), run_dir)
    return _opened(run_dir, out)


def simulate(
    scenario: Scenario = "t_junction",
    *,
    detector: OwnDetector | None = None,
    upload_policy: OwnUpload | None = None,
    fusion: OwnFusion | None = None,
    controller: OwnController | None = None,
    out: Path | str | None = None,
    **overrides: Any,  # noqa: ANN401 - values of scenario keys
) -> Iterator[SimulatedFrame]:
    """Runs a scenario in this process and yields each frame, perceived, before signals decide.

    The run goes on when the next frame is asked for, and ends when the iterator is closed. One run
    at a time: SUMO has one state in a process. For the arguments see `run`.

    Raises:
        ConfigError: the scenario cannot be run, or another run of this process has not ended.
        BusError: the roles wait for each other.
    """
    check_not_again()
    own = OwnParts(detector, upload_policy, fusion, controller)
    with provided(own.plugins()):
        resolved = resolve(scenario, _with_own(overrides, own))
        run_dir = _folder(out, resolved.name)
        with _removed_if(out is None, run_dir):
            yield from perceived_frames(_setup(resolved, run_dir), run_dir)


def study(
    what: str | Path | Mapping[str, Any],
    *,
    out: Path | str | None = None,
    jobs: int = 1,
    seeds: list[int] | None = None,
    keep_runs: bool = False,
    **overrides: Any,  # noqa: ANN401 - values of scenario keys
) -> Any:  # noqa: ANN401 - a polars.DataFrame
    """Runs the missing cells of a study; returns its table, a `polars.DataFrame`.

    A row for each cell and seed: `grid`, a column for each axis, `seed`, then measures, which
    are called as in `Run.figures`. Cells that failed have no row.

    Args:
        what: a built-in name, a YAML file, or what such a file holds.
        out: folder of results; a cell that is done there is not run again. None: a temporary one.
        jobs: processes. One runs all cells here; more need `if __name__ == "__main__":` in scripts.
        seeds: instead of the study's.
        keep_runs: keep each run folder in `out`/runs.
        **overrides: scenario keys, see `run`; they win over the study's.

    Raises:
        ConfigError: there is no such study, it is invalid, or every cell failed.
    """
    from cpnet.study_cells import run_study

    check_not_again()
    return run_study(what, out, jobs, seeds, flattened(overrides), keep_runs=keep_runs)


def resolve(scenario: Scenario, overrides: Mapping[str, Any]) -> scenarios.Scenario:
    """Returns a scenario with every key.

    Raises:
        ConfigError: there is no such scenario, an unknown key or a value out of range.
    """
    settings = flattened(overrides)
    name = str(scenario)
    if isinstance(scenario, Mapping):
        name, settings = "t_junction", flattened(scenario) | settings
    _check_names(settings)
    return scenarios.load(name, settings)


def _with_own(overrides: Mapping[str, Any], own: OwnParts) -> dict[str, Any]:
    """Returns the overrides with the names of plug-in functions.

    Raises:
        ConfigError: a part is given by a function and by a name.
    """
    given, names = flattened(overrides), own.settings()
    for key in names:
        if key in given and not callable(given[key]):
            raise ConfigError(
                f"{key} is {given[key]!r}, and {_ARGUMENTS[key]}= gives a function: give one"
            )
    return names | given


def _check_names(settings: Mapping[str, Any]) -> None:
    """Checks that no function stands where a scenario has a name.

    Raises:
        ConfigError: one does.
    """
    for key, argument in _ARGUMENTS.items():
        if callable(settings.get(key)):
            raise ConfigError(
                f"{key} is a function, must be a name: give functions by the argument {argument}="
            )


def flattened(overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Returns dotted keys and their values; nested mappings are flattened."""
    found: dict[str, Any] = {}
    for key, value in overrides.items():
        if isinstance(value, Mapping) and scenarios.is_section(key):
            found |= flattened({f"{key}.{name}": inner for name, inner in value.items()})
        else:
            found[key] = value
    return found


def _setup(scenario: scenarios.Scenario, run_dir: Path) -> Setup:
    if scenario.mode != "lockstep":
        raise ConfigError(
            f"mode is {scenario.mode}: a run in this process is in lockstep; cpnet.run with "
            "processes=True runs on the wall clock"
        )
    check_simulator()
    check_detector(scenario.edge.detector)
    return build_setup(scenario.model_dump(mode="json"), run_dir)


def _folder(out: Path | str | None, name: str) -> Path:
    """Makes the run folder; without `out` a temporary one."""
    if out is not None:
        return RunFolder.at(Path(out), name).make()
    return Path(tempfile.mkdtemp(prefix="cpnet-run-")).resolve()


@contextmanager
def _removed_if(
    temporary: bool, run_dir: Path, *, after_error_only: bool = False
) -> Iterator[None]:
    """Removes a temporary folder at the end, or where the run fails."""
    try:
        yield
    except BaseException:
        if temporary:
            shutil.rmtree(run_dir, ignore_errors=True)
        raise
    if temporary and not after_error_only:
        shutil.rmtree(run_dir, ignore_errors=True)


def _opened(run_dir: Path, out: Path | str | None) -> Run:
    """Opens a run, whose folder is removed with the object if it is a temporary one."""
    opened = Run(run_dir)
    if out is None:
        weakref.finalize(opened, shutil.rmtree, run_dir, ignore_errors=True)
    return opened


def _run_processes(
    scenario: Scenario, own: OwnParts, out: Path | str | None, overrides: Mapping[str, Any]
) -> Run:
    from rich.console import Console

    from cpnet.preparation import Options
    from cpnet.up import up

    if own.settings():
        raise ConfigError(
            "functions of this program run in its process: give processes=False, or install them "
            "as a plug-in (docs/plugins.md)"
        )
    name = "t_junction" if isinstance(scenario, Mapping) else str(scenario)
    keys = flattened(scenario) if isinstance(scenario, Mapping) else {}
    run_dir = _folder(out, name)
    options = Options(name, keys | flattened(overrides), None, [], [], run_dir)
    with _removed_if(out is None, run_dir, after_error_only=True):
        status, _ = up(options, Console(quiet=True))
        if status:
            raise BusError(f"the run ended with status {status}: give `out` and see its logs")
    return _opened(run_dir, out)
