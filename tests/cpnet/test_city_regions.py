"""Several regions in one run: processes of each, border strips, the same rows wherever they run."""

from recording.run import Run, differences
from recording.tables import DetectionRow, PhaseRow, RegionFrameRow, RequestRow, UploadRow
from tests.cpnet.commands import SMALL, Shell, free_ports
from tests.signal_safety import violations_of

CITY = ("corridor", *SMALL, "--regions=2", "--cav-rate=0.2", "--duration=6")


def test_five_signals_of_two_regions_give_the_same_rows_on_one_machine_and_on_two(shell: Shell):
    here = shell.start("up", *CITY, "--out=here")
    status, output = here.finish()
    assert status == 0, output
    place = f"127.0.0.1:{free_ports()}"
    own = "--only=router,sim,record,edge-r0,signal-r0,infra-r0,vehicle-0"
    first = shell.start("up", *CITY, "--out=first", own, f"--listen={place}")
    other = "--only=edge-r1,signal-r1,infra-r1,vehicle-1"
    second = shell.start("up", other, f"--connect={place}", "--out=second")
    for command in (first, second):
        status, output = command.finish()
        assert status == 0, output
    assert differences(shell.folder / "here", shell.folder / "first") == []

    with Run(shell.folder / "here") as run:
        regions = run.scenario["regions"]
        requested = {(row.frame, row.tls) for row in run.rows(RequestRow)}
        signals = [tls for junctions in regions.values() for tls in junctions]
        assert requested == {(frame, tls) for frame in range(6) for tls in signals}
        assert {row.tls for row in run.rows(PhaseRow)} == set(signals)
        frames = list(run.rows(RegionFrameRow))
        assert [(row.frame, row.region) for row in frames] == [
            (frame, region) for frame in range(6) for region in sorted(regions)
        ]
        assert all(row.complete and row.border_bytes for row in frames)
        assert all(row.end_to_end_ns is not None for row in frames)
        owner = {lane.id: lane.tls for lane in run.setup.road_map.lanes}
        found = list(run.rows(DetectionRow))
        assert found
        assert all(not row.lane or owner[row.lane] in regions[row.region] for row in found)
        uploads = {(row.region, row.agent) for row in run.rows(UploadRow)}
        posts = {mount["id"]: mount["tls"] for mount in run.scenario["roadside_mounts"]}
        at = {agent: region for region, agent in uploads if agent in posts}
        assert all(posts[agent] in regions[region] for agent, region in at.items())
        assert at.keys() == posts.keys()
        assert violations_of(run) == []
