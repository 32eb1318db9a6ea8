"""Outputs of Rerun: a web page, a window, or a file."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO
from urllib.parse import quote

import rerun as rr
import rerun_cli

from protocol.config import is_free
from protocol.errors import ConfigError, CpnetError
from viewer.rerun_log import blueprint
from viewer.scene import Scene

APPLICATION = "cpnet"
MEMORY = "128MiB"
"""Memory limit of data kept for browsers that connect later; older data is dropped."""
_HERE = "127.0.0.1"
_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")
_PATIENCE_S = 20.0
_FLUSH_S = 5.0
_STOP_S = 5.0
_SAVE_S = 60.0
_LEAST_FREE_BYTES = 1 << 20


@dataclass(frozen=True, slots=True, eq=False)
class Sink:
    """A Rerun recording to draw into, its address, the process that shows it, whether it stays."""

    recording: rr.RecordingStream
    where: str
    server: subprocess.Popen[bytes] | None = None
    stays: bool = False


@contextmanager
def opened(port: int | None, save: Path | None, scene: Scene) -> Iterator[Sink]:
    """Opens a page at a port, or a file, or else a window of Rerun's viewer.

    Raises:
        ConfigError: the port is taken, the file cannot be written, or the viewer does not start.
        CpnetError: at the end: the file is not whole, for the disk is full or fails.
    """
    check(port, save)
    recording = rr.RecordingStream(APPLICATION)
    with ExitStack() as stack:
        if save is not None:
            sink = _file(recording, save, scene)
        elif port is not None:
            url, page, server = stack.enter_context(_page(port))
            recording.connect_grpc(url, default_blueprint=blueprint(scene))
            sink = Sink(recording, f"view: {page}", server, stays=True)
        else:
            sink = _window(recording, scene)
        try:
            yield sink
        finally:
            if save is None:
                _finish(recording)
            else:
                _finish_file(recording, save)


def check(port: int | None, save: Path | None) -> None:
    """Checks an output before there is a run to show.

    Raises:
        ConfigError: the port is taken, the file exists already or cannot be written, or there is no
            display for a window.
    """
    if save is not None:
        if save.suffix != ".rrd" or not is_free(save):
            raise ConfigError(f"--save {save}: needs a new file NAME.rrd in a folder that is there")
    elif port is not None:
        _check_free(port)
    elif sys.platform == "linux" and not any(map(os.environ.get, _DISPLAYS)):
        raise ConfigError(
            f"no window can open here, for none of {', '.join(_DISPLAYS)} is set: "
            "--web shows a page, --save keeps a file"
        )


def _finish(recording: rr.RecordingStream) -> None:
    with suppress(RuntimeError):  # the receiver may be gone, or slow
        recording.flush(timeout_sec=_FLUSH_S)
    recording.disconnect()


def _finish_file(recording: rr.RecordingStream, path: Path) -> None:
    try:
        recording.flush(timeout_sec=_SAVE_S)
    except RuntimeError as error:
        raise CpnetError(
            f"--save {path} is not whole: {error}; {_free_bytes(path)} bytes of the disk are free"
        ) from None
    finally:
        recording.disconnect()
    if (free_bytes := _free_bytes(path)) < _LEAST_FREE_BYTES:  # its end would be cut off silently
        raise CpnetError(
            f"--save {path} is not whole: {free_bytes} bytes of the disk are free, its end may lack"
        )


def _free_bytes(path: Path) -> int:
    try:
        return shutil.disk_usage(path.parent).free
    except OSError:  # the disk is gone as a whole
        return 0


def _file(recording: rr.RecordingStream, path: Path, scene: Scene) -> Sink:
    try:
        path.open("xb").close()
        recording.save(path, default_blueprint=blueprint(scene))
    except (OSError, RuntimeError) as error:
        raise ConfigError(f"--save {path}: {error}") from None
    return Sink(recording, f"writing {path}; `rerun {path}` shows it")


def _window(recording: rr.RecordingStream, scene: Scene) -> Sink:
    port = free_port()
    server = _started(["--port", str(port), "--hide-welcome-screen"], [port])
    recording.connect_grpc(_url(port), default_blueprint=blueprint(scene))
    return Sink(recording, "view: in Rerun's window", server)


@contextmanager
def _page(port: int) -> Iterator[tuple[str, str, subprocess.Popen[bytes]]]:
    """Serves page and data; yields the recording, its address and the server."""
    data = free_port()
    options = ["--serve-web", "--port", str(data), "--web-viewer-port", str(port)]
    options += ["--server-memory-limit", MEMORY, "--newest-first"]
    server = _started(options, [data, port])
    try:
        url = _url(data)
        yield url, f"http://{_HERE}:{port}/?url={quote(url, safe='')}", server
    finally:
        _stop(server)


def _url(port: int) -> str:
    return f"rerun+http://{_HERE}:{port}/proxy"


def _started(options: list[str], ports: list[int]) -> subprocess.Popen[bytes]:
    """Starts Rerun for this machine alone; a Ctrl-C in the terminal is not for it."""
    command = [str(Path(rerun_cli.__file__).parent / "rerun"), "--bind", _HERE, *options]
    with tempfile.TemporaryFile() as said:
        quiet = subprocess.DEVNULL
        server = subprocess.Popen(command, stdout=quiet, stderr=said, start_new_session=True)
        try:
            for port in ports:
                _await(server, port, said)
        except BaseException:  # an interruption as well
            _stop(server)
            raise
    return server


def _stop(server: subprocess.Popen[bytes]) -> None:
    server.terminate()
    try:
        server.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        server.kill()
        server.wait()


def _await(server: subprocess.Popen[bytes], port: int, said: IO[bytes]) -> None:
    give_up_ns = time.monotonic_ns() + round(_PATIENCE_S * 1e9)
    while time.monotonic_ns() < give_up_ns and server.poll() is None:
        with socket.socket() as probe:
            if probe.connect_ex((_HERE, port)) == 0:
                return
        time.sleep(0.05)
    said.seek(0)
    last = (said.read().decode("utf-8", "replace").strip().splitlines() or ["not a word"])[-1]
    raise ConfigError(
        f"Rerun serves nothing at port {port}; give another --port (it said: {last:.300})"
    )


def _check_free(port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((_HERE, port))
        except OSError as error:
            raise ConfigError(
                f"--port {port}: {error.strerror}; another run may be viewed there"
            ) from None


def free_port() -> int:
    """Returns a free port of this machine."""
    with socket.socket() as probe:
        probe.bind((_HERE, 0))
        port: int = probe.getsockname()[1]
        return port
