"""All figures of README and docs."""

from __future__ import annotations

from dataclasses import replace

from control_figures import CONTROL_FIGURES
from figure import AGENTS, PERCEPTION, STUDY, SYSTEM, Figure, Part, needs_resco, rows_of
from layouts import cities, codecs, comparison, detection, links, runs, worlds

_READING = ("recording/foreign_scans", "learning/kitti_object.py", "sensing/point_files.py")
LEARNED = ("pointpillars",)
"""Detectors whose weights change rows. Runs of `pointpillars-full` are not compared."""
_MINE = (
    'python -c \'import os, re, pathlib; page = pathlib.Path(os.environ["ROOT"]); '
    'text = (page / "docs/own-junction.md").read_text("utf-8"); '
    'found = re.findall(r"```xml\\n(.*?)```", text, re.DOTALL); '
    '[pathlib.Path(f"mine.{n}.xml").write_text(one) '
    'for n, one in zip(("nod", "edg"), found)]\'; '
    "netconvert --node-files mine.nod.xml --edge-files mine.edg.xml --no-turnarounds "
    "--output-file mine.net.xml >&2;"
)
_GLANCE = "docs/figures-at-a-glance.md"
_RUN = "cpnet up t_junction --cav-rate 0.05 --duration 120 --seed 1"
_CITY_UP = "cpnet up --tls all --cav-rate 0.05 --duration 3600 --seed 1 --set frame_period_s=1"
_SOAK = " ".join(
    f"--set lidar.{kind}.{key}"
    for key in ("channels=16", "points_per_second=288000")
    for kind in ("vehicle", "roadside")
)
_HARD15 = "cpnet dataset hard15 --networks 100 --samples 10 --seed 1 --realism hard --split test"


def _given(*names: str) -> str:
    """Returns commands that stop unless these variables name folders of source distributions."""
    folders = " ".join(f'"${{{name}:-}}"' for name in names)
    return (
        f'for folder in {folders}; do [ -d "$folder" ] || {{ echo "{", ".join(names)}: must be '
        'unpacked source distributions, see docs/figures/public_scans.py" >&2; exit 1; }; done; '
    )


def _study_figures(
    study: str, page: str, minutes: int, part: Part, **shown: bool
) -> tuple[Figure, Figure]:
    """Returns the page of a built-in study, and a part elsewhere of the same runs.

    `shown` are `learned`, `tracked`, `predictive` of the figures, where they are not the default.
    """
    run = f"cpnet study {study} --out {study}"
    whole = Figure(
        study,
        f"{run} --markdown ../../docs/{page}.md",
        STUDY,
        minutes,
        (Part("age", f"docs/{page}.md"),),
        files=(f"docs/{page}.md", f"docs/{page}/*.png"),
        of_rows=True,
        **shown,
    )
    rows = f"{run} >&2; {rows_of(study)}"
    return whole, replace(whole, name=f"{study}-readme", command=rows, parts=(part,), files=())


