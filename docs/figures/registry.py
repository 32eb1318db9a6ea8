"""All figures of README and docs: command, what code it measures, minutes, where it is shown."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from scipy.stats import t as student_t

Rows = list[dict[str, Any]]
Table = list[list[str]]  # the first row is the head

AGENTS = ("protocol", "sensing", "vehicle_agent", "infra_agent", "sim_host")
PERCEPTION = ("perception", "edge_server")
SYSTEM = (
    *AGENTS,
    *PERCEPTION,
    "signal_controller",
    "link_relay",
    "recording",
    "cpnet/supervisor.py",
)
STUDY = (*SYSTEM, "studies", "learning")


@dataclass(frozen=True, slots=True)
class Part:
    """What a page shows of a figure; without a layout it was written by hand and is only kept."""

    name: str
    page: str
    layout: Callable[[Any], Table | str] | None = None


@dataclass(frozen=True, slots=True)
class Figure:
    """A command that prints JSON on stdout, or writes files: whole pages, pictures.

    The shell runs it in `runs/figures`, `$ROOT` is the repository. Without a command it cannot be
    made again by `scripts/figures`.
    """

    name: str
    command: str
    sources: tuple[str, ...]
    minutes: int
    parts: tuple[Part, ...]
    files: tuple[str, ...] = ()
    read: Callable[[str], Any] = field(default=json.loads)

    def digests(self, root: Path) -> dict[str, str]:
        """Returns a hash of each of its files; of pages without the ages put in later."""
        found = {}
        for path in sorted(path for name in self.files for path in root.glob(name)):
            data = path.read_bytes()
            if path.suffix == ".md":
                data = re.sub(rb"\n<!-- figure: .*?<!-- /figure -->\n", b"", data, flags=re.DOTALL)
            found[str(path.relative_to(root))] = hashlib.sha256(data).hexdigest()[:16]
        return found


def _fixed(value: float | None, digits: int, factor: float = 1.0) -> str:
    return "–" if value is None else f"{factor * value:.{digits}f}"


def _uplink(link: str) -> Callable[[Rows], Table]:
    def layout(rows: Rows) -> Table:
        heads = ["kB", "Mbit/s", "mean", "p95", "scans/s", "seen %", "false a frame", "count"]
        return [[_LINKS[link], *heads]] + [
            [
                f"`{row['policy']}`", _fixed(row["bytes_per_frame"], 1, 1e-3),
                _fixed(row["mbps_per_agent"], 2), _fixed(row["latency_ms"]["mean"], 1),
                _fixed(row["latency_ms"]["p95"], 1), _fixed(row["fps"], 1),
                _fixed(row["recall_visible"], 1, 100), _fixed(row["false_per_frame"], 1),
                _fixed(row["count_error"], 2),
            ]
            for row in rows if row["link"] == link
        ]  # fmt: skip

    return layout


_LINKS = {
    "5mbit": "5 Mbit/s",
    "lte": "LTE, 6 Mbit/s on average, round trip 50 ms",
    "5g-urban": "urban 5G, 50 Mbit/s on average, round trip 16 ms",
}
_WAYS_TO_UPLOAD = {
    "full": "whole scans to the edge",
    "reap+foreground": "`reap` with `foreground` (EMP's scheme, without ground and background)",
    "objects": "boxes, detected on the agents",
    "sharing": "no edge: everybody hears everybody and detects alone",
}


def _uplink_readme(rows: Rows) -> Table:
    by_policy = {row["policy"]: row for row in rows if row["link"] == "5mbit"}
    table = [["", "bytes a frame", "mean latency", "visible vehicles detected"]]
    for policy, words in _WAYS_TO_UPLOAD.items():
        row = by_policy[policy]
        size = f"{_fixed(row['bytes_per_frame'], 1, 1e-3)} kB"
        latency = f"{_fixed(row['latency_ms']['mean'], 0)} ms"
        table.append([words, size, latency, f"{_fixed(row['recall_visible'], 1, 100)} %"])
    return table


def _rates(rows: Rows) -> Table:
    table = [["policy", "at 10 frames/s, mean / p95", "highest rate kept up with"]]
    for policy in dict.fromkeys(row["policy"] for row in rows):
        own = [row for row in rows if row["policy"] == policy]
        ms = own[0]["latency_ms"]
        best_hz = max((row["rate_hz"] for row in own if row["is_sustained"]), default=0)
        latency = f"{_fixed(ms['mean'], 0)} / {_fixed(ms['p95'], 0)} ms"
        table.append([f"`{policy}`", latency, f"{best_hz:g} frames/s"])
    return table


def _emulated(runs: Rows) -> Table:
    table = [["", "p50", "p95"]]
    for name, run in zip(("virtual", "emulated"), runs, strict=True):
        link = run["latency_ms"]["link"]
        table.append([name, _fixed(link["p50"], 1), _fixed(link["p95"], 1)])
    return table


def _beside_draco(rows: Rows) -> Iterable[tuple[str, str, list[tuple[float, float, float]]]]:
    """Yields Draco's bits, a profile, and its ratios of bytes and times on each cloud."""
    draco = {(r["cloud"], r["bound_m"]): r for r in rows if r["codec"].startswith("draco")}
    groups: dict[tuple[str, str], list[tuple[float, float, float]]] = {}
    for row in rows:
        other = draco.get((row["cloud"], row["bound_m"]))
        if other is not None and other is not row:
            ratios = (
                row["bytes"] / other["bytes"],
                other["encode_ms"] / row["encode_ms"],
                other["decode_ms"] / row["decode_ms"],
            )
            groups.setdefault((other["codec"].removeprefix("draco-"), row["codec"]), []).append(
                ratios
            )
    yield from ((bits, codec, ratios) for (bits, codec), ratios in groups.items())


