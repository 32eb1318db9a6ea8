"""The file of a study of signal policies: see `studies.control_study`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, get_args

import yaml
from pydantic import Field, ValidationError

from protocol.config import Section, is_file
from protocol.errors import ConfigError
from sim_host.config import CabinetConfig, NetworkName
from studies.sweep.study_file import Name, Seed

BENCH = "control"
"""Value of `bench` at the top of a study file of this kind."""
NETS = ("moving_peak", *get_args(NetworkName))
"""Nets that are built in.

`moving_peak` is `t_junction` with a demand that no fixed plan fits. Of nets with several signals
the busiest approach has 80 % of what its fixed plan can serve.
"""


CabinetTime = Literal["min_green_s", "yellow_s", "all_red_s"]
"""Times of a cabinet that are the same for all controls of a study."""
MOST_MIN_GREEN_S = 25.0
"""No baseline is tried with a longest green below it: see `control_baselines.TUNINGS`."""


class ControlStudy(Section):
    """A study of signal policies."""

    bench: str = Field(BENCH, pattern=f"^{BENCH}$", description="the kind of study")
    name: Name = Field(description="names the folder of the results")
    title: str = Field("", description="a line for people")
    nets: dict[str, list[float]] = Field(
        min_length=1,
        description=f"{', '.join(NETS)}, a .sumocfg or a folder with one; factors of the demand, "
        "of your own net 1 alone",
    )
    policies: list[str] = Field(min_length=2, description="as in `cpnet bench control`")
    perceived: dict[str, dict[str, Any]] = Field(
        {},
        description="with perception in the loop, by a name each: dotted keys of the scenario, "
        "such as signal.policy",
    )
    studied: str = Field("predictive", description="whose difference to the others is shown")
    seeds: list[Seed] = Field([1, 2, 3, 4, 5], min_length=1, description="that are reported")
    tuning_seeds: list[Seed] = Field([101, 102], description="others; none: nothing is tuned")
    duration_s: int = Field(3600, ge=60, le=86400, description="of each reported run")
    warmup_s: int = Field(
        0, ge=0, le=7200, description="on the net's own plan, before policies and measures begin"
    )
    junctions: list[str] = Field([], description="signals that are controlled; none named: all")
    cabinet: dict[CabinetTime, float] = Field(
        {}, description="times of the scenario's section cabinet, for all but the net's own plan"
    )
    tuning_duration_s: int = Field(1200, ge=60, le=86400, description="of each run for tuning")
    finalists: int = Field(
        3,
        ge=1,
        le=20,
        description="tunings of each baseline, the best of those runs, that are tried again in "
        "runs as long as the reported ones; 1: the best one is taken",
    )

    @property
    def finals(self) -> int:
        """How many tunings are tried again: one, so none is, where that would take less time."""
        return self.finalists if self.duration_s > self.tuning_duration_s else 1

    def check(self) -> None:
        """Checks that span several fields.

        Raises:
            ConfigError: seeds overlap, the studied policy is none of those, a folder has factors,
                a time of the cabinet is out of its bounds.
        """
        try:
            CabinetConfig.model_validate(self.cabinet)
        except ValidationError as error:
            one = error.errors()[0]
            where = ".".join(map(str, ("cabinet", *one["loc"])))
            raise ConfigError(f"study {self.name}: {where}: {one['msg']}") from None
        if self.cabinet.get("min_green_s", 0.0) > MOST_MIN_GREEN_S:
            raise ConfigError(
                f"study {self.name}: cabinet.min_green_s: must be at most {MOST_MIN_GREEN_S:g}, "
                "the shortest of the longest greens that baselines are tried with"
            )
        both = sorted(set(self.seeds) & set(self.tuning_seeds))
        if both:
            raise ConfigError(f"study {self.name}: seed {both[0]} is for tuning and reported")
        twice = sorted(set(self.policies) & set(self.perceived))
        if twice:
            raise ConfigError(f"study {self.name}: {twice[0]} is of policies and of perceived")
        if self.studied not in (*self.policies, *self.perceived):
            raise ConfigError(
                f"study {self.name}: studied is {self.studied}, must be of policies or perceived"
            )
        for net, factors in self.nets.items():
            if net not in NETS and factors != [1.0]:
                raise ConfigError(f"study {self.name}: {net} has a demand of its own: [1]")


def read_control_study(path: Path, changes: Mapping[str, Any]) -> ControlStudy | None:
    """Reads a study file with `changes` of its keys; None if it is of another kind.

    Raises:
        ConfigError: it is of this kind and invalid.
    """
    if not is_file(path):
        return None
    try:
        data = yaml.safe_load(path.read_text("utf-8"))
    except (OSError, yaml.YAMLError, ValueError):
        return None  # the reader of other kinds of studies raises the error
    if not isinstance(data, dict) or data.get("bench") != BENCH:
        return None
    unknown = sorted(set(changes) - set(ControlStudy.model_fields))
    if unknown:
        allowed = ", ".join(ControlStudy.model_fields)
        raise ConfigError(f"--set {unknown[0]}: a study of control allows: {allowed}")
    try:
        study = ControlStudy.model_validate(data | dict(changes))
    except ValidationError as error:
        lines = [f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors()[:8]]
        raise ConfigError(f"{path}: " + "\n".join(lines)) from None
    study.check()
    return study
