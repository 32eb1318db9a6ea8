"""The commands that make data sets, train detectors and measure them."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    track,
)

from cpnet import scenario as scenarios
from cpnet.cli_options import AsJson, assigned, console, errors, one_signal, show
from cpnet.needs import check_detector
from edge_server.config import EdgeConfig
from perception.config import DETECTORS, DetectorName
from perception.registry import check
from protocol.errors import ConfigError
from protocol.extras import to_install

if TYPE_CHECKING:
    from studies.kitti_tracking import KittiScore
    from studies.run_tracks import RunTracks

learn_app = typer.Typer()
MOST_RANGE_M = 90.0  # as far as `studies.evaluate` gives points


@learn_app.command("dataset")
def dataset_command(
    out: Annotated[Path, typer.Argument(help="a new or empty folder")],
    *,
    networks: Annotated[int, typer.Option(help="generated junctions")] = 60,
    samples: Annotated[int, typer.Option(help="of each network, some seconds apart")] = 12,
    seed: Annotated[int, typer.Option(help="the same bytes for the same seed")] = 1,
    realism: Annotated[str, typer.Option(help="of the world: paper, clear or hard")] = "paper",
    split: Annotated[
        str | None, typer.Option(help="only its networks: train, val or test; default all")
    ] = None,
    furniture: Annotated[
        float,
        typer.Option(help="walls, trees and such per 100 m of road's edge; parked cars, too"),
    ] = 0.0,
    jobs: Annotated[int | None, typer.Option(help="processes; default one a core")] = None,
) -> None:
    """Write labelled scans of many generated junctions, for training."""
    from learning.generate import DatasetSpec, generate

    scenario = scenarios.load("t_junction", {"realism": realism})
    world = None if realism == "paper" else scenario.model_dump(mode="json")
    spec = DatasetSpec(networks, samples, seed, realism, world, split, furniture)
    columns = [TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()]
    with Progress(*columns, TimeElapsedColumn(), console=errors, transient=True) as progress:
        task = progress.add_task("networks", total=len(spec.made))

        def report(done: int, scans: int) -> None:
            progress.update(task, completed=done, description=f"networks, {scans} scans")

        generate(out, spec, (os.cpu_count() or 1) if jobs is None else jobs, report)
    console.print(f"wrote {out}", highlight=False, soft_wrap=True)


@learn_app.command("train")
def train_command(  # noqa: PLR0913 - one parameter per option of the command
    dataset: Annotated[Path, typer.Argument(help="a folder that `cpnet dataset` wrote")],
    *,
    out: Annotated[Path, typer.Option(help="for weights and state; training resumes from it")],
    network: Annotated[
        str, typer.Option(help="pointpillars or pointpillars-full")
    ] = "pointpillars",
    steps: Annotated[int, typer.Option(help="of the optimiser")] = 20_000,
    windows: Annotated[int, typer.Option(help="a step")] = 4,
    cells: Annotated[int, typer.Option(help="of 0.25 m, a window's side")] = 320,
    rate: Annotated[float, typer.Option(help="of learning, at its highest")] = 3e-3,
    seed: Annotated[int, typer.Option(help="the same weights for the same seed")] = 1,
    start: Annotated[
        Path | None, typer.Option(help="weights to begin with, trained on other data")
    ] = None,
    mean: Annotated[
        bool, typer.Option("--mean", help="write the mean of the weights learnt and --start")
    ] = False,
    real: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="real scans mixed in: velodyne/, label_2/ as KITTI's"),
    ] = None,
    real_share: Annotated[
        float | None, typer.Option(help="of --real in all windows; 0.25 if not given")
    ] = None,
    real_range: Annotated[
        float | None,
        typer.Option(metavar="M", help="to which --real has labels of all vehicles; 50"),
    ] = None,
) -> None:
    """Train PointPillars on labelled scans, on a GPU if there is one."""
    from cpnet.evaluation import detectors_of, figures_of

    try:
        from learning.dataset import Dataset
        from learning.real_frames import RealFrames
        from learning.training import Recipe, Training, train
        from perception.pillars.weights import describe
    except ImportError as error:
        raise ConfigError(
            f"training needs PyTorch (extra `learn`): {error}; {to_install('learn')}"
        ) from None
    recipe = Recipe(steps=steps, windows=windows, cells=cells, rate=rate, seed=seed)
    if real is None and (real_share, real_range) != (None, None):
        raise ConfigError("--real-share and --real-range are for --real DIR")
    share, range_m = _or(real_share, 0.25), _or(real_range, 50.0)
    mixed = None if real is None else RealFrames(real, range_m, share)
    path = train(Training(dataset, out, network, recipe, start, mixed, mean), errors)
    if Dataset(dataset).samples("val"):
        errors.print("measuring it on the networks kept for validation")
        (name,) = detectors_of(network)
        describe(path, {"ap40_val": figures_of(dataset, name, path, "val")})
    else:
        errors.print(f"not measured: {dataset} keeps no networks for validation")
    console.print(f"wrote {path}", highlight=False, soft_wrap=True)


def _or(given: float | None, default: float) -> float:
    return default if given is None else given


class TrackFormat(StrEnum):
    """Format of tracks to read."""

    run = "run"
    kitti = "kitti"


@learn_app.command("eval")
def eval_command(  # noqa: PLR0913 - one parameter per option of the command
    dataset: Annotated[
        Path | None, typer.Argument(help="a folder that `cpnet dataset` wrote")
    ] = None,
    *,
    net: Annotated[Path | None, typer.Option(help="instead: your own .net.xml")] = None,
    tls: Annotated[list[str] | None, typer.Option(help="id of the signal in that net")] = None,
    kitti: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="instead: velodyne/, label_2/, calib/ as KITTI has them"),
    ] = None,
    range_: Annotated[
        float | None, typer.Option("--range", metavar="M", help="with --kitti; 80 if not given")
    ] = None,
    detectors: Annotated[
        str, typer.Option(metavar="NAME,...", help=f"of {', '.join(DETECTORS.builtin)}")
    ] = "fast",
    split: Annotated[str, typer.Option(help="of the dataset: train, val or test")] = "test",
    samples: Annotated[int, typer.Option(min=1, max=500, help="of your own net")] = 12,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="a key of `edge`")
    ] = None,
    tracks: Annotated[
        Path | None,
        typer.Option(metavar="RUN", help="instead: the tracks of a run, or of files, see --format"),
    ] = None,
    form: Annotated[
        TrackFormat, typer.Option("--format", help="of --tracks: a run, or files as KITTI's")
    ] = TrackFormat.run,
    truth: Annotated[
        Path | None, typer.Option(metavar="DIR", help="label files of --format kitti")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure detectors beside the truth, AP40 and recall, or tracks, HOTA, IDF1 and MOTA."""
    if tracks is not None:
        if dataset is not None or net is not None:
            raise ConfigError("--tracks measures a run: give neither a dataset nor --net")
        _show_tracks(tracks, form, truth, as_json=as_json)
        return
    if truth is not None:
        raise ConfigError("--truth goes with --tracks DIR --format kitti")
    from cpnet.evaluation import Source, detectors_of
    from studies.evaluate import evaluate
    from studies.evaluation_tables import print_evaluation

    names = detectors_of(detectors)
    config = scenarios.load("t_junction", assigned(set_)).edge
    for name in names:
        check_detector(name)
        check(config.model_copy(update={"detector": name}))
    if kitti is not None:
        if dataset is not None or net is not None:
            raise ConfigError("give a dataset, --net or --kitti, one of them")
        _eval_kitti(kitti, names, config, 80.0 if range_ is None else range_, as_json=as_json)
        return
    if range_ is not None:
        raise ConfigError("--range is for --kitti DIR")
    count, listed = Source(dataset, net, one_signal(tls), split, samples).open(config)
    shown = track(listed, "measuring", count, console=errors, transient=True)
    rows = evaluate(shown, names)
    show(rows, print_evaluation, as_json=as_json)


