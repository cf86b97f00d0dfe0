# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observations and a chain in, an identified chain out: accepted or refused, and why."""
