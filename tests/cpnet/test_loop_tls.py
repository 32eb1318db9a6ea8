"""The whole loop with keys: the same results, the same links, over several machines."""

import shutil
import sqlite3
import statistics
from pathlib import Path

from recording.run import differences
from tests.certificates import make_keys
from tests.cpnet.commands import Shell, check_breakdown, free_ports


def test_each_machine_needs_its_own_keys_alone(shell, first_run):
    made = make_keys(shell.folder / "keys")
    part(made, shell.folder / "a", "router", "sim", "record", "edge-r0", "signal-r0", "watch")
    part(made, shell.folder / "b", "vehicle-0", "vehicle-1", "infra-r0", "watch")
    place = f"127.0.0.1:{free_ports()}"
    world = "--only=router,sim,record,edge,signal"
    here = shell.up("--duration=8", "--out=here", world, f"--listen={place}", "--keys=a")
    there = shell.start(
        "up", "--only=vehicle,infra", f"--connect={place}", "--out=there", "--keys=b"
    )
    for command in (here, there):
        status, output = command.finish()
        assert status == 0, output
    assert differences(first_run, shell.folder / "here") == []


def test_emulated_links_delay_scans_over_tls_and_their_bytes_are_counted(shell: Shell):
    make_keys(shell.folder / "keys")
    slow = ("--mode=realtime", "--duration=5", "--link=5mbit,80ms", "--set=edge.deadline_ms=90")
    status, output = shell.up(*slow, "--out=run", "--keys=keys").finish()
    assert status == 0, output
    with sqlite3.connect(f"file:{shell.folder}/run/run.sqlite?mode=ro", uri=True) as database:
        sql = "SELECT min(received_ns - encode_end_ns) FROM uploads WHERE agent {} 'rsu-0'"
        ((vehicle_ns,),) = database.execute(sql.format("<>")).fetchall()
        ((roadside_ns,),) = database.execute(sql.format("=")).fetchall()
        sql = "SELECT agent, payload_bytes, wire_bytes FROM uploads WHERE wire_bytes IS NOT NULL"
        sizes = database.execute(sql).fetchall()
    assert len({agent for agent, *_ in sizes}) > 1
    extra = [wire - payload for _, payload, wire in sizes]
    # Poses, headers, acknowledgements. What a handshake or a repeated packet adds is rare, and on
    # a loaded machine a scan's last packets may count in the next frame.
    assert 0 < statistics.median(extra) < 2000
    assert vehicle_ns > 40_000_000
    assert roadside_ns < 40_000_000
    check_breakdown(shell.folder / "run", exactly=False)


def part(made: Path, folder: Path, *ids: str) -> None:
    """Copies the keys that a machine with these processes gets."""
    folder.mkdir()
    for name in ("ca.pem", *(f"{one}.{end}" for one in ids for end in ("pem", "key"))):
        shutil.copy(made / name, folder)
