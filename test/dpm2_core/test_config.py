# SPDX-License-Identifier: Apache-2.0
"""Configuration: dumped settings can be loaded, later settings take precedence, every error names its origin."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field

from dpm2_core.config import Settings, dump_settings, flat_fields, load_settings
from dpm2_core.data.settings import InputSettings
from dpm2_core.errors import UsageError


class Color(StrEnum):
    RED = "red"
    BLUE = "blue"


class Inner(Settings):
    voxel: Annotated[float, Field(gt=0)] = 0.5
    """Edge of a voxel, m."""

    names: tuple[str, ...] = ()
    color: Color = Color.RED


class Middle(Settings):
    inner: Inner = Inner()
    angle: Annotated[float, Field(ge=-5, le=5)] | Literal["auto"] = "auto"
    """Degrees.

    auto: what the recording says."""


class Outer(Settings):
    middle: Middle = Middle()
    """The part in the middle."""

    second: Inner = Inner(voxel=1.0)
    several: tuple[Inner, ...] = ()
    perhaps: Inner | None = None
    count: Annotated[int, Field(ge=0, le=9)] = 3
    text: str = "x"
    free: dict[str, float] = Field({"a": 1})
    folder: Path | None = None
    switch: bool = True


def _file(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "config.yaml"
    path.write_text(text, encoding="utf-8")
    return path


texts = st.text(st.characters(codec="utf-8", exclude_categories=["Cs"]), max_size=30)
inners = st.builds(
    Inner, voxel=st.floats(1e-12, 1e12), names=st.lists(texts, max_size=3).map(tuple), color=st.sampled_from(Color)
)


@given(
    st.builds(
        Outer,
        middle=st.builds(Middle, inner=inners, angle=st.floats(-5, 5) | st.just("auto")),
        second=inners,
        several=st.lists(inners, max_size=2).map(tuple),
        perhaps=st.none() | inners,
        count=st.integers(0, 9),
        text=texts
        | st.sampled_from(["null", "true", "1", "1e3", "~", "- a", "a: b", "#", "'", '"', "...", "x " * 2000]),
        folder=st.none() | st.just(Path("/tmp/a b")),
        switch=st.booleans(),
    )
)
@pytest.mark.slow
def test_what_is_dumped_loads_back_equal(tmp_path_factory: pytest.TempPathFactory, settings: Outer) -> None:
    path = tmp_path_factory.getbasetemp() / "dumped.yaml"
    path.write_bytes(dump_settings(settings).encode())
    assert load_settings(Outer, path) == settings


def test_the_dump_explains_each_key() -> None:
    lines = dump_settings(Outer()).splitlines()
    assert lines[lines.index("    voxel: 0.5") - 1] == "    # Edge of a voxel, m."
    assert lines[lines.index("middle:") - 1] == "# The part in the middle."


def test_later_settings_override_earlier_ones_key_by_key(tmp_path: Path) -> None:
    path = _file(tmp_path, "middle: {inner: {voxel: 2, names: [a]}}\ncount: 4\n")
    settings = load_settings(Outer, path, ["middle.inner.voxel=3", "text=a=b", "middle.inner.voxel=7", "folder="])
    assert settings.middle.inner == Inner(voxel=7, names=("a",))
    assert (settings.count, settings.text, settings.folder, settings.second.voxel) == (4, "a=b", None, 1.0)


@pytest.mark.parametrize(
    ("overrides", "free"),
    [
        (["free={c: 3}"], {"c": 3}),
        (["free={}"], {}),
        (["free.c=3"], {"b": 2, "c": 3}),
        (["free={c: 3}", "free.d=4"], {"c": 3, "d": 4}),
    ],
)
def test_a_mapping_replaces_one_whose_keys_are_free(
    tmp_path: Path, overrides: list[str], free: dict[str, float]
) -> None:
    """A dotted key adds a key; without a file a mapping has the same meaning."""
    assert load_settings(Outer, _file(tmp_path, "free: {b: 2}"), overrides).free == free
    assert load_settings(Outer, None, ["free={c: 3}"]).free == {"c": 3}


def test_a_mapping_changes_the_keys_of_a_part_that_it_has(tmp_path: Path) -> None:
    path = _file(tmp_path, "middle: {inner: {voxel: 2, names: [a]}}\n")
    assert load_settings(Outer, path, ["middle={inner: {voxel: 3}}"]).middle.inner == Inner(voxel=3, names=("a",))


def test_what_is_not_said_of_a_part_is_as_in_the_default_of_its_field() -> None:
    """Not the defaults of the part's type: two parts of one type may differ."""
    assert load_settings(Outer, None, ["second.color=blue"]).second == Inner(voxel=1.0, color=Color.BLUE)


def test_an_empty_file_and_none_give_the_defaults(tmp_path: Path) -> None:
    assert load_settings(Outer, _file(tmp_path, "# nothing\n")) == load_settings(Outer) == Outer()


def test_an_override_of_one_of_two_keys_with_the_same_anchor_leaves_the_other(tmp_path: Path) -> None:
    path = _file(tmp_path, "middle: {inner: &a {voxel: 2}}\nsecond: *a\n")
    settings = load_settings(Outer, path, ["second.voxel=9"])
    assert (settings.second.voxel, settings.middle.inner.voxel) == (9, 2)


