# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The pages of this folder by Sphinx, as rosdoc2 calls it for docs.ros.org."""

project = 'calib_ros'
extensions = ['myst_parser']
myst_heading_anchors = 3
exclude_patterns = ['index.rst', 'reference.md']  # made by rosdoc2; for mkdocstrings