def _codec(rows: Rows) -> Table:
    table = [["bits of Draco", "profile", "bytes / Draco", "worst", "encode x Draco", "worst",
              "decode x Draco", "worst"]]  # fmt: skip
    for bits, codec, ratios in _beside_draco(rows):
        cells = []
        for values, worst in zip(zip(*ratios, strict=True), (max, min, min), strict=True):
            cells += [_fixed(sum(values) / len(values), 2), _fixed(worst(values), 2)]
        table.append([bits, f"`{codec}`", *cells])
    return table


def _codec_floor(rows: Rows) -> Table:
    table = [["cloud", "`default` bits/point", "x noise", "x noise and losses"]]
    for row in rows:
        noise = row["noise_floor_bits"]
        if noise and row["codec"] == "default" and row["bound_m"] == 0.01:
            both, bits = noise + (row["loss_floor_bits"] or 0), row["bits_per_point"]
            table.append(
                [row["cloud"], _fixed(bits, 2), _fixed(bits / noise, 2), _fixed(bits / both, 2)]
            )
    return table


_CLOUDS = {"none": "one scan", "early": "merged", "late": "each scan, then fused"}
_CELLS = (("bev", 0.01), ("bev", 0.1), ("bev", 0.5), ("bev", 0.7), ("3d", 0.1), ("3d", 0.5))


def _visible(rows: Rows) -> dict[tuple[str, str, bool], dict[tuple[str, float], dict[str, Any]]]:
    """Returns rows of all visible vehicles by detector, cloud and geofence, then view and IoU."""
    found: dict[tuple[str, str, bool], dict[tuple[str, float], dict[str, Any]]] = {}
    for row in rows:
        if row["part"] == "all" and row["truth"] == "visible":
            key = row["detector"], _CLOUDS[row["fusion"]], row["geofence"]
            found.setdefault(key, {})[row["view"], row["iou"]] = row
    return found


