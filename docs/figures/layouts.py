"""How figures are laid out: from what a command measured to the table or text that a page shows."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import product
from statistics import mean, stdev
from typing import Any

from scipy.stats import t as student_t

Rows = list[dict[str, Any]]
Table = list[list[str]]  # the first row is the head


def _fixed(value: float | None, digits: int, factor: float = 1.0) -> str:
    return "–" if value is None else f"{factor * value:.{digits}f}"


def uplink(link: str) -> Callable[[Rows], Table]:
    """Returns the layout of upload policies on one link."""

    def layout(rows: Rows) -> Table:
        heads = ["kB", "Mbit/s", "mean", "p95", "scans/s", "seen %", "false a frame", "count"]
        return [[LINKS[link], *heads]] + [
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


LINKS = {
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


def uplink_readme(rows: Rows) -> Table:
    """Returns the README's table of ways to upload."""
    by_policy = {row["policy"]: row for row in rows if row["link"] == "5mbit"}
    table = [["", "bytes a frame", "mean latency", "visible vehicles detected"]]
    for policy, words in _WAYS_TO_UPLOAD.items():
        row = by_policy[policy]
        size = f"{_fixed(row['bytes_per_frame'], 1, 1e-3)} kB"
        latency = f"{_fixed(row['latency_ms']['mean'], 0)} ms"
        table.append([words, size, latency, f"{_fixed(row['recall_visible'], 1, 100)} %"])
    return table


def uplink_emp(rows: Rows) -> Table:
    """Returns the latency of EMP's scheme on mobile networks, beside the published one."""
    by_link = {row["link"]: row for row in rows if row["policy"] == "reap+foreground"}
    table = [["sensing to signal", "mean, ms", "p95, ms"]]
    for link in ("lte", "5g-urban"):
        ms = by_link[link]["latency_ms"]
        words = f"`reap+foreground` on {LINKS[link]}"
        table.append([words, _fixed(ms["mean"], 0), _fixed(ms["p95"], 0)])
    return [*table, ["EMP, as published, over a cellular network, without detection", "93", "–"]]


def rates(rows: Rows) -> Table:
    """Returns the highest frame rate of each policy."""
    table = [["policy", "at 10 frames/s, mean / p95", "highest rate kept up with"]]
    for policy in dict.fromkeys(row["policy"] for row in rows):
        own = [row for row in rows if row["policy"] == policy]
        ms = own[0]["latency_ms"]
        best_hz = max((row["rate_hz"] for row in own if row["is_sustained"]), default=0)
        latency = f"{_fixed(ms['mean'], 0)} / {_fixed(ms['p95'], 0)} ms"
        table.append([f"`{policy}`", latency, f"{best_hz:g} frames/s"])
    return table


def emulated(runs: Rows) -> Table:
    """Returns link latency by kind of link."""
    table = [["", "p50", "p95"]]
    for name, run in zip(("virtual", "emulated"), runs, strict=True):
        link = run["latency_ms"]["link"]
        table.append([name, _fixed(link["p50"], 1), _fixed(link["p95"], 1)])
    return table


def lossy(rows: Rows) -> Table:
    """Returns mean and p95 of delay over lossy paths: the kernel's TCP and both of ours."""
    forms = ("kernel", "virtual", "emulated")
    heads = [f"{form}, mean / p95, ms" for form in forms]
    table = [["link", "message", "every", *heads]]
    for row in rows:
        cells = [
            f"{_fixed(row[form]['mean_ms'], 1)} / {_fixed(row[form]['p95_ms'], 1)}"
            for form in forms
        ]
        size, period = f"{row['size_bytes'] / 1e3:g} kB", f"{row['period_s']:g} s"
        table.append([f"`{row['link']}`", size, period, *cells])
    return table


