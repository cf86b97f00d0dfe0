# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The node's help around an identification, and the live estimate that its status tells.

    ~/next_pose          where to measure next, after every sample
    ~/workspace_error    the errors over the workspace, after every accepted identification
    ~/joint_trajectory   -> ~/compensated_joint_trajectory

All is computed on one separate thread, in pieces, while messages are taken. On one core the next
pose takes about 15 ms, the cloud 0.3 s, 10,000 points of a trajectory 0.1 s, and 0.3 s with
velocities; the estimate 0.02 s, and half a second with fifty targets.
"""

from __future__ import annotations

import copy
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import lru_cache
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.qos import qos_profile_services_default
from rclpy.serialization import deserialize_message
from scipy.spatial import cKDTree
from sensor_msgs.msg import JointState, PointCloud2
from trajectory_msgs.msg import JointTrajectory

from calib_ros.apply.candidates import draw_candidates
from calib_ros.apply.choice import Choice
from calib_ros.apply.compensation import in_words, knowledge
from calib_ros.apply.compensator import Compensator
from calib_ros.apply.design import Design
from calib_ros.apply.program import compensate_program
from calib_ros.apply.workspace import survey
from calib_ros.errors import MOST_ENTRIES, CalibrationError, InputError
from calib_ros.estimation.configurations import STILL
from calib_ros.estimation.observations import SOME_POSES
from calib_ros.files.programs import RATES, trajectory_program
from calib_ros.identification.calibration import Calibration
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.ros import to_ros
from calib_ros.sampling.cdr import trajectory_size
from calib_ros.sampling.sample import Sample
from calib_ros.sampling.session import CalibrationSession
from calib_ros.settings import Settings
from calib_ros.shown import some

CLOUD = 10 * MOST_ENTRIES  # points of the error cloud (0.3 s)
MOST_POINTS = Settings.pose_buffer  # points of a trajectory; longer ones are refused
MOST_SIZE = 400 * MOST_POINTS
"""Bytes of a serialised trajectory: ten joints with all rates take 352 a point."""
MOST_QUEUED = qos_profile_services_default.depth
"""Trajectories that may wait; further ones are refused."""


class Guide:
    """Publishes help before and after an identification.

    `guarded` wraps a function to log its exceptions. The next pose is chosen among `candidates`
    (N, n), or among random ones within the limits.
    """

    def __init__(
        self,
        node: Node,
        session: CalibrationSession,
        guarded: Callable[[Callable[..., None]], Callable[..., None]],
        candidates: FloatArray | None,
    ) -> None:
        self._node, self._session, self._guarded = node, session, guarded
        self._candidates = candidates
        self._pool = ThreadPoolExecutor(1)
        self._pending: set[Future[None]] = set()
        self._lock = threading.Lock()
        self._advised: tuple[Sample, ...] = ()
        self._advising: Future[None] | None = None
        self._last_trajectory = ''
        self._next_pose = node.create_publisher(JointState, '~/next_pose', to_ros.LATCHED)
        self._errors = node.create_publisher(PointCloud2, '~/workspace_error', to_ros.LATCHED)
        self._corrected = node.create_publisher(
            JointTrajectory, '~/compensated_joint_trajectory', MOST_QUEUED
        )
        taken, size = self._guarded(self._on_trajectory), MOST_QUEUED  # raw: see `_too_large`
        node.create_subscription(JointTrajectory, '~/joint_trajectory', taken, size, raw=True)

    def join(self, timeout: float) -> bool:
        """Start nothing more and wait [s] for running work; return whether it has ended."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        running = [each for each in self._pending if not each.cancelled()]
        return not wait(running, timeout).not_done

    def figures(self) -> dict[str, Any]:
        """Return the diagnostics: progress of sampling, and the last trajectory."""
        estimate = self._session.estimate
        settings = self._session.settings
        if estimate is not None and estimate.astray(settings.largest_error):
            estimate = None
        known = {} if estimate is None else {'expected [mm]': f'{1e3 * estimate.sigma:.4f}'}
        enough = estimate is not None and estimate.enough(settings.wanted_accuracy)
        return known | {'enough samples': enough, 'last trajectory': self._last_trajectory}

    def advise(self) -> None:
        """Update the estimate, then search the next pose if there are new samples.

        A failure is raised by the next call.
        """
        before = self._advising
        if before is None or before.done():
            samples = tuple(self._session.usable)
            self._advising = self._start(self._advise, self._session.learning(), samples)
            if before is not None:
                before.result()

    def show(self, calibration: Calibration, world: str) -> None:
        """Publish the errors over the workspace of a calibration with its base in a frame."""
        self._start(self._guarded(self._show), calibration, world)

    def _start(self, work: Callable[..., None], *arguments: Any) -> Future[None]:
        with self._lock:  # identifications call from their own thread
            future = self._pool.submit(work, *arguments)
            self._pending = {each for each in self._pending if not each.done()} | {future}
        return future

    def _advise(self, learn: Callable[[], object], samples: tuple[Sample, ...]) -> None:
        session = self._session
        learn()
        if samples == self._advised or session.settings.mode == 'continuous':
            return
        self._advised = samples
        estimate = session.estimate
        try:
            problem = session.problem_of(samples)
            design = Design.of(problem, estimate)
        except CalibrationError:  # shown by the status, or nothing to fit, or distances
            return
        taken = np.concatenate([each.joints for each in problem.sets])
        if estimate is None:
            design = design.after(taken)
        rng = np.random.default_rng(len(taken))
        candidates = self._candidates
        if candidates is None:
            candidates = draw_candidates(design, SOME_POSES, rng)
        candidates = _untaken(candidates, taken)
        best, names = np.empty(0), self._session.joint_names if len(candidates) else ()
        if len(candidates):
            best = candidates[Choice(design, candidates).best(1)[0]]
        self._next_pose.publish(to_ros.joints(names, best, self._now()))  # none left: empty

    def _show(self, calibration: Calibration, world: str) -> None:
        points = survey(calibration, CLOUD, np.random.default_rng(0)).cloud
        base = calibration.chain.frame('base').matrix
        points[:, :3] = points[:, :3] @ base[:3, :3].T + base[:3, 3]
        fields = ('x', 'y', 'z', 'error', 'sigma')
        self._errors.publish(to_ros.cloud(fields, points, world, self._now()))

    def _on_trajectory(self, data: bytes) -> None:
        if sum(not each.done() for each in self._pending) > MOST_QUEUED:
            self._refuse(f'{MOST_QUEUED} others are already waiting; send them more slowly')
        elif too_large := _too_large(data):
            self._refuse(too_large)
        else:
            self._start(self._guarded(self._correct), data, self._session.calibration)

    def _correct(self, data: bytes, calibration: Calibration | None) -> None:
        try:
            message = deserialize_message(data, JointTrajectory)
            corrected, self._last_trajectory = self._corrected_by(message, calibration)
        except CalibrationError as err:
            self._refuse(str(err))
        else:
            self._corrected.publish(corrected)

    def _refuse(self, reason: str) -> None:
        self._last_trajectory = f'refused: {reason}'
        self._node.get_logger().warning(f'trajectory {self._last_trajectory}')

    def _corrected_by(self, message: Any, calibration: Calibration | None) -> tuple[Any, str]:
        if calibration is None:
            raise InputError('there is no accepted calibration: call ~/identify or ~/load')
        compensator = _compensator(self._session.chain, calibration)
        robot = dict(zip(self._session.joint_names, self._session.chain.joint_names, strict=True))
        names = [robot.get(name, name) for name in message.joint_names]
        points = [{key: list(getattr(point, key)) for key in RATES} for point in message.points]
        program = trajectory_program(names, points, 'the trajectory')
        corrected, result = compensate_program(compensator, program)
        words = in_words(compensator, result)
        if result.refusals:
            reasons = [f'point {each.sample + 1}: {each.reason}' for each in result.refusals]
            raise InputError('; '.join([words, *some(reasons)]))
        known, warning = knowledge(calibration, result)
        words = '; '.join(part for part in (words, known, warning) if part)
        if warning:
            self._node.get_logger().warning(f'trajectory: {warning}')
        answer = copy.deepcopy(message)
        for key in RATES:
            values = getattr(corrected, key)
            if values is not None:
                for point, row in zip(answer.points, values.tolist(), strict=True):
                    setattr(point, key, row)
        return answer, words

    def _now(self) -> Any:
        return self._node.get_clock().now().to_msg()


def _untaken(candidates: FloatArray, taken: FloatArray) -> FloatArray:
    """Return the candidates (M, n) that are none of the poses taken (N, n)."""
    far, _ = cKDTree(taken).query(candidates, p=np.inf, distance_upper_bound=STILL)
    return np.asarray(candidates[np.isinf(far)])


@lru_cache(maxsize=1)
def _compensator(nominal: Chain, calibration: Calibration) -> Compensator:
    return Compensator(nominal, calibration.chain, region=calibration.region)


def _too_large(data: bytes) -> str:
    """Return what exceeds the limits in a serialised trajectory; empty if it can be decoded.

    Decoding a million points takes many seconds, during which no other thread runs.
    """
    names, points = trajectory_size(data, MOST_ENTRIES)
    for count, most, what in (
        (len(data), MOST_SIZE, 'bytes'),
        (names, MOST_ENTRIES, 'joints'),
        (points, MOST_POINTS, 'points'),
    ):
        if count > most:
            return f'{count} {what}; the limit is {most}'
    return ''
