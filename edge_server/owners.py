"""Ownership of agents: which process may publish for which agent."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from protocol.messages import Roster

MAX_AGENTS = 512  # of a process


class AgentOwners:
    """An agent belongs to the process that first published something for it.

    So it stays until a roster of that process lacks it, or the process vanishes. The agents in
    `pinned` belong to their processes for ever. `drops` counts what others published, by reason.
    """

    def __init__(self, pinned: Mapping[str, str], drops: Counter[str]) -> None:
        self._agents: dict[str, set[str]] = {}
        self._owner = dict(pinned)
        self._drops = drops

    def admits(self, process: str, agent: str) -> bool:
        """Whether a process owns an agent, from now on if none did; counts it if not."""
        owner = self._owner.get(agent)
        if owner is None:
            return self._take(process, agent)
        self._drops["wrong_sender"] += owner != process
        return owner == process

    def own(self, roster: Roster) -> Roster:
        """Returns a roster without others' agents; releases those that it lacks."""
        process, named = roster.process, set(roster.agents)
        for agent in self._agents.get(process, set()) - named:
            self._release(process, agent)
        owned = {agent for agent in roster.agents if self.admits(process, agent)}
        if len(owned) == len(named):
            return roster
        return roster.model_copy(
            update={
                "agents": [agent for agent in roster.agents if agent in owned],
                "scanning": [agent for agent in roster.scanning if agent in owned],
            }
        )

    def forget(self, process: str) -> None:
        """Releases all agents of a process that has vanished."""
        for agent in list(self._agents.get(process, ())):
            self._release(process, agent)
        self._agents.pop(process, None)

    def _take(self, process: str, agent: str) -> bool:
        held = self._agents.setdefault(process, set())
        if len(held) >= MAX_AGENTS:
            self._drops["too_many_agents"] += 1
            return False
        held.add(agent)
        self._owner[agent] = process
        return True

    def _release(self, process: str, agent: str) -> None:
        self._agents[process].discard(agent)
        del self._owner[agent]
