"""Documentation is generated from the code, complete, and without broken links."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml

from cpnet.scenario import Scenario
from protocol.messages import MESSAGES
from protocol.topics import TOPICS
from recording.tables import TABLES
from sensing.upload_policies import POLICIES
from studies.bench import POLICY_CHOICES
from tests.waiting import TIMEOUT_S

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def generate() -> ModuleType:
    spec = importlib.util.spec_from_file_location("documentation", ROOT / "docs" / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def keys_of(data: dict[str, Any], path: str = "") -> list[str]:
    """Returns the dotted keys that `cpnet scenario` prints."""
    found = []
    for name, value in data.items():
        found.append(f"{path}{name}")
        found += keys_of(value, f"{path}{name}.") if isinstance(value, dict) else []
    return found


def test_every_key_of_a_scenario_says_what_it_is(generate) -> None:
    schema = Scenario.model_json_schema()
    silent = [
        f"{path}.{name}"
        for path, section in generate.sections(schema)
        for name, field in section["properties"].items()
        if not generate.description(field, schema)
    ]
    assert silent == []


def test_the_page_of_keys_has_every_key_with_its_default(generate) -> None:
    page = generate.scenario_page()
    for key in keys_of(Scenario().model_dump(mode="json")):
        assert f"| `{key}` |" in page
    assert "| `edge.cluster.eps_m` | number | `1.25` | > 0, ≤ 5 |" in page
    for inner in ("## traffic.vehicles[]", "## link.profile.rate (kind: trace)", "`rates_bps`"):
        assert inner in page


def test_the_pages_of_the_protocol_have_every_topic_and_message(generate) -> None:
    topics, messages = generate.topics_page(), generate.messages_page()
    for topic in TOPICS.values():
        link = f"[{topic.message.__name__}](messages.md#{topic.message.__name__.lower()})"
        assert f"| {topic.name} | `{topic.template}`" in topics
        assert link in topics
    for message in MESSAGES.values():
        _, _, section = messages.partition(f"\n## {message.__name__}\n")
        section, _, _ = section.partition("\n## ")
        for name in message.model_fields:
            assert f"| `{name}` |" in section
    assert "| `poses` | array of float64, (N, 6) |" in messages


def test_the_page_of_tables_has_every_column_with_its_unit(generate) -> None:
    page = generate.tables_page()
    for table in TABLES.values():
        _, _, section = page.partition(f"\n## {table.name}\n")
        section, _, _ = section.partition("\n## ")
        for name in table.columns:
            assert f"| `{name}` | " in section
    assert "| `speed_mps` | float | m/s |  |" in page
    assert "| `link_sim_ns` | int or null | ns |  |" in page
    assert "| `frame` | int |  | key |" in page


def test_every_page_is_in_the_navigation(generate) -> None:
    text = (ROOT / "mkdocs.yml").read_text("utf-8")
    listed = re.findall(r"[\w/-]+\.md", str(yaml.safe_load(text)["nav"]))
    written = [path.name for path in (ROOT / "docs").glob("*.md")]
    assert sorted(listed) == sorted([*written, *generate.GENERATED])


def test_links_out_of_the_docs_lead_to_files(generate) -> None:
    linked = [
        path
        for page in (ROOT / "docs").glob("*.md")
        for path in generate.outside(page.read_text("utf-8"))
    ]
    assert linked
    assert [path for path in linked if not (ROOT / path).is_file()] == []


def test_files_that_the_docs_include_are_there_and_marked_as_the_site_reads_it() -> None:
    pages = [page.read_text("utf-8") for page in (ROOT / "docs").glob("*.md")]
    assert [line for page in pages for line in page.splitlines() if "8 <" in line] == []
    included = [path for page in pages for path in re.findall(r'^--8<-- "([^"]+)"$', page, re.M)]
    assert included
    assert [path for path in included if not (ROOT / path).is_file()] == []


def test_every_upload_policy_is_described_and_measured() -> None:
    page = (ROOT / "docs" / "protocol.md").read_text("utf-8")
    _, _, section = page.partition("## What agents upload")
    assert [name for name in POLICIES if f"`{name}`" not in section.partition("\n## ")[0]] == []
    measured = {choice.partition("+")[0] for choice in POLICY_CHOICES}
    assert POLICIES.keys() - measured == {"pose"}  # without LiDAR there is nothing to compare


@pytest.mark.skipif(
    importlib.util.find_spec("material") is None, reason="needs mkdocs-material (extra `docs`)"
)
def test_the_site_builds_without_a_warning_and_needs_nothing_from_elsewhere(tmp_path) -> None:
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")],
        cwd=ROOT,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
    )
    assert done.returncode == 0, done.stderr
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) > 15
    for page in pages:
        fetched = re.findall(r'(?:src|<link[^>]*href)="(https?://[^"]+)', page.read_text("utf-8"))
        assert fetched == []
    plugins = (tmp_path / "site" / "plugins" / "index.html").read_text("utf-8")
    assert "LongestQueue" in plugins  # the example's code, not a line that includes it
