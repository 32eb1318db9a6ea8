"""The sentence of `cpnet compare`: delays, posts, uplink, and how far it can be trusted."""

from __future__ import annotations

from collections.abc import Sequence

from studies.compare import (
    ACTUATED,
    BASELINES,
    MAX_PRESSURE,
    PLAN,
    PREDICTIVE,
    WEBSTER,
    Variant,
)
from studies.compare_question import BOTH, CAVS, POSTS, Comparison, Question
from studies.control_study import paired

MIN_SEEDS = 5
"""Number of seeds from which on an interval is given; below, each seed's value."""
PROMPT_S = 0.1
"""Time within which a scan must arrive, for the rate that a LiDAR's link needs."""
NAMES = {
    PLAN: "the net's own plan",
    WEBSTER: "Webster's fixed plan",
    ACTUATED: "actuated by loops",
    MAX_PRESSURE: "max pressure",
    PREDICTIVE: "predictive",
}
_MIN_DURATION_S = 600
_MIN_VEHICLES = 100
_WORSE_S = 2.0  # than under the own plan: an approach that is named
_MAX_NAMED = 4


def name_of(one: Variant) -> str:
    """Returns the name of a variant in charts."""
    return f"{NAMES[one.policy]}: {one.sight}" if one.sight else NAMES[one.policy]


def best_baseline(variants: Sequence[Variant]) -> Variant:
    """Returns the tuned timer or loop control of least delay on the reported seeds."""
    found = [one for one in variants if one.policy in BASELINES and one.policy != PLAN]
    return min(found, key=lambda one: one.delay_s)


def answer(comparison: Comparison, variants: Sequence[Variant]) -> str:
    """Returns the answer for a city in sentences: delay, number of posts, uplink.

    It is about the predictive policy, which is chosen beforehand, not about the best of all; max
    pressure on the same LiDARs is given beside it. Caveats come first, an approach that loses by it
    last.
    """
    plan, baseline = variants[0], best_baseline(variants)
    found = {one.sight: one for one in variants if one.is_perceived and one.policy == PREDICTIVE}
    lead = found.pop(comparison.lead_sight)
    tuned = ", tuned" if baseline.setting else ""
    pressure = next(
        one for one in variants if (one.policy, one.sight) == (MAX_PRESSURE, lead.sight)
    )
    sentences = [
        caveat(comparison.question, min(lead.values("vehicles"))),
        f"With {_equipment(comparison, lead.sight)} and predictive control a vehicle loses "
        f"{lead.delay_s:.1f} s, {_against(lead, plan)} the net's own plan "
        f"({plan.delay_s:.1f} s) and {_against(lead, baseline)} {NAMES[baseline.policy]}{tuned} "
        f"({baseline.delay_s:.1f} s); {_uplink(comparison, lead)}.",
        f"Max pressure in place of predictive: {pressure.delay_s:.1f} s.",
        *(
            f"Predictive with {_equipment(comparison, one.sight)}: {one.delay_s:.1f} s and "
            f"{_sent(one)}."
            for one in found.values()
        ),
        _losers(comparison, lead, plan),
    ]
    return " ".join(filter(None, sentences))


def caveat(asked: Question, vehicles: float) -> str:
    """Returns why the answer is only indicative; empty if it is not.

    Args:
        asked: seeds, duration and tuning.
        vehicles: of the run with the fewest.
    """
    is_untuned, are_few = asked.tuning_s == 0, vehicles < _MIN_VEHICLES
    seeds, duration_s = len(asked.seeds), asked.duration_s
    if seeds >= MIN_SEEDS and duration_s >= _MIN_DURATION_S and not (is_untuned or are_few):
        return ""
    runs = "1 seed" if seeds == 1 else f"{seeds} seeds"
    number = "1 vehicle" if vehicles == 1 else f"{vehicles:.0f} vehicles"
    few = f", {number} in a run" if are_few else ""
    untuned = ", baselines not tuned" if is_untuned else ""
    return f"A direction only: {runs} of {duration_s} s{few}{untuned}."


