"""Cells on real Dask workers: one that fails or kills its worker harms no other."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from protocol.errors import ConfigError
from tests.studies.sweep.made_cells import cell

pytest.importorskip("distributed", reason="needs the extra `study`")

from distributed import get_worker

from studies.sweep.cluster import local, remote, usable_cores
from studies.sweep.engine import Engine, missing
from studies.sweep.worker import Outcome, in_own_folder
from tests.waiting import TIMEOUT_S

pytestmark = pytest.mark.process


class RecordingListener:
    """A progress listener that records calls."""

    def __init__(self):
        self.running, self.done, self.most = set(), [], 0

    def started(self, one):
        self.running.add(one.id)
        self.most = max(self.most, len(self.running))

    def finished(self, one):
        self.running.remove(one.id)
        self.done.append(one.seed)

    def failed(self, failure):
        self.running.remove(failure.cell.id)

    def idle(self, workers):
        pass


def work(task):
    """What a seed stands for."""
    match task.scenario["seed"]:
        case 13:
            raise ConfigError("thirteen cannot be")
        case 14:
            raise ZeroDivisionError("fourteen")
        case 15:
            os._exit(1)
    return Outcome({"pid": os.getpid(), "cores": len(os.sched_getaffinity(0))}, 0.5)


@pytest.fixture(scope="module")
def client():
    with local(2) as made:
        yield made


def run(client, store, seeds):
    listener = RecordingListener()
    cells = [cell(seed) for seed in seeds]
    failures = Engine(client, store, listener, keep_runs=False, work=work).run(
        missing(cells, store)
    )
    return listener, {failure.cell.seed: failure.reason for failure in failures}


def test_a_worker_has_one_core_and_one_cell_at_a_time(client, store):
    listener, failures = run(client, store, range(8))
    assert not failures
    assert sorted(listener.done) == list(range(8))
    assert listener.most <= 2
    rows = [store.row(cell(seed).id) for seed in range(8)]
    assert {row["cores"] for row in rows} == {1}
    assert os.getpid() not in {row["pid"] for row in rows}
    assert len(os.sched_getaffinity(0)) == len(usable_cores())


def test_cells_that_fail_are_named_and_the_others_go_on(client, store):
    listener, failures = run(client, store, [13, 1, 14, 2])
    assert failures == {13: "thirteen cannot be", 14: "ZeroDivisionError: fourteen"}
    assert sorted(listener.done) == [1, 2]
    left = sorted(path.name for path in (store.folder / "cells").glob("*.failed.txt"))
    assert left == sorted(f"{cell(seed).id}.failed.txt" for seed in (13, 14))
    assert (
        "thirteen cannot be" in (store.folder / "cells" / f"{cell(13).id}.failed.txt").read_text()
    )


def test_a_failed_cell_is_tried_again_and_a_finished_one_is_not(client, store):
    run(client, store, [13, 1])
    listener, failures = run(client, store, [13, 1, 2])
    assert listener.done == [2]
    assert list(failures) == [13]


def test_a_worker_that_dies_takes_only_its_own_cell_with_it(client, store):
    listener, failures = run(client, store, [1, 15, 2, 3])
    assert sorted(listener.done) == [1, 2, 3]
    assert "was killed" in failures[15]


def test_a_scheduler_that_does_not_answer_is_refused(monkeypatch):
    monkeypatch.setattr("studies.sweep.cluster.CONNECT_S", 0.3)
    with (
        pytest.raises(ConfigError, match="--scheduler tcp://127.0.0.1:1: no answer"),
        remote("tcp://127.0.0.1:1"),
    ):
        pass


def test_a_port_behind_which_is_no_scheduler_is_given_up(monkeypatch):
    monkeypatch.setattr("studies.sweep.cluster.CONNECT_S", 0.3)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(ConfigError, match="no answer"), remote(address):
            pass


def where():
    with in_own_folder() as folder:
        return folder, get_worker().local_directory


def test_a_run_is_written_where_dask_tidies_up_after_a_killed_worker(client):
    folder, own = client.submit(where, pure=False).result(timeout=TIMEOUT_S)
    assert folder.startswith(f"{own}/")
    assert not Path(folder).exists()
    with in_own_folder() as elsewhere:
        assert Path(elsewhere).is_dir()
