# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The calibration in use: published, saved, loaded, and exported."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray, String

from calib_ros.atomic import confined, given_path, write_file
from calib_ros.errors import InputError, trouble
from calib_ros.files.archive import Archive
from calib_ros.files.export import exports, urdf_export
from calib_ros.files.vendor_files import vendor_files
from calib_ros.identification.calibration import Calibration, parse_calibration
from calib_ros.kinematics.chain_file import chain_text, parse_chain
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.ros import to_ros
from calib_ros.ros.boundary import Answer, Job
from calib_ros.ros.broadcast import Broadcast
from calib_ros.ros.parameters import NodeValues
from calib_ros.ros.to_ros import LATCHED
from calib_ros.sampling.sample import Sample
from calib_ros.sampling.session import CalibrationSession

FILENAMES = ('target_filename', 'calibration_filename')  # parameters that name files

UNSAVED = 'the calibration identified before was not saved: to get it, identify its poses again'


class Published(NamedTuple):
    """A calibration as the text of a file, with its settings, if known.

    `page` makes the report of its identification, which takes a while; it returns None if that is
    not possible.
    """

    text: str
    configuration: str
    page: Callable[[], str | None] = lambda: None


class Keeper:
    """Keeps the calibration of a session, its publishers and its files together.

    `adopted` is called with every calibration that comes into use, and the frame of its base.
    """

    def __init__(
        self,
        node: Node,
        session: CalibrationSession,
        archive: Archive,
        given: NodeValues,
        urdf: str,
        adopted: Callable[[Calibration, str], None],
    ) -> None:
        self._node, self._session, self._archive = node, session, archive
        self._given, self._urdf, self._adopted = given, urdf, adopted
        self._published = Published('', '')
        self.unsaved = False  # True if the calibration in use was identified and not saved
        self._lock = threading.Lock()  # identifications end on their own thread
        self._posed: tuple[int, Sequence[float]] | None = None
        self._dh_parameters = node.create_publisher(Float64MultiArray, '~/dh_parameters', LATCHED)
        self._calibration = node.create_publisher(String, '~/calibration', LATCHED)
        for name in FILENAMES:
            self._named(name)  # refuse bad names at the start
        self._broadcast = Broadcast(node, given, urdf)
        self._corrected_pose = node.create_publisher(PoseStamped, '~/corrected_pose', 10)

    def adopt(
        self,
        calibration: Calibration,
        published: Published,
        samples: Sequence[Sample] | None = None,
    ) -> None:
        """Use a calibration (`CalibrationSession.adopt`)."""
        with self._lock:
            self._session.adopt(calibration, samples)
            self._published, self.unsaved = published, samples is not None
            self._dh_parameters.publish(to_ros.dh_parameters(calibration.chain))
            self._calibration.publish(String(data=published.text))
            self._broadcast.publish(calibration)
        self._adopted(calibration, self._world(calibration))

    def save(self) -> Job:
        """Return what saves the calibration, to `target_filename` as it is now."""
        if not self._published.text:
            raise InputError(
                'there is no accepted calibration to save: ~/identify must accept one first'
            )
        return partial(self._save, self._published, self._named('target_filename'))

    def _save(self, published: Published, target: Path | None) -> Answer:
        """Write a calibration to the target or a new file, and its report beside it.

        Return success, and where. The calibration is saved even without the report.
        """
        path = self._archive.save(published.text, published.configuration, target)
        if published is self._published:
            self.unsaved = False
        written = [path]
        try:
            page = published.page()
            if page is not None:
                report = path.with_suffix('.html')
                write_file(report, page)
                written.append(report)
        except Exception as err:  # the calibration is saved without the page
            self._node.get_logger().warning(f'the report of {path} is not written: {trouble(err)}')
        text = f'saved to {", ".join(map(str, written))}'
        if target not in (None, self._named('calibration_filename')):  # not the newest by its name
            text += '; to load it set calibration_filename to it'
        return True, text

    def at_start(self) -> tuple[Path | None, bool]:
        """Return the calibration file found at startup, and whether to load it."""
        named = self._named('calibration_filename')
        path = named or self._archive.newest_calibration()
        return path, path is not None and (named is not None or self._given.autoload)

    def load(self) -> str:
        """Load the calibration in `calibration_filename` or the newest one; return which."""
        path, _ = self.at_start()
        session = self._session
        if path is None:
            there = f'{session.chain.name} in {self._archive.folder}'
            how = 'call ~/identify and ~/save first, or set calibration_filename'
            raise InputError(f'there is no saved calibration of {there}: {how}')
        text = _calibration_text(path)
        calibration = parse_calibration(text, str(path), session.chain, session.settings)
        calibration.serial_of(str(path), self._given.serial)
        lost = f'; {UNSAVED}' * self.unsaved
        self.adopt(calibration, Published(text, ''))
        return f'{path}, {calibration.whose}{lost}'

    def export(self) -> Job:
        """Return what writes the calibration in all formats, checked at the samples."""
        session = self._session
        if session.calibration is None:
            raise InputError('there is no calibration to export: call ~/identify or ~/load first')
        joints = np.array([sample.joints for sample in session.samples])
        with self._lock:
            return partial(self._export, session.calibration, joints if len(joints) else None)

    def _export(self, calibration: Calibration, joints: FloatArray | None) -> Answer:
        chain, record = calibration.chain, calibration.record
        nominal, links = self._session.chain, self._given.links
        forms = exports(chain, nominal, joints, record)
        forms += vendor_files(chain, nominal, record, self._urdf, links)
        if self._urdf:
            forms += (urdf_export('corrected.urdf', self._urdf, chain, links),)
        files = {each.name: each.content for each in forms}
        return True, f'{len(files)} files exported to {self._archive.export(files)}'

    def publish_pose(self) -> None:
        """Publish the corrected pose of the latest joint values, once."""
        calibration, latest = self._session.calibration, self._session.latest
        if calibration is None or latest is None or latest is self._posed:
            return
        if {'base', 'tool'} & {*calibration.outdated}:
            return
        self._posed = latest
        stamp_ns, values = latest
        pose = to_ros.pose(calibration.chain, values, stamp_ns, self._world(calibration))
        self._corrected_pose.publish(pose)

    def _world(self, calibration: Calibration) -> str:
        """Return the frame of the measurements, or the target of a camera on the flange."""
        seen = to_ros.in_hand(calibration.owners)
        return str(self._given.target_frame if seen else calibration.world_frame)

    def _named(self, parameter: str) -> Path | None:
        return self.file_of(parameter, self._node.get_parameter(parameter).value)

    def file_of(self, parameter: str, name: str) -> Path | None:
        """Return the file for a parameter's name; None without one."""
        if not name:
            return None
        if not name.endswith(('.yaml', '.yml')):
            raise InputError(f'{parameter} must end in .yaml or .yml')
        folders = self._archive.folder, *map(given_path, self._given.allowed_folders)
        allowed_by = f'choose {parameter} in data_dir, or start the node with allowed_folders'
        return confined(name, folders, allowed_by)


def _calibration_text(path: Path) -> str:
    """Return the text of a chain file; the content of other files must not leak."""
    if not path.is_file():
        how = "set calibration_filename to a saved one, or to '' for the newest"
        raise InputError(f'there is no file {path}: {how}')
    try:
        text = chain_text(path)
        parse_chain(text)
    except Exception as err:  # its text may quote the file
        if isinstance(err.__cause__, OSError):
            raise
        raise InputError(
            f'{path} is not a calibration: `calib_ros chain {path}` says what is wrong with it'
        ) from None
    return text
