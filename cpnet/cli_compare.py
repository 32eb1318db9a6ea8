"""`cpnet compare`: what LiDAR is worth at one's own junctions, in one command."""

from __future__ import annotations

import json
import re
import shlex
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import BarColumn, Progress, TextColumn

from cpnet.cli_options import AsJson, Override, assigned, console, errors, junctions_of
from cpnet.cli_study import REPORT, explained_if_missing, seeds_of
from cpnet.compiling import compile_ahead
from cpnet.study_cells import resolved
from protocol.errors import ConfigError

compare_app = typer.Typer()
_KNOWN_RUNS = 5  # from which the time of others is estimated
_SCENARIO = "t_junction"  # whose defaults apply to keys that no option sets


@compare_app.command("compare")
def compare_command(  # noqa: PLR0913 - one parameter per option of the command
    *,
    net: Annotated[Path | None, typer.Option(help="your own .net.xml")] = None,
    tls: Annotated[
        list[str] | None, typer.Option(metavar="ID,...|all", help="the signals to control")
    ] = None,
    sumocfg: Annotated[
        Path | None, typer.Option(help="your own .sumocfg, with a net and a demand")
    ] = None,
    routes: Annotated[Path | None, typer.Option(help="with --net: your own .rou.xml")] = None,
    demand: Annotated[
        float | None,
        typer.Option(metavar="VPH", help="with --net: vehicles per hour and lane, one signal"),
    ] = None,
    posts: Annotated[
        str, typer.Option(metavar="all|none|ID,...", help="signals with a roadside LiDAR")
    ] = "all",
    cav_rate: Annotated[
        float, typer.Option(min=0, max=1, help="share of CAVs; 0.05 is 5 %")
    ] = 0.05,
    seeds: Annotated[
        str, typer.Option(metavar="N,...", help="paired; five give intervals")
    ] = "1-3",
    duration: Annotated[int, typer.Option(min=60, max=86400, help="simulated s of a run")] = 600,
    warmup: Annotated[
        int, typer.Option(min=0, max=7200, help="before it, on the net's plan")
    ] = 120,
    tuning: Annotated[
        int, typer.Option(min=0, max=86400, help="simulated s of a run that tunes; 0: untuned")
    ] = 600,
    frame_period: Annotated[
        float, typer.Option(metavar="S", help="between scans, and between decisions")
    ] = 1.0,
    set_: Override = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, max=512, help="runs at a time; default one a core")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="results; default runs/compare-NAME")] = None,
    markdown: Annotated[
        Path | None, typer.Option(help="the page as Markdown too, charts beside it")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compare fixed plans and loops with LiDAR on posts, on CAVs and on both, at your junctions."""
    with explained_if_missing():
        from recording.database import versions
        from studies.compare import run_comparison, weights
        from studies.compare_page import as_json as json_of
        from studies.compare_page import compare_page, print_comparison_table
        from studies.compare_question import Question, prepare
        from studies.page.write import check_target, save_html, save_markdown
        from studies.sweep.cluster import usable_cores
    listed = [one.strip() for one in posts.split(",")]
    question = Question(
        net=net,
        sumocfg=sumocfg,
        routes=routes,
        demand_vph=demand,
        tls=junctions_of(tls),
        posts=posts if posts in ("all", "none") else listed,
        cav_rate=cav_rate,
        seeds=tuple(seeds_of(seeds)),
        duration_s=duration,
        warmup_s=warmup,
        tuning_s=tuning,
        frame_period_s=frame_period,
        settings=assigned(set_),
    )
    question.check()
    if markdown is not None:
        check_target(markdown, "--markdown")
    name = _name(sumocfg or net)
    folder = (out or Path("runs") / f"compare-{name}").absolute()
    _make(folder)

    def resolve(settings: dict[str, Any]) -> dict[str, Any]:
        return resolved(_SCENARIO, settings)

    comparison = prepare(question, folder, name, resolve)
    compile_ahead(errors)
    with CompareProgress(weights(comparison)) as progress:
        processes = jobs or len(usable_cores())
        variants = run_comparison(comparison, folder, processes, progress.report, resolve)
    page = compare_page(comparison, variants, shlex.join(["cpnet", *sys.argv[1:]]), versions())
    save_html(page, folder / REPORT)
    if markdown is not None:
        save_markdown(page, markdown)
    if as_json:
        typer.echo(json.dumps(json_of(comparison, variants), indent=2))
        return
    print_comparison_table(comparison, variants, console)
    console.print(f"wrote {folder / REPORT}", highlight=False, soft_wrap=True)


def _name(file: Path | None) -> str:
    return re.sub(r"[^A-Za-z0-9_-]", "_", file.name.split(".")[0] if file else "")[:60] or "own"


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(
            f"--out {folder}: must be a folder that can be made ({error.strerror})"
        ) from None


class CompareProgress:
    """A bar with the time left on a terminal, a line for each run elsewhere."""

    def __init__(self, stages: dict[str, tuple[int, float]]) -> None:
        self._stages = stages
        self._total = sum(count * work for count, work in stages.values())
        self._names = iter(stages)
        self._name = ""
        self._before = self._kept = self._done = 0.0
        self._runs = 0
        self._begun_ns = time.monotonic_ns()
        self._bar = Progress(
            TextColumn("{task.fields[stage]}"),
            BarColumn(bar_width=20),
            TextColumn("{task.fields[left]}"),
            TextColumn("{task.description}", markup=False),
            console=errors,
            transient=True,
            disable=not errors.is_terminal,
        )
        self._task = self._bar.add_task("", total=self._total, stage="", left="")

    def __enter__(self) -> CompareProgress:
        self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._bar.stop()
        if kind is KeyboardInterrupt:
            errors.print("stopped; finished runs are kept: the same command goes on with the rest")

    def report(self, done: int, total: int, last: str) -> None:
        """Updates after a run is done; without a name, when a stage begins."""
        if not last:
            if self._name:
                count, work = self._stages[self._name]
                self._before += count * work
            self._name = next(self._names)
        _, work = self._stages[self._name]
        self._done = self._before + done * work
        if last:
            self._runs += 1
        else:
            self._kept += done * work
        stage = f"{self._name} {done}/{total}"
        self._bar.update(
            self._task, completed=self._done, stage=stage, left=self._left(), description=last
        )
        if last and not errors.is_terminal:
            text = f"{stage}  {last}  {self._left()}"
            errors.print(text, markup=False, highlight=False, soft_wrap=True)

    def _left(self) -> str:
        from studies.sweep.engine import duration

        own = self._done - self._kept
        if own <= 0 or self._runs < _KNOWN_RUNS:
            return ""
        each_s = (time.monotonic_ns() - self._begun_ns) / 1e9 / own
        return f"about {duration(each_s * (self._total - self._done))} left"
