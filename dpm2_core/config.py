# SPDX-License-Identifier: Apache-2.0
"""YAML files and `key=value` settings into one typed configuration; every error names file, key and what is allowed.

Each part of the package keeps its own `Settings` type beside the code it configures; `slam.system.Config` joins them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar, cast

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic.fields import FieldInfo

from dpm2_core.errors import UsageError

T = TypeVar("T", bound="Settings")


class Settings(BaseModel):
    """Base of every configuration type: unknown keys are errors, values immutable, docstrings describe fields."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, validate_default=True, use_attribute_docstrings=True, allow_inf_nan=False
    )


def load_settings(kind: type[T], path: Path | None = None, overrides: Sequence[str] = ()) -> T:
    """Defaults, then the YAML file, then `dotted.key=value` settings, each overriding the one before.

    Raises:
        UsageError: the file is missing or no YAML mapping, or a key or value is not allowed.
    """
    tree: dict[str, Any] = {}
    origin: dict[str, str] = {}
    if path is not None:
        _merge(tree, _read(path))
        origin = {key: str(path) for key in _leaves(tree)}
    for setting in overrides:
        key, equals, text = setting.partition("=")
        if not equals or not key.strip():
            raise UsageError(f"--set {setting}: want KEY=VALUE, such as slam.registration=geometric")
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError:
            value = text
        for part in reversed(key.strip().split(".")):
            value = {part: value}
        _merge(tree, value)
        origin[key.strip()] = f"--set {setting}"
    return settings_from(kind, tree, origin, str(path) if path else "configuration")


def settings_from(kind: type[T], tree: dict[str, Any], origin: dict[str, str] | None = None, default: str = "") -> T:
    """Validate a nested dictionary; `origin` maps dotted keys to where they were set, for the message."""
    try:
        return kind.model_validate(tree)
    except ValidationError as error:
        raise UsageError("; ".join(_explain(kind, e, origin or {}, default) for e in error.errors())) from None


def dump_settings(settings: Settings) -> str:
    """YAML of every value, each key preceded by its description."""
    return "\n".join(_dump(settings, 0)) + "\n"


def flat_fields(kind: type[Settings], prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """Dotted name and field of every leaf: the names that `--set` and the ROS parameters share."""
    for name, info in kind.model_fields.items():
        if isinstance(info.annotation, type) and issubclass(info.annotation, Settings):
            yield from flat_fields(info.annotation, f"{prefix}{name}.")
        else:
            yield prefix + name, info


def _read(path: Path) -> dict[str, Any]:
    try:
        tree = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: not valid YAML: {' '.join(str(error).split())}") from None
    if tree is None:
        return {}
    if not isinstance(tree, dict):
        raise UsageError(f"{path}: want a mapping of keys, found {type(tree).__name__}")
    return tree


def _merge(tree: dict[str, Any], more: dict[str, Any]) -> None:
    for key, value in more.items():
        if isinstance(value, dict) and isinstance(tree.get(key), dict):
            _merge(tree[key], value)
        else:
            tree[key] = value


def _leaves(tree: dict[str, Any], prefix: str = "") -> Iterator[str]:
    for key, value in tree.items():
        yield f"{prefix}{key}"
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{key}.")


def _explain(kind: type[Settings], error: Any, origin: dict[str, str], default: str) -> str:
    parts = [str(part) for part in error["loc"]]
    key = ".".join(parts)
    prefixes = (".".join(parts[:n]) for n in range(len(parts), 0, -1))
    where = next((origin[prefix] for prefix in prefixes if prefix in origin), default)
    if error["type"] == "extra_forbidden":
        for part in parts[:-1]:
            annotation = kind.model_fields[part].annotation
            kind = cast("type[Settings]", annotation)
        return f"{where}: unknown key {key}; allowed here: {', '.join(kind.model_fields)}"
    return f"{where}: {key}: {error['msg'][0].lower()}{error['msg'][1:]}, got {error['input']!r}"


def _dump(settings: Settings, depth: int) -> Iterator[str]:
    indent = "  " * depth
    for name, info in type(settings).model_fields.items():
        value = getattr(settings, name)
        if info.description:
            yield from (f"{indent}# {line.strip()}" for line in info.description.splitlines())
        if isinstance(value, Settings):
            yield f"{indent}{name}:"
            yield from _dump(value, depth + 1)
        else:
            plain = settings.model_dump(mode="json", include={name})[name]
            text = yaml.safe_dump(plain, default_flow_style=True, width=1000).removesuffix("\n").removesuffix("\n...")
            yield f"{indent}{name}: {text}"