_LIST = (
    Figure(
        "run",
        "rm -rf run; cpnet up --duration 60 --out run >&2; "
        "cpnet report run --json; printf '\\f'; cpnet report run",
        SYSTEM,
        2,
        (
            Part("text", "README.md", runs.run_text),
            Part("table", _GLANCE, runs.run_readme),
        ),
        read=runs.summary_and_text,
    ),
    Figure(
        "codec",
        'cpnet bench codec --json ${LIDAR_FILES:+--points "$LIDAR_FILES"}',
        (
            "protocol/codec",
            "sensing",
            "studies/bench_codec.py",
            "studies/bench_scans.py",
            "studies/sensor_clouds.py",
        ),
        5,
        (
            Part("kinds", "docs/codec.md", codecs.codec_kinds),
            Part("extremes", "docs/codec.md", codecs.codec_extremes),
            Part("scans", "docs/codec.md", codecs.codec_scans),
            Part("floor", "docs/codec.md", codecs.codec_floor),
        ),
    ),
    Figure(
        "uplink",
        "cpnet bench uplink --json",
        (*SYSTEM, "studies/bench_uplink.py", "studies/bench_sharing.py"),
        15,
        (
            *(Part(link, "docs/uplink.md", links.uplink(link)) for link in links.LINKS),
            Part("readme", _GLANCE, links.uplink_readme),
            Part("emp", _GLANCE, links.uplink_emp),
        ),
    ),
    Figure(
        "rate",
        "cpnet bench rate --json",
        (*SYSTEM, "studies/bench_uplink.py"),
        5,
        (Part("highest", "docs/uplink.md", links.rates),),
    ),
    Figure(
        "emulated",
        "rm -rf virtual emulated; run='cpnet up --link 5mbit,20ms --cav-rate 0.05 "
        "--duration 12 --set upload.filters=[foreground]'; $run --mode lockstep --out virtual >&2; "
        "$run --mode realtime --out emulated >&2; "
        "echo '['; cpnet report virtual --json; echo ','; cpnet report emulated --json; echo ']'",
        SYSTEM,
        1,
        (Part("link", "docs/uplink.md", links.emulated),),
    ),
    Figure(
        "lossy",
        'cd "$ROOT" && python -m tests.link_relay.lossy_bench',
        (
            "sensing/link_channel.py",
            "sensing/lossy_link.py",
            "sensing/packet_loss.py",
            "sensing/tcp_sender.py",
            "sensing/congestion_control.py",
            "link_relay",
            "tests/kernel_path.py",
            "tests/link_relay/lossy_bench.py",
        ),
        24,
        (Part("tcp", "docs/uplink.md", links.lossy),),
    ),
    Figure(
        "edge",
        "cpnet bench edge --agents 1,2,4,6,8,16 --frames 8 --json",
        (*PERCEPTION, "protocol", "studies/bench_edge.py"),
        8,
        (Part("all", "docs/detection.md", detection.edge),),
    ),
    Figure(
        "recorder",
        "cpnet bench recorder --json",
        ("protocol", "recording", "studies/bench_recorder.py"),
        1,
        (Part("all", "docs/running.md", runs.recorder),),
    ),
    Figure(
        "accuracy",
        f"rm -rf hard15; {_HARD15} >&2; cpnet eval hard15 --detectors fast,pointpillars --json",
        (*PERCEPTION, "sensing", "learning", "studies/evaluate.py", "studies/average_precision.py"),
        40,
        (
            Part("all", "docs/detection.md", detection.accuracy),
            Part("classes", "docs/detection.md", detection.accuracy_by_class),
        ),
        of_rows=True,
        tracked=False,
        learned=True,
    ),
    Figure(
        "accuracy-full",
        f"rm -rf hard15; {_HARD15} >&2; cpnet eval hard15 --detectors pointpillars-full --json",
        (*PERCEPTION, "sensing", "learning", "studies/evaluate.py", "studies/average_precision.py"),
        40,
        (
            Part("all", "docs/detection.md", detection.accuracy),
            Part("classes", "docs/detection.md", detection.accuracy_by_class),
        ),
        of_rows=True,
        tracked=False,
    ),
    Figure(
        "street",
        "rm -rf street; cpnet dataset street --networks 50 --samples 6 --seed 5 --realism hard "
        "--furniture 16 --split test >&2; cpnet eval street --detectors fast,pointpillars --json",
        (*PERCEPTION, "sensing", "learning", "studies/evaluate.py", "studies/average_precision.py"),
        6,
        (Part("all", "docs/detection.md", detection.accuracy),),
        of_rows=True,
        tracked=False,
        learned=True,
    ),
    Figure(
        "public-scans",
        _given("OUSTER_SDK", "POINTCLOUDSET") + "rm -rf public-scans; "
        'python $ROOT/docs/figures/public_scans.py "$OUSTER_SDK" "$POINTCLOUDSET" public-scans '
        "fast,pointpillars,pointpillars-full",
        (*PERCEPTION, *_READING, "docs/figures/public_scans", "studies/kitti_eval.py"),
        1,
        (Part("all", "docs/detection.md", detection.public_scans),),
        of_rows=True,
        tracked=False,
        learned=True,
    ),
    Figure(
        "public-folds",
        _given("OUSTER_SDK")
        + "git -C $ROOT show a849f04:perception/pillars/weights/pointpillars.safetensors "
        "> before.safetensors; rm -rf public-folds; "
        'python $ROOT/docs/figures/public_folds.py "$OUSTER_SDK" before.safetensors public-folds',
        (
            *PERCEPTION,
            *_READING,
            "docs/figures/public_scans",
            "docs/figures/public_scans.py",
            "studies/kitti_eval.py",
            "learning",
            "sensing",
        ),
        26,
        (Part("all", "docs/detection.md", detection.public_scans),),
        tracked=False,
    ),
    Figure(
        "reference",
        "rm -rf data3; cpnet dataset data3 --networks 20 --samples 2 --seed 6 --split test >&2; "
        "cpnet eval data3 --detectors fast,reference --json",
        (*PERCEPTION, "sensing", "learning", "studies/evaluate.py", "studies/average_precision.py"),
        10,
        (Part("all", "docs/detection.md", detection.accuracy),),
    ),
    Figure(
        "misbehaviour",
        "$ROOT/scripts/misbehaviour --seconds 30 --set traffic.cv_rate=0.05 --json",
        (*AGENTS, *PERCEPTION, "tests/misbehaviour"),
        10,
        (Part("all", "docs/reliability.md", detection.misbehaviour),),
    ),
    Figure(
        "soak",
        f"$ROOT/scripts/soak --minutes 30 --kills 200 --seed 1 --out soak {_SOAK} "
        "--markdown soak.md >&2; cat soak.md",
        (*SYSTEM, "protocol/observer.py", "tests/soak"),
        31,
        (Part("all", "docs/reliability.md", runs.text),),
        read=runs.as_text,
    ),
    *_study_figures(
        "paper",
        "results",
        90,
        Part("table", _GLANCE, comparison.paper_readme),
        tracked=False,
        learned=True,
    ),
    *_study_figures(
        "bandwidth", "bandwidth", 60, Part("table", "README.md", links.bandwidth_readme)
    ),
    *_study_figures(
        "value", "value", 90, Part("table", "README.md", comparison.value_readme), predictive=True
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
        "gallery",
        "rm -rf gallery-run gallery-compare; mkdir -p $ROOT/docs/gallery; "
        "cpnet up --duration 60 --out gallery-run >&2; "
        "cpnet report gallery-run --markdown gallery-report.md >&2; "
        f"{_MINE} cpnet compare --net mine.net.xml --demand 300 --seeds 1 --duration 300 "
        "--tuning 0 --out gallery-compare --markdown gallery-compare.md >&2; "
        "cp gallery-report/gallery-report-1.png $ROOT/docs/gallery/counts.png; "
        "cp gallery-report/gallery-report-14.png $ROOT/docs/gallery/map.png; "
        "cp gallery-compare/gallery-compare-2.png $ROOT/docs/gallery/approaches.png",
        (*SYSTEM, "studies/run_page.py", "studies/compare.py", "studies/compare_page.py"),
        5,
        (),
        files=("docs/gallery/*.png",),
    ),
    Figure(
        "unseen",
        f"rm -rf hard15; {_HARD15} >&2; "
        "cpnet study $ROOT/docs/figures/unseen.yaml --out unseen >&2; " + rows_of("unseen"),
        (*STUDY, "cpnet/realism"),
        10,
        (Part("all", "docs/realism.md", worlds.unseen),),
        of_rows=True,
        learned=True,
    ),
    Figure(
        "tracks",
        f"[ -e hard15 ] || {_HARD15} >&2; "
        "cpnet study $ROOT/docs/figures/tracks.yaml --keep-runs --out tracks >&2; "
        "python $ROOT/docs/figures/track_scores.py tracks",
        (*STUDY, "cpnet/realism"),
        20,
        (Part("all", "docs/tracking.md", worlds.tracks),),
        of_rows=True,
    ),
    Figure(
        "counts",
        f"[ -e hard15 ] || {_HARD15} >&2; "
        "cpnet study $ROOT/docs/figures/counts.yaml --out counts >&2; " + rows_of("counts"),
        (*STUDY, "cpnet/realism"),
        15,
        (Part("all", "docs/tracking.md", worlds.counts),),
        of_rows=True,
    ),
    Figure(
        "realism",
        "cpnet study $ROOT/docs/figures/realism.yaml --out realism >&2; printf '{\"runs\": '; "
        "python -c 'import json, pyarrow.parquet as p; "
        'print(json.dumps(p.read_table("realism/results.parquet").to_pylist()))\'; '
        "printf ', \"accuracy\": '; "
        "python $ROOT/docs/figures/accuracy_by_part.py $ROOT/docs/figures/realism.yaml 10; "
        "echo '}'",
        (*STUDY, "cpnet/realism", "docs/figures/accuracy_by_part.py"),
        30,
        (
            Part("parts", "docs/realism.md", worlds.realism),
            Part("accuracy", "docs/realism.md", worlds.realism_accuracy),
            Part("readme", _GLANCE, worlds.realism_readme),
        ),
        of_rows=True,
        learned=True,
    ),
    Figure(
        "ecvpr",
        "cpnet study $ROOT/docs/figures/ecvpr.yaml --out ecvpr >&2; "
        "python $ROOT/docs/figures/study_rows.py $ROOT/docs/figures/ecvpr.yaml ecvpr",
        STUDY,
        15,
        (
            Part("steps", "docs/comparison.md", comparison.ecvpr_steps),
            Part("shares", "docs/comparison.md", comparison.ecvpr_shares),
            Part("readme", _GLANCE, comparison.ecvpr_shares),
        ),
        of_rows=True,
        tracked=False,
    ),
    *CONTROL_FIGURES,
    Figure(
        "lidars",
        "python $ROOT/docs/figures/study_rows.py",
        ("sensing/config.py", "cpnet/realism", "cpnet/scenarios", "docs/figures/study_rows.py"),
        0,
        (
            Part("readme", _GLANCE, worlds.lidars),
            Part("realism", "docs/realism.md", worlds.lidars),
            Part("city", "docs/city.md", worlds.lidars),
            Part("bandwidth", "docs/bandwidth.md", worlds.lidars),
        ),
    ),
    Figure(
        "alignment",
        "cpnet study $ROOT/docs/figures/alignment.yaml --out alignment >&2; "
        + rows_of("alignment"),
        STUDY,
        15,
        (Part("poses", "docs/realism.md", worlds.alignment),),
        of_rows=True,
    ),
    Figure(
        "city-run",
        f"{needs_resco('cologne3', 'ingolstadt7')}rm -rf city-3 city-7; "
        f"{_CITY_UP} --sumocfg resco/cologne3/cologne3.sumocfg --out city-3 >&2; "
        f"{_CITY_UP} --sumocfg resco/ingolstadt7/ingolstadt7.sumocfg --regions 2 --out city-7 >&2; "
        "printf '{\"cologne3\": '; cpnet report city-3 --json; "
        "printf ', \"ingolstadt7\": '; cpnet report city-7 --json; echo '}'",
        SYSTEM,
        15,
        (
            Part("runs", "docs/city.md", cities.city_runs),
            Part("junctions", "docs/city.md", cities.city_junctions),
        ),
    ),
    Figure(
        "scale",
        "cpnet bench scale --junctions 1,4,16,64,100 --json",
        (*SYSTEM, "cpnet/bench_scale.py"),
        8,
        (
            Part("cost", "docs/city.md", cities.scale),
            Part("parts", "docs/city.md", cities.scale_parts),
        ),
    ),
    # By hand: from a browser.
    Figure("view", "", ("viewer",), 0, (), files=("docs/view.png",)),
)
FIGURES = {figure.name: figure for figure in _LIST}