def _accuracy(rows: Rows) -> Table:
    heads = ["BEV 0.01", "0.1", "0.5", "0.7", "3D 0.1", "0.5", "recall", "precision"]
    table = [["detector", "cloud", "geofence", *heads]]
    order = {cloud: place for place, cloud in enumerate(_CLOUDS.values())}
    lines = _visible(rows)
    for key in sorted(lines, key=lambda k: (k[0], order[k[1]], not k[2])):
        detector, cloud, geofence = key
        cells = lines[key]
        at = cells["bev", 0.1]
        figures = [_fixed(cells[cell]["ap40"], 1, 100) for cell in _CELLS]
        figures += [_fixed(at["recall"], 1, 100), _fixed(at["precision"], 1, 100)]
        table.append([f"`{detector}`", cloud, "yes" if geofence else "no", *figures])
    return table


def _city(rows: Rows) -> Table:
    """Returns a line for each net and control; differences are paired by seed, 95 % intervals."""
    seen, *others = dict.fromkeys(row["control"] for row in rows)
    heads = ["delay, s", "perception saves, s", "E-CVPR, %", "count error", "Mbit/s"]
    table = [["net", "control", "seeds", *heads]]
    for net in dict.fromkeys(row["net"] for row in rows):
        by = {name: {r["seed"]: r for r in rows if (r["net"], r["control"]) == (net, name)}
              for name in (seen, *others)}  # fmt: skip
        for name, own in by.items():
            both = sorted(own.keys() & by[seen].keys())
            gains = [own[seed]["delay_s"] - by[seen][seed]["delay_s"] for seed in both]
            cells = [_interval([row["delay_s"] for row in own.values()], 1)]
            cells.append("" if name == seen else _interval(gains, 1))
            if name == seen:
                cells += [_interval([100 * row["e_cvpr"] for row in own.values()], 1)]
                for key in ("count_error", "uplink_mbps"):
                    cells.append(_interval([row[key] for row in own.values()], 2))
            table.append([net, name, str(len(own)), *cells, *[""] * (len(heads) - len(cells))])
    return table


def _interval(values: list[float], digits: int) -> str:
    """Returns the mean with half the width of its 95 % interval, Student's t."""
    if len(values) < 2:
        return _fixed(mean(values), digits) if values else "–"
    half = float(student_t.ppf(0.975, len(values) - 1)) * stdev(values) / len(values) ** 0.5
    return f"{_fixed(mean(values), digits)} ± {_fixed(half, digits)}"


def _totals(rows: Rows) -> dict[tuple[str, int], dict[str, Any]]:
    return {(r["detector"], r["agents"]): r for r in rows if r["stage"] == "total"}


def _edge(rows: Rows) -> Table:
    totals = _totals(rows)
    detectors = list(dict.fromkeys(name for name, _ in totals))
    table = [["agents", "points", *(f"`{name}`" for name in detectors)]]
    for agents in dict.fromkeys(agents for _, agents in totals):
        own = [totals[name, agents] for name in detectors]
        table.append([str(agents), str(own[0]["points"]), *(_fixed(r["ms_p50"], 1) for r in own)])
    return table


def _misbehaviour(rows: Rows) -> Table:
    heads = [["what one agent sends"]]
    lines: dict[str, list[str]] = {}
    for rate in dict.fromkeys(row["cav_rate"] for row in rows):
        heads[0] += [f"{100 * rate:g} % CAVs: detected", "after, s"]
        for row in rows:
            if row["cav_rate"] == rate:
                after = "" if row["after_s"] is None else _fixed(row["after_s"], 1)
                cells = [f"{row['found']} of {row['tried']}", after]
                lines.setdefault(row["attack"], []).extend(cells)
    return heads + [[attack, *cells] for attack, cells in lines.items()]


