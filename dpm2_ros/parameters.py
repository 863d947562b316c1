# SPDX-License-Identifier: Apache-2.0
"""Every configuration value as a ROS parameter of the same name; `python -m dpm2_ros.parameters` writes their page.

Later sources override earlier ones: defaults, the YAML file named by `config_file`, parameters. They are read once, at
the start, except those that may change while a node runs.
"""

from __future__ import annotations

import functools
import json
import os
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import annotated_types
from pydantic.fields import FieldInfo

from dpm2_core.config import flat_fields, load_settings, put, read_settings, settings_from
from dpm2_core.errors import UsageError
from dpm2_ros.settings import CHANGEABLE, NodeConfig

if TYPE_CHECKING:
    from rcl_interfaces.msg import ParameterDescriptor
    from rclpy.node import Node

CONFIG_FILE = "config_file"
_RCLPY_PARAMETERS = ("use_sim_time", "start_type_description_service")
_HEAD = """# Parameters

<!-- Written by `make parameters` from the settings themselves; a test keeps it up to date. -->

One list for everything. `slam_node` and `mapper_node` take each value as a ROS parameter of this name
(`--ros-args -p slam.registration:=geometric`) or from a YAML file (`-p config_file:=FILE`). `dpm2 run` takes all
but `ros.*`, as `--set slam.registration=geometric` or from a file (`--config FILE`; `dpm2 config dump` writes one).
A single value overrides the file, the file the defaults. An unknown name or a value that is not allowed ends the
program with exit code 2 and one line that says what is. Values are read at the start; those that are *changeable*
can also be set while a node runs (`ros2 param set`)."""


def load_parameters(node: Node) -> NodeConfig:
    """The node's configuration; afterwards every value is declared, described and read-only.

    Args:
        node: created with automatically_declare_parameters_from_overrides=True, so that all given parameters are
            visible, misspelt names included.

    Raises:
        UsageError: an unknown parameter or a value that is not allowed.
    """
    fields = dict(flat_fields(NodeConfig))
    declared = {
        name: parameter.value
        for name, parameter in node.get_parameters_by_prefix("").items()
        if name not in _RCLPY_PARAMETERS
    }
    # `ros2 param dump` writes null for unset values, which rcl reads as a text.
    unset = {name for name, info in fields.items() if info.default is None}
    given = {n: value for n, value in declared.items() if value is not None and not (value == "null" and n in unset)}
    file = given.pop(CONFIG_FILE, "")
    if not isinstance(file, str):
        raise UsageError(f"ROS parameter: {CONFIG_FILE}: want the path of a file, got {file!r}")
    if any(name.startswith("qos_overrides.") for name in given):
        raise UsageError("qos_overrides is not supported; ros.reliability and ros.queue_depth are the inputs' QoS")
    if unknown := sorted(set(given) - set(fields)):
        raise UsageError(f"unknown parameter {', '.join(unknown)}; docs/parameters.md lists them")
    path = Path(os.path.expanduser(file)) if file else None
    load_settings(NodeConfig, path)  # checked alone, to report its errors as those of the file
    # Only the given values: a preset may change the rest.
    tree = _with_values({} if path is None else read_settings(NodeConfig, path), given)
    config = settings_from(NodeConfig, tree, dict.fromkeys(given, "ROS parameter"))
    for name in declared:
        node.undeclare_parameter(name)
    _declare(node, CONFIG_FILE, file, "YAML file with settings, as for `dpm2 run --config`.", None)
    for name, info in fields.items():
        value = _to_ros_value(functools.reduce(getattr, name.split("."), config))
        if name.endswith("_topic") and value:
            _check_topic(node, name, value)
        _declare(node, name, value, _description(info), info)
    return config


def _check_topic(node: Node, name: str, topic: str) -> None:
    try:
        node.resolve_topic_name(topic)
    except Exception as error:  # RCLError, whose text ends with a line of ROS' source code
        raise UsageError(f"{name}: {str(error).partition(', at /')[0]}, got {topic!r}") from None


