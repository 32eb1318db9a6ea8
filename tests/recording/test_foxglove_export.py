"""A recording is translated whole, whatever there was time for when it was made."""

from __future__ import annotations

from pathlib import Path

import pytest
from test_foxglove import Booth, decoded, heard, messages_of

from protocol.errors import ConfigError
from protocol.inbox import Envelope
from recording.mcap import writer
from recording.mcap.format import next_file
from recording.mcap.foxglove import FoxgloveFiles, export_foxglove
from recording.mcap.reader import McapReader

FRAMES = 6


def said(frame: int) -> list[Envelope]:
    """Returns the messages of a frame."""
    return [
        heard(topic, message, 10**9 * (frame + 1) + n)
        for n, (topic, message) in enumerate(messages_of(frame).items())
    ]


def steps(booth: Booth) -> None:
    while booth.scene.step():
        pass


def recorded(folder: Path) -> Booth:
    """Returns a booth whose recording holds frames, and nothing for other tools."""
    booth = Booth(folder)
    for frame in range(FRAMES):
        for item in said(frame):
            booth.writer.write(item)
    booth.writer.close({})
    return booth


def translated(path: Path, folder: Path, cloud_every: int = 1) -> tuple[FoxgloveFiles, list[int]]:
    told: list[int] = []
    folder.mkdir()
    made = export_foxglove(McapReader(path), lambda: next_file(folder), cloud_every, told.append)
    return made, told


def test_it_shows_what_a_scene_with_all_the_time_would(tmp_path):
    made, told = translated(recorded(tmp_path).path, tmp_path / "new")
    assert (made.frames, told) == (FRAMES, [*range(1, FRAMES + 1)])
    assert made.size_bytes == made.files[0].stat().st_size
    (tmp_path / "live").mkdir()
    live = Booth(tmp_path / "live")
    for frame in range(FRAMES):
        for item in said(frame):
            live.scene.take(item, frame)
        steps(live)
    live.scene.finish()
    steps(live)
    expected = live.read()
    found = decoded(made.files[0])
    assert found.keys() == expected.keys()
    for topic, messages in expected.items():
        assert [*map(str, found[topic])] == [*map(str, messages)]


def test_clouds_are_those_of_each_nth_frame(tmp_path):
    made, _ = translated(recorded(tmp_path).path, tmp_path / "new", 4)
    found = decoded(made.files[0])
    assert len(found["foxglove/v2x/detections"]) == FRAMES
    assert len(found["foxglove/v2x/cloud/a"]) == 2


def test_of_a_tape_that_was_cut_there_is_what_can_be_read(tmp_path, monkeypatch):
    monkeypatch.setattr(writer, "CHUNK_BYTES", 1000)
    booth = recorded(tmp_path)
    data = booth.path.read_bytes()
    booth.path.write_bytes(data[: len(data) // 3])
    made, _ = translated(booth.path, tmp_path / "new")
    assert 0 < made.frames < FRAMES


def test_a_translation_is_no_part_of_the_tape_and_itself_translates_to_nothing(tmp_path):
    made, _ = translated(recorded(tmp_path).path, tmp_path / "new")
    again, _ = translated(made.files[0], tmp_path / "newer")
    assert again.frames == 0


def test_what_is_no_tape_is_refused_before_a_file_is_made(tmp_path):
    with pytest.raises(ConfigError, match="no such recording"):
        translated(tmp_path / "none.mcap", tmp_path / "new")
    assert not [*(tmp_path / "new").iterdir()]


def test_of_a_translation_that_is_broken_off_nothing_is_left(tmp_path):
    path = recorded(tmp_path).path
    (tmp_path / "new").mkdir()

    def interrupt(frames: int) -> None:
        if frames == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export_foxglove(McapReader(path), lambda: next_file(tmp_path / "new"), 1, interrupt)
    assert not [*(tmp_path / "new").iterdir()]
