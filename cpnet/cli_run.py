"""The commands that run something: `cpnet up` and `cpnet replay`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

import typer

from cpnet.cli_options import (
    Connect,
    Insecure,
    Listen,
    Log,
    Only,
    Out,
    Override,
    ServeMetrics,
    UsedKeys,
    View,
    assigned,
    console,
    junctions_of,
)
from protocol.errors import ConfigError
from protocol.geometry import Floats
from protocol.logs import LogStyle

run_app = typer.Typer(pretty_exceptions_enable=False)
_SCANS = "Scans from elsewhere"
_DEFAULT = "t_junction"


@run_app.command("up")
def up_command(  # noqa: PLR0913 - one parameter per option of the command
    scenario: Annotated[str, typer.Argument(help="built-in name or YAML file")] = _DEFAULT,
    *,
    mode: Annotated[str | None, typer.Option(help="lockstep or realtime")] = None,
    duration: Annotated[float | None, typer.Option(help="simulated s after warm-up")] = None,
    seed: Annotated[int | None, typer.Option(help="of traffic, CAVs, scene and noise")] = None,
    cav_rate: Annotated[float | None, typer.Option(help="share of vehicles with LiDAR")] = None,
    cv_rate: Annotated[float | None, typer.Option(help="share that reports its pose only")] = None,
    net: Annotated[Path | None, typer.Option(help="your own .net.xml")] = None,
    routes: Annotated[
        Path | None, typer.Option(help="with --net: your own .rou.xml, else demand is generated")
    ] = None,
    sumocfg: Annotated[Path | None, typer.Option(help="your own .sumocfg")] = None,
    tls: Annotated[
        list[str] | None, typer.Option(metavar="ID,...|all", help="the signals to control")
    ] = None,
    regions: Annotated[
        int | None, typer.Option(help="edge servers, each for a part of the junctions")
    ] = None,
    link: Annotated[
        str | None, typer.Option(help="uplink of vehicles: 5g-urban, lte, 5mbit,20ms, a trace file")
    ] = None,
    set_: Override = None,
    out: Out = None,
    only: Only = None,
    listen: Listen = None,
    connect: Connect = None,
    record: Annotated[
        bool, typer.Option("--record", help="keep all messages in RUN/run.mcap, for `replay`")
    ] = False,
    restart: Annotated[
        bool, typer.Option("--restart", help="restart processes that fail; realtime only")
    ] = False,
    metrics: ServeMetrics = None,
    view: View = None,
    log: Log = LogStyle.TEXT,
    keys: UsedKeys = None,
    insecure: Insecure = False,
) -> None:
    """Run the loop: world, sensors, edge, signal, record; then print the summary."""
    from cpnet.preparation import Options
    from cpnet.up import print_results, up

    named = {
        "mode": mode,
        "duration_s": duration,
        "seed": seed,
        "traffic.cav_rate": cav_rate,
        "traffic.cv_rate": cv_rate,
        "link.profile": link,
        "traffic.net": _absolute(net),
        "traffic.routes": _absolute(routes),
        "traffic.sumocfg": _absolute(sumocfg),
        "junctions": junctions_of(tls),
        "regions": regions,
        "record.mcap": True if record else None,
    }
    if routes is not None and net is None:
        raise ConfigError("--routes needs --net: the net that its routes are of")
    own = net or sumocfg
    if own is not None:
        named["name"] = _run_name(own)
        if scenario == _DEFAULT:  # whose policy is that of the paper
            named["signal.policy"] = "predictive"
    overrides: dict[str, Any] = {k: v for k, v in named.items() if v is not None}
    overrides |= assigned(set_)
    places = listen or [], connect or []
    options = Options(
        scenario, overrides, only, *places, out, restart, metrics, log, keys, insecure, view
    )
    status, run_dir = up(options, console)
    print_results(run_dir, console)
    raise typer.Exit(status)


def _run_name(file: Path) -> str:
    """Returns a name for runs of a file: its own, without characters that names may not have."""
    return re.sub(r"[^A-Za-z0-9_-]", "_", file.name.split(".")[0])[:80] or "own"


@run_app.command("replay")
def replay_command(  # noqa: PLR0913 - one parameter per option of the command
    recording: Annotated[
        Path | None, typer.Argument(help="run folder with a recording, or an MCAP file")
    ] = None,
    *,
    speed: Annotated[
        float | None, typer.Option(metavar="N", help="in realtime, N times as fast as recorded")
    ] = None,
    lockstep: Annotated[
        bool, typer.Option("--lockstep", help="each frame waits for its request, as fast as it can")
    ] = False,
    set_: Override = None,
    out: Out = None,
    only: Only = None,
    listen: Listen = None,
    connect: Connect = None,
    metrics: ServeMetrics = None,
    view: View = None,
    log: Log = LogStyle.TEXT,
    keys: UsedKeys = None,
    insecure: Insecure = False,
    scans: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="folder of .bin, .pcd, .ply, .feather, .npy", rich_help_panel=_SCANS
        ),
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="CSV, text of KITTI, TUM or EMP, .feather", rich_help_panel=_SCANS
        ),
    ] = None,
    extrinsics: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="how sensors are mounted", rich_help_panel=_SCANS),
    ] = None,
    sensors: Annotated[
        str | None,
        typer.Option(metavar="NAME,...", help="numbered devices' names", rich_help_panel=_SCANS),
    ] = None,
    refine: Annotated[
        bool, typer.Option("--refine", help="extrinsics are a guess", rich_help_panel=_SCANS)
    ] = False,
    scenario: Annotated[
        str | None,
        typer.Option(help="whose roads are those of the scans", rich_help_panel=_SCANS),
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option(min=1, help="how many; files are played anew", rich_help_panel=_SCANS),
    ] = None,
    height: Annotated[
        float | None,
        typer.Option(metavar="M", help="over the ground; else found", rich_help_panel=_SCANS),
    ] = None,
    width: Annotated[
        float | None,
        typer.Option(min=1, help="of the open ground, m; else 100", rich_help_panel=_SCANS),
    ] = None,
    boxes: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="write detected boxes: .parquet, .txt or a folder (KITTI)",
            rich_help_panel=_SCANS,
        ),
    ] = None,
    align: Annotated[
        bool,
        typer.Option("--align", help="move agents to where others see", rich_help_panel=_SCANS),
    ] = False,
) -> None:
    """Play a recorded run to live processes: another detector, policy or link, the same scans."""
    from cpnet.preparation import Options
    from cpnet.replay import Pace, replay_of_recording
    from cpnet.up import print_results, up

    pace, overrides = Pace.of(speed, lockstep=lockstep), assigned(set_)
    if (recording is None) == (scans is None):
        both = "" if recording is None else "; not both"
        raise ConfigError(
            f"give the recording that is to be played, or --scans DIR --poses FILE{both}"
        )
    if recording is not None:
        named = [poses, extrinsics, sensors, scenario, frames, height, width, boxes]
        if refine or align or any(option is not None for option in named):
            raise ConfigError("--poses and all that is for scans from elsewhere needs --scans DIR")
        played = replay_of_recording(recording, overrides, pace, console)
    elif refine and extrinsics is None:
        raise ConfigError(
            "--refine needs --extrinsics FILE: a first guess of how sensors are mounted"
        )
    elif scans is None or poses is None:
        raise ConfigError("--scans needs --poses FILE: where the sensor was in each frame")
    else:
        from cpnet.replay import Scans, replay_of_scans
        from recording.foreign_scans.agents import Source

        if boxes is not None:
            from studies.box_files import check_boxes

            check_boxes(boxes)
        names = [name.strip() for name in sensors.split(",")] if sensors else []
        source = Source(scans, poses, extrinsics, names, refine=refine)
        played = replay_of_scans(
            Scans(source, scenario, overrides, frames, height, width, align), pace, console
        )
    options = Options(
        "", {}, only, listen or [], connect or [], out,
        metrics=metrics, log=log, keys=keys, insecure=insecure, view=view,
    )  # fmt: skip
    status, run_dir = up(options, console, played)
    print_results(run_dir, console)
    if played.sensor_poses is not None:
        _say_boxes(run_dir, boxes, played.sensor_poses)
    raise typer.Exit(status)


def _say_boxes(run_dir: Path, boxes: Path | None, sensor_poses: Floats) -> None:
    """Prints how many boxes were found, and writes them on request."""
    if not (run_dir / "run.sqlite").is_file():  # the role record runs elsewhere
        return
    from studies.box_files import count_boxes, write_boxes

    if boxes is None:
        found, where = count_boxes(run_dir), ""
    else:
        found, where = write_boxes(run_dir, boxes, sensor_poses), f", written to {boxes}"
    console.print(
        f"{found} boxes in {len(sensor_poses)} frames{where}", highlight=False, soft_wrap=True
    )


def _absolute(path: Path | None) -> str | None:
    return str(path.resolve()) if path is not None else None
