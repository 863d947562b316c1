# SPDX-License-Identifier: Apache-2.0
"""dpm2: LiDAR-visual SLAM with neural descriptors. No ROS import anywhere in this package.

The names below are the public API; `examples/` shows them at work. Each is imported when it is first used, so that
`import dpm2_core` is quick, and geometric odometry imports neither torch nor matplotlib.

* Data: `open_source(path)` gives a `Source` of `Frame`s, each with its `Image`s and their `Camera`s, from a recording
  of any known format. `write_kitti` and `write_tum` write trajectories.
* Settings: `Config` holds those of `dpm2 run`, `SlamSettings` those of the SLAM alone, `InputSettings` those of a
  recording. `load_settings(Config, file, ["slam.threads=4"])` reads them from YAML, `dump_settings` writes them.
* SLAM: `make_slam(settings)` puts a `Slam` together, whose `process(frame)` gives a `SlamResult`: the `OdometryResult`
  with its `Registration` and `State`, and, of a frame that became a `Keyframe`, the loops (`Edge`s) that were tried.
  `make_odometry` does without the map. `open_session` makes or extends a map file; with one from
  `open_for_localization` the map stays as it is, and keyframes are found in it (`LocalizationResult`).
  `OfflineRun(recording, config).run()` is `dpm2 run`.
* Network: `load_network(name, threads)` gives a network whose `describe` makes `Descriptors` of a frame, and whose
  `register` finds the `Registration` of two.
* Figures: `trajectory_png` draws a trajectory on its map, `matches_png` a registration; both need the extra `plot`.
* Errors: `Dpm2Error` is what can go wrong, `UsageError` (one of them) what the caller can put right.

A program that runs the SLAM beside others should call `dpm2_core.openmp.wait_passively()` before it imports numpy, as
`dpm2` and the ROS nodes do: an import sets no environment variable.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from dpm2_core._version import __version__ as __version__

if TYPE_CHECKING:
    from dpm2_core.config import dump_settings, load_settings
    from dpm2_core.data.open import open_source
    from dpm2_core.data.settings import InputSettings
    from dpm2_core.data.source import Source
    from dpm2_core.data.trajectory import write_kitti, write_tum
    from dpm2_core.descriptors import Descriptors
    from dpm2_core.errors import Dpm2Error, UsageError
    from dpm2_core.estimates import Edge, Keyframe, OdometryResult, Registration, State
    from dpm2_core.evaluation.figures import trajectory_png
    from dpm2_core.evaluation.matches import matches_png
    from dpm2_core.frame import Camera, Frame, Image
    from dpm2_core.network.pretrained import load_network
    from dpm2_core.pipeline import OfflineRun
    from dpm2_core.slam.build import make_odometry, make_slam
    from dpm2_core.slam.loops.localizer import LocalizationResult
    from dpm2_core.slam.session import open_for_localization, open_session
    from dpm2_core.slam.settings import Config, SlamSettings
    from dpm2_core.slam.system import Slam, SlamResult

__all__ = [
    "Camera",
    "Config",
    "Descriptors",
    "Dpm2Error",
    "Edge",
    "Frame",
    "Image",
    "InputSettings",
    "Keyframe",
    "LocalizationResult",
    "OdometryResult",
    "OfflineRun",
    "Registration",
    "Slam",
    "SlamResult",
    "SlamSettings",
    "Source",
    "State",
    "UsageError",
    "__version__",
    "dump_settings",
    "load_network",
    "load_settings",
    "make_odometry",
    "make_slam",
    "matches_png",
    "open_for_localization",
    "open_session",
    "open_source",
    "trajectory_png",
    "write_kitti",
    "write_tum",
]

_MODULES = {
    "config": "dump_settings load_settings",
    "data.open": "open_source",
    "data.settings": "InputSettings",
    "data.source": "Source",
    "data.trajectory": "write_kitti write_tum",
    "descriptors": "Descriptors",
    "errors": "Dpm2Error UsageError",
    "estimates": "Edge Keyframe OdometryResult Registration State",
    "evaluation.figures": "trajectory_png",
    "evaluation.matches": "matches_png",
    "frame": "Camera Frame Image",
    "network.pretrained": "load_network",
    "pipeline": "OfflineRun",
    "slam.build": "make_odometry make_slam",
    "slam.loops.localizer": "LocalizationResult",
    "slam.session": "open_for_localization open_session",
    "slam.settings": "Config SlamSettings",
    "slam.system": "Slam SlamResult",
}
"""The public names by the module that has them, as under TYPE_CHECKING above."""
_PLACES = {name: module for module, names in _MODULES.items() for name in names.split()}


if not TYPE_CHECKING:  # type checkers would take it for a module that has every name

    def __getattr__(name: str) -> object:
        if name not in _PLACES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(import_module(f"{__name__}.{_PLACES[name]}"), name)
        globals()[name] = value  # found without this function from now on
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
