"""Weight files: safetensors, with the network's shape and metadata of the training."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from perception.config import PillarsDetection
from perception.pillars.config import NETWORKS, PillarsConfig
from perception.pillars.network import PointPillars
from protocol.config import is_file, is_folder
from protocol.errors import ConfigError

SHIPPED = Path(__file__).parent / "weights"
FORMAT = "cpnet-pillars-1"
MAX_BYTES = 200 << 20


def save(network: PointPillars, path: Path, about: Mapping[str, Any]) -> None:
    """Writes a network in half precision; `about` is metadata for its users."""
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
    """Adds to the metadata of a file; its weights stay as they are.

    Raises:
        ConfigError: see `load`.
    """
    network, about = load(path)
    save(network, path, {**about, **more})


def network_of(name: str, config: PillarsDetection) -> PointPillars:
    """Reads a network by its name, with the user's weights or the shipped ones.

    Raises:
        ConfigError: see `load`; or the weights are those of the other network.
    """
    path = Path(config.weights) if config.weights else SHIPPED / f"{name}.safetensors"
    network, _ = load(path)
    widths = _widths(network.config)
    others = [n for n, known in NETWORKS.items() if _widths(known) == widths and n != name]
    if others:
        raise ConfigError(f"weights {path}: they are of {others[0]}, not of {name}")
    return network


def _widths(config: PillarsConfig) -> tuple[object, ...]:
    """Returns the shape that distinguishes networks; anchors and heights are of the training."""
    return config.pillar_channels, config.channels, config.layers, config.up_channels


def load(path: Path) -> tuple[PointPillars, dict[str, Any]]:
    """Loads a network and its metadata.

    Raises:
        ConfigError: the file is missing, broken, or of another network.
    """
    metadata, tensors = _read(path)
    if metadata.get("format") != FORMAT:
        raise ConfigError(f"weights {path}: format {metadata.get('format')!r}, needs {FORMAT!r}")
    try:
        config, about = _described(metadata)
    except (ValueError, KeyError, RecursionError) as error:
        reason = _first_of(error) if isinstance(error, ValidationError) else str(error)
        raise ConfigError(f"weights {path}: its description is not valid: {reason}") from None
    with torch.device("meta"):  # takes no memory, however large it is declared
        network = PointPillars(config)
    if wrong := _mismatch(network.state_dict(), tensors):
        raise ConfigError(f"weights {path}: not those of its network: {wrong}")
    network.to_empty(device="cpu").load_state_dict(tensors)
    for name, value in network.state_dict().items():
        if not bool(torch.isfinite(value).all()):
            raise ConfigError(f"weights {path}: {name} holds numbers that are not finite")
        if name.endswith("running_var") and bool((value < 0).any()):
            raise ConfigError(f"weights {path}: {name} is a variance, but holds negative numbers")
    return network.eval(), about


def _first_of(error: ValidationError) -> str:
    """Returns the first mistake, on one line."""
    first = error.errors()[0]
    return ": ".join([".".join(str(part) for part in first["loc"]) or "config", first["msg"]])


def _read(path: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    if is_folder(path):
        raise ConfigError(f"weights {path}: is a folder, needs a file")
    if not is_file(path):
        raise ConfigError(f"weights {path}: there is no such file")
    if path.stat().st_size > MAX_BYTES:
        raise ConfigError(f"weights {path}: {path.stat().st_size} bytes, limit {MAX_BYTES}")
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            return metadata, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no dict
    except (SafetensorError, OSError) as error:
        raise ConfigError(f"weights {path}: is no whole safetensors file: {error}") from None


def _described(metadata: Mapping[str, str]) -> tuple[PillarsConfig, dict[str, Any]]:
    about = json.loads(metadata["about"])
    if not isinstance(about, dict):
        raise ValueError(f"about is a {type(about).__name__}, needs an object")
    return PillarsConfig.model_validate_json(metadata["config"]), about


def _mismatch(needed: Mapping[str, Tensor], given: Mapping[str, Tensor]) -> str:
    """Returns the first difference of tensors from those that are needed; empty if none."""
    if missing := [name for name in needed if name not in given]:
        return f"{len(missing)} tensors are missing, the first is {missing[0]}"
    if more := sorted(given.keys() - needed.keys()):
        return f"{len(more)} tensors are of no use, the first is {more[0]:.80}"
    for name, value in needed.items():
        if given[name].shape != value.shape:
            return f"{name} is {list(given[name].shape)}, needs {list(value.shape)}"
        if given[name].is_floating_point() != value.is_floating_point():
            return f"{name} is of {given[name].dtype}, needs {value.dtype} or of less precision"
    return ""