def test_a_key_overrides_what_is_merged_into_its_mapping(tmp_path: Path) -> None:
    path = _file(
        tmp_path, "second: &a {voxel: 2, names: [a]}\nmiddle: {inner: {<<: *a, voxel: 3}}\nperhaps: {<<: *a}\n"
    )
    settings = load_settings(Outer, path)
    assert (settings.middle.inner, settings.perhaps) == (Inner(voxel=3, names=("a",)), Inner(voxel=2, names=("a",)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("cuont: 1", "unknown key cuont; allowed here: middle, second, several, perhaps, count"),
        ("middle: {inner: {vxel: 1}}", "unknown key middle.inner.vxel; allowed here: voxel, names, color$"),
        ("several: [{vxel: 1}]", "unknown key several.0.vxel; allowed here: voxel, names, color$"),
        ("perhaps: {vxel: 1}", "unknown key perhaps.vxel; allowed here: voxel, names, color$"),
        ("count: three", "count: .*integer.* got 'three'"),
        ("count: 10", "count: .*less than or equal to 9, got 10"),
        ("middle: {inner: {voxel: 0}}", "middle.inner.voxel: .*greater than 0, got 0"),
        ("middle: {inner: {voxel: .inf}}", "middle.inner.voxel: .*finite number"),
        ("middle: {inner: {color: green}}", "middle.inner.color: .*'red' or 'blue', got 'green'"),
        ("middle: {angle: six}", r"middle\.angle: .*number.*'auto'"),
        ("middle: 5", "middle: .*got 5"),
        ("several: [{voxel: -1}]", "several.0.voxel: .*greater than 0"),
        ("count: 1\ntext: [", "not valid YAML"),
        ("text: !!python/object/apply:os.getcwd []", "not valid YAML"),
        ("text: 2024-13-45", "not valid YAML"),
        ("count: 1\ntext: a\ncount: 2", "count is there twice .*line 3"),
        ("middle: {inner: {voxel: 1, voxel: 2}}", "voxel is there twice"),
        ("[" * 5000, "not valid YAML"),
        ("middle: &a {inner: *a}", "not valid YAML"),
        ("- a\n- b", "want a mapping of keys, found list"),
        ("1: 2", "1.*"),
    ],
)
def test_a_mistake_in_the_file_names_file_and_key_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = _file(tmp_path, text)
    with pytest.raises(UsageError, match=f"{path}: .*{message}") as caught:
        load_settings(Outer, path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("count=10", "--set count=10: count: .*less than or equal to 9"),
        ("nonsense.a=1", "--set nonsense.a=1: unknown key nonsense"),
        ("middle.inner.a=1", "--set middle.inner.a=1: unknown key middle.inner.a; allowed here: voxel"),
        ("count", "--set count: want KEY=VALUE"),
        ("=3", "--set =3: want KEY=VALUE"),
        ("count=2024-13-45", "--set count=2024-13-45: count: "),
        ("count.a=1", "--set count.a=1: count: "),
        ("count=true", "--set count=true: count: .*want a number, got True"),
        ("middle.inner.voxel=on", "--set middle.inner.voxel=on: middle.inner.voxel: .*want a number"),
    ],
)
def test_a_mistake_on_the_command_line_names_the_setting(setting: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        load_settings(Outer, None, [setting])


def test_a_bad_override_is_not_blamed_on_the_file(tmp_path: Path) -> None:
    path = _file(tmp_path, "count: 4\n")
    with pytest.raises(UsageError, match=r"^--set count=11: count"):
        load_settings(Outer, path, ["count=11"])


def test_several_mistakes_are_told_at_once(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"count: .*; .*text: "):
        load_settings(Outer, _file(tmp_path, "count: 10\ntext: [1]\n"))


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00\x80")
    for path in (tmp_path / "none.yaml", tmp_path, tmp_path / "binary"):
        with pytest.raises(UsageError, match=str(path)):
            load_settings(Outer, path)


def test_flat_fields_name_every_leaf_that_can_be_set() -> None:
    names = [name for name, _ in flat_fields(Outer)]
    assert names[:4] == ["middle.inner.voxel", "middle.inner.names", "middle.inner.color", "middle.angle"]
    dumped = yaml.safe_load(dump_settings(Outer()))
    for name in names:
        value = dumped
        for part in name.split("."):
            value = value[part]


def test_settings_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="frozen"):
        Outer().count = 4  # type: ignore[misc]


def test_a_number_with_leading_zeros_stays_what_was_typed() -> None:
    """04 is a sequence, which YAML 1.1 would read as an octal number."""
    assert load_settings(InputSettings, None, ["sequence=04"]).sequence == "04"
    assert load_settings(InputSettings, None, ["image_time_offset=0.5"]).image_time_offset == 0.5


def test_a_number_is_a_text_where_one_is_wanted(tmp_path: Path) -> None:
    """Numbers are accepted as strings: previously, KITTI's sequences from 10 on needed quotes that the shell keeps.
    true and lists are rejected."""
    (tmp_path / "a.yaml").write_text("sequence: 10")
    assert load_settings(InputSettings, tmp_path / "a.yaml").sequence == "10"
    assert load_settings(InputSettings, None, ["sequence=10"]).sequence == "10"
    for value in ("true", "[10]"):
        with pytest.raises(UsageError, match="sequence: input should be a valid string"):
            load_settings(InputSettings, None, [f"sequence={value}"])