def _sent(one: Variant) -> str:
    rate = one.mean("uplink_mbps")
    return f"{mbps(rate)} on average" if rate else "no CAV came near the signals"


def _losers(comparison: Comparison, lead: Variant, plan: Variant) -> str:
    """Returns the approaches on which vehicles lose clearly more than under the own plan."""
    before, after = approaches(plan), approaches(lead)
    more = {
        name: own_s - plan_s
        for name, plan_s in before.items()
        if plan_s is not None
        and (own_s := after.get(name)) is not None
        and own_s - plan_s > _WORSE_S
    }
    if not more:
        return ""
    worst = sorted(more, key=lambda name: -more[name])
    named = ", ".join(f"{name} ({more[name]:.1f} s)" for name in worst[:_MAX_NAMED])
    left = f" and on {len(worst) - _MAX_NAMED} further approaches" if worst[_MAX_NAMED:] else ""
    return (
        f"With {_equipment(comparison, lead.sight)} and predictive control a vehicle loses more "
        f"than under the own plan within 300 m of the stop bar {named}{left}."
    )


def approaches(one: Variant) -> dict[str, float | None]:
    """Returns the time that a vehicle loses on each approach, a mean over the seeds."""
    names = one.rows[0]["approaches"]
    return {name: mean_of([row["approaches"].get(name) for row in one.rows]) for name in names}


def mean_of(values: Sequence[float | None]) -> float | None:
    """Returns the mean of what is known; None if nothing is."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def link_mbps(one: Variant, time_s: float) -> float | None:
    """Returns the rate at which a LiDAR's largest scan arrives within a time."""
    largest_kb = one.greatest("scan_peak_kb")
    return None if largest_kb is None else largest_kb * 8e-3 / time_s


def mbps(rate: float) -> str:
    """Returns a rate with its unit."""
    return f"{rate:.1f} Mbit/s" if rate >= 0.1 or rate == 0 else f"{rate:.2f} Mbit/s"


def _uplink(comparison: Comparison, lead: Variant) -> str:
    period_s = comparison.question.frame_period_s
    sent, peak = lead.mean("uplink_mbps") or 0.0, lead.greatest("uplink_peak_mbps") or 0.0
    at_most = f", {mbps(peak)} at most" if mbps(peak) != mbps(sent) else ""
    text = (
        f"all LiDARs together send {mbps(sent)} on average{at_most}, at a scan every {period_s:g} s"
    )
    prompt, slow = link_mbps(lead, PROMPT_S), link_mbps(lead, period_s)
    if prompt is None or slow is None:
        return text
    return text + (
        f"; the link of each needs {mbps(prompt)} for its largest scan "
        f"({lead.greatest('scan_peak_kb'):.0f} kB) to be there within {1e3 * PROMPT_S:g} ms, "
        f"{mbps(slow)} for within the frame period"
    )


def _equipment(comparison: Comparison, sight: str) -> str:
    number = len(comparison.posts)
    posts = "1 roadside post" if number == 1 else f"{number} roadside posts"
    cavs = f"{100 * comparison.question.cav_rate:g} % CAVs (vehicles with LiDAR and radio)"
    return {POSTS: posts, CAVS: cavs, BOTH: f"{posts} and {cavs}"}[sight]


def _against(one: Variant, other: Variant) -> str:
    """Returns how far a delay lies below or above another, and whether that is certain."""
    less_s = -difference(one, other)
    word = "less than" if less_s >= 0 else "more than"
    pairs = zip(one.values("delay_s"), other.values("delay_s"), strict=True)
    signs = {a < b for a, b in pairs}
    doubt = " (seeds disagree)" if len(signs) > 1 else ""
    return f"{abs(less_s):.1f} s{doubt} {word}"


def difference(one: Variant, other: Variant) -> float:
    """Returns how far a variant's delay lies above another's, a mean of pairs."""
    return paired(one.values("delay_s"), other.values("delay_s")).mean
