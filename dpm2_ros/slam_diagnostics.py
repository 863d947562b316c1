# SPDX-License-Identifier: Apache-2.0
"""The state of slam_node, on /diagnostics once per second."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from functools import partial

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus

from dpm2_core.data.frames import FrameBuilder
from dpm2_core.estimates import OdometryResult, State
from dpm2_ros.base_frame import BaseFrame
from dpm2_ros.diagnostics import ERROR, OK, STALE, WARN, mapper_status, message_status, publish_diagnostics, status
from dpm2_ros.guard import GuardedNode
from dpm2_ros.health import Health
from dpm2_ros.keyframe_sender import KeyframeSender
from dpm2_ros.mapping import BEHIND, MapperThread
from dpm2_ros.other_odometry import OtherOdometry
from dpm2_ros.state import SILENT
from dpm2_ros.subscriptions import Inputs
from dpm2_ros.synchronizer import StampCheck
from dpm2_ros.tf import TransformBroadcaster

OTHER_CLOCK = 1.0
"""A larger difference between a cloud's stamp and the node's clock, s, is reported as two different clocks."""

_LEVEL = {
    State.TRACKING: OK,
    State.INITIALIZING: OK,
    State.DEGRADED: WARN,
    State.RELOCALIZING: WARN,
    State.RELOCALIZED: OK,
    State.LOST: ERROR,
}


class Diagnostics:
    """Publishes the state of the odometry, the sensors and the mapper."""

    def __init__(
        self,
        node: GuardedNode,
        inputs: Inputs,
        frames: FrameBuilder,
        health: Health,
        keyframes: MapperThread | KeyframeSender,
        base: BaseFrame,
    ) -> None:
        """`keyframes`: the embedded mapper, or the sender of keyframes to a separate one."""
        self._node, self._inputs, self._frames, self._health = node, inputs, frames, health
        self._keyframes, self._base = keyframes, base
        self.tf_problem = ""
        """Why the node's pose is not on /tf, in words."""
        self.other: OtherOdometry | None = None
        """Another odometry, if there is one."""
        self.tf: TransformBroadcaster | None = None
        """Sends the pose on /tf."""
        self._lost_before = self._dropped_before = 0
        self._status = partial(status, node)
        publish_diagnostics(node, self._statuses)

    def _statuses(self) -> list[DiagnosticStatus]:
        out = [self._odometry()]
        calibration = self._inputs.calibration
        for part, camera in zip(("camera", "second camera"), calibration.cameras, strict=False):
            out.append(self._sensor_status(part, "image", camera.topic))
        if calibration.second_topic:
            out.append(self._sensor_status("second lidar", "cloud", calibration.second_topic))
        if (imu := self._imu()) is not None:
            out.append(imu)
        if self._inputs.gnss is not None:
            out.append(self._gnss())
        if self.other is not None:
            out.append(self._other_odometry(self.other))
        keyframes = self._keyframes
        if isinstance(keyframes, KeyframeSender):
            arrived, made = keyframes.arrived
            text = f"{arrived} of {made} keyframes have arrived at the mapper"
            level = WARN if made - arrived > BEHIND else OK
            if problem := keyframes.problem:
                level, text = ERROR, f"{text}; {problem}"
            out.append(self._status("mapper", level, text, {"keyframes": made, "delivered": arrived}))
        elif keyframes.active.localizer is not None:
            out.append(self._localization(keyframes))
        else:
            out.append(mapper_status(self._node, keyframes))
        return [*out, message_status(self._node)]

    def account(self) -> str:
        """How many of all clouds sent since the first that arrived were processed, dropped or lost, in words. Call it
        while no cloud is being processed."""
        synchronizer, lost = self._inputs.synchronizer, self._inputs.losses.count
        received, waiting, processed = synchronizer.received, len(synchronizer), self._health.processed
        rejected = sum(
            synchronizer.counts[why] for why in (StampCheck.REPEATED, StampCheck.OUT_OF_ORDER, StampCheck.STRAY)
        )
        rare = {
            "rejected for their stamps": rejected,
            "still waiting": waiting,
            "ended by an internal error": received - rejected - synchronizer.dropped - waiting - processed,
        }
        return (
            f"{received + lost} clouds sent: {processed} processed, {synchronizer.dropped} dropped (queue full), "
            f"{lost} lost on the way" + "".join(f", {count} {what}" for what, count in rare.items() if count)
        )

    def _odometry(self) -> DiagnosticStatus:
        no_cloud, last = self._no_cloud(), self._health.last
        if no_cloud is not None or last is None:
            level, text = no_cloud or (OK, "the first cloud is being processed")
        else:
            found = [_tracking_condition(last), *self._further_conditions(last)]
            level, text = max(level for level, _ in found), "; ".join(text for _, text in found)
        return self._status("odometry", level, text, self._odometry_figures())

    def _odometry_figures(self) -> dict[str, object]:
        synchronizer, counts = self._inputs.synchronizer, self._inputs.synchronizer.counts
        figures = self._health.figures() | {
            "received": synchronizer.received,
            "lost on the way": self._inputs.losses.count,
            "dropped (queue full)": synchronizer.dropped,
            "rejected (stamp repeated)": counts[StampCheck.REPEATED],
            "rejected (stamp out of order)": counts[StampCheck.OUT_OF_ORDER],
            "rejected (stray stamp)": counts[StampCheck.STRAY],
            "restarts": counts[StampCheck.RESTARTED],
            "waiting": len(synchronizer),
        }
        if times := self._inputs.times:
            stamp, clock = (f"{ns * 1e-9:.3f}" for ns in times)
            figures |= {"cloud stamp (s)": stamp, "clock (s)": clock}
        return figures

    def _no_cloud(self) -> tuple[bytes, str] | None:
        """Level and reason, in words, if no cloud arrives; None if one has arrived recently."""
        topic, last = self._inputs.calibration.points_topic, self._inputs.synchronizer.last_arrival
        if not (text := _silence_text("cloud", topic, last)):
            return None
        if problem := self._inputs.problem(topic):
            return ERROR, problem
        if last is None and (found := self._inputs.candidates()):
            text += f"; point clouds are published on {', '.join(found)}"
        return STALE, text

    def _further_conditions(self, last: OdometryResult) -> list[tuple[bytes, str]]:
        """Further levels and texts, of the last result and of the clouds since the last message."""
        topic, log = self._inputs.calibration.points_topic, self._node.get_logger()
        dropped, lost = self._inputs.synchronizer.dropped, self._inputs.losses.count
        count, fields, clock = self._node.count_publishers(topic), self._frames.time_problem, self._clock_problem()
        if fields:
            log.warning(f"{topic}: {fields}", once=True)
        if last.times:
            log.warning(f"{topic}: {last.times}", once=True)
        if clock:
            log.warning(clock, once=True)
        found = (
            (OK, f"the motion across {last.breaks} pause(s) or lift(s) is not known" if last.breaks else ""),
            (ERROR, self._base.problem),
            (WARN, self.tf_problem),
            (WARN, self.tf.problem() if self.tf is not None else ""),
            (WARN, f"{count} publishers on {topic}: a drive has one LiDAR" if count > 1 else ""),
            (WARN, f"cannot keep up, {dropped} clouds dropped" if dropped > self._dropped_before else ""),
            (OK, fields),
            (OK, last.camera),
            (WARN, last.times),
            (WARN, clock),
            (WARN, f"{lost} clouds lost on the way" if lost > self._lost_before else ""),
        )
        self._dropped_before, self._lost_before = dropped, lost
        return [(level, text) for level, text in found if text]

    def _clock_problem(self) -> str:
        """How the clouds' clock differs from that of the node, in words; empty if it does not."""
        clock = self._node.get_clock().now().nanoseconds
        stamp, now = self._inputs.times or (clock, clock)  # clouds without a stamp get that of the clock
        if not now:
            return "use_sim_time is on, and /clock has no publisher"
        if abs(now - stamp) <= OTHER_CLOCK * 1e9:
            return ""
        if not self._node.get_parameter("use_sim_time").value:
            text = f"clouds are stamped {_date_text(stamp)}, the clock of this machine says {_date_text(now)}"
            return f"{text}: set the sensor's clock, or for a recording use_sim_time and /clock"
        return f"clouds are stamped {_date_text(stamp)}, /clock says {_date_text(now)}"

    def _localization(self, mapper: MapperThread) -> DiagnosticStatus:
        located, figures = mapper.active.located, {"keyframes of the map": str(mapper.keyframes)}
        if located is None:
            return self._status("localisation", WARN, f"{State.RELOCALIZING}: no keyframe yet", figures)
        result, last, state = located.registration, self._health.last, located.state
        if last is not None and last.state is State.LOST and state is not State.LOST:
            return self._status("localisation", ERROR, f"{State.LOST}: the odometry is lost", figures)
        text = str(state)
        if result.ok:
            figures |= {"confidence": f"{result.confidence:.2f}", "worst sigma (m)": f"{result.worst_sigma:.3f}"}
        else:
            text += f": {result.reason}"
        level, problem = _LEVEL[state], mapper.tf.problem()
        if problem:
            level, text = max(level, WARN), f"{text}; {problem}"
        return self._status("localisation", level, text, figures)

    def _other_odometry(self, other: OtherOdometry) -> DiagnosticStatus:
        verdict = other.verdict
        text = f"{verdict}; going on without" if other.problem else verdict or "in use"
        figures: dict[str, object] = {
            "clouds with it": other.found,
            "without": other.missed,
            "outweighed": other.outweighed,
        }
        if not np.isnan(other.slip):
            figures |= {"its distances too long by (%)": f"{100 * other.slip:.1f}"}
        return self._status("other odometry", WARN if verdict else OK, text, figures)

    def _imu(self) -> DiagnosticStatus | None:
        """None if there is no IMU and no setting requests one."""
        inputs, last, topic = self._inputs, self._health.last, self._inputs.calibration.imu_topic
        problem = inputs.problem(topic) or self._frames.problems.get(topic, "")
        if not problem and not inputs.imu_received:
            if inputs.imu is None or not self._node.get_parameter("input.imu_topic").value:
                return None
            problem = f"no usable message on {topic} yet"
        if not problem and last is not None and last.imu:
            problem = last.imu
            self._node.get_logger().warning(f"{topic}: {problem}; going on without the IMU", once=True)
        problem = problem or _silence_text("sample", topic, inputs.imu_last)  # also if no cloud arrives
        text = f"{problem}; going on without" if problem else "in use"
        return self._status("imu", WARN if problem else OK, text, {"received": inputs.imu_received})

    def _gnss(self) -> DiagnosticStatus:
        inputs, located = self._inputs, None
        problem = self._fix_problem() or self._frames.problems.get(inputs.calibration.gnss_topic)
        if isinstance(self._keyframes, MapperThread):
            located = self._keyframes.active.mapper.graph.georeference
        text = "in use" if located is not None else "the map's place on Earth is not known yet"
        return self._status("gnss", WARN if problem else OK, problem or text, {"received": inputs.gnss_received})

    def _fix_problem(self) -> str:
        """Why no fix arrives, or why the fixes are unusable, in words; else empty."""
        last, clouds, topic = self._inputs.gnss_last, self._inputs.times, self._inputs.calibration.gnss_topic
        stamp, arrival = last or (0, None)
        if problem := self._inputs.problem(topic) or _silence_text("fix", topic, arrival):
            return problem
        ahead = (stamp - clouds[0]) * 1e-9 if clouds else 0.0
        return f"stamps of another clock, {ahead:+.0f} s from the clouds'" if abs(ahead) > OTHER_CLOCK + SILENT else ""

    def _sensor_status(self, part: str, what: str, topic: str) -> DiagnosticStatus:
        """Status of a sensor other than the LiDAR; `part` is its name, `what` that of its messages."""
        sensor = self._inputs.synchronizer.sensors[topic]
        figures = {"received": sensor.received, "matched": sensor.matched, "late": sensor.late}
        if subscription_problem := self._inputs.problem(topic):
            level, text = ERROR, subscription_problem
        elif silence := _silence_text(what, topic, sensor.last_arrival):
            level, text = WARN, silence
        elif problem := self._frames.problems.get(topic):
            level, text = ERROR, problem
        elif not sensor.fits:
            level, text = WARN, f"{what}s come too late or have stamps of another clock"
        else:
            return self._status(part, OK, "in use", figures)
        return self._status(part, level, f"{text}; going on without", figures)


def _tracking_condition(last: OdometryResult) -> tuple[bytes, str]:
    """Level of the state, and the state with its reason."""
    level, registration = _LEVEL[last.state], last.registration
    if last.failed:
        level = max(level, WARN)  # also at the start, as for clouds in millimeters, with no point in range
    return level, f"{last.state}: {registration.reason}" if registration.reason else str(last.state)


def _date_text(stamp: int) -> str:
    """A stamp in ns as text."""
    date = datetime.fromtimestamp(stamp // 10**9, UTC)
    return f"{stamp * 1e-9:.3f} s ({date:%Y-%m-%d %H:%M:%S} UTC)"


def _silence_text(what: str, topic: str, last_arrival: float | None) -> str:
    """Text if no message has arrived on a topic recently; else empty. `what`: the kind of its messages, in one word."""
    if last_arrival is None:
        return f"no {what} on {topic} yet"
    silence = time.monotonic() - last_arrival
    return f"no {what} on {topic} for {silence:.0f} s" if silence > SILENT else ""
