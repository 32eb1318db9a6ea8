"""Pages of the documentation that are made from the code when the site is built.

A hook of MkDocs (`mkdocs.yml`). The front page, contributing and changes are files of the
repository's root; scenario keys come from the scenario's classes, topics and messages from the
protocol's. Files outside `docs/` to which a page links become files of the site, so that such
links are checked.
"""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_type_hints

import numpy as np
from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import core_schema

import protocol.messages
from cpnet.scenario import Scenario
from protocol.messages import MESSAGES, Part
from protocol.messages.fields import Array
from protocol.topics import PREFIX, QUERIED, ROLES, TOPICS, Delivery, Roles, Topic
from recording.tables import TABLES

ROOT = Path(__file__).parent.parent
_OUTSIDE = re.compile(r"\]\(\.\./([^)#\s]+)")
_CODE = re.compile(r"`[^`]*`")
_BOUNDS = {
    "minimum": "≥ {}", "exclusiveMinimum": "> {}", "maximum": "≤ {}", "exclusiveMaximum": "< {}",
    "minLength": "≥ {} characters", "maxLength": "≤ {} characters",
    "minItems": "≥ {} entries", "maxItems": "≤ {} entries", "pattern": "`{}`",
}  # fmt: skip


def pages() -> dict[str, str]:
    """Returns the generated pages, Markdown by path."""
    return {path: make() for path, make in GENERATED.items()}


def scenario_page() -> str:
    """Returns a table of keys for each section of a scenario."""
    schema = Scenario.model_json_schema()
    parts = [
        "# Scenario keys",
        "Every key of a scenario with its default, as `cpnet scenario` prints them and "
        "`--set KEY=VALUE` takes them. A file needs only the keys that differ. Unknown keys and "
        "values out of range are refused. Made from the classes that validate a scenario.",
    ]
    for path, section in sections(schema):
        about = "A whole run." if not path else _text(section.get("description", ""))
        parts += [f"## {path or 'The scenario'}", about, _keys_table(path, section, schema)]
    return "\n\n".join(parts) + "\n"


def sections(schema: JsonSchemaValue) -> Iterator[tuple[str, JsonSchemaValue]]:
    """Yields the scenario's sections by their dotted paths, `[]` for an entry of a list."""

    def walk(path: str, section: JsonSchemaValue) -> Iterator[tuple[str, JsonSchemaValue]]:
        yield path, section
        for name, field in section["properties"].items():
            for suffix, inner in _inner(field, schema):
                yield from walk(f"{path}.{name}{suffix}".lstrip("."), inner)

    yield from walk("", schema)


def _inner(
    field: JsonSchemaValue, schema: JsonSchemaValue
) -> Iterator[tuple[str, JsonSchemaValue]]:
    """Yields the sections that a key holds."""
    choices = field.get("anyOf") or field.get("oneOf") or [field]
    several = sum("$ref" in choice for choice in choices) > 1
    for choice in choices:
        of, suffix = (choice["items"], "[]") if "items" in choice else (choice, "")
        target = _target(of, schema)
        if "properties" in target:
            kind = target["properties"].get("kind", {}).get("const")
            yield (f"{suffix} (kind: {kind})" if several and kind else suffix), target


def _target(field: JsonSchemaValue, schema: JsonSchemaValue) -> JsonSchemaValue:
    name = field.get("$ref", "").removeprefix("#/$defs/")
    target: JsonSchemaValue = schema["$defs"][name] if name else field
    return target


def _keys_table(path: str, section: JsonSchemaValue, schema: JsonSchemaValue) -> str:
    rows = ["| key | type | default | allowed | |", "|---|---|---|---|---|"]
    for name, field in section["properties"].items():
        key = f"{path}.{name}".lstrip(".") if "(" not in path and "[" not in path else name
        is_section = any(not suffix for suffix, _ in _inner(field, schema))
        default = "" if is_section and field.get("default") else _default(field)
        cells = [f"`{key}`", _type(field, schema), default, _bounds(field, schema)]
        rows.append(_row([*cells, description(field, schema)]))
    return "\n".join(rows)


def description(field: JsonSchemaValue, schema: JsonSchemaValue) -> str:
    """Returns the description of a key, or else of its section."""
    about = field.get("description")
    return _text(about or _target(field, schema).get("description", "").split("\n\n")[0])


def _default(field: JsonSchemaValue) -> str:
    if "default" not in field:
        return "given by the scenario's class" if "items" in field else ""
    return f"`{json.dumps(field['default'], ensure_ascii=False)}`"


