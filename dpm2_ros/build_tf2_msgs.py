# SPDX-License-Identifier: Apache-2.0
"""Build `tf2_msgs` for a ROS 2 that came from pip: `python -m dpm2_ros.build_tf2_msgs` (about 5 s, once).

/tf needs tf2_msgs/TFMessage, which no wheel contains. The wheels do contain ROS's own generators, so the message is
generated and compiled here from its one-line definition. All generated sources are linked into one shared object, which
is the Python extension and, by links from PREFIX/lib, the two type-support libraries that ROS 2 opens by name. ROS 2
computes the same type hash for it as for the official package, so both are compatible.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

from dpm2_core.errors import Dpm2Error, exit_code

DEFINITION = "geometry_msgs/TransformStamped[] transforms\n"
TYPE_HASH = "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
"""Type hash of tf2_msgs/msg/TFMessage in ROS 2 Jazzy; endpoints with another hash do not connect."""

MODULE = f"tf2_msgs_s__rosidl_typesupport_c{sysconfig.get_config_var('EXT_SUFFIX')}"
SUPPORTS = ("rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c")
"""Fast DDS needs both: the first to (de)serialize, the second to announce the type to other machines."""


def available() -> bool:
    """Whether `tf2_msgs` can be imported already, from a ROS installation or from an earlier build."""
    return importlib.util.find_spec("tf2_msgs") is not None


def build() -> Path:
    """Generate, compile and install tf2_msgs into this environment's site-packages.

    Raises:
        Dpm2Error: no compiler, no Python headers, no ROS generators, or a type hash that would not connect.
    """
    target = Path(sysconfig.get_paths()["platlib"]) / "tf2_msgs"
    for tool in ("gcc", "g++"):
        if shutil.which(tool) is None:
            raise Dpm2Error(f"tf2_msgs cannot be built: no {tool} on PATH (Debian, Ubuntu: apt install g++)")
    header = Path(sysconfig.get_paths()["include"]) / "Python.h"
    if not header.is_file():
        raise Dpm2Error(f"tf2_msgs cannot be built: no {header} (Debian, Ubuntu: apt install python3-dev)")
    with tempfile.TemporaryDirectory(dir=_check_writable(target.parent)) as folder:
        package = Path(folder) / "tf2_msgs"
        _generate(package)
        _compile(package)
        _remove_unused(package)
        shutil.rmtree(target, ignore_errors=True)
        package.rename(target)
    for support in SUPPORTS:
        link = Path(sys.prefix) / "lib" / f"libtf2_msgs__{support}.so"
        link.unlink(missing_ok=True)
        link.symlink_to(target / MODULE)
    return target


def _check_writable(folder: Path) -> Path:
    try:
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError as error:
        raise Dpm2Error(f"tf2_msgs cannot be installed into {folder}: {error.strerror}") from None


def _introspection_folder(package: Path) -> Path:
    return package.parent / "introspection" / "tf2_msgs"


def _generate(package: Path) -> None:
    """IDL, type description, C structures, Fast DDS type support and the Python classes, by ROS's own generators."""
    os.environ.setdefault("AMENT_PREFIX_PATH", sys.prefix)  # the generators look their templates up there
    try:
        from rosidl_adapter.msg import convert_msg_to_idl
        from rosidl_generator_c.cli import GenerateC
        from rosidl_generator_py.cli import GeneratePython
        from rosidl_generator_type_description.cli import HashTypeDescription
        from rosidl_typesupport_c.cli import GenerateCTypesupport
        from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport
        from rosidl_typesupport_introspection_c.cli import GenerateIntrospectionCTypesupport
    except ImportError as error:
        raise Dpm2Error(f"tf2_msgs cannot be built: {error}; install the project with `pip install .` first") from None
    (package / "msg").mkdir(parents=True)
    (package / "msg" / "TFMessage.msg").write_text(DEFINITION)
    with contextlib.redirect_stdout(io.StringIO()):
        convert_msg_to_idl(package, "tf2_msgs", Path("msg/TFMessage.msg"), package / "msg")
    include_paths = [str(Path(sys.prefix) / "share")]
    arguments = ("tf2_msgs", [f"{package}:msg/TFMessage.idl"], include_paths, package)
    descriptions = HashTypeDescription("description").generate_type_hashes(*arguments)
    found = json.loads(Path(descriptions[0]).read_text())["type_hashes"][0]["hash_string"]
    if found != TYPE_HASH:
        raise Dpm2Error(f"tf2_msgs: the generators give type hash {found}, ROS 2 Jazzy has {TYPE_HASH}")
    GenerateC("c").generate(*arguments, type_description_files=descriptions)
    GenerateFastRTPSCTypesupport("fastrtps").generate(*arguments)
    GenerateCTypesupport("c", typesupport_implementations=list(SUPPORTS)).generate(*arguments)
    GeneratePython("py", typesupport_implementations=["rosidl_typesupport_c"]).generate(*arguments)
    # A folder of its own, because it gives its files the same names as GenerateC does.
    GenerateIntrospectionCTypesupport("introspection").generate(*arguments[:3], _introspection_folder(package))