def follow_changes(node: Node, config: NodeConfig, apply: Callable[[NodeConfig], None]) -> None:
    """Call `apply` with the new settings whenever one of `CHANGEABLE` is set. An invalid value is rejected, with the
    reason."""
    from rcl_interfaces.msg import SetParametersResult

    current = config

    def on_set(parameters: Sequence[Any]) -> SetParametersResult:
        nonlocal current
        given = {parameter.name: parameter.value for parameter in parameters if parameter.name in CHANGEABLE}
        try:
            tree = _with_values(current.model_dump(), given)
            current = settings_from(NodeConfig, tree, dict.fromkeys(given, "ROS parameter"))
        except UsageError as error:
            return SetParametersResult(successful=False, reason=str(error))
        if given:
            apply(current)
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(on_set)


def _with_values(tree: dict[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """The same tree, with the given parameters set; lists arrive as arrays."""
    for name, value in given.items():
        put(NodeConfig, tree, name.split("."), value.tolist() if hasattr(value, "tolist") else value)
    return tree


def _declare(node: Node, name: str, value: Any, description: str, info: FieldInfo | None) -> None:
    descriptor = _descriptor(description, value, info)
    descriptor.read_only = name not in CHANGEABLE
    node.declare_parameter(name, value, descriptor, ignore_override=True)


def _descriptor(description: str, value: Any, info: FieldInfo | None) -> ParameterDescriptor:
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

    descriptor = ParameterDescriptor(description=description, dynamic_typing=value is None)
    if info is None:
        return descriptor
    descriptor.additional_constraints = f"{_type_name(info.annotation)} {_limits_text(info)}".strip()
    limits = {type(limit): limit for limit in _limits(info)}
    if annotated_types.Ge in limits and annotated_types.Le in limits:  # ROS ranges have two closed ends
        low, high = limits[annotated_types.Ge].ge, limits[annotated_types.Le].le
        if isinstance(value, float):
            descriptor.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
        elif isinstance(value, int) and not isinstance(value, bool):
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    return descriptor


def _to_ros_value(value: Any) -> Any:
    """A value of a type that ROS has: no tuples, enumerations or paths."""
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, (tuple, list)):
        return [_to_ros_value(item) for item in value]
    return str(value) if isinstance(value, Path) else value


def _description(info: FieldInfo) -> str:
    return " ".join((info.description or "").split())


def _limits(info: FieldInfo) -> list[Any]:
    """annotated_types of the field, also those inside `X | None` or an alias."""
    found = list(info.metadata)
    for part in typing.get_args(info.annotation):
        found += getattr(part, "__metadata__", ())
    flat: list[Any] = []
    for item in found:
        flat += item.metadata if isinstance(item, FieldInfo) else [item]
    return flat


def _limits_text(info: FieldInfo) -> str:
    signs = (("ge", "at least"), ("gt", "above"), ("le", "at most"), ("lt", "below"))
    pairs = ((word, getattr(limit, sign, None)) for limit in _limits(info) for sign, word in signs)
    return ", ".join(f"{word} {value:g}" for word, value in pairs if value is not None)


def _type_name(annotation: Any) -> str:
    if annotation is type(None):
        return "unset"
    origin, args = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return _type_name(args[0])
    if origin is typing.Literal:
        return " or ".join(str(arg) or "empty" for arg in args)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(_type_name(arg) for arg in args)
    if origin in (tuple, list):
        kinds = [arg for arg in args if arg is not Ellipsis]
        count = f"{len(kinds)} " if origin is tuple and Ellipsis not in args else ""
        return f"list of {count}{_type_name(kinds[0])}"
    if isinstance(annotation, type) and issubclass(annotation, Enum):
        return " or ".join(str(member.value) for member in annotation)
    return {str: "text", Path: "path"}.get(annotation, getattr(annotation, "__name__", str(annotation)))


def page() -> str:
    """The Markdown page of all parameters."""
    return "\n".join([_HEAD, *_sections()]) + "\n"


def _sections() -> Iterator[str]:
    section = None
    for name, info in flat_fields(NodeConfig):
        prefix = name.rpartition(".")[0]
        if prefix != section:
            section = prefix
            yield from (
                "",
                f"## {section or 'General'}",
                "",
                "| parameter | type | default | meaning |",
                "|---|---|---|---|",
            )
        kind_text = ", ".join(filter(None, (_type_name(info.annotation), _limits_text(info))))
        default = json.dumps(_to_ros_value(info.get_default(call_default_factory=True)), default=str)
        text = _description(info).replace("|", "&#124;") + (" *Changeable.*" if name in CHANGEABLE else "")
        yield f"| `{name}` | {kind_text} | `{default}` | {text} |"


if __name__ == "__main__":
    print(page(), end="")
