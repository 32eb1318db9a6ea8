"""The commands that measure parts of the system."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cpnet.cli_options import AsJson, show, show_measured
from perception.config import DETECTORS
from studies.bench import FRAME_PERIOD_S, LINK_CHOICES, POLICY_CHOICES, WARM_UP_FRAMES

bench_app = typer.Typer(help="Measure parts of the system.", no_args_is_help=True)

Policies = Annotated[str, typer.Option(metavar="NAME[+FILTER],...", help="upload policies")]
Agents = Annotated[int, typer.Option(help="a roadside LiDAR and CAVs")]
Frames = Annotated[
    int, typer.Option(help=f"frames of each run; the first {WARM_UP_FRAMES} do not count")
]
_ALL_POLICIES = ",".join(POLICY_CHOICES)
_CONTROL_POLICIES = "plan,webster,actuated,delay_based,max_pressure,predictive"


@bench_app.command("codec")
def bench_codec_command(
    *,
    points: Annotated[
        list[Path] | None,
        typer.Option(metavar="PATH", help="a .bin, .pcd, .ply, … file as well, or all in a folder"),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure the codec beside others at equal maximum error, by kind of sensor."""
    from sensing.point_files import point_files
    from studies.bench_codec import (
        BenchCloud,
        bench,
        cast_clouds,
        load_draco,
        print_bench,
    )
    from studies.bench_scans import Junction, cast_scans

    files = [BenchCloud.of_file(path) for path in point_files(points or [])]
    load_draco()
    junction = Junction.in_traffic()
    clouds = [BenchCloud.of_scan(scan) for scan in cast_scans(junction)]
    clouds += cast_clouds(junction) + files
    rows = [row for cloud in clouds for row in bench(cloud)]
    show(rows, print_bench, as_json=as_json)


@bench_app.command("uplink")
def bench_uplink_command(
    *,
    policies: Policies = _ALL_POLICIES,
    link: Annotated[
        list[str] | None, typer.Option(help="uplink of all agents; may be given several times")
    ] = None,
    agents: Agents = 6,
    frames: Frames = 60,
    realtime: Annotated[
        bool, typer.Option("--realtime", help="emulated links and the wall clock")
    ] = False,
    rate: Annotated[float, typer.Option(min=1, max=100, help="realtime: frames a second")] = 10,
    as_json: AsJson = False,
) -> None:
    """Measure upload policies on links: bytes, latency, what is still detected and counted."""
    from cpnet.bench import UplinkBench, measure
    from studies.bench_uplink import print_uplink

    bench = UplinkBench(
        policies=tuple(policies.split(",")),
        links=tuple(link or LINK_CHOICES),
        agents=agents,
        frames=frames,
        realtime=realtime,
        rate_hz=rate if realtime else 1 / FRAME_PERIOD_S,
    )
    cells = len(bench.policies) * len(bench.links)
    show_measured(measure(bench), cells, print_uplink, as_json=as_json)


@bench_app.command("rate")
def bench_rate_command(
    *,
    policies: Policies = "full,foreground,reap+foreground",
    agents: Agents = 6,
    frames: Frames = 120,
    as_json: AsJson = False,
) -> None:
    """Find the highest frame rate in realtime, with detection, on recorded scans."""
    from cpnet.bench import UplinkBench, measure_rates
    from studies.bench_uplink import print_rates

    bench = UplinkBench(policies=tuple(policies.split(",")), agents=agents, frames=frames)
    show_measured(measure_rates(bench), None, print_rates, as_json=as_json)


@bench_app.command("edge")
def bench_edge_command(
    *,
    detectors: Annotated[
        str, typer.Option(metavar="NAME,...", help=f"of {', '.join(DETECTORS.builtin)}")
    ] = ",".join(DETECTORS.builtin),
    agents: Annotated[
        str, typer.Option(metavar="N,...", help="a roadside LiDAR and CAVs, up to 16")
    ] = "1,2,4,8,16",
    frames: Annotated[int, typer.Option(min=1, max=600, help="of each")] = 20,
    as_json: AsJson = False,
) -> None:
    """Measure the edge from payloads to counts, stage by stage, for each detector.

    Scans are decoded and placed by a thread for each core: these two are sums, total is less.
    """
    from cpnet.evaluation import detectors_of
    from studies.bench_edge import EdgeBench, measure_edge, numbers_of, print_edge

    bench = EdgeBench(detectors_of(detectors), numbers_of(agents), frames)
    show_measured(measure_edge(bench), bench.rows, print_edge, as_json=as_json)


