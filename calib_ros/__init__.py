# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Kinematic calibration of industrial arms: DH errors from joint states and measured poses."""

__version__ = '0.1.0'