def _recorder(rows: Rows) -> Table:
    row = rows[0]
    tables = row["gb_by_table"]
    shown = [f"`{name}` {_fixed(tables[name], 2)}" for name in _LARGE]
    return [
        ["junctions, regions, agents, vehicles", "frames/s", "core-ms a frame", "GB/h", "of these"],
        [
            ", ".join(str(row[key]) for key in ("junctions", "regions", "agents", "vehicles")),
            _fixed(row["frames_per_s"], 1), _fixed(row["core_ms"], 0),
            _fixed(row["gb_per_hour"], 2), ", ".join(shown),
        ],
    ]  # fmt: skip


_LARGE = ("detections", "truth", "sightings", "counts", "stages")


def _run_readme(data: dict[str, Any]) -> Table:
    run = data["summary"]
    ms, factor = run["latency_ms"]["end_to_end"], _fixed(run["real_time_factor"], 2)
    latency = f"{_fixed(ms['p50'], 0)} / {_fixed(ms['p95'], 0)} ms"
    mbps = mean(agent["mbps"] for agent in run["agents"].values())
    return [
        ["", "cpnet", "published"],
        ["real-time factor, sensors, edge and SUMO together", factor, "–"],
        ["sensing to signal, median / p95", latency, "93 ms mean (EMP, without detection)"],
        ["uplink per agent, whole scans at 2 cm error", f"{_fixed(mbps, 1)} Mbit/s", "–"],
    ]


def _run_text(data: dict[str, Any]) -> str:
    """Returns the head of the summary, its end-to-end latency and the first agents."""
    lines = data["text"].strip().split("\n")
    end = next(i for i, line in enumerate(lines) if "end to end" in line)
    agents = next(i for i, line in enumerate(lines) if line.startswith(" agent "))
    shown = [*lines[:10], " …", lines[end], "", *lines[agents : agents + 4], " …", *lines[-2:]]
    return "\n".join(["```", *shown, "```"])


def _text(data: dict[str, str]) -> str:
    return data["text"].strip()


def _as_text(output: str) -> dict[str, str]:
    return {"text": output}


def _summary_and_text(output: str) -> dict[str, Any]:
    summary, text = output.split("\f")
    return {"summary": json.loads(summary), "text": text}