_TYPES = {"number": "number", "integer": "integer", "string": "text", "boolean": "true, false"}


def _type(field: JsonSchemaValue, schema: JsonSchemaValue) -> str:
    if choices := field.get("anyOf") or field.get("oneOf"):
        return " or ".join(dict.fromkeys(_type(choice, schema) for choice in choices))
    target = _target(field, schema)
    if "properties" in target:
        return "section" if schema["title"] == "Scenario" else str(target["title"])
    if "prefixItems" in target:
        return f"({', '.join(_type(item, schema) for item in target['prefixItems'])})"
    kind = target.get("type", "anything")
    if kind == "array":
        return f"list of {_type(target.get('items', {}), schema)}"
    if kind == "object":
        values = target.get("additionalProperties")
        return f"mapping to {_type(values if isinstance(values, dict) else {}, schema)}"
    return "one of" if target.keys() & {"enum", "const"} else _TYPES.get(kind, kind)


def _bounds(field: JsonSchemaValue, schema: JsonSchemaValue) -> str:
    target = _target(field, schema)
    named = target.get("enum") or ([target["const"]] if "const" in target else [])
    shown = [f"`{value}`" for value in named]
    if "prefixItems" not in target:
        bounds = {name: target[name] for name in _BOUNDS if name in target}
        shown += [_BOUNDS[name].format(_round(value)) for name, value in bounds.items()]
    for choice in [*target.get("anyOf", []), target.get("items", {})]:
        inner = _bounds(choice, schema) if choice else ""
        shown += [inner] if inner else []
    return ", ".join(dict.fromkeys(shown))


def _round(value: object) -> object:
    """Returns a number as people write it: large powers of two as such."""
    if isinstance(value, int) and abs(value) >= 1 << 20 and abs(value).bit_count() == 1:
        return f"{'-' if value < 0 else ''}2^{abs(value).bit_length() - 1}"
    return value


def topics_page() -> str:
    """Returns the topic table."""
    head = ["topic", "key", "message", "bus", "delivery", "published by", "subscribed by"]
    rows = [_row(head), _row(["---"] * len(head))]
    rows += [_row(_topic_cells(topic)) for topic in TOPICS.values()]
    delivery = inspect.getdoc(Delivery) or ""
    return "\n\n".join(
        [
            "# Topics",
            f"Keys stand under `{PREFIX}/`; those marked (query) are not published but queried. "
            "[How a frame travels](../protocol.md) says what happens on the way.",
            "\n".join(rows),
            _text(delivery),
            "",
        ]
    )


def _topic_cells(topic: Topic) -> list[str]:
    key = f"`{topic.template}`" + (" (query)" if topic.name in QUERIED else "")
    message = topic.message.__name__
    link = f"[{message}](messages.md#{message.lower()})"
    by, to = _roles(topic.publishers), _roles(topic.subscribers)
    return [topic.name, key, link, topic.bus.value, topic.delivery.value, by, to]


def _roles(roles: Roles) -> str:
    return "all" if roles == ROLES else ", ".join(sorted(roles))


class _Schema(GenerateJsonSchema):
    """Arrays have no JSON schema; `_array` describes them."""

    def function_plain_schema(self, schema: core_schema.CoreSchema) -> JsonSchemaValue:  # noqa: ARG002 - as the base has it
        return {}


def messages_page() -> str:
    """Returns every message with its fields."""
    parts = [
        "# Messages",
        "Fields of the header and arrays of each message; "
        "[on the wire](../protocol.md#on-the-wire) describes their encoding. Made from the "
        "classes in `protocol/messages/`.",
        _paragraphs(inspect.getdoc(protocol.messages) or ""),
    ]
    for kind, message in MESSAGES.items():
        parts += [f"## {message.__name__}", f"Kind {kind}.", *_fields(message)]
    held = sorted(Part.__subclasses__(), key=lambda part: part.__name__)
    for part in [one for one in held if one.__module__.startswith("protocol.messages")]:
        parts += [f"## {part.__name__}", "Held by messages.", *_fields(part)]
    return "\n\n".join(parts) + "\n"


def _fields(model: type[BaseModel]) -> list[str]:
    schema = model.model_json_schema(schema_generator=_Schema)
    rows = ["| field | type | allowed |", "|---|---|---|"]
    for name, field in schema["properties"].items():
        array = next((m for m in model.model_fields[name].metadata if isinstance(m, Array)), None)
        kind = _type(field, schema) if array is None else _array(array)
        rows.append(_row([f"`{name}`", kind, _bounds(field, schema) if array is None else ""]))
    return [_paragraphs(inspect.getdoc(model) or ""), "\n".join(rows)]


