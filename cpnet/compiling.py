"""Ahead-of-time compilation of Numba functions: once per cpnet version and CPU, on all cores.

Numba compiles a module's functions when the module is imported, and keeps them beside it or, where
that may not be written, in the user's cache. One process after the other that would take minutes,
so modules are imported by several processes, each as soon as those it imports are done. A stamp in
the user's cache lists the files that have been compiled.
"""

from __future__ import annotations

import ast
import fcntl
import hashlib
import json
import multiprocessing
import os
import platform
import signal
import stat
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager, suppress
from functools import cache
from importlib import import_module
from importlib.metadata import version
from itertools import count
from pathlib import Path
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from cpnet.main_module import without_main
from cpnet.shadowing import ROOT
from protocol.errors import ConfigError
from protocol.starting import signals_deferred

_PACKAGES = (
    *("protocol", "perception", "sensing", "sim_host", "vehicle_agent", "infra_agent"),
    *("edge_server", "signal_controller", "recording", "studies", "v2x_router", "link_relay"),
)
_LATER = ("perception.pillars", "edge_server.alignment", "edge_server.static_map")
"""Modules that few runs import; they are compiled when one does."""
_MARK = b"njit("
_MOST_PROCESSES = 8
_TOLD_EACH = 10
_LOCK = "compiling.lock"


def compile_ahead(console: Console | None = None) -> int:
    """Compiles the functions that runs need, unless compiled; returns how many modules.

    Without a console it prints to standard error. Only the main process of a program compiles.

    Raises:
        ConfigError: there is no folder that may be written.
    """
    if multiprocessing.parent_process() is not None:
        return 0
    console = console or Console(stderr=True)
    folder = _cache_folder()
    stamps = _stamps()
    if not _missing(folder, stamps):
        return 0
    with (folder / _LOCK).open("a+") as lock:
        _acquire(lock, console)
        return _compile_missing(folder, stamps, console)


def _acquire(lock: TextIO, console: Console) -> None:
    """Waits while another process compiles the same, and says which one that is."""
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.seek(0)
        owner = lock.read() or "another"
        console.print(
            f"waiting for process {owner}, which compiles the same modules",
            highlight=False,
            markup=False,
            soft_wrap=True,
        )
        fcntl.flock(lock, fcntl.LOCK_EX)
    lock.truncate(0)
    lock.write(str(os.getpid()))
    lock.flush()


def _compile_missing(folder: Path, stamps: dict[str, str], console: Console) -> int:
    todo = _missing(folder, stamps)
    if not todo:
        return 0
    jobs = min(len(os.sched_getaffinity(0)), _MOST_PROCESSES, len(todo))
    console.print(
        f"compiling, once: {len(todo)} modules on {jobs} core{'s' * (jobs > 1)}",
        highlight=False,
        soft_wrap=True,
    )
    with _progress(console, len(todo)) as advance:
        _compile(todo, jobs, advance)
    _write_stamp(folder, stamps)
    return len(todo)


@contextmanager
def _progress(console: Console, total: int) -> Iterator[Callable[[], object]]:
    """Shows progress: in place on a terminal, else by a line for each tenth module."""
    if console.is_terminal:
        columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
        with Progress(*columns, console=console, transient=True) as bar:
            task = bar.add_task("compiling", total=total)
            yield lambda: bar.advance(task)
        return
    done = count(1)

    def advance() -> None:
        number = next(done)
        if number % _TOLD_EACH == 0 and number < total:
            console.print(f"compiled {number}/{total}", highlight=False)

    yield advance


def _compile(todo: dict[str, set[str]], jobs: int, advance: Callable[[], object]) -> None:
    """Imports modules in processes, each once those that it needs are done."""
    waiting, running = dict(todo), dict[Future[None], str]()
    done: set[str] = set()
    with without_main(), _pool(jobs) as pool, _ending_processes():
        while waiting or running:
            ready = [name for name, needs in waiting.items() if needs <= done]
            for name in sorted(ready, key=lambda name: -_weight(name)):
                del waiting[name]
                with signals_deferred(), _without_interrupts():
                    running[pool.submit(_import, name)] = name
            finished, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in finished:
                done.add(running.pop(future))
                future.result()
                advance()


def _pool(jobs: int) -> ProcessPoolExecutor:
    with signals_deferred():  # it imports modules, and an import that breaks off leaves a file open
        return ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn"))