_RESCO = (
    'for net in cologne3 ingolstadt7; do [ -e resco/$net ] || { echo "runs/figures/resco/$net is '
    "missing: a folder of RESCO's nets\" >&2; exit 1; }; done; "
)
_RUN = "cpnet up t_junction --cav-rate 0.05 --duration 120 --seed 1"
_SOAK = " ".join(
    f"--set lidar.{kind}.{key}"
    for key in ("channels=16", "points_per_second=288000")
    for kind in ("vehicle", "roadside")
)
_LIST = (
    Figure(
        "run",
        f"rm -rf run; {_RUN} --out run >&2; "
        "cpnet report run --json; printf '\\f'; cpnet report run",
        SYSTEM,
        2,
        (Part("text", "README.md", _run_text), Part("table", "README.md", _run_readme)),
        read=_summary_and_text,
    ),
    Figure(
        "codec",
        "cpnet bench codec --json",
        ("protocol/codec", "sensing", "studies/bench_codec.py"),
        2,
        (
            Part("draco", "docs/codec.md", _codec),
            Part("floor", "docs/codec.md", _codec_floor),
        ),
    ),
    Figure(
        "uplink",
        "cpnet bench uplink --json",
        (*SYSTEM, "studies/bench_uplink.py", "studies/bench_sharing.py"),
        15,
        (
            *(Part(link, "docs/uplink.md", _uplink(link)) for link in _LINKS),
            Part("readme", "README.md", _uplink_readme),
        ),
    ),
    Figure(
        "rate",
        "cpnet bench rate --json",
        (*SYSTEM, "studies/bench_uplink.py"),
        5,
        (Part("highest", "docs/uplink.md", _rates),),
    ),
    Figure(
        "emulated",
        "rm -rf virtual emulated; run='cpnet up --link 5mbit,20ms --cav-rate 0.05 "
        "--duration 12 --set upload.filters=[foreground]'; $run --mode lockstep --out virtual >&2; "
        "$run --mode realtime --out emulated >&2; "
        "echo '['; cpnet report virtual --json; echo ','; cpnet report emulated --json; echo ']'",
        SYSTEM,
        1,
        (Part("link", "docs/uplink.md", _emulated),),
    ),
    Figure(
        "edge",
        "cpnet bench edge --agents 1,2,4,6,8,16 --frames 8 --json",
        (*PERCEPTION, "protocol", "studies/bench_edge.py"),
        8,
        (Part("all", "docs/detection.md", _edge),),
    ),
    Figure(
        "recorder",
        "cpnet bench recorder --json",
        ("protocol", "recording", "studies/bench_recorder.py"),
        1,
        (Part("all", "docs/running.md", _recorder),),
    ),
    Figure(
        "accuracy",
        "[ -e data100 ] || cpnet dataset data100 --networks 100 --samples 10 --seed 1 >&2; "
        "cpnet eval data100 --detectors fast,pointpillars --json",
        (*PERCEPTION, "sensing", "learning", "studies/evaluate.py", "studies/average_precision.py"),
        40,
        (Part("all", "docs/detection.md", _accuracy),),
    ),
    Figure(
        "reference",
        "[ -e data20 ] || cpnet dataset data20 --networks 20 --samples 2 --seed 6 >&2; "
        "cpnet eval data20 --detectors fast,reference --json",
        (*PERCEPTION, "sensing", "learning", "studies/evaluate.py", "studies/average_precision.py"),
        10,
        (Part("all", "docs/detection.md", _accuracy),),
    ),
    Figure(
        "misbehaviour",
        "$ROOT/scripts/misbehaviour --seconds 30 --set traffic.cv_rate=0.05 --json",
        (*AGENTS, *PERCEPTION, "tests/misbehaviour"),
        10,
        (Part("all", "docs/reliability.md", _misbehaviour),),
    ),
    Figure(
        "soak",
        f"$ROOT/scripts/soak --minutes 30 --kills 200 --seed 1 --out soak {_SOAK} "
        "--markdown soak.md >&2; cat soak.md",
        (*SYSTEM, "tests/soak"),
        31,
        (Part("all", "docs/reliability.md", _text),),
        read=_as_text,
    ),
    Figure(
        "paper",
        "cpnet study paper --out paper --markdown $ROOT/docs/results.md",
        STUDY,
        90,
        (Part("age", "docs/results.md"),),
        files=("docs/results.md", "docs/results/*.png"),
    ),
    Figure(
        "bandwidth",
        "cpnet study bandwidth --seeds 1 --out bandwidth --markdown $ROOT/docs/bandwidth.md",
        STUDY,
        60,
        (Part("age", "docs/bandwidth.md"),),
        files=("docs/bandwidth.md", "docs/bandwidth/*.png"),
    ),
    Figure(
        "frame",
        f"rm -rf frame; {_RUN} --out frame >&2; "
        "cpnet draw frame --frame 1100 --png $ROOT/docs/frame.png",
        (*SYSTEM, "studies/frame_picture.py", "studies/snapshot.py"),
        3,
        (),
        files=("docs/frame.png",),
    ),
    Figure(
        "city",
        f"{_RESCO}cpnet study $ROOT/docs/figures/city.yaml --out city >&2; "
        "python -c 'import json, pyarrow.parquet as p; "
        'print(json.dumps(p.read_table("city/results.parquet").to_pylist()))\'',
        STUDY,
        60,
        (Part("control", "docs/city.md", _city),),
    ),
    # By hand: from the pages of the studies, from a browser.
    Figure("paper-readme", "", STUDY, 0, (Part("table", "README.md"),)),
    Figure("bandwidth-readme", "", STUDY, 0, (Part("table", "README.md"),)),
    Figure("view", "", ("viewer",), 0, (), files=("docs/view.png",)),
)
FIGURES = {figure.name: figure for figure in _LIST}