def _compile(package: Path) -> None:
    import numpy as np

    include, lib = Path(sys.prefix) / "include", Path(sys.prefix) / "lib"
    flags = ["-O2", "-fPIC", f"-I{package.parent}", f"-I{_introspection_folder(package).parent}", f"-I{include}"]
    flags += [f"-I{folder}" for folder in include.iterdir() if folder.is_dir()]
    flags += [f"-I{sysconfig.get_paths()['include']}", f"-I{np.get_include()}"]
    objects = []
    for source in sorted([*package.parent.rglob("*.c"), *package.parent.rglob("*.cpp")]):
        objects.append(f"{source}.o")
        compiler = ["gcc", "-std=gnu11"] if source.suffix == ".c" else ["g++", "-std=gnu++17"]
        _run([*compiler, *flags, "-c", str(source), "-o", objects[-1]])
    parts = ("generator_c", "generator_py", "typesupport_c", "typesupport_fastrtps_c", "typesupport_introspection_c")
    libraries = [
        f"-l{name}__rosidl_{part}" for name in ("geometry_msgs", "std_msgs", "builtin_interfaces") for part in parts
    ]
    libraries += ["-lrosidl_runtime_c", "-lrosidl_typesupport_fastrtps_c", "-lrosidl_typesupport_fastrtps_cpp"]
    libraries += ["-lrosidl_typesupport_c", "-lrosidl_typesupport_introspection_c", "-lrmw", "-lrcutils", "-lfastcdr"]
    _run(["g++", "-shared", "-o", str(package / MODULE), *objects, f"-L{lib}", f"-Wl,-rpath,{lib}", *libraries])


def _remove_unused(package: Path) -> None:
    """Remove all files that a Python process does not import."""
    for suffix in ("c", "cpp", "h", "hpp", "o"):
        for leftover in package.rglob(f"*.{suffix}"):
            leftover.unlink()
    for folder in (package / "msg" / "detail" / "dds_fastrtps_c", package / "msg" / "detail"):
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
    (package / "__init__.py").touch()


def _run(command: list[str]) -> None:
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        errors = [line for line in result.stderr.splitlines() if "error" in line] or result.stderr.splitlines()
        raise Dpm2Error(f"tf2_msgs cannot be compiled: {errors[0] if errors else command[0]}")


def main() -> int:
    """Build it unless it exists; exit code 1 and one line if it cannot be built (the nodes then run without /tf)."""
    if available():
        print("tf2_msgs: already installed")
        return 0
    return exit_code(lambda: print(f"tf2_msgs: built into {build()}"))


if __name__ == "__main__":
    sys.exit(main())
