"""The packages of plug-ins in examples/, installed as a user would install them."""

import subprocess
import sys
from pathlib import Path

from tests.waiting import TIMEOUT_S

EXAMPLES = Path(__file__).parents[1] / "examples"


def install(folder: Path, package: Path = EXAMPLES / "plugin_package") -> Path:
    """Installs a package into a folder, to be put on the path."""
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    options = ["--no-deps", "--no-index", "--no-build-isolation", "--target", str(folder)]
    subprocess.run([*pip, *options, str(package)], check=True, timeout=TIMEOUT_S)
    return folder


def pretend(folder: Path, name: str, points: dict[str, dict[str, str]], **modules: str) -> Path:
    """Writes what an installed package leaves: its metadata, and modules by their text."""
    metadata = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    sections = [
        f"[{group}]\n" + "".join(f"{key} = {value}\n" for key, value in entries.items())
        for group, entries in points.items()
    ]
    (metadata / "entry_points.txt").write_text("\n".join(sections))
    for module, text in modules.items():
        (folder / f"{module}.py").write_text(text)
    return folder
