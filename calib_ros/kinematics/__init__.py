# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The arm: its chain, its errors by name, where it is and how it gets there. Numbers only."""
