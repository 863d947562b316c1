# SPDX-License-Identifier: Apache-2.0
"""The map that a node works on, with its file: a map that grows, or a fixed one to localize in."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

from dpm2_core.config import dump_settings
from dpm2_core.errors import Dpm2Error, UsageError
from dpm2_core.estimates import Edge, Keyframe, State, isotropic
from dpm2_core.frame import Array
from dpm2_core.slam.build import make_map, make_slam
from dpm2_core.slam.loops.localizer import LocalizationResult, Localizer
from dpm2_core.slam.mapping.mapper import Mapper
from dpm2_core.slam.mapping.tiles import TiledMap
from dpm2_core.slam.output import save_map
from dpm2_core.slam.session import check_for_localization, open_for_localization, open_session
from dpm2_core.slam.store.map_file import left_log, remove_map
from dpm2_core.slam.store.map_store import MapStore
from dpm2_ros.map_folder import MapFolder, map_file_of
from dpm2_ros.settings import NodeConfig

AUTO = "auto"
_MAP_COVARIANCE = isotropic(0.01, 0.1)  # possible error of the map itself around a robot localized in it


class ActiveMap:
    """A map that grows by keyframes, unless the SLAM has a localizer. Methods are for one thread; any thread may read.

    Attributes:
        slam: the SLAM system that works on the map; another map is put in there.
        located: result of the last keyframe in a fixed map.
        file_problem: why the map has no file, in words; empty if it has one, or if none is wanted.

    Raises:
        UsageError: `localization_mode` without a usable map.
    """

    def __init__(self, config: NodeConfig, robot: str, log: Any) -> None:
        """`robot`: name of the node's robot; `log`: a ROS logger."""
        self._config, self._robot, self._log = config, robot, log
        ros = config.ros
        self._maps = MapFolder(Path(ros.map_directory) if ros.map_directory else None, robot)
        self._path = Path(ros.map_file) if ros.map_file not in ("", AUTO) else None  # written, or to localize in
        self._folders: dict[str, Path] = {}  # folders of this drive, by the name under which it was saved
        self._copies: dict[Path, Path] = {}  # the copy saved last under a name, by the path that the name stands for
        self.located: LocalizationResult | None = None
        self.file_problem = ""
        self._unreadable = False  # whether a keyframe of the map to localize in could not be read
        self._T_map_odom: dict[str, Array] | None = None  # by robot, while the map grows; None before any keyframe
        self._store: MapStore | TiledMap | None = (
            self._open_read_only() if ros.localization_mode else self._create_first_file()
        )
        # background: gtsam holds Python's global lock while it works, and the odometry must not wait
        self.slam = make_slam(config.slam, robot, self._store, background=True)

    @property
    def mapper(self) -> Mapper:
        return self.slam.mapper

    @property
    def localizer(self) -> Localizer | None:
        return self.slam.localizer

    def T_map_odom(self, robot: str) -> Array | None:
        """(4, 4) map -> odom of a robot; None while its pose in the map is not known."""
        if (localizer := self.localizer) is not None:
            return localizer.T_map_odom if localizer.state.located else None
        placed = self._T_map_odom
        if placed is None:
            return self.mapper.T_map_odom if robot == self._robot else None
        return placed.get(robot)

    def add(self, keyframe: Keyframe) -> list[Edge]:
        """Add a keyframe to the map, or localize it; returns the loops that were tried.

        Raises:
            RejectedError: it is invalid; see `Mapper.add`.
        """
        if self.localizer is not None:
            self._localize(keyframe, self.localizer)
            return []
        result, before = self.slam.map_step(keyframe), self._T_map_odom or {}
        found = {robot: self.mapper.T_map_odom_of(robot) for robot in self.mapper.robots}
        placed = self._T_map_odom = {robot: T for robot, T in found.items() if T is not None}
        for robot in placed.keys() - before.keys():
            self._log.info(f"robot {robot or '/'}: its place in the map is known")
        return result.loops

    def settle(self, wait: bool = False) -> bool:
        """Apply what another process has optimized to the map and to its robots' poses; see `Mapper.settle`."""
        if not self.mapper.settle(wait):
            return False
        if self._T_map_odom is not None:  # but not of a restarted robot: its last keyframe is from before
            found = {robot: self.mapper.T_map_odom_of(robot) for robot in self._T_map_odom}
            self._T_map_odom = {robot: T for robot, T in found.items() if T is not None}
        return True

    def localise(self, name: str = "") -> str:
        """End the growing map, if there is one, and localize the robot in its file; returns a message.

        Args:
            name: of another map in the folder of maps: the one that was saved last under this name, if any. A growing
                map without a file is saved in its folder first.

        Raises:
            UsageError, Dpm2Error: there is no usable file; the work before continues.
        """
        self._complete_file()
        requested, saved = self._maps.file(name) if name else None, ""
        path = None if requested is None else self._copies.get(requested, requested)
        if path is not None and (self._path is None or path.resolve() != self._path.resolve()):
            saved = self.keep() if self._store is None else ""  # else it would be lost
            self._switch_to(open_for_localization(path, self._config.slam))
        else:
            if self.localizer is None:
                self._check_localizable()
                self.close()  # before it is opened again: with a reader, FILE-wal would remain
            self._switch_to(self._open_read_only())
        searching = f"looking for the robot in {self._path}, {len(self.mapper.keyframes)} keyframes"
        return "; ".join(filter(None, (saved, searching)))

    def _check_localizable(self) -> None:
        """Raises UsageError unless the robot can be localized in the growing map."""
        if not isinstance(self._store, MapStore):
            raise UsageError("no map to localize in: ros.map_file is empty, or could not be written")
        if not self.mapper.keyframes:
            raise UsageError("no map to localize in: there is no keyframe yet")
        check_for_localization(self._store, self._config.slam)

    def _switch_to(self, store: MapStore | TiledMap) -> None:
        """Continue with an opened file; the map before is completed in its own file, if it has one."""
        try:
            made = make_map(self._config.slam, store, background=True)
            self.close()
        except BaseException:
            store.close()
            raise
        self._path, self._store, self._folders, self.file_problem = store.path, store, {}, ""
        self.located = self._T_map_odom = None
        self._unreadable = False
        self.slam.use(*made)

    def extend(self) -> str:
        """Extend the map in which the robot was localized by a new session; returns a message.

        Raises:
            UsageError: the robot's pose is not known, or the map is in tiles. Dpm2Error: the file cannot be written.
                Localization continues as before.
        """
        if (localizer := self.localizer) is None:
            return f"a map is being made already, {len(self.mapper.keyframes)} keyframes"
        located = self.located
        if located is None or not localizer.state.located:
            raise UsageError(f"not extended: the robot is {localizer.state} in {self._path}")
        if not isinstance(self._store, MapStore):
            raise UsageError(f"not extended: {self._path} is a folder of tiles, which cannot be extended")
        self._switch_to(open_session(self._store.path, self._config.slam, dump_settings(self._config), resume=True))
        self.mapper.start_session(localizer.T_map_odom, located.covariance + _MAP_COVARIANCE)
        return f"{self._path} is extended by a new session"

    def restart(self, robot: str) -> None:
        """A robot's odometry has restarted: a loop closure or a relocalization must find its pose."""
        placed = self._T_map_odom or {}
        self._T_map_odom = {other: T for other, T in placed.items() if other != robot}
        self.mapper.forget_start()
        if self.localizer is not None:
            self.localizer.restart()

    def keep(self) -> str:
        """Save all that `reset` would end, in the file and in the folder, if there are any; returns a message.

        A map whose file could not be created is only in the folder: the next one may have a file.

        Raises:
            Dpm2Error: it cannot be written.
        """
        self._complete_file()
        return self._save("") if self.saves and self.mapper.keyframes else ""

    def reset(self) -> None:
        """Begin an empty map; or, in a fixed map, search for the robot anew."""
        if self.localizer is not None:
            self.localizer.restart()
        else:
            self.close()
            self._store = self._create_file()
            self.slam.use(*make_map(self._config.slam, self._store, background=True))
            self._T_map_odom = None

    @property
    def saves(self) -> bool:
        """Whether `save` has a folder to write into."""
        return self._maps.folder is not None and self.localizer is None

    def save(self, name: str = "") -> str:
        """Write cloud, trajectory and pose graph into the drive's own folder; returns a message.

        Args:
            name: of the folder and of a copy of the map file; with a number, if another drive has this name. Empty:
                the drive's own name, and no copy.

        Raises:
            UsageError: there is nothing to save. Dpm2Error: it cannot be written; or the map file is incomplete or
                could not be created: then the folder is written, but no copy.
        """
        text = self._save(name)
        if self.file_problem:
            raise Dpm2Error(text)
        return text

    def _save(self, name: str) -> str:
        """As `save`, but only reports in the message why a map file could not be created."""
        if (folder := self._maps.folder) is None:
            raise UsageError("no map is saved: ros.map_directory is empty")
        if self.localizer is not None:
            raise UsageError("no map is saved: in localization_mode the map stays as it is, in its file")
        if not self.mapper.keyframes:
            raise UsageError("no map is saved: there is no keyframe yet")
        self.settle(wait=True)
        try:
            folder = self._folders[name] = self._folders.get(name) or self._maps.claimed(name, self._path)
            save_map(self.mapper, folder)
        except OSError as error:
            raise Dpm2Error(f"{folder}: no map saved: {error.strerror}") from None
        file_moved = isinstance(self._store, MapStore) and not self._store.in_place  # its file, since the last keyframe
        if self.mapper.store_problem or file_moved:
            self.finish()  # tries to write again: there may be space by now
        if problem := self.mapper.store_problem:
            raise Dpm2Error(f"map saved in {folder.resolve()}, but its file is incomplete: {problem}")
        path = self._path
        if name and isinstance(self._store, MapStore):
            path = map_file_of(folder)
            self._store.copy_to(path)
            self._copies[self._maps.file(name)] = path
        file_note = f", and as {path.resolve()}" if self._store is not None and path is not None else ""
        if self.file_problem:
            file_note = f", but there is no map file: {self.file_problem}"
        unconnected = int((~self.mapper.placed).sum())
        missing_note = (
            f"; map.ply and trajectory.tum lack {unconnected} that no loop connects to the first" if unconnected else ""
        )
        return f"map of {len(self.mapper.keyframes)} keyframes saved in {folder.resolve()}{file_note}{missing_note}"

    def finish(self) -> None:
        """Complete the pending work; the file stays open."""
        self.slam.finish()

    def close(self) -> None:
        """Complete the file and close it; a file without a keyframe is removed."""
        self.finish()
        if self._store is not None:
            self._store.close()
            if self._path is not None and not self._store.read_only and not self.mapper.keyframes:
                remove_map(self._path)
                with suppress(OSError):  # it is not empty
                    self._path.parent.rmdir()
            self._store = None

    def _complete_file(self) -> None:
        """Complete the file, if there is one.

        Raises:
            Dpm2Error: it cannot be written, and the map continues in memory.
        """
        self.finish()
        if self.mapper.store_problem:
            raise Dpm2Error(f"map file incomplete, the map continues: {self.mapper.store_problem}")

    def _create_first_file(self) -> MapStore | None:
        """A new map file; warns if the requested one exists already, as after a crash: it is not continued."""
        store, name = self._create_file(), self._config.ros.map_file
        if store is not None and name != AUTO and self._path != (requested := self._maps.of_robot(Path(name))):
            existing = requested if requested.exists() else left_log(requested) or requested
            self._log.warning(
                f"{existing} exists already and is not changed: {self._path} is a new map without its drives"
            )
        return store

    def _create_file(self) -> MapStore | None:
        """A new map file, if one is wanted. If it cannot be created, the map is built without it."""
        ros, self._folders, self.file_problem = self._config.ros, {}, ""
        requested = self._maps.usual if ros.map_file == AUTO else Path(ros.map_file)
        if requested.name:
            try:
                self._path, store = self._create_unused_file(requested)
            except Dpm2Error as error:
                self.file_problem = str(error)
                self._log.error(f"no map file: {error}")
            else:
                self._log.info(f"map file: {self._path}")
                return store
        return None

    def _create_unused_file(self, requested: Path) -> tuple[Path, MapStore]:
        """A new map file. Neither its name nor that of the folder for its clouds exists yet."""
        for path in self._maps.free(requested):
            try:
                return path, open_session(path, self._config.slam, dump_settings(self._config), resume=False)
            except UsageError:
                if not path.exists():
                    raise
                continue  # another node has just taken the name
        raise AssertionError

    def _open_read_only(self) -> MapStore | TiledMap:
        """The map file or folder of tiles, opened read-only."""
        if self._path is None:
            raise UsageError("no map to localize in: ros.map_file does not name one" + self._maps.hint())
        return open_for_localization(self._path, self._config.slam)

    def _localize(self, keyframe: Keyframe, localizer: Localizer) -> None:
        """Localize a keyframe in the fixed map, and log changes of the state. An unreadable map cannot confirm it."""
        previous_state = localizer.state
        located = self.located = self.slam.map_step(keyframe).located
        assert located is not None
        if located.unreadable and not self._unreadable:  # once per map, not with each keyframe
            self._log.error(located.registration.reason)
            self._unreadable = True
        if located.state is previous_state:
            return
        if located.state is State.RELOCALIZED:
            x, y, z = located.T_map_kf[:3, 3].tolist()
            kind = "kidnapped; found again" if previous_state.located else "found"
            self._log.info(f"{kind} at ({x:.1f}, {y:.1f}, {z:.1f}) m in {self._config.ros.map_frame}")
        elif located.state in (State.LOST, State.DEGRADED):
            self._log.warning(f"{located.state}: {located.registration.reason}")
