# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Journals of an arm with two joints."""

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from calib_ros.files.archive import Archive
from calib_ros.sampling.sample import Sample


def sample(number, **more):
    return Sample(number, np.full(2, 0.1 * number), position=np.arange(3.0) + number, **more)


def open_archive(folder, robot='arm', joints=('a', 'b')):
    return Archive(folder, robot, joints, lambda: 'settings: none\n')


def written(folder, *numbers, robot='arm'):
    """Write a journal with samples of these numbers, and close it."""
    archive = open_archive(folder, robot)
    for number in numbers:
        archive.add(sample(number))
    archive.close()


def stamps(folder, robot='arm'):
    """Return the stamps that a resumed session has, while another may still write."""
    with TemporaryDirectory() as copy:
        shutil.copytree(folder, copy, dirs_exist_ok=True)
        archive = open_archive(Path(copy), robot)
        samples, _ = archive.resume()
        archive.close()
    return [each.stamp_ns for each in samples]
