"""Which deaths end a run."""

import io
from types import SimpleNamespace

import pytest
from rich.console import Console

from cpnet.deaths import Death
from cpnet.follow import Attendant


class Dying:
    """A supervisor of whose processes one dies just after it was asked for a dead tape."""

    def __init__(self, death: Death) -> None:
        self._coming = death
        self._dead: Death | None = None

    def bereft(self) -> None:
        return None

    def death(self, *, at_end: bool) -> Death | None:
        return self._dead

    def dismiss(self, role: str, *, at_end: bool) -> Death | None:
        found, self._dead = self._dead, self._coming
        if found is None or found.id != role:
            return None
        self._dead = None
        return found


@pytest.mark.parametrize(("name", "has_begun", "ends"), [
    ("tape", True, False), ("tape", False, True), ("edge", True, True),
])  # fmt: skip
def test_a_death_that_comes_at_an_odd_moment_ends_the_run_unless_it_is_a_tapes(
    name, has_begun, ends
):
    death = Death(name, "was killed by SIGKILL", "")
    supervisor = Dying(death)
    if not has_begun:
        supervisor.dismiss("", at_end=False)  # which is not asked for
    said, tapes = io.StringIO(), []
    attendant = Attendant(supervisor, None, None, Console(file=said), restart=False)
    progress = object() if has_begun else None
    watch = SimpleNamespace(end=None, progress=progress, await_end=lambda _: None)
    assert attendant._fatal(watch, tapes) == (death if ends else None)
    if not ends:
        assert attendant._fatal(watch, tapes) is None
        assert tapes == [death]
        assert "the run goes on without it" in said.getvalue()


class Alone:
    """A supervisor on a machine without the world."""

    def holds(self, process: str) -> bool:
        return False


@pytest.mark.parametrize("comes_back", [True, False])
def test_a_world_that_is_missed_for_a_moment_ends_no_run_elsewhere(comes_back):
    missed = [("sim", "sim")]
    watch = SimpleNamespace(end=None, lost=lambda: [*missed])
    watch.await_end = lambda _: missed.clear() if comes_back else None
    attendant = Attendant(Alone(), None, None, Console(file=io.StringIO()), restart=True)
    death = attendant._lost_elsewhere(watch)
    assert (death is None) == comes_back
