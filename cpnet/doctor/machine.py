"""What a machine must have: Python, packages, system libraries, room."""

from __future__ import annotations

import ctypes
import importlib.util
import os
import platform
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path

from cpnet.doctor.finding import Finding
from protocol.courtesy import core_quota

SUMO_LIBRARIES = {
    "libstdc++.so.6": "libstdc++6",
    "libgcc_s.so.1": "libgcc-s1",
    "libz.so.1": "zlib1g",
    "libexpat.so.1": "libexpat1",
    "libatomic.so.1": "libatomic1",
    "libX11.so.6": "libx11-6",
    "libXext.so.6": "libxext6",
    "libXrender.so.1": "libxrender1",
    "libGL.so.1": "libgl1",
}
"""What SUMO's wheels link to but do not bring: shared library to Debian and Ubuntu package."""

OPEN3D_LIBRARIES = {
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libGL.so.1": "libgl1",
    "libgomp.so.1": "libgomp1",
}
"""The same of Open3D, which the detector `reference` needs."""

PARTS = {
    "zenoh": "eclipse-zenoh",
    "embreex": "embreex",
    "numba": "numba",
    "libsumo": "libsumo",
    "sumo": "eclipse-sumo",
    "matplotlib": "matplotlib",
}
MIN_FREE_BYTES = 1 << 30
MIN_MEMORY_BYTES = 4 << 30
MIN_CORES = 2
_CGROUP = Path("/sys/fs/cgroup")


def missing_packages() -> list[str]:
    """Returns the system packages that SUMO, and Open3D if it is installed, lack here."""
    has_open3d = importlib.util.find_spec("open3d") is not None
    return _missing(SUMO_LIBRARIES | (OPEN3D_LIBRARIES if has_open3d else {}))


def python() -> list[Finding]:
    """Looks at the interpreter."""
    ok = sys.version_info >= (3, 11)
    what = f"Python {platform.python_version()}"
    return [Finding("python", what, ok, "" if ok else "needs 3.11 or newer")]


def libraries() -> list[Finding]:
    """Looks for the system libraries of SUMO, and of Open3D."""
    return [
        _of("sumo_libraries", "SUMO", SUMO_LIBRARIES),
        _of("open3d_libraries", "Open3D (edge.detector=reference)", OPEN3D_LIBRARIES),
    ]


def parts() -> list[Finding]:
    """Looks for packages."""
    result = []
    for module, package in PARTS.items():
        found = importlib.util.find_spec(module) is not None
        advice = "" if found else f"pip install {package}"
        result.append(Finding(f"package_{package}", f"package {package}", found, advice))
    return result


def disk() -> list[Finding]:
    """Looks whether a run can be written here."""
    free = shutil.disk_usage(Path.cwd()).free
    ok = free >= MIN_FREE_BYTES and os.access(Path.cwd(), os.W_OK)
    advice = "" if ok else "run folders are written here: needs 1 GiB and write permission"
    what = f"{free / 2**30:.0f} GiB free in this folder"
    return [Finding("disk", what, ok, advice, measured={"free_bytes": free})]


def cores() -> list[Finding]:
    """Looks how many cores processes may use."""
    count = float(len(os.sched_getaffinity(0)))
    if (quota := core_quota(_CGROUP)) is not None:
        count = min(count, quota)
    ok = count >= MIN_CORES
    advice = "" if ok else f"with fewer than {MIN_CORES}, realtime runs fall behind"
    what = f"{count:g} cores"
    return [Finding("cores", what, ok, advice, optional=True, measured={"cores": count})]


def memory() -> list[Finding]:
    """Looks how much memory there is for all processes together."""
    rows = Path("/proc/meminfo").read_text().splitlines()
    total = next(int(row.split()[1]) * 1024 for row in rows if row.startswith("MemTotal:"))
    limit = _words(_CGROUP / "memory.max")
    if limit and limit[0].isdigit():
        total = min(total, int(limit[0]))
    ok = total >= MIN_MEMORY_BYTES
    advice = "" if ok else f"a run with all roles wants {MIN_MEMORY_BYTES >> 30} GiB"
    what = f"{total / 2**30:.1f} GiB of memory"
    return [Finding("memory", what, ok, advice, optional=True, measured={"memory_bytes": total})]


def _of(check: str, user: str, wanted: Mapping[str, str]) -> Finding:
    missing = _missing(wanted)
    advice = f"apt-get install -y --no-install-recommends {' '.join(missing)}" if missing else ""
    what = f"{len(wanted)} system libraries of {user}"
    return Finding(check, what, not missing, advice, optional=wanted is OPEN3D_LIBRARIES)


def _missing(wanted: Mapping[str, str]) -> list[str]:
    return [package for library, package in wanted.items() if not _loads(library)]


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def _words(path: Path) -> list[str]:
    """Returns the words of a file of the kernel, none where the kernel has no such file."""
    try:
        return path.read_text().split()
    except OSError:
        return []