def codec_kinds(rows: Rows) -> Table:
    """Returns bits a point and the share of Draco's bytes by kind of sensor, and speeds."""
    bounds = sorted({row["bound_m"] for row in rows if row["codec"] == "draco"})
    heads = [f"{100 * bound:g} cm, bits / of Draco" for bound in bounds]
    table = [["cloud", "points", *heads, "encode x Draco", "decode x Draco"]]
    for kind in ("simulated", "file"):
        own = [row for row in rows if row["kind"] == kind]
        for cloud in dict.fromkeys(row["cloud"] for row in own):
            pairs = [_beside_draco(own, cloud, bound, "default") for bound in bounds]
            cells = [
                f"{_fixed(row['bits_per_point'], 2)} / {_fixed(row['bytes'] / draco['bytes'], 2)}"
                for row, draco in pairs
            ]
            table.append([cloud, str(pairs[0][0]["points"]), *cells, *_speeds(pairs)])
    return table


def _beside_draco(
    rows: Rows, cloud: str, bound_m: float, codec: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns the row of a codec and Draco's."""
    same = {r["codec"]: r for r in rows if r["cloud"] == cloud and r["bound_m"] == bound_m}
    return same[codec], same["draco"]


def _speeds(pairs: list[tuple[dict[str, Any], dict[str, Any]]]) -> list[str]:
    """Returns the least and the largest speed of encoding and decoding beside Draco's."""
    cells = []
    for step in ("encode_ms", "decode_ms"):
        ratios = [draco[step] / row[step] for row, draco in pairs]
        cells.append(f"{_fixed(min(ratios), 1)} to {_fixed(max(ratios), 1)}")
    return cells


_CODECS = {
    "default": "`default`", "fast": "`fast`", "draco": "Draco", "jpeg-xl": "JPEG XL, mask",
    "jpeg-ls": "JPEG-LS, mask",
}  # fmt: skip


def codec_scans(rows: Rows) -> Table:
    """Returns bits a point of structured scans by codec, means over the scans."""
    own = [row for row in rows if row["kind"] == "structured"]
    clouds = list(dict.fromkeys(row["cloud"] for row in own))
    bounds = sorted({row["bound_m"] for row in own if row["codec"] == "draco"})
    table = [["codec", *(f"{100 * bound:g} cm" for bound in bounds), "encode x Draco",
              "decode x Draco"]]  # fmt: skip
    for codec, name in _CODECS.items():
        if not any(row["codec"] == codec for row in own):
            continue
        pairs = [_beside_draco(own, cloud, bound, codec) for bound in bounds for cloud in clouds]
        bits = [
            _fixed(mean(row["bits_per_point"] for row, _ in pairs if row["bound_m"] == bound), 2)
            for bound in bounds
        ]
        table.append([name, *bits, *_speeds(pairs)])
    return table


def codec_floor(rows: Rows) -> Table:
    """Returns bits a point beside the noise that they must hold."""
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
        is_vehicle = row.get("objects", "vehicle") == "vehicle"
        if is_vehicle and row["part"] == "all" and row["truth"] == "visible":
            key = row["detector"], _CLOUDS[row["fusion"]], row["geofence"]
            found.setdefault(key, {})[row["view"], row["iou"]] = row
    return found


def accuracy(rows: Rows) -> Table:
    """Returns average precision, recall and precision by detector."""
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


_OBJECTS = {
    "vehicle": "vehicles, whatever they are called",
    "car": "cars, vans",
    "truck": "lorries, buses",
    "two_wheeler": "two-wheelers",
    "pedestrian": "pedestrians",
}
_BY_CLASS: tuple[tuple[str, float], ...] = tuple(product(("visible", "all"), (0.1, 0.5, 0.7)))


def accuracy_by_class(rows: Rows) -> Table:
    """Returns average precision by class, of merged clouds inside the geofence, from above."""
    heads = [f"{truth}, {iou:g}" for truth, iou in _BY_CLASS]
    table = [["detector", "objects", "visible", *heads]]
    for detector in dict.fromkeys(row["detector"] for row in rows):
        for name, words in _OBJECTS.items():
            cells = {
                (row["truth"], row["iou"]): row
                for row in rows
                if (row["detector"], row["fusion"], row["view"]) == (detector, "early", "bev")
                and (row["part"], row["geofence"], row["objects"]) == ("all", True, name)
            }
            figures = [_with_half(cells[cell]) for cell in _BY_CLASS]
            count = str(cells["visible", 0.1]["vehicles"])
            table.append([f"`{detector}`", words, count, *figures])
    return table


def _with_half(row: dict[str, Any]) -> str:
    """Returns AP40 and half of its interval over networks, in per cent."""
    if row["ap40"] is None:
        return ""
    half = row["ap40_half"]
    found = _fixed(row["ap40"], 1, 100)
    return found if half is None else f"{found} ± {_fixed(half, 1, 100)}"


def city(rows: Rows) -> Table:
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


def city_runs(runs: dict[str, dict[str, Any]]) -> Table:
    """Returns a line for each whole run of a net."""
    heads = ["junctions", "regions", "agents a frame", "real-time factor", "latency p50 / p95, ms"]
    table = [["net", *heads, "E-CVPR, %", "delay, s", "Mbit/s in all"]]
    for net, run in runs.items():
        ms = run["latency_ms"]["end_to_end"]
        table.append(
            [
                net, str(len(run["junctions"])), str(len(run["regions"])),
                _fixed(sum(one["agents"] for one in run["regions"].values()), 1),
                _fixed(run["real_time_factor"], 1),
                f"{_fixed(ms['p50'], 0)} / {_fixed(ms['p95'], 0)}",
                _fixed(run["e_cvpr"]["mean"], 1, 100), _fixed(run["delay_s"]["mean"], 1),
                _fixed(sum(one["mbps"] for one in run["regions"].values()), 1),
            ]
        )  # fmt: skip
    return table


def city_junctions(runs: dict[str, dict[str, Any]]) -> Table:
    """Returns a line for each signal of those runs."""
    table = [["net", "signal", "delay, s", "E-CVPR, %", "switches", "count error"]]
    for net, run in runs.items():
        for tls, one in run["junctions"].items():
            table.append(
                [
                    net, f"`{tls}`", _fixed(one["delay_s"], 1), _fixed(one["e_cvpr"], 1, 100),
                    str(one["switches"]), _fixed(one["count_error"], 2),
                ]
            )  # fmt: skip
    return table


_ROLES = ("vehicle", "infra", "edge", "sim", "record")


def scale(rows: Rows) -> Table:
    """Returns what a frame of an agent costs, a line for each size of a city."""
    heads = [
        "junctions",
        "regions",
        "agents",
        "CAVs",
        "real-time factor",
        "core-ms",
        "to the first",
    ]
    table = [[*heads, *(f"`{role}`" for role in _ROLES), "others", "MB a CAV"]]
    for row in rows:
        by = row["core_ms_by_role"]
        others = sum(value for role, value in by.items() if role not in _ROLES)
        table.append(
            [
                str(row["junctions"]), str(row["regions"]), _fixed(row["agents"], 1),
                _fixed(row["cavs"], 1), _fixed(row["real_time_factor"], 2),
                _fixed(row["core_ms"], 1), _fixed(row["core_ms"] / rows[0]["core_ms"], 2),
                *(_fixed(by[role], 2) for role in _ROLES), _fixed(others, 2),
                _fixed(row["agent_mb"], 1),
            ]
        )  # fmt: skip
    return table


def scale_parts(rows: Rows) -> Table:
    """Returns what casting, encoding and the edge's stages alone take at one junction."""
    row = rows[0]
    parts = row["parts_ms"]
    total = sum(parts.values())
    return [
        [*parts, "together", "of all processes", "ratio"],
        [
            *(_fixed(value, 2) for value in [*parts.values(), total, row["core_ms"]]),
            _fixed(row["core_ms"] / total, 2),
        ],
    ]


def realism(data: dict[str, Rows]) -> Table:
    """Returns a line for each part of realism; what it costs is paired by seed with the first."""
    rows = data["runs"]
    detectors = list(dict.fromkeys(row["detector"] for row in rows))
    first, *_ = parts = list(dict.fromkeys(row["part"] for row in rows))
    heads = ["E-CVPR, %", "lost, points", "of the visible, %", "false boxes a frame"]
    table = [["part", *(f"`{name}`: {head}" for name in detectors for head in heads)]]
    by = {(row["part"], row["detector"], row["seed"]): row for row in rows}
    seeds = sorted({row["seed"] for row in rows})
    for part in parts:
        cells = []
        for name in detectors:
            own = [by[part, name, seed] for seed in seeds]
            plain = [by[first, name, seed] for seed in seeds]
            lost = [100 * (a["e_cvpr"] - b["e_cvpr"]) for a, b in zip(plain, own, strict=True)]
            cells += [
                _fixed(mean(row["e_cvpr"] for row in own), 1, 100),
                "" if part == first else _interval(lost, 1),
                _interval([100 * row["e_cvpr"] / row["visible_share"] for row in own], 1),
                _interval([row["false_detections"] for row in own], 2),
            ]
        table.append([part, *cells])
    return table


def unseen(rows: Rows) -> Table:
    """Returns a line for each detector: means over networks, with 95 % intervals."""
    table = [["detector", "networks", "E-CVPR, %", "of the visible, %", "false boxes a frame"]]
    for name in dict.fromkeys(row["detector"] for row in rows):
        own = [row for row in rows if row["detector"] == name]
        cells = [
            _interval([100 * row["e_cvpr"] for row in own], 1),
            _interval([100 * row["e_cvpr"] / row["visible_share"] for row in own], 1),
            _interval([row["false_detections"] for row in own], 2),
        ]
        table.append([f"`{name}`", str(len(own)), *cells])
    return table


_WORLDS = {
    "paper": "as in Chen et al. (`paper`)",
    "all: hard": "all kinds of traffic, rain (`hard`)",
}


def realism_accuracy(data: dict[str, Rows]) -> Table:
    """Returns AP40 of cars and of trucks for each part of realism."""
    rows = data["accuracy"]
    by = {(row["part"], row["detector"], row["objects"]): row["ap40"] for row in rows}
    kinds = [(name, one) for name in dict.fromkeys(r["detector"] for r in rows) for one in _KINDS]
    table = [["part", *(f"`{name}`: {_KINDS[one]}" for name, one in kinds)]]
    for part in dict.fromkeys(row["part"] for row in rows):
        found = [by[part, *kind] for kind in kinds]
        table.append([part, *("–" if one is None else _fixed(one, 1, 100) for one in found)])
    return table


_KINDS = {"vehicle": "all vehicles", "car": "cars, vans", "truck": "lorries, buses"}


def realism_readme(data: dict[str, Rows]) -> Table:
    """Returns a line for the easiest and the hardest world."""
    rows = data["runs"]
    heads = ["E-CVPR", "of what is visible", "false boxes a frame"]
    detectors = list(dict.fromkeys(row["detector"] for row in rows))
    table = [["world", *(f"`{name}`: {head}" for name in detectors for head in heads)]]
    for part, words in _WORLDS.items():
        cells = []
        for name in detectors:
            own = [row for row in rows if (row["part"], row["detector"]) == (part, name)]
            cells += [
                f"{_fixed(mean(row['e_cvpr'] for row in own), 1, 100)} %",
                f"{_fixed(mean(row['e_cvpr'] / row['visible_share'] for row in own), 1, 100)} %",
                _fixed(mean(row["false_detections"] for row in own), 1),
            ]
        table.append([words, *cells])
    return table


def alignment(rows: Rows) -> Table:
    """Returns a line for each case of poses: means over seeds, differences paired by seed."""
    first, *_ = names = list(dict.fromkeys(row["poses"] for row in rows))
    table = [["poses", "E-CVPR, %", "points lost", "false boxes a frame"]]
    for name in names:
        own = {row["seed"]: row for row in rows if row["poses"] == name}
        base = {row["seed"]: row for row in rows if row["poses"] == first}
        lost = [100 * (base[seed]["e_cvpr"] - own[seed]["e_cvpr"]) for seed in own]
        table.append(
            [
                name,
                _interval([100 * row["e_cvpr"] for row in own.values()], 1),
                "" if name == first else _interval(lost, 1),
                _interval([row["false_detections"] for row in own.values()], 2),
            ]
        )
    return table


def _interval(values: list[float], digits: int) -> str:
    """Returns the mean with half the width of its 95 % interval, Student's t."""
    if len(values) < 2:
        return _fixed(mean(values), digits) if values else "–"
    half = float(student_t.ppf(0.975, len(values) - 1)) * stdev(values) / len(values) ** 0.5
    return f"{_fixed(mean(values), digits)} ± {_fixed(half, digits)}"


def _totals(rows: Rows) -> dict[tuple[str, int], dict[str, Any]]:
    return {(r["detector"], r["agents"]): r for r in rows if r["stage"] == "total"}


def edge(rows: Rows) -> Table:
    """Returns milliseconds of the edge by agents and detector."""
    totals = _totals(rows)
    detectors = list(dict.fromkeys(name for name, _ in totals))
    table = [["agents", "points", *(f"`{name}`" for name in detectors)]]
    for agents in dict.fromkeys(agents for _, agents in totals):
        own = [totals[name, agents] for name in detectors]
        table.append([str(agents), str(own[0]["points"]), *(_fixed(r["ms_p50"], 1) for r in own)])
    return table


def misbehaviour(rows: Rows) -> Table:
    """Returns which attacks are detected, and after how long."""
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


def recorder(rows: Rows) -> Table:
    """Returns what the recorder of a city takes."""
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


def run_readme(data: dict[str, Any]) -> Table:
    """Returns the README's table of a run."""
    run = data["summary"]
    ms, factor = run["latency_ms"]["end_to_end"], _fixed(run["real_time_factor"], 2)
    latency = f"{_fixed(ms['p50'], 0)} / {_fixed(ms['p95'], 0)} ms"
    mbps = mean(agent["mbps"] for agent in run["agents"].values())
    return [
        ["", "cpnet"],
        ["real-time factor, sensors, edge and SUMO together", factor],
        ["sensing to signal, median / p95, over loopback", latency],
        ["uplink per agent, whole scans at 2 cm error", f"{_fixed(mbps, 1)} Mbit/s"],
    ]


def run_text(data: dict[str, Any]) -> str:
    """Returns the head of the summary, its end-to-end latency and the first agents."""
    lines = data["text"].strip().split("\n")
    end = next(i for i, line in enumerate(lines) if "end to end" in line)
    agents = next(i for i, line in enumerate(lines) if line.startswith(" agent "))
    shown = [*lines[:10], " …", lines[end], "", *lines[agents : agents + 4], " …", *lines[-2:]]
    return "\n".join(["```", *shown, "```"])


def text(data: dict[str, str]) -> str:
    """Returns what a command printed."""
    return data["text"].strip()


def as_text(output: str) -> dict[str, str]:
    """Reads what a command printed as it is."""
    return {"text": output}


def summary_and_text(output: str) -> dict[str, Any]:
    """Reads a summary in JSON and what is printed of it, parted by a form feed."""
    summary, text = output.split("\f")
    return {"summary": json.loads(summary), "text": text}


def _lidar(lidar: dict[str, float]) -> list[str]:
    """Returns rings, points a second and range as cells of a table."""
    return [
        f"{lidar['channels']:g}",
        f"{lidar['points_per_second']:,}",
        f"{lidar['range']:g}",
    ]


_LIDAR_HEADS = ["rings", "points/s", "range, m"]


def _between(values: list[float], digits: int) -> str:
    """Returns an interval as `_interval` does; below five values, the values themselves."""
    if len(values) >= LEAST_SEEDS:
        return _interval(values, digits)
    return ", ".join(_fixed(value, digits) for value in sorted(values))


LEAST_SEEDS = 5


def ecvpr_steps(rows: Rows) -> Table:
    """Returns E-CVPR step by step from ours to theirs, each paired by seed with the one before."""
    own = [row for row in rows if row["grid"] == "steps"]
    table = [["each with what stands above it", *_LIDAR_HEADS, "E-CVPR, %", "this step, points",
              "of the visible, %"]]  # fmt: skip
    before: dict[int, float] = {}
    for step in dict.fromkeys(row["step"] for row in own):
        part = [row for row in own if row["step"] == step]
        now = {row["seed"]: 100 * row["e_cvpr"] for row in part}
        change = [now[seed] - before[seed] for seed in now] if before else []
        table.append(
            [
                step,
                *_lidar(part[0]["lidar"]),
                _between([*now.values()], 1),
                _between(change, 1) if change else "",
                _between([100 * row["e_cvpr"] / row["visible_share"] for row in part], 1),
            ]
        )
        before = now
    return table


_THEIRS = {0: (29.9, 31.4), 0.01: (35.4, 35.7), 0.02: (38.3, 37.4), 0.05: (None, 46.6)}


_AS_THEIRS = {
    "`reference`, their DBSCAN and size filter": "as theirs: `reference`, duplicates by radius",
    "CARLA's 56,000 points a second": "the same, range of 80 m, CARLA's default points a second",
}


def ecvpr_shares(rows: Rows) -> Table:
    """Returns E-CVPR by share of CAVs: ours, with their detector and fusion, and as published."""
    shown = {}
    for row in rows:
        share = 0.05 if row["grid"] == "steps" else row["traffic.cav_rate"]
        shown.setdefault(row["step"], {}).setdefault(share, []).append(row)
    heads = [f"{100 * share:g} % CAVs" for share in _THEIRS]
    table = [["E-CVPR, %", *_LIDAR_HEADS, *heads]]
    for step, by_share in shown.items():
        if set(by_share) == set(_THEIRS):
            cells = [
                _between([100 * row["e_cvpr"] for row in by_share[share]], 1) for share in _THEIRS
            ]
            table.append([_AS_THEIRS.get(step, step), *_lidar(by_share[0][0]["lidar"]), *cells])
    for place, name in enumerate(("DBSCAN", "PointPillars")):
        cells = [_fixed(theirs[place], 1) for theirs in _THEIRS.values()]
        table.append([f"Chen et al., {name}", "64", "not stated", "not stated", *cells])
    return table


_CONTROLS = {
    "perception": "max pressure on perception (a post, no CAV), 200 m before and 100 m behind",
    "perception, unseen empty": "the same, what no LiDAR sees taken for empty, as in Chen et al.",
    "perception, 50 m": "max pressure on perception, 50 m before and nothing behind",
    "perception, held": "the same, greens of 10 s at least",
    "perfect counts": "max pressure on perfect counts, 200 m before and 100 m behind",
    "perfect counts, 50 m": "max pressure on perfect counts, 50 m before and nothing behind",
    "perfect counts, held": "the same, greens of 10 s at least",
    "max wave": "max wave on perfect counts: 200 m before and nothing behind",
    "actuated": "SUMO's actuated control, loops",
    "webster": "fixed plan by Webster's formula for this demand",
    "own plan": "the net's own fixed plan",
}


def delay(rows: Rows) -> Table:
    """Returns delay by control, and how much more it is than on perception, paired by seed."""
    by: dict[str, dict[int, float]] = {}
    for row in rows:
        by.setdefault(row["control"], {})[row["seed"]] = row["delay_s"]
    first, *_ = _CONTROLS
    runs = f"{len(by[first])} seeds of {rows[0]['frames']} s"
    heads = [f"delay, s; {runs}", "more than the first line, s", "more than perfect counts, s"]
    table = [["control", *heads]]
    for name, words in _CONTROLS.items():
        if name not in by:  # added since it was measured
            continue
        cells = [
            "" if name == base else _between([by[name][s] - by[base][s] for s in by[name]], 1)
            for base in (first, "perfect counts")
        ]
        table.append([words, _between([*by[name].values()], 1), *cells])
    return table


def lidars(kinds: dict[str, dict[str, float]]) -> str:
    """Returns a sentence on the LiDARs behind each E-CVPR."""
    words: dict[tuple[str, ...], list[str]] = {}
    for kind, one in kinds.items():
        words.setdefault(tuple(_lidar(one)), []).append(f"`{kind}`")
    parts = [
        f"{', '.join(names)}: {rings} rings, {points} points a second, range {range_m} m"
        for (rings, points, range_m), names in words.items()
    ]
    return f"LiDARs behind each E-CVPR, on posts and CAVs alike, by `realism`: {'; '.join(parts)}."
