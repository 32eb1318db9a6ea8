"""Functions are compiled ahead, once, by several processes, in an order without double work."""

from __future__ import annotations

import fcntl
import io
import os
import signal
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from rich.console import Console

from cpnet import compiling
from protocol.errors import ConfigError
from tests.waiting import wait_until


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "cpnet"


@pytest.fixture
def compiled(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, set[str]]]:
    """What would be compiled, call by call."""
    calls: list[dict[str, set[str]]] = []

    def keep(todo, jobs, advance) -> None:
        calls.append(todo)
        for _ in todo:
            advance()

    monkeypatch.setattr(compiling, "_compile", keep)
    return calls


def test_it_says_so_and_does_it_once(cache, compiled) -> None:
    written = io.StringIO()
    assert compiling.compile_ahead(Console(file=written)) == len(compiled[0]) > 30
    lines = written.getvalue().splitlines()
    total = len(compiled[0])
    assert lines[0].startswith(f"compiling, once: {total} modules on ")
    assert lines[1:] == [f"compiled {done}/{total}" for done in range(10, total, 10)]
    assert len([*cache.glob("compiled-*.json")]) == 1
    assert compiling.compile_ahead(Console(file=written)) == 0
    assert len(compiled) == 1
    assert written.getvalue().splitlines() == lines


def test_a_terminal_is_shown_how_many_are_done_in_one_place(cache, compiled) -> None:
    written = io.StringIO()
    compiling.compile_ahead(Console(file=written, force_terminal=True, width=100))
    total = len(compiled[0])
    assert f"{total}/{total}" in written.getvalue()
    assert "compiled 10" not in written.getvalue()


def test_only_what_changed_is_compiled_again(cache, compiled, monkeypatch) -> None:
    stamps = compiling._stamps()
    compiling.compile_ahead(Console(quiet=True))
    monkeypatch.setattr(compiling, "_stamps", lambda: stamps | {"perception.thin": "changed"})
    compiling.compile_ahead(Console(quiet=True))
    assert compiled[1] == {"perception.thin": set()}


def test_another_cpu_or_version_of_numba_compiles_all(cache, compiled, monkeypatch) -> None:
    compiling.compile_ahead(Console(quiet=True))
    monkeypatch.setenv("NUMBA_CPU_NAME", "generic")
    compiling.compile_ahead(Console(quiet=True))
    assert compiled[1].keys() == compiled[0].keys()


def test_a_module_waits_for_those_that_it_imports(cache, compiled) -> None:
    compiling.compile_ahead(Console(quiet=True))
    (todo,) = compiled
    assert "perception.roadway" in todo["perception.fast"]
    assert "protocol.codec.rans" in todo["protocol.codec.symbols"]
    done: set[str] = set()
    while len(done) < len(todo):
        ready = {name for name, needs in todo.items() if needs <= done} - done
        assert ready, "modules wait for each other"
        done |= ready


def test_a_damaged_stamp_is_no_stamp(cache, compiled) -> None:
    compiling.compile_ahead(Console(quiet=True))
    (stamp,) = cache.glob("compiled-*.json")
    for text in ("{", "[]", '{"x": 1}', ""):
        stamp.write_text(text)
        assert compiling.compile_ahead(Console(quiet=True)) > 30


def test_a_cache_that_cannot_be_written_is_named(tmp_path, compiled, monkeypatch) -> None:
    file = tmp_path / "file"
    file.touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(file / "below"))
    with pytest.raises(ConfigError, match=r"NUMBA_CACHE_DIR is .*below, which cannot be written"):
        compiling.compile_ahead(Console(quiet=True))


def test_without_a_home_there_is_a_folder_that_only_the_user_may_write(
    tmp_path, compiled, monkeypatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    folder = tmp_path / f"cpnet-cache-{os.getuid()}"
    assert compiling.compile_ahead(Console(quiet=True)) > 30
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o777)
    with pytest.raises(ConfigError, match="is another user's: set NUMBA_CACHE_DIR"):
        compiling.compile_ahead(Console(quiet=True))


def test_who_waits_for_another_process_says_for_which(cache, compiled) -> None:
    compiling.compile_ahead(Console(quiet=True))
    next(cache.glob("compiled-*.json")).unlink()
    written = io.StringIO()
    with ThreadPoolExecutor() as pool:
        with (cache / "compiling.lock").open() as lock:  # closing it lets the other go on
            fcntl.flock(lock, fcntl.LOCK_EX)
            waiting = pool.submit(compiling.compile_ahead, Console(file=written, width=100))
            text = f"waiting for process {os.getpid()}, which compiles the same modules"
            wait_until(lambda: text in written.getvalue())
            assert len(compiled) == 1
        assert waiting.result() > 30


@pytest.mark.slow
def test_processes_import_each_module_after_its_own(tmp_path) -> None:
    todo = {"protocol.codec.rans": set(), "protocol.codec.symbols": {"protocol.codec.rans"}}
    advanced: list[None] = []
    compiling._compile(todo, 2, lambda: advanced.append(None))
    assert len(advanced) == 2


@pytest.mark.slow
@pytest.mark.process
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_at_once_and_leaves_nothing(cache, shell, monkeypatch, number) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(cache / "numba"))
    command = shell.start("up", "--out=run", fresh=True)
    command.read_until("compiling, once")
    command.process.send_signal(number)
    status, output = command.finish()
    assert status == 128 + number
    assert "Traceback" not in output
    assert not (shell.folder / "run").exists()
