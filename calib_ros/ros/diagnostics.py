# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The node's diagnostics, once a second, whatever else fails."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from calib_ros.files.archive import Archive
from calib_ros.ros.boundary import Boundary
from calib_ros.ros.inputs import Inputs
from calib_ros.sampling.account import Account, Cause
from calib_ros.sampling.session import CalibrationSession


class Diagnostics:
    """Judge the state of the node and publish it."""

    def __init__(
        self,
        node: Node,
        session: CalibrationSession,
        archive: Archive,
        inputs: Inputs,
        boundary: Boundary,
        serial: str,
    ) -> None:
        self._node, self._session, self._archive = node, session, archive
        self._inputs, self._boundary, self._serial = inputs, boundary, serial
        self._dropped_before: dict[Cause, int] = {}
        self.unloaded = ''  # why no calibration was loaded at the start, if one was wanted
        self._alike = 1
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)

    def publish(self, status: str, answers: Callable[[], Mapping[str, Any]]) -> None:
        """Publish the state, the status and failures since the last time.

        `answers` returns the results of calls and requests.
        """
        tried = self._boundary.tried
        tried('the rates', self._inputs.look)
        account = tried('the account', self._session.account)
        judged = account and tried('judging', lambda: self._judged(account))
        found = account and tried('the figures', lambda: {**self._figures(account), **answers()})
        level, words = judged or (DiagnosticStatus.OK, '')
        if failed := self._boundary.failed:
            level = DiagnosticStatus.ERROR
            words = ''.join(f'{text}; ' for text in failed.values()) + words
            failed.clear()
        line = DiagnosticStatus(
            name=f'{self._node.get_fully_qualified_name().lstrip("/")}: calibration',
            hardware_id=self._serial,
            level=level,
            message=f'{words}{status}',
            values=[KeyValue(key=key, value=str(value)) for key, value in (found or {}).items()],
        )
        message = DiagnosticArray(status=[line])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)

    def _judged(self, account: Account) -> tuple[bytes, str]:
        unloaded = '' if self._session.calibration else self.unloaded
        wrong = [*filter(None, [unloaded]), *self._namesakes(), *self._inputs.troubles()]
        if not self._node.get_clock().now().nanoseconds:
            wrong.append('use_sim_time is set, but /clock gives no time: published stamps are 0')
        before, self._dropped_before = self._dropped_before, account.dropped
        fresh = [cause for cause, count in account.dropped.items() if count > before.get(cause, 0)]
        if fresh:
            wrong.append(f'messages are dropped ({", ".join(fresh)})')
        doubt = wrong or self._session.doubtful  # of what the status says
        level = DiagnosticStatus.WARN if doubt else DiagnosticStatus.OK
        if self._archive.trouble or unloaded:
            level = DiagnosticStatus.ERROR
        return level, ''.join([self._archive.trouble, *(f'{text}; ' for text in wrong)])

    def _namesakes(self) -> list[str]:
        """Return a warning about other nodes of the same name; log it when they appear."""
        node = self._node
        me = (node.get_name(), node.get_namespace())
        count = node.get_node_names_and_namespaces().count(me)
        before, self._alike = self._alike, count
        if count < 2:
            return []
        words = (
            f'{count} nodes are named {node.get_fully_qualified_name()}, and all of them answer '
            'services: stop one, or rename it (-r __node:=NAME)'
        )
        if before < 2:
            node.get_logger().warning(f'{words}. A killed node still counts for some seconds')
        return [words]

    def _figures(self, account: Account) -> dict[str, Any]:
        session = self._session
        delay = session.delay
        return {
            'robot': session.chain.name,
            'recording': session.recording,
            'calibrated': session.calibration is not None,
            'joint states': account.joint_states,
            'poses': account.poses,
            'poses waiting': account.waiting,
            'samples': account.samples,
            'held-out samples': account.held_out,
            'configurations': account.configurations,
            'journal': self._archive.journal or '',
            'delay [s]': 'not known' if delay is None else f'{round(delay.seconds, 2) + 0.0:.2f}',
            **self._inputs.figures(),
            **{f'not used {cause}': count for cause, count in account.unused.items()},
            **{f'dropped {cause}': count for cause, count in account.dropped.items()},
            **{f'note {cause}': count for cause, count in account.notes.items()},
        }
