"""The tape role: hears both buses and keeps all as it came, in the run folder."""

from __future__ import annotations

from typing import Any

from protocol.courtesy import step_back
from protocol.process import Context
from protocol.topics import TOPICS, BusName
from tape.names import next_file
from tape.taping import Choice, Taping


def build(context: Context) -> Taping:
    """Begins `run.mcap`, or the next of that name if it is there; announces that it listens.

    Raises:
        ConfigError: the run folder cannot take it.
    """
    step_back()
    scenario = context.setup.scenario
    choice = choice_of(scenario)
    taping = Taping(
        context.setup, lambda: next_file(context.run_dir), context.inbox, choice, context.stop
    )
    for name in sorted(choice.topics):
        topic = TOPICS[name]
        bus = context.world if topic.bus is BusName.WORLD else context.v2x
        own = {"region": str(scenario["region"])} if "{region}" in topic.template else {}
        bus.subscribe(name, **own)
    context.world.watch()
    context.v2x.watch()
    context.announce("tape")
    return taping


def choice_of(scenario: dict[str, Any]) -> Choice:
    """Returns what a scenario wants taped."""
    record = scenario.get("record", {})
    return Choice(truth=record.get("truth", True), foxglove=record.get("foxglove", True))
