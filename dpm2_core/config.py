# SPDX-License-Identifier: Apache-2.0
"""Reads YAML files and `key=value` settings into one typed configuration. Each error names the file, the key and the
allowed values.

Each part of the package has its own `Settings` class next to the code it configures; `slam.settings.Config` joins them.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError, ValidationInfo, field_validator
from pydantic.fields import FieldInfo

from dpm2_core.errors import UsageError, one_line

T = TypeVar("T", bound="Settings")

# PyYAML passes on the errors of int() and datetime(), and it is recursive.
_YAML_ERRORS = (yaml.YAMLError, ValueError, RecursionError)


class _Loader(yaml.SafeLoader):
    """The safe loader, which also rejects duplicate keys: PyYAML would drop the first one without a warning."""

    def compose_mapping_node(self, anchor: dict[Any, yaml.Node]) -> yaml.MappingNode:
        node = super().compose_mapping_node(anchor)  # the keys as written: `<<` is not merged yet
        seen = set[tuple[str, str]]()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if (key.tag, key.value) in seen:
                    raise yaml.composer.ComposerError(None, None, f"{key.value} is there twice", key.start_mark)
                seen.add((key.tag, key.value))
        return node


class Settings(BaseModel):
    """Base of all configuration classes: unknown keys are errors, values immutable, docstrings describe the fields."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, validate_default=True, use_attribute_docstrings=True, allow_inf_nan=False,
        coerce_numbers_to_str=True,  # sequence=10 is the text 10
    )  # fmt: skip

    @classmethod
    def implied(cls, tree: Mapping[str, Any]) -> dict[str, Any]:
        """Values that a file with this tree may omit, such as those of the preset that it names."""
        return {}

    @field_validator("*", mode="before")
    @classmethod
    def _reject_bool_as_number(cls, value: Any, info: ValidationInfo) -> Any:
        """Reject `true`, `yes` and `on` where a number is expected: pydantic accepts them as 1."""
        if isinstance(value, bool):
            kinds = set(_types_in(cls.model_fields[info.field_name or ""].annotation))
            if bool not in kinds and kinds & {int, float}:
                raise ValueError("want a number")
        return value

    @field_validator("*", mode="before")
    @classmethod
    def _merge_with_default(cls, value: Any, info: ValidationInfo) -> Any:
        """A part of which only some keys are given takes the others from the default of its field."""
        default = cls.model_fields[info.field_name or ""].default
        if isinstance(value, Mapping) and isinstance(default, Settings):
            return merged(default.model_dump(exclude_unset=True), value)
        return value


def _types_in(annotation: Any) -> Iterator[Any]:
    """The types that an annotation allows, at any depth."""
    yield annotation
    for part in get_args(annotation):
        yield from _types_in(part)


def load_settings(kind: type[T], path: Path | str | None = None, overrides: Sequence[str] = ()) -> T:
    """Defaults, then the YAML file, then `dotted.key=value` settings; each overrides the previous ones.

    A mapping as the value of a part changes only the keys that it contains; where keys are free, it replaces the old
    mapping.

    Raises:
        UsageError: the file is missing or not a YAML mapping, or a key or value is not allowed.
    """
    tree = {} if path is None else read_settings(kind, Path(path))
    origin: dict[str, str] = {}
    for setting in overrides:
        key, equals, text = setting.partition("=")
        key = key.strip()
        if not equals or not key:
            raise UsageError(f"--set {setting}: want KEY=VALUE, such as slam.registration=geometric")
        put(kind, tree, key.split("."), value_of(text))
        origin.pop(key, None)  # an error is reported for the last setting of a key
        origin[key] = f"--set {setting}"
    return settings_from(kind, tree, origin, str(path) if path else "configuration")


def settings_from(kind: type[T], tree: dict[str, Any], origin: dict[str, str] | None = None, default: str = "") -> T:
    """Validate a nested dictionary; `origin` maps dotted keys to the place where they were set, for the message."""
    try:
        return kind.model_validate(tree)
    except ValidationError as error:
        raise UsageError("; ".join(_messages(kind, error, origin or {}, default))) from None


def dump_settings(settings: Settings) -> str:
    """YAML of all values, each key preceded by its description."""
    return "\n".join(_dump(settings, 0)) + "\n"


