# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the node says of itself once a second, whatever fails meanwhile."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node

from calib_ros.files.archive import Archive
from calib_ros.ros import to_ros
from calib_ros.ros.inputs import Inputs
from calib_ros.sampling.account import Account
from calib_ros.sampling.session import CalibrationSession


class Diagnostics:
    """Judges what goes on and publishes it.

    Parameters
    ----------
    node : Node
    session : CalibrationSession
    archive : Archive
    inputs : Inputs
    serial : str
        Of the robot.
    answers : callable
        Returns what else there is to say.

    """

    def __init__(
        self,
        node: Node,
        session: CalibrationSession,
        archive: Archive,
        inputs: Inputs,
        serial: str,
        answers: Callable[[], dict[str, Any]],
    ) -> None:
        self._node, self._session, self._archive = node, session, archive
        self._inputs, self._serial, self._answers = inputs, serial, answers
        self._dropped_before: dict[str, int] = {}
        self._failed: dict[str, str] = {}
        self._logged: dict[str, str] = {}
        self._alike = 1
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)

    def tried(self, what: str, work: Callable[[], Any]) -> Any:
        """Return what a part of the work returns; None when it fails, which is told then."""
        try:
            return work()
        except Exception as err:
            self._failed[what] = f'{what} failed: {err!r}'
            if self._logged.get(what) != str(err):  # not every second
                self._logged[what] = str(err)
                self._node.get_logger().error(f'internal error: {traceback.format_exc()}')
            return None

    def publish(self, status: str) -> None:
        """Publish how it goes, with the status in words, and what failed since the last time."""
        self.tried('the rates', self._inputs.look)
        account = self.tried('the account', self._session.account)
        level, words = DiagnosticStatus.OK, ''
        figures: dict[str, Any] = {}
        if account is not None:
            judged = self.tried('judging', lambda: self._judged(account))
            level, words = judged or (level, words)
            figures = self.tried('the figures', lambda: self._figures(account)) or {}
        if self._failed:
            level = DiagnosticStatus.ERROR
            words = ''.join(f'{text}; ' for text in self._failed.values()) + words
            self._failed = {}
        name = f'{self._node.get_fully_qualified_name().lstrip("/")}: calibration'
        message = DiagnosticArray(
            status=[to_ros.status(name, self._serial, level, f'{words}{status}', figures)]
        )
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)

    def _judged(self, account: Account) -> tuple[bytes, str]:
        """Return how grave what is wrong is, and what it is in words."""
        wrong = [*self._namesakes(), *self._inputs.troubles()]
        fresh = {
            cause: count
            for cause, count in account.dropped.items()
            if count > self._dropped_before.get(cause, 0)
        }
        self._dropped_before = account.dropped
        if fresh:
            wrong.append(f'messages are dropped ({", ".join(fresh)})')
        level = DiagnosticStatus.WARN if wrong else DiagnosticStatus.OK
        if self._archive.trouble:
            level = DiagnosticStatus.ERROR
        return level, ''.join([self._archive.trouble, *(f'{text}; ' for text in wrong)])

    def _namesakes(self) -> list[str]:
        """Return in words that there are other nodes of the same name; log it when they come."""
        node = self._node
        me = (node.get_name(), node.get_namespace())
        count = node.get_node_names_and_namespaces().count(me)
        before, self._alike = self._alike, count
        if count < 2:
            return []
        words = (
            f'{count} nodes are called {node.get_fully_qualified_name()}, and all of them answer '
            'services: end one, or rename it (-r __node:=NAME)'
        )
        if before < 2:
            node.get_logger().warning(f'{words}. One that was killed counts for some seconds')
        return [words]

    def _figures(self, account: Account) -> dict[str, Any]:
        session = self._session
        delay = session.delay
        return {
            'robot': session.chain.name,
            'recording': session.recording,
            'calibrated': session.calibration is not None,
            **self._answers(),
            'joint states': account.joint_states,
            'poses': account.poses,
            'poses waiting': account.waiting,
            'samples': account.samples,
            'held-out samples': account.held_out,
            'configurations': account.configurations,
            'journal': self._archive.journal or '',
            'delay [s]': 'not known' if delay is None else f'{delay.seconds:.4f}',
            **self._inputs.figures(),
            **{f'not used {cause}': count for cause, count in account.unused.items()},
            **{f'dropped {cause}': count for cause, count in account.dropped.items()},
            **{f'note {cause}': count for cause, count in account.notes.items()},
        }