def _eval_kitti(
    folder: Path,
    names: Sequence[DetectorName],
    config: EdgeConfig,
    range_m: float,
    *,
    as_json: bool,
) -> None:
    from learning.kitti_object import kitti_frames
    from studies.evaluation_tables import print_kitti
    from studies.kitti_eval import evaluate_kitti

    if not 5 <= range_m <= MOST_RANGE_M:
        raise ConfigError(f"--range {range_m:g}: must be 5 to {MOST_RANGE_M:g} m")
    frames = kitti_frames(folder)
    shown = track(frames, "measuring", console=errors, transient=True)
    show(evaluate_kitti(shown, names, config, range_m), print_kitti, as_json=as_json)


def _show_tracks(tracks: Path, form: TrackFormat, truth: Path | None, *, as_json: bool) -> None:
    """Measures tracks and prints the result."""
    from studies.tracking import print_measures

    found: RunTracks | KittiScore
    if form is TrackFormat.kitti:
        from studies.kitti_tracking import score_files

        if truth is None:
            raise ConfigError("--format kitti: give the folder of the labels, --truth DIR")
        found = score_files(tracks, truth)
    else:
        from studies.run_tracks import evaluate_run

        if truth is not None:
            raise ConfigError("--truth goes with --format kitti; a run holds its own")
        found = evaluate_run(tracks)
    if as_json:
        typer.echo(json.dumps(found.as_json(), indent=2))
    else:
        print_measures(found.as_text(), console)


@learn_app.command("track")
def track_command(
    detections: Annotated[Path, typer.Argument(help="a folder with a .txt file a sequence")],
    *,
    form: Annotated[TrackFormat, typer.Option("--format", help="of the files")] = TrackFormat.kitti,
    poses: Annotated[
        Path | None, typer.Option(metavar="PATH", help="the car's poses: a file a sequence")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="tracks; default DETECTIONS-tracks")
    ] = None,
    rate: Annotated[float, typer.Option(min=0.1, max=1000, help="frames a second")] = 10.0,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="of `edge.tracking`")
    ] = None,
) -> None:
    """Track detections in KITTI's tracking format, without a map; tracks are in it, too."""
    from studies.kitti_tracking import track_files

    if form is not TrackFormat.kitti:
        raise ConfigError("--format: must be kitti; the edge itself tracks a run's vehicles")
    folder = out or detections.with_name(f"{detections.resolve().name}-tracks")
    config = scenarios.load("t_junction", assigned(set_)).edge.tracking
    written = track_files(detections, folder, poses, rate, config)
    console.print(f"wrote {len(written)} files in {folder}", highlight=False, soft_wrap=True)