@contextmanager
def _ending_processes() -> Iterator[None]:
    """Kills this process's children where the block is left by an error or a signal."""
    try:
        yield
    except BaseException:
        for child in multiprocessing.active_children():
            child.kill()
        raise


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Blocks Ctrl-C; processes that are started meanwhile never receive it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _weight(module: str) -> int:
    """Estimates the compile time of a module: the longest go first."""
    return _file_of(module).stat().st_size


def _import(module: str) -> None:
    with suppress(ImportError):  # an extra that is not installed
        import_module(module)


def _missing(folder: Path, stamps: dict[str, str]) -> dict[str, set[str]]:
    """Returns the modules to compile, each with those among them that it imports."""
    known = _read_stamp(folder)
    todo = {name for name, stamp in stamps.items() if known.get(name) != stamp}
    return {name: set(_imported(name) - {name}) & todo for name in sorted(todo)}


def _stamps() -> dict[str, str]:
    """Returns time and size of each file with functions to compile, by its module."""
    found = {}
    for package in _PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            if _MARK in path.read_bytes() and not name.startswith(_LATER):
                found[name] = f"{path.stat().st_mtime_ns}-{path.stat().st_size}"
    return found


@cache
def _imported(module: str) -> frozenset[str]:
    """Returns the modules of cpnet that importing one imports, itself included."""
    found, left = set[str](), [module]
    while left:
        name = left.pop()
        if name not in found and _file_of(name).is_file():
            found.add(name)
            left += _imports_of(name)
    return frozenset(found)


@cache
def _imports_of(module: str) -> tuple[str, ...]:
    """Returns a module's imports at the top level: not those of functions or type checkers."""
    tree = ast.parse(_file_of(module).read_text("utf-8"))
    return tuple(name for node in tree.body for name in _names(node) if _is_own(name))


def _names(node: ast.stmt) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom) and node.module:
        yield node.module
        yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _is_own(module: str) -> bool:
    return module.partition(".")[0] in _PACKAGES


def _file_of(module: str) -> Path:
    path = ROOT.joinpath(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def _stamp_file(folder: Path) -> Path:
    """Returns the stamp's path: one for each combination that compiled code depends on."""
    import llvmlite.binding as llvm  # names the CPU as Numba does

    facts = [
        str(ROOT),
        os.environ.get("NUMBA_CACHE_DIR", ""),
        platform.python_version(),
        *(version(name) for name in ("numba", "llvmlite", "numpy")),
        llvm.get_host_cpu_name(),
        llvm.get_host_cpu_features().flatten(),
        os.environ.get("NUMBA_CPU_NAME", ""),
    ]
    digest = hashlib.sha256("\n".join(facts).encode()).hexdigest()[:16]
    return folder / f"compiled-{digest}.json"


def _read_stamp(folder: Path) -> dict[str, str]:
    try:
        found = json.loads(_stamp_file(folder).read_text("utf-8"))
        return {str(name): str(stamp) for name, stamp in found.items()}
    except (OSError, ValueError, AttributeError):
        return {}


def _write_stamp(folder: Path, stamps: dict[str, str]) -> None:
    path = _stamp_file(folder)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    partial.write_text(json.dumps(stamps), "utf-8")
    partial.replace(path)


def _cache_folder() -> Path:
    """Returns a folder for the stamp; where Numba would find none for its files, it gets one.

    Raises:
        ConfigError: no folder is writable by this user alone.
    """
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    homes = [Path(chosen)] if chosen else [_user_cache() / "cpnet"]
    for folder in homes:
        if _is_writable(folder):
            return folder
    if chosen:
        raise ConfigError(f"NUMBA_CACHE_DIR is {chosen}, which cannot be written")
    folder = Path(tempfile.gettempdir()) / f"cpnet-cache-{os.getuid()}"
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    found = folder.lstat()  # files there are executed: only this user may have written them
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise ConfigError(f"{folder} is another user's: set NUMBA_CACHE_DIR to a folder of yours")
    if not os.access(ROOT / "protocol", os.W_OK):
        os.environ["NUMBA_CACHE_DIR"] = str(folder)
    return folder


def _user_cache() -> Path:
    given = os.environ.get("XDG_CACHE_HOME")
    try:
        return Path(given) if given else Path.home() / ".cache"
    except RuntimeError:  # no home
        return Path("/nonexistent")


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False
