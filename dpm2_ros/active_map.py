# SPDX-License-Identifier: Apache-2.0
"""The map that a node works on, with its file: one that grows, or one that stays as it is, to find oneself in."""

from __future__ import annotations

from itertools import count
from pathlib import Path
from typing import Any

from dpm2_core.config import dump_settings
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.frame import Array, Keyframe, LoopClosure, State
from dpm2_core.slam.loops.localiser import Localiser, Located
from dpm2_core.slam.map.mapper import Mapper
from dpm2_core.slam.map.session import open_for_localisation, open_session
from dpm2_core.slam.map.store import MapStore
from dpm2_core.slam.output import save_map
from dpm2_core.slam.system import make_localiser, make_mapper
from dpm2_ros.settings import NodeConfig


class ActiveMap:
    """It grows by keyframes, unless `localiser` is set. Methods are for one thread; any thread may read.

    Attributes:
        mapper: of the map, whether it grows or not.
        localiser: finds the robot in a map that stays as it is; None while the map grows.
        located: what became of the last keyframe in a map that stays as it is.

    Raises:
        UsageError: `localization_mode` without a map that would serve.
    """

    mapper: Mapper

    def __init__(self, config: NodeConfig, robot: str, log: Any) -> None:
        """`robot`: whose node it is; `log`: a ROS logger."""
        self._config, self._robot, self._log = config, robot, log
        self._path = Path(config.ros.map_file)  # written, or to be found in
        self._store: MapStore | None = None
        self.localiser: Localiser | None = None
        self.located: Located | None = None
        self._T_map_odom: dict[str, Array] | None = None  # by robot, while the map grows; None before any keyframe
        if config.ros.localization_mode:
            self._load()
        else:
            self._begin()

    def T_map_odom(self, robot: str) -> Array | None:
        """(4, 4) of a robot; None while its place in the map is not known."""
        if (localiser := self.localiser) is not None:
            return localiser.T_map_odom if localiser.state.located else None
        placed = self._T_map_odom
        if placed is None:
            return self.mapper.T_map_odom if robot == self._robot else None
        return placed.get(robot)

    def add(self, keyframe: Keyframe) -> list[LoopClosure]:
        """Take a keyframe in, or find it; returns the loops that were tried."""
        if self.localiser is not None:
            self._locate(self.localiser, keyframe)
            return []
        closures, before = self.mapper.add(keyframe), self._T_map_odom or {}
        found = {robot: self.mapper.T_map_odom_of(robot) for robot in self.mapper.robots}
        placed = self._T_map_odom = {robot: T for robot, T in found.items() if T is not None}
        for robot in placed.keys() - before.keys():
            self._log.info(f"robot {robot or '/'}: its place in the map is known")
        return closures

    def localise(self) -> str:
        """End the map that grows, if it does, and look for the robot in the file; says so in words.

        Raises:
            UsageError, Dpm2Error: there is no file that would serve; what was before goes on.
        """
        growing = self.localiser is None
        if growing:
            if self._store is None:
                raise UsageError("no map to find oneself in: ros.map_file is empty, or could not be written")
            self.close()  # what is in memory is in the file
        try:
            self._load()
        except Dpm2Error:
            if growing:
                self._resume()
            raise
        return f"looking for the robot in {self._path}, {len(self.mapper.keyframes)} keyframes"

    def extend(self) -> str:
        """Let the map grow in which the robot was looked for, by a new session; says so in words.

        Raises:
            UsageError: the robot's place is not known. Dpm2Error: the file cannot be written.
        """
        if (localiser := self.localiser) is None:
            return f"a map is being made already, {len(self.mapper.keyframes)} keyframes"
        if not localiser.state.located:
            raise UsageError(f"not extended: the robot is {localiser.state} in {self._path}")
        self.close()
        self._resume()
        self.mapper.start_session(localiser.T_map_odom)
        self._T_map_odom, self.localiser, self.located = None, None, None
        return f"{self._path} grows by a new session"

    def restart(self) -> None:
        """The robot's odometry has started again: where it is, a loop or a search has to tell."""
        placed = self._T_map_odom or {}
        self._T_map_odom = {robot: T for robot, T in placed.items() if robot != self._robot}
        if self.localiser is not None:
            self.localiser.restart()

    def reset(self) -> None:
        """Begin an empty map; or, in a map that stays as it is, look for the robot anew."""
        if self.localiser is not None:
            self.localiser.restart()
            return
        self.close()
        self._begin()

    def save(self, directory: Path) -> str:
        """Cloud, trajectory and pose graph into a folder; says so in words.

        Raises:
            UsageError: there is nothing to save. Dpm2Error: it cannot be written.
        """
        if self.localiser is not None:
            raise UsageError("no map is saved: in localization_mode the map stays as it is, in its file")
        if not self.mapper.keyframes:
            raise UsageError("no map is saved: there is no keyframe yet")
        try:
            save_map(self.mapper, directory)
        except OSError as error:
            raise Dpm2Error(f"{directory}: no map saved: {error.strerror}") from None
        return f"map of {len(self.mapper.keyframes)} keyframes saved in {directory.resolve()}"

    def finish(self) -> None:
        """Do what still waits; the file stays open."""
        if self.localiser is None:
            self.mapper.finish()

    def close(self) -> None:
        """Everything that is known is in the file, which is closed."""
        self.finish()
        if self._store is not None:
            self._store.close()
            self._store = None

    def _begin(self) -> None:
        """An empty map, with a file if there is to be one. A file that cannot be made is no reason not to map."""
        ros = self._config.ros
        if ros.map_file:
            path = free_path(Path(ros.map_file), self._robot)
            try:
                self._store = open_session(path, self._config.slam, dump_settings(self._config), resume=False)
                self._path = path
            except Dpm2Error as error:
                self._log.error(f"no map file: {error}")
        self.mapper, self._T_map_odom = make_mapper(self._config.slam, self._store), None

    def _load(self) -> None:
        """The file, to find oneself in; what was before stays if that fails."""
        if not self._config.ros.map_file:
            raise UsageError("no map to find oneself in: ros.map_file is empty")
        store = open_for_localisation(self._path, self._config.slam)
        try:
            mapper = make_mapper(self._config.slam, store)
            localiser = make_localiser(self._config.slam, mapper)
        except BaseException:
            store.close()
            raise
        if self._store is not None:
            self._store.close()
        self._store, self.mapper, self.localiser, self.located = store, mapper, localiser, None

    def _resume(self) -> None:
        """Go on with the file."""
        self._store = open_session(self._path, self._config.slam, dump_settings(self._config), resume=True)
        self.mapper = make_mapper(self._config.slam, self._store)

    def _locate(self, localiser: Localiser, keyframe: Keyframe) -> None:
        before = localiser.state
        located = self.located = localiser.add(keyframe)
        if located.state is before:
            return
        if located.jumped:
            x, y, z = located.T_map_kf[:3, 3].tolist()
            kind = "kidnapped; found again" if before.located else "found"
            self._log.info(f"{kind} at ({x:.1f}, {y:.1f}, {z:.1f}) m of {self._config.ros.map_frame}")
        elif located.state in (State.LOST, State.DEGRADED):
            self._log.warning(f"{located.state}: {located.registration.reason}")


def free_path(path: Path, robot: str) -> Path:
    """The path with the robot's name, and with -2, -3, ... while there is a file of that name."""
    stem = f"{path.stem}_{robot.replace('/', '_')}" if robot else path.stem
    names = (stem if n == 1 else f"{stem}-{n}" for n in count(1))
    return next(p for name in names if not (p := path.with_name(name + path.suffix)).exists())