def _array(array: Array) -> str:
    shape = ", ".join("N" if side is None else str(side) for side in array.shape)
    return f"array of {np.dtype(array.dtype).name}, ({shape}{',' if len(array.shape) == 1 else ''})"


def _of_root(name: str) -> Callable[[], str]:
    """Returns what reads a page of the repository's root, with links as the site has them."""

    def read() -> str:
        text = (ROOT / name).read_text("utf-8").replace("](docs/", "](")
        return re.sub(r"\]\((CONTRIBUTING|CHANGELOG)\.md", lambda m: m.group().lower(), text)

    return read


def _paragraphs(text: str) -> str:
    return "\n\n".join(_text(part) for part in text.split("\n\n"))


def _text(text: str) -> str:
    return " ".join(text.split())


def _row(cells: list[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def outside(markdown: str) -> list[str]:
    """Returns the paths in the repository, outside `docs/`, that a page links to."""
    return list(dict.fromkeys(_OUTSIDE.findall(markdown)))


def on_files(files: Any, config: Any) -> Any:  # noqa: ANN401 - MkDocs, which tests do without
    """Adds the generated pages, and the files that pages link to."""
    from mkdocs.structure.files import File

    linked = {p: None for page in files.documentation_pages() for p in outside(page.content_string)}
    for path in sorted(linked.keys() - {"README.md"}):
        source = str(ROOT / path)
        files.append(File.generated(config, _copy(path), abs_src_path=source))
    for path, content in pages().items():
        files.append(File.generated(config, path, content=content))
    return files


def on_page_markdown(markdown: str, page: Any, **_: object) -> str:  # noqa: ANN401 - the same
    """Points links out of `docs/` to the site's copies; writes tables as MkDocs reads them."""
    if page.file.src_uri not in GENERATED:
        markdown = _OUTSIDE.sub(_inward, markdown)
    return "\n".join(
        _CODE.sub(lambda code: code.group().replace("\\|", "|"), line) if line[:1] == "|" else line
        for line in markdown.split("\n")
    )


def _inward(link: re.Match[str]) -> str:
    path = link.group(1)
    return f"]({'index.md' if path == 'README.md' else _copy(path)}"


def _copy(path: str) -> str:
    return f"source/{path}.txt"  # which browsers show, whatever the file is


_UNITS = {
    "m": "m", "mps": "m/s", "rad": "rad", "s": "s", "ns": "ns", "bytes": "bytes", "sim_ns": "ns",
}  # fmt: skip


def tables_page() -> str:
    """Returns the columns of each table of a run, with their types and units."""
    parts = [
        "# Tables of a run",
        "Tables of `run.sqlite`; `cpnet.Run` gives them as [Polars frames](../python.md). A "
        "column's unit is the end of its name; positions are in the map frame, which is the net's: "
        "x east, y north, z up. `_ns` is a process's monotonic clock, but for `sim_time_ns`.",
    ]
    for table in TABLES.values():
        keys, hints = set(table.columns[: table.keys]), get_type_hints(table.row)
        rows = [
            _row([f"`{name}`", _kind(hints[name]), _unit(name), "key" if name in keys else ""])
            for name in table.columns
        ]
        head = [_row(["column", "type", "unit", ""]), "|---|---|---|---|"]
        about = _paragraphs(inspect.getdoc(table.row) or "")
        parts += [f"## {table.name}", about, "\n".join(head + rows)]
    return "\n\n".join(parts) + "\n"


def _kind(hint: object) -> str:
    kinds = get_args(hint) or (hint,)
    names = [kind.__name__ for kind in kinds if isinstance(kind, type) and kind is not NoneType]
    return " or ".join([*names, *(["null"] if NoneType in kinds else [])])


def _unit(column: str) -> str:
    return _UNITS.get(column.rsplit("_", 1)[-1], "") if "_" in column else ""


GENERATED = {
    "index.md": _of_root("README.md"),
    "contributing.md": _of_root("CONTRIBUTING.md"),
    "changelog.md": _of_root("CHANGELOG.md"),
    "reference/scenario.md": scenario_page,
    "reference/topics.md": topics_page,
    "reference/messages.md": messages_page,
    "reference/tables.md": tables_page,
}