@bench_app.command("scale")
def bench_scale_command(
    *,
    junctions: Annotated[
        str, typer.Option(metavar="N,...", help="squares, such as 1,4,16,64,100")
    ] = "1,4,16",
    duration: Annotated[float, typer.Option(help="simulated seconds of each, at 1 Hz")] = 60,
    cav_rate: Annotated[float, typer.Option(min=0, max=1, help="share of CAVs")] = 0.05,
    as_json: AsJson = False,
) -> None:
    """Measure what an agent's frame costs as the city grows: CPU time by role, memory."""
    from cpnet.bench_scale import ScaleBench, measure_scale, print_scale

    bench = ScaleBench.of(junctions, duration, cav_rate)
    show_measured(measure_scale(bench), len(bench.junctions), print_scale, as_json=as_json)


@bench_app.command("recorder")
def bench_recorder_command(
    *,
    junctions: Annotated[int, typer.Option(min=1, max=1000, help="with 15 vehicles each")] = 200,
    regions: Annotated[int, typer.Option(min=1, help="they are cut into")] = 50,
    agents: Annotated[int, typer.Option(min=1, max=64, help="that scan, in each region")] = 5,
    frames: Annotated[int, typer.Option(min=1, max=3600, help="at 1 Hz")] = 120,
    as_json: AsJson = False,
) -> None:
    """Measure the recorder alone on what a city publishes: bytes an hour, frames a second."""
    from studies.bench_recorder import RecorderBench, measure_recorder, print_recorder

    bench = RecorderBench(junctions, regions, agents, frames)
    show([measure_recorder(bench)], print_recorder, as_json=as_json)


@bench_app.command("control")
def bench_control_command(  # noqa: PLR0913 - one parameter per option of the command
    *,
    net: Annotated[
        list[str] | None,
        typer.Option(
            help="t_junction, moving_peak, corridor, grid, town or a folder with a .sumocfg; may "
            "be given several times"
        ),
    ] = None,
    policies: Annotated[
        str, typer.Option(metavar="NAME,...", help="signal policies, built in or of plug-ins")
    ] = _CONTROL_POLICIES,
    seeds: Annotated[int, typer.Option(min=1, max=100, help="of each, from 1 on")] = 1,
    demand: Annotated[
        float, typer.Option(min=0.1, max=3, help="factor of a built-in net's demand")
    ] = 1.0,
    duration: Annotated[int, typer.Option(min=60, help="simulated seconds of each")] = 3600,
    reporting: Annotated[
        float,
        typer.Option(min=0.01, max=1, help="share of the vehicles that policies know of"),
    ] = 1.0,
    upstream: Annotated[float, typer.Option(help="m before stop bars that are known")] = 200,
    downstream: Annotated[float, typer.Option(help="m behind them that count")] = 100,
    processes: Annotated[int, typer.Option(min=1, max=64, help="runs at a time")] = 1,
    as_json: AsJson = False,
) -> None:
    """Measure signal policies on SUMO alone, with perfect positions near the signals."""
    from studies.bench_control import measure_control, print_control
    from studies.control_case import ControlCase

    cases = [
        ControlCase(
            net=name,
            policy=policy,
            seed=seed,
            demand=demand,
            duration_s=duration,
            reporting=reporting,
            upstream_m=upstream,
            downstream_m=downstream,
        )
        for name in net or ["t_junction"]
        for policy in policies.split(",")
        for seed in range(1, seeds + 1)
    ]
    show_measured(measure_control(cases, processes), len(cases), print_control, as_json=as_json)