def merged(tree: Mapping[str, Any], more: Mapping[str, Any]) -> dict[str, Any]:
    """A nested dictionary, updated with the keys of another one."""
    out = dict(tree)
    for key, value in more.items():
        inner = out.get(key)
        out[key] = merged(inner if isinstance(inner, dict) else {}, value) if isinstance(value, dict) else value
    return out


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file; {} for an empty one.

    Raises:
        UsageError: the file is missing, or does not contain a mapping.
    """
    try:
        tree = yaml.load(path.read_text(encoding="utf-8"), _Loader)  # a SafeLoader
        json.dumps(tree, default=str, skipkeys=True)  # rejects a mapping that contains itself through an alias
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from None
    except _YAML_ERRORS as error:
        raise UsageError(f"{path}: not valid YAML: {one_line(error)}") from None
    if tree is None:
        return {}
    if not isinstance(tree, dict):
        raise UsageError(f"{path}: want a mapping of keys, found {type(tree).__name__}")
    return tree


def read_settings(kind: type[Settings], path: Path) -> dict[str, Any]:
    """The settings in a YAML file without those that are `implied`, so that another preset can replace the file's.

    Raises:
        UsageError: the file is missing or not a YAML mapping.
    """
    return _without_implied(kind, read_yaml(path))


def _without_implied(kind: type[Settings], tree: dict[str, Any]) -> dict[str, Any]:
    out = _without_equal(tree, kind.implied(tree))
    for name, info in kind.model_fields.items():
        part = info.annotation
        if isinstance(part, type) and issubclass(part, Settings) and isinstance(out.get(name), dict):
            out[name] = _without_implied(part, out[name])
    return out


def _without_equal(tree: dict[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """A copy without the keys that have the same value in `values`, at any depth."""
    out: dict[str, Any] = {}
    for key, value in tree.items():
        other = values.get(key)
        if isinstance(value, dict) and isinstance(other, dict):
            out[key] = _without_equal(value, other)
        elif key not in values or value != other or isinstance(value, bool) != isinstance(other, bool):
            out[key] = value
    return out


def flat_fields(kind: type[Settings], prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """Dotted name and field of every leaf; `--set` and the ROS parameters use the same names."""
    for name, info in kind.model_fields.items():
        if isinstance(info.annotation, type) and issubclass(info.annotation, Settings):
            yield from flat_fields(info.annotation, f"{prefix}{name}.")
        else:
            yield prefix + name, info


def value_of(text: str) -> Any:
    """The value of a setting, read as YAML; invalid YAML and numbers like 04 (a KITTI sequence) are strings."""
    try:
        return text.strip() if re.fullmatch(r"\s*0\d+\s*", text) else yaml.safe_load(text)
    except _YAML_ERRORS:
        return text


def put(kind: type[Settings] | None, tree: dict[str, Any], path: Sequence[str], value: Any) -> None:
    """Set the value at a path of keys in a tree of that kind; `kind` is None below a field with free keys."""
    key, *rest = path
    found = kind.model_fields[key].annotation if kind is not None and key in kind.model_fields else None
    part = None if get_origin(found) is dict else next(_settings_in(found), None)
    if not rest and not (part and isinstance(value, dict)):
        tree[key] = value
        return
        # A copy: through a YAML anchor two keys may share one mapping, but each may change independently.
    branch = tree[key] = dict(tree[key]) if isinstance(tree.get(key), dict) else {}
    for keys, more in [(rest, value)] if rest else [([name], inner) for name, inner in value.items()]:
        put(part, branch, keys, more)


def _messages(kind: type[Settings], error: ValidationError, origin: dict[str, str], default: str) -> Iterator[str]:
    """One message per key that names where the key was set; the branches of a union become `this or that`."""
    messages: dict[str, list[str]] = {}
    for e in error.errors():
        unknown = e["type"] == "extra_forbidden"
        parts, allowed = _locate_field(kind, e["loc"][:-1] if unknown else e["loc"])
        key = ".".join([*parts, str(e["loc"][-1])] if unknown else parts)
        where = next((origin[name] for name in reversed(origin) if _related(name, key)), default)
        if unknown:
            yield f"{where}: unknown key {key}; allowed here: {', '.join(allowed.model_fields)}"
        else:
            message = f"{e['msg'][0].lower()}{e['msg'][1:]}, got {e['input']!r}"
            messages.setdefault(f"{where}: {key}" if key else where, []).append(message)
    yield from (f"{key}: {' or '.join(branches)}" for key, branches in messages.items())


def _locate_field(kind: type[Settings], location: tuple[str | int, ...]) -> tuple[list[str], type[Settings]]:
    """Names and indices of a pydantic error location without its union branches, and the type they lead to."""
    parts = []
    for part in location:
        if isinstance(part, int):
            parts.append(str(part))
        elif part in kind.model_fields:
            parts.append(part)
            kind = next(_settings_in(kind.model_fields[part].annotation), kind)
    return parts, kind


def _settings_in(annotation: Any) -> Iterator[type[Settings]]:
    """The configuration types in an annotation such as `tuple[Inner, ...]` or `Inner | None`."""
    if isinstance(annotation, type) and issubclass(annotation, Settings):
        yield annotation
    for argument in get_args(annotation):
        yield from _settings_in(argument)


def _related(a: str, b: str) -> bool:
    """Whether one dotted key is the other, above or below it."""
    return f"{a}.".startswith(f"{b}.") or f"{b}.".startswith(f"{a}.")


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
