"""Figures of signal control: policies on SUMO alone, and on what is perceived."""

from __future__ import annotations

from figure import CONTROL, STUDY, SYSTEM, Figure, Part, needs_resco, rows_of
from layouts import comparison


def _network(name: str, minutes: int, *more: str) -> Figure:
    """Returns the figure of policies, and of more of them, on a built-in net of several signals."""
    policies = ", ".join(["webster", "actuated", "max_pressure", *more, "predictive"])
    return Figure(
        name,
        f"cpnet study control_city --set 'nets={{{name}: [1]}}' "
        f"--set 'policies=[{policies}]' --out {name} --json",
        (*CONTROL, "studies/builtin/control_city.yaml"),
        minutes,
        (Part("all", "docs/control.md", comparison.tuned_networks),),
        of_policies=name != "town",  # which nothing compares: it takes too long
    )


def _loop(name: str, page: str, minutes: int, study: str = "", needs: str = "") -> Figure:
    """Returns control on perception beside tuned baselines; `study` is run, with its options."""
    return Figure(
        f"loop-{name}",
        f"{needs}cpnet study $ROOT/docs/figures/{study or f'loop_{name}.yaml'} "
        f"--out loop_{name} --json",
        (*SYSTEM, *CONTROL, "studies/perceived_case.py", "studies/perceived_study.py"),
        minutes,
        (Part("all", page, comparison.loop),),
        of_rows=True,
        predictive=True,
    )


def _loop_resco(name: str, *nets: str, minutes: int) -> Figure:
    chosen = ", ".join(f"resco/{net}: [1]" for net in nets)
    study = f"loop_resco.yaml --set name=loop_{name} --set 'nets={{{chosen}}}'"
    return _loop(name, "docs/city.md", minutes, study, needs_resco(*nets))


CONTROL_FIGURES = (
    Figure(
        "delay",
        "cpnet study $ROOT/docs/figures/delay.yaml --out delay >&2; " + rows_of("delay"),
        STUDY,
        25,
        (
            Part("all", "docs/comparison.md", comparison.delay),
            Part("readme", "README.md", comparison.delay_short),
        ),
        of_rows=True,
        predictive=True,
    ),
    Figure(
        "tuned",
        "cpnet study $ROOT/docs/figures/tuned.yaml --out tuned --json",
        CONTROL,
        8,
        (Part("all", "docs/comparison.md", comparison.tuned),),
        of_policies=True,
    ),
    Figure(
        "demands",
        "cpnet study $ROOT/docs/figures/demands.yaml --out demands --json",
        CONTROL,
        20,
        (Part("all", "docs/control.md", comparison.tuned),),
        of_policies=True,
    ),
    _network("corridor", 15, "max_wave"),
    _network("grid", 25),
    _network("town", 45),
    _loop("t", "docs/control.md", 40),
    _loop("paper", "docs/control.md", 55),
    _loop("peak", "docs/control.md", 55),
    _loop_resco("cologne", "cologne1", "cologne3", minutes=30),
    _loop_resco("ingolstadt1", "ingolstadt1", minutes=15),
    _loop_resco("ingolstadt7", "ingolstadt7", minutes=45),
    Figure(
        "reports",
        needs_resco("cologne1", "ingolstadt1") + "export OWN='--seeds 5 --processes 2 --json'; "
        "for traffic in 't_junction --demand 1' 't_junction --demand 1.4' resco/cologne1 "
        "resco/ingolstadt1; do for share in 1 0.3 0.1 0.05; do printf '\\f'; cpnet bench control "
        "--net $traffic --policies predictive --reporting $share $OWN; done; printf '\\f'; "
        "cpnet bench control --net $traffic --policies webster $OWN; done",
        (
            *("sim_host", "protocol", "signal_controller", "studies/bench_control.py"),
            *(f"studies/control_{one}.py" for one in ("baselines", "case", "run")),
        ),
        40,
        (Part("delay", "docs/control.md", comparison.reports),),
        read=comparison.of_lists,
    ),
)
