# SPDX-License-Identifier: Apache-2.0
"""dpm2: LiDAR-visual SLAM with neural descriptors. No ROS import anywhere in this package.

The names below are the public API; `examples/` shows how they are used. Each is imported when it is first used, so that
`import dpm2_core` is quick, and geometric odometry imports neither torch nor matplotlib.

* Data: `open_source(path)` opens a recording of any known format as a `Source` of `Frame`s, each with its `Image`s and
  their `Camera`s, the samples of an IMU (`Inertial`), a GNSS `Fix`, and the pose by another odometry (`Guess`), if
  there are any. `write_kitti` and `write_tum` write trajectories.
* Settings: `Config` has the settings of `dpm2 run`, `SlamSettings` those of the SLAM, `InputSettings` those of a
  recording. `load_settings(Config, file, ["slam.threads=4"])` reads them from YAML, `dump_settings` writes them.
* SLAM: `make_slam(settings)` creates a `Slam`, whose `process(frame)` returns a `SlamResult`: the `OdometryResult` with
  its `Registration` and `State` and, for a frame that became a `Keyframe`, the loops (`Edge`s) that were tried.
  `make_odometry` creates the odometry without a map. `open_session` creates or extends a map file; with a map from
  `open_for_localization` the map is not changed, and keyframes are localized in it (`LocalizationResult`).
  `OfflineRun(recording, config).run()` is `dpm2 run`.
* Network: `load_network(name, threads)` loads a network, whose `describe` computes the `Descriptors` of a frame, and
  whose `register` returns the `Registration` of two.
* Figures: `trajectory_png` draws a trajectory on its map, `matches_png` a registration; both need the extra `plot`.
* Errors: `Dpm2Error` is any failure, `UsageError` (a subclass) one that the caller can correct.

A program that runs other work next to the SLAM should call `dpm2_core.openmp.wait_passively()` before it imports numpy,
as `dpm2` and the ROS nodes do: an import sets no environment variable.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from dpm2_core._version import __version__ as __version__

if TYPE_CHECKING:  # `as` exports the names
    from dpm2_core.config import dump_settings as dump_settings
    from dpm2_core.config import load_settings as load_settings
    from dpm2_core.data.open import open_source as open_source
    from dpm2_core.data.settings import InputSettings as InputSettings
    from dpm2_core.data.source import Source as Source
    from dpm2_core.data.trajectory import write_kitti as write_kitti
    from dpm2_core.data.trajectory import write_tum as write_tum
    from dpm2_core.descriptors import Descriptors as Descriptors
    from dpm2_core.errors import Dpm2Error as Dpm2Error
    from dpm2_core.errors import UsageError as UsageError
    from dpm2_core.estimates import Edge as Edge
    from dpm2_core.estimates import Keyframe as Keyframe
    from dpm2_core.estimates import OdometryResult as OdometryResult
    from dpm2_core.estimates import Registration as Registration
    from dpm2_core.estimates import State as State
    from dpm2_core.evaluation.figures import trajectory_png as trajectory_png
    from dpm2_core.evaluation.matches import matches_png as matches_png
    from dpm2_core.frame import Camera as Camera
    from dpm2_core.frame import Fix as Fix
    from dpm2_core.frame import Frame as Frame
    from dpm2_core.frame import Guess as Guess
    from dpm2_core.frame import Image as Image
    from dpm2_core.frame import Inertial as Inertial
    from dpm2_core.network.pretrained import load_network as load_network
    from dpm2_core.pipeline import OfflineRun as OfflineRun
    from dpm2_core.slam.build import make_odometry as make_odometry
    from dpm2_core.slam.build import make_slam as make_slam
    from dpm2_core.slam.loops.localizer import LocalizationResult as LocalizationResult
    from dpm2_core.slam.session import open_for_localization as open_for_localization
    from dpm2_core.slam.session import open_session as open_session
    from dpm2_core.slam.settings import Config as Config
    from dpm2_core.slam.settings import SlamSettings as SlamSettings
    from dpm2_core.slam.system import Slam as Slam
    from dpm2_core.slam.system import SlamResult as SlamResult

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
    "frame": "Camera Fix Frame Guess Image Inertial",
    "network.pretrained": "load_network",
    "pipeline": "OfflineRun",
    "slam.build": "make_odometry make_slam",
    "slam.loops.localizer": "LocalizationResult",
    "slam.session": "open_for_localization open_session",
    "slam.settings": "Config SlamSettings",
    "slam.system": "Slam SlamResult",
}
"""The public names by the module that defines them, as under TYPE_CHECKING above."""
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names.split()}
__all__ = ["__version__", *_MODULE_OF]


if not TYPE_CHECKING:  # with __getattr__, type checkers would accept any name of this module

    def __getattr__(name: str) -> object:
        if name not in _MODULE_OF:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
        globals()[name] = value  # next time it is found without this function
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
