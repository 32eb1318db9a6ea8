"""The wheel that `pip install .` makes: all that cpnet needs, run from another folder."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest
import yaml

from tests.waiting import TIMEOUT_S

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "wheel", "--quiet"]
    options = ["--no-deps", "--no-index", "--no-build-isolation", "--wheel-dir", str(folder)]
    subprocess.run([*pip, *options, str(ROOT)], check=True, timeout=TIMEOUT_S)
    return next(folder.glob("*.whl"))


def test_the_wheel_has_every_source_file_of_every_package_and_its_types(wheel) -> None:
    packages = {path.parent.name for path in ROOT.glob("*/py.typed")}
    assert {"cpnet", "protocol", "edge_server", "sim_host"} <= packages
    wanted = {
        path.relative_to(ROOT).as_posix()
        for package in packages
        for path in (ROOT / package).rglob("*")
        if path.is_file() and path.suffix not in {".pyc", ".nbi", ".nbc"}
    }
    with zipfile.ZipFile(wheel) as archive:
        assert wanted <= set(archive.namelist())


def test_the_citation_is_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert citation["version"] == project["version"]
    assert citation["license"] == project["license"]
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()


def test_no_text_tells_to_install_from_an_index_where_the_package_is_not() -> None:
    """Neither the docs nor any error; what is installed in a clone or by its file is fine."""
    sources = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *ROOT.glob("*/**/*.py")]
    own = [path for path in sources if "tests" not in path.parts and ".venv" not in path.parts]
    pattern = re.compile(r"pip install [^\n]*(?<![\w-])cpnet-(edge|example)")
    assert [str(path) for path in own if pattern.search(path.read_text("utf-8"))] == []


def test_every_package_of_the_project_is_typed() -> None:
    packages = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    assert [name for name in packages - {"tests"} if not (ROOT / name / "py.typed").is_file()] == []


def take_compiled_along(site: Path) -> None:
    """Saves the minute that compiling all of it again would take; the code is the same."""
    for source in site.rglob("*.py"):
        shutil.copystat(ROOT / source.relative_to(site), source)  # by which it counts as the same
        compiled = (ROOT / source.relative_to(site)).parent / "__pycache__"
        for path in compiled.glob(f"{source.stem}.*.nb[ic]"):
            source.with_name("__pycache__").mkdir(exist_ok=True)
            shutil.copy2(path, source.with_name("__pycache__"))


@pytest.mark.process
def test_an_installed_cpnet_runs_the_loop_from_another_folder(wheel, tmp_path) -> None:
    """The new environment has the wheel of its own and this environment's dependencies."""
    venv.create(tmp_path / "env", with_pip=False, symlinks=True)
    python = tmp_path / "env" / "bin" / "python"
    site = Path(sysconfig.get_path("purelib", vars={"base": str(tmp_path / "env")}, scheme="venv"))
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    take_compiled_along(site)
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    clean = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    here = tmp_path / "elsewhere"
    here.mkdir()
    command = [str(python), "-m", "cpnet", "up", "t_junction", "--duration", "2", "--out", "run"]
    small = ["--set=lidar.vehicle.channels=16", "--set=lidar.roadside.channels=16"]
    done = subprocess.run(
        [*command, *small], cwd=here, env=clean, capture_output=True, text=True, timeout=TIMEOUT_S
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert (here / "run" / "run.sqlite").is_file()
    origin = [str(python), "-c", "import cpnet; print(cpnet.__file__)"]
    shown = subprocess.run(origin, cwd=here, env=clean, capture_output=True, text=True, check=True)
    assert Path(shown.stdout.strip()).is_relative_to(site)
