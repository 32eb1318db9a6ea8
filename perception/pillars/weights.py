"""Weights in a file: safetensors, with the network's shape and what is known of their making."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from perception.pillars.config import PillarsConfig
from perception.pillars.network import PointPillars
from protocol.errors import ConfigError

SHIPPED = Path(__file__).parent / "weights"
FORMAT = "cpnet-pillars-1"
MAX_BYTES = 200 << 20


def save(network: PointPillars, path: Path, about: Mapping[str, Any]) -> None:
    """Writes a network in half precision; `about` is what its users may want to know of it."""
    tensors = {
        name: value.detach().cpu().half().contiguous() if value.is_floating_point() else value.cpu()
        for name, value in network.state_dict().items()
    }
    metadata = {
        "format": FORMAT,
        "config": network.config.model_dump_json(),
        "about": json.dumps(about),
    }
    save_file(tensors, path, metadata)


def describe(path: Path, more: Mapping[str, Any]) -> None:
    """Adds to what a file says of its weights; these stay as they are.

    Raises:
        ConfigError: see `load`.
    """
    network, about = load(path)
    save(network, path, {**about, **more})


def load(path: Path) -> tuple[PointPillars, dict[str, Any]]:
    """Reads a network and what is known of it.

    Raises:
        ConfigError: the file is missing, broken, or of another network.
    """
    if not path.is_file():
        raise ConfigError(f"weights {path}: there is no such file")
    if path.stat().st_size > MAX_BYTES:
        raise ConfigError(f"weights {path}: {path.stat().st_size} bytes, limit {MAX_BYTES}")
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no dict
    except (SafetensorError, OSError) as error:
        raise ConfigError(f"weights {path}: {error}") from None
    if metadata.get("format") != FORMAT:
        raise ConfigError(f"weights {path}: format {metadata.get('format')!r}, needs {FORMAT!r}")
    try:
        network = PointPillars(PillarsConfig.model_validate_json(metadata["config"]))
        about = json.loads(metadata["about"])
    except (ValidationError, ValueError, KeyError) as error:
        raise ConfigError(f"weights {path}: its description is not valid: {error}") from None
    try:
        network.load_state_dict(
            {k: v.float() if v.is_floating_point() else v for k, v in tensors.items()}
        )
    except RuntimeError as error:
        raise ConfigError(f"weights {path}: not those of its network: {error}") from None
    if not all(bool(torch.isfinite(value).all()) for value in network.state_dict().values()):
        raise ConfigError(f"weights {path}: they hold numbers that are not finite")
    return network.eval(), about
